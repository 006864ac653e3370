"""A flight cut into revolutions of the scanner: deskewed with a trajectory, and ready to be placed again under trims of it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.cloud import georeference
from groundproc.flight.shots import shots as shots_of
from groundproc.flight.timeline import Leg
from groundproc.sensors.shots import Gate, turns
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

LONGEST_NS: Final = NS_PER_S // 2
"""A revolution that lasts longer has a hole in it: 5 Hz is the slowest the rotor turns."""
LEAST_POINTS: Final = 100


@dataclass(frozen=True, slots=True)
class Revolution:
    """The points of one turn of the scanner.

    Attributes
    ----------
    time_ns : int
        UTC of its middle.
    position_m : ndarray, shape (3,)
        INS at that time, local frame.
    angles_rad : ndarray, shape (3,)
        Heading, pitch, roll at that time.
    turned_m : ndarray of float32, shape (n, 3)
        From the INS to each point when it was measured, east north up: what a trim of an angle turns.
    base_m : ndarray of float32, shape (n, 3)
        The INS when each point was measured, from `position_m`: what no trim turns.
    """

    time_ns: int
    position_m: Array
    angles_rad: Array
    turned_m: Floats
    base_m: Floats

    def __len__(self) -> int:
        return len(self.turned_m)

    def turn(self, trim_rad: Array) -> Array:
        """The matrix, shape (3, 3), by which trims of heading, pitch and roll turn `turned_m`.

        Source: step 3 of the geometry, with (yaw + yaw_trim, pitch + pitch_trim, roll + roll_trim) for the attitude. The trims of
        pitch and roll turn about axes of the revolution's middle; over its 0.1 s that is right to some hundredths of the trim.
        """
        trimmed = frames.mat_local_ins(*(self.angles_rad + trim_rad))
        return np.asarray(trimmed @ frames.mat_local_ins(*self.angles_rad).T)

    def height_m(self) -> Floats:
        """Heights of the points over the INS at the middle, shape (n,)."""
        return np.asarray(self.turned_m[:, 2] + self.base_m[:, 2])

    def thinned(self, pixel_m: float, half_width_m: float) -> "Revolution":
        """One point for each pixel seen from above: the mean of those in it."""
        n = 2 * int(np.ceil(half_width_m / pixel_m))
        return Revolution(
            self.time_ns,
            self.position_m,
            self.angles_rad,
            *_thinned(self.turned_m, self.base_m, pixel_m, np.full(n * n, -1, np.int32), n),
        )

    def some(self, chosen: npt.NDArray[np.bool_]) -> "Revolution":
        """Those of its points that a mask, shape (n,), chooses."""
        return Revolution(self.time_ns, self.position_m, self.angles_rad, self.turned_m[chosen], self.base_m[chosen])


def revolutions(
    readers: Sequence[LogReader],
    timeline: Sequence[Leg],
    trajectory: Trajectory,
    mount: Mount,
    gate: Gate,
    progress: Callable[[int], None],
) -> Iterator[Revolution]:
    """Stream the revolutions of a flight; those without pose or with next to no points are left out.

    Parameters
    ----------
    readers, timeline
        As for the cloud.
    trajectory : Trajectory
        What the trims will be of.
    mount : Mount
    gate : Gate
    progress : callable
        Called with the number of file bytes done since the last call.
    """
    times: list[npt.NDArray[np.int64]] = []
    places: list[Array] = []
    azimuth_rad: float | None = None
    first_ns, last_ns = 0, 0
    for shots in shots_of(readers, timeline, gate, progress=progress):
        if not len(shots):
            continue
        # cut straight behind, where the airframe hides the view
        silent = np.flatnonzero(np.diff(shots.time_ns, prepend=last_ns) > LONGEST_NS)
        azimuth = shots.azimuth_rad
        cuts = np.union1d(turns(azimuth, azimuth_rad), silent)
        points = georeference.georeference(shots, trajectory, mount)
        edges = np.searchsorted(points.time_ns, shots.time_ns[cuts])
        start = 0
        for cut, edge in zip(cuts, edges, strict=True):
            times.append(points.time_ns[start:edge])
            places.append(points.xyz_m[start:edge])
            if first_ns:
                end_ns = int(shots.time_ns[cut - 1]) if cut else last_ns
                yield from _revolution(first_ns, end_ns, times, places, trajectory)
            times, places, start, first_ns = [], [], edge, int(shots.time_ns[cut])
        times.append(points.time_ns[start:])
        places.append(points.xyz_m[start:])
        azimuth_rad, last_ns = float(azimuth[-1]), int(shots.time_ns[-1])
    if first_ns:
        yield from _revolution(first_ns, last_ns, times, places, trajectory)


@njit(cache=True, nogil=True)
def _thinned(turned: Any, base: Any, pixel: float, place: Any, n: int) -> Any:
    out_turned, out_base = np.zeros_like(turned), np.zeros_like(base)
    number = np.zeros(len(turned), np.int32)
    count = 0
    for i in range(len(turned)):
        column = int(np.floor((turned[i, 0] + base[i, 0]) / pixel)) + n // 2
        row = int(np.floor((turned[i, 1] + base[i, 1]) / pixel)) + n // 2
        if column < 0 or row < 0 or column >= n or row >= n:
            continue
        at = row * n + column
        if place[at] < 0:
            place[at] = count
            count += 1
        k = place[at]
        number[k] += 1
        for axis in range(3):
            out_turned[k, axis] += turned[i, axis]
            out_base[k, axis] += base[i, axis]
    for k in range(count):
        for axis in range(3):
            out_turned[k, axis] /= number[k]
            out_base[k, axis] /= number[k]
    return out_turned[:count].copy(), out_base[:count].copy()


def _revolution(
    first_ns: int,
    last_ns: int,
    times: list[npt.NDArray[np.int64]],
    places: list[Array],
    trajectory: Trajectory,
) -> Iterator[Revolution]:
    """One revolution of the parts it was read in; none where it is too thin or its middle has no pose."""
    time_ns, place = np.concatenate(times), np.concatenate(places)
    if len(time_ns) < LEAST_POINTS or last_ns - first_ns > LONGEST_NS:
        return
    middle_ns = (first_ns + last_ns) // 2
    middle, covered = trajectory.where_covered(np.array([middle_ns]))
    if not covered[0]:
        return
    poses, known = trajectory.where_covered(time_ns)
    ins = poses.position_m[known]
    angles = frames.attitude_of(frames.mat_from_quat(middle.quat_local_ins_wxyz[0]))
    yield Revolution(
        middle_ns,
        middle.position_m[0],
        np.array([float(angle) for angle in angles]),
        (place[known] - ins).astype(np.float32),
        (ins - middle.position_m[0]).astype(np.float32),
    )
