"""What is said of each point beyond its place: the angles of its beam, how well it is known, what surface it lies on.

Some of this follows from the point and its pose, some from what lies around it. For the latter, the flight is
processed again, one stretch after the other. First all points of the stretch are gathered; for classes, all beams are
followed; then each point is processed again, in the same order. A stretch ends at a limit of memory, so the cost is
linear and the memory bounded.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import ConfigError
from flightlog.mount import Mount
from groundproc.cloud import cleaning, freespace
from groundproc.cloud.beams import Beams
from groundproc.cloud.mixing import Mixing
from groundproc.cloud.points import Points
from groundproc.cloud.pointsigma import Errors, MountErrors
from groundproc.cloud.surroundings import Surroundings
from groundproc.cloud.voxelnumbers import VoxelNumbers
from groundproc.machine import readahead
from groundproc.machine.system import give_back_memory
from groundproc.sensors.model import Ranging
from groundproc.trajectory.trajectory import Trajectory

Stream = Callable[[], Iterator[Points]]
Array = npt.NDArray[np.float64]

NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "scan_angle": ("scan_angle",),
    "incidence": ("incidence",),
    "sigma": ("sigma_h", "sigma_v"),
    "classes": ("classification", "mixed"),
    "strip": ("point_source_id",),
}
"""What can be asked for, and the columns that it fills."""
_LAST_LINE: Final = 65535
_OF_SURROUNDINGS: Final = frozenset({"incidence", "classes"})


@dataclass(frozen=True, slots=True)
class Scene:
    """What the attributes follow from.

    Attributes
    ----------
    trajectory : Trajectory
    mount : Mount
    mount_errors : MountErrors
    ranging : Ranging
    line_begins_ns : ndarray of int64, shape (k,)
        When each flight line but the first begins.
    """

    trajectory: Trajectory
    mount: Mount
    mount_errors: MountErrors
    ranging: Ranging
    line_begins_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))


def wanted(names: tuple[str, ...] | None) -> frozenset[str]:
    """The attributes that a survey asks for; all where it does not say.

    Raises
    ------
    ConfigError
        There is none of that name.
    """
    for name in names or ():
        if name not in NAMES:
            raise ConfigError(f"attributes: {name!r} found, expected some of {', '.join(NAMES)}")
    return frozenset(NAMES if names is None else names)


def passes(names: frozenset[str]) -> int:
    """How often the flight is gone through for some attributes."""
    return 3 if "classes" in names else 2 if names & _OF_SURROUNDINGS else 1


@dataclass(slots=True)
class Found:
    """What was found of the points, counted.

    Attributes
    ----------
    classes : dict of int to int
        Points of each class.
    mixed : int
        Points that are echoes of two surfaces.
    stretches : list of cleaning.Stretch
        One for each stretch of flight that was cleaned.
    points : int
        How many there are, where that is known before the first of them is handed on: the flight is one stretch. Else 0.
    """

    classes: dict[int, int] = field(default_factory=dict)
    mixed: int = 0
    stretches: list[cleaning.Stretch] = field(default_factory=list)
    points: int = 0

    def add(self, points: Points) -> None:
        """Count points."""
        if "classification" in points and "mixed" in points:
            for number, count in enumerate(np.bincount(points["classification"])):
                if count:
                    self.classes[number] = self.classes.get(number, 0) + int(count)
            self.mixed += int(np.count_nonzero(points["mixed"]))

    def tell(self) -> dict[str, Any]:
        """For quality.json; empty where nothing was cleaned."""
        if not self.stretches:
            return {}
        doubtful = [each.contradicted for each in self.stretches if not each.trusted]
        warning = (
            f"in {len(doubtful)} of {len(self.stretches)} stretches of the flight beams pass through {max(doubtful):.1%} of the voxels at "
            "another time, walls among them: the path does not come back to where it was, and nothing is classed as moving or mixed there; "
            "is the mount that of this flight (method adjusted estimates it, `swath calibrate` too), and do clocks and trajectory fit?"
            if doubtful
            else ""
        )
        return {
            "classes": {str(each): self.classes[each] for each in sorted(self.classes)},
            "mixed": self.mixed,
            "warning": warning,
        }


def described(stream: Stream, scene: Scene, names: frozenset[str], found: Found | None = None) -> Iterator[Points]:
    """Points with their attributes, in their order.

    Parameters
    ----------
    stream : callable
        Goes through all points of the flight anew, in the local frame, in pieces; the same ones each time.
    scene : Scene
    names : frozenset of str
        Of `NAMES`.
    found : Found, optional
        Is added to.
    """
    found = Found() if found is None else found
    if not names & _OF_SURROUNDINGS:
        yield from (_with_attributes(points, scene, names, None) for points in stream())
        return
    ahead, along, behind = (stream() for _ in range(3))
    for stretch in itertools.count():
        around, voxels, pieces, count = _gathered(ahead, scene)
        if not pieces:
            return
        if not stretch and not around.full:
            found.points = count
        around.find_planes()
        classes: cleaning.Classes | None = None
        if "classes" in names:
            classes = cleaning.classify(around, _looked(around, voxels.beside(itertools.islice(along, pieces)), scene))
            found.stretches.append(classes.of_stretch)
        around.keep_planes_only()
        mixing = Mixing(around) if classes is not None and classes.of_stretch.trusted else None
        give_back_memory()  # while points are handed on, the products take the most
        for points, voxel in voxels.beside(itertools.islice(behind, pieces)):
            points = _with_attributes(points, scene, names, _Known(around, classes, mixing, voxel))
            found.add(points)
            yield points
        del around, voxels, classes, mixing  # the next stretch takes their memory


@dataclass(frozen=True, slots=True)
class _Known:
    """What lies around some points of a stretch, and their voxels; where asked for, classes of these and, if trusted, what is mixed."""

    around: Surroundings
    classes: cleaning.Classes | None
    mixing: Mixing | None
    voxel: npt.NDArray[np.int32]


def _looked(
    around: Surroundings, pieces: Iterable[tuple[Points, npt.NDArray[np.int32]]], scene: Scene
) -> freespace.Looks:
    """What the beams of a stretch, its points with their voxels, passed through, as `freespace.Evidence` has it."""
    lookout = freespace.Lookout(around)

    def rays() -> Iterator[tuple[Any, ...]]:
        for points, voxel in pieces:
            if len(points):
                origins = Beams.of(points.time_ns, scene.trajectory, scene.mount).origins(points.time_ns)
                yield points.xyz_m, origins, points.time_ns, voxel

    with contextlib.closing(readahead.ahead(rays())) as made:
        for some in made:
            lookout.look_along(*some)
            del some  # the next piece takes their memory
    return lookout.evidence.open_looks


def _gathered(ahead: Iterator[Points], scene: Scene) -> tuple[Surroundings, VoxelNumbers, int, int]:
    """The surroundings of the next stretch of flight, the voxels of its points, and the numbers of its pieces and of its points."""
    around, pieces, count = Surroundings(), 0, 0
    voxels = VoxelNumbers(around)
    for points in ahead:
        pieces, count = pieces + 1, count + len(points)
        if len(points):
            beams = Beams.of(points.time_ns, scene.trajectory, scene.mount)
            voxels.keep(around.add(points.xyz_m, points.time_ns, beams.origins(points.time_ns)))
        if around.full:
            break
    return around, voxels, pieces, count


def _with_attributes(points: Points, scene: Scene, names: frozenset[str], known: _Known | None) -> Points:
    """One piece with its attributes."""
    if not len(points):
        return points
    beams = Beams.of(points.time_ns, scene.trajectory, scene.mount)
    origins = beams.origins(points.time_ns)
    columns: dict[str, npt.NDArray[Any]] = {}
    slant = None
    if "scan_angle" in names:
        columns["scan_angle"] = beams.scan_angle_deg(points.xyz_m, points.time_ns, origins)
    if "strip" in names:
        line = np.searchsorted(scene.line_begins_ns, points.time_ns, side="right") + 1
        columns["point_source_id"] = np.minimum(line, _LAST_LINE).astype(np.uint16)
    if known is not None:
        slant = known.around.incidence_deg(points.xyz_m, origins, known.voxel)
        if "incidence" in names:
            columns["incidence"] = slant
        if known.classes is not None:
            columns["classification"] = known.classes.of_voxel[known.voxel]
            columns["mixed"] = (
                np.zeros(len(points), np.uint8)
                if known.mixing is None
                else known.mixing.of(points.xyz_m, origins, known.voxel)
            )
    if "sigma" in names:
        errors = Errors.of(points.time_ns, scene.trajectory, scene.mount, scene.mount_errors)
        columns["sigma_h"], columns["sigma_v"] = errors.sigmas_m(
            points.xyz_m, points.time_ns, origins, scene.ranging, slant
        )
    return points.with_columns(**columns)
