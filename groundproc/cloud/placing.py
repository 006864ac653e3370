"""The stage that makes the cloud: every shot given its pose, placed, projected and handed on; and what became of each."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from flightlog.clock import utc_text
from flightlog.errors import CoverageError
from flightlog.mount import Mount
from groundproc import geodesy
from groundproc.cloud import georeference
from groundproc.cloud.points import Dropped, Points
from groundproc.cloud.selection import Selection
from groundproc.machine.readahead import ahead, beside
from groundproc.machine.system import give_back_memory
from groundproc.sensors.shots import Shots
from groundproc.trajectory.trajectory import Trajectory

FARTHEST_M: Final = 1e6
"""From the origin of the flight's frame."""


@dataclass(frozen=True, slots=True)
class Placed:
    """How many points were handed on, what became of the other shots, and what was left out by choice."""

    points: int
    dropped: Dropped
    left_out: Mapping[str, int]


class Sink(Protocol):
    """Takes the points of a flight as they are placed."""

    def begin(self) -> None:
        """Get ready: the first points come."""

    def add(self, points: Points) -> None:
        """Take some projected points; their arrays are not to be changed."""

    def finish(self) -> None:
        """All points were given."""


@dataclass(frozen=True, slots=True)
class Then:
    """A sink, and what is done when it is finished.

    Attributes
    ----------
    sink : Sink
    after : callable
    """

    sink: Sink
    after: Callable[[], None]

    def begin(self) -> None:
        """Get the sink ready."""
        self.sink.begin()

    def add(self, points: Points) -> None:
        """Hand it points."""
        self.sink.add(points)

    def finish(self) -> None:
        """Finish it, and go on."""
        self.sink.finish()
        self.after()


def placed(shots: Iterable[Shots], trajectory: Trajectory, mount: Mount) -> Iterator[Points]:
    """Shots, with times in UTC, as points of the flight's frame, piece by piece; those of a piece may be none."""
    for some in shots:
        yield without_strays(georeference.georeference(some, trajectory, mount))
        del some  # the next piece takes its memory


def handed_on(
    pieces: Iterable[Points],
    trajectory: Trajectory,
    projection: geodesy.Projection,
    sinks: Sequence[Sink],
    selection: Selection,
) -> Placed:
    """Project points of the flight's frame and hand them to the sinks, piece by piece; a thread makes the next one meanwhile.

    Parameters
    ----------
    pieces : iterable of Points
        Their places are written over.
    trajectory : Trajectory
        That they were placed with.
    projection : geodesy.Projection
        From the trajectory's frame.
    sinks : sequence of Sink
        That which takes longest to finish is the first: the others are finished beside it, by a thread.
    selection : Selection
        Which of the projected points are wanted.

    Raises
    ------
    CoverageError
        Not one point.
    """
    for sink in sinks:
        sink.begin()
    count, dropped = 0, Dropped()
    with contextlib.closing(ahead(iter(pieces))) as made:
        for points in made:
            dropped = dropped + points.dropped
            if len(points):
                project(points, projection)
                points = selection.of(points)
            if len(points):
                count += len(points)
                for sink in sinks:
                    sink.add(points)
            del points  # the next piece takes their memory
    if not count and any(selection.left_out.values()):
        raise CoverageError(_all_left_out(selection, trajectory))
    if not count:
        raise CoverageError(f"not one shot gives a point: {_why_nothing(dropped, trajectory)}")
    give_back_memory()  # finishing an octree takes much
    beside([sink.finish for sink in sinks])
    return Placed(count, dropped, dict(selection.left_out))


def _all_left_out(selection: Selection, trajectory: Trajectory) -> str:
    """Which choices left no point."""
    told = ", ".join(f"{count:,} by {name}" for name, count in selection.left_out.items() if count)
    start, end = int(trajectory.time_ns[0]), int(trajectory.time_ns[-1])
    return (
        f"not one point is left: {told}; expected a choice that some points meet; the flight goes from {utc_text(start)} to "
        f"{utc_text(end)}, {(end - start) * 1e-9:.1f} s"
    )


def _why_nothing(dropped: Dropped, trajectory: Trajectory) -> str:
    """What became of all shots."""
    if dropped.no_pose:
        return (
            f"the trajectory covers {utc_text(int(trajectory.time_ns[0]))} to {utc_text(int(trajectory.time_ns[-1]))}, and "
            f"{dropped.no_pose:,} shots lie outside it"
        )
    return (
        f"{dropped.outside_fov:,} lie outside the field of view (fov), {dropped.out_of_range:,} outside the range gate (min_range_m, "
        f"max_range_m), {dropped.no_return:,} have no return; is the lidar blocked, or looked it at nothing but the airframe?"
    )


def without_strays(points: Points) -> Points:
    """Points of the flight's frame whose places can be; the others are counted.

    Whatever a trajectory holds, no product gets a place that is no number: it would spoil extents and rasters.
    """
    count = int(georeference.strays(points.xyz_m, FARTHEST_M))
    if not count:
        return points
    kept = points.masked(np.asarray((np.abs(points.xyz_m) <= FARTHEST_M).all(axis=1)))
    return replace(kept, dropped=replace(points.dropped, impossible=points.dropped.impossible + count))


def project(points: Points, projection: geodesy.Projection) -> None:
    """Put points into the projected CRS, in place."""
    georeference.project(points.xyz_m, projection.polynomial(*georeference.extent(points.xyz_m)))
