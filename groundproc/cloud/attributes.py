"""What is said of each point beyond its place: the angles of its beam, how well it is known, what surface it lies on.

Some of it follows from the point and its pose, some from what lies around it. For that the flight is gone through twice, one stretch after
the other: first all points of the stretch are gathered, then each is looked at again, in the same order. A stretch ends where memory
does, so the cost is linear and the memory bounded.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import ConfigError
from flightlog.mount import Mount
from groundproc.cloud.beams import Beams
from groundproc.cloud.points import Points
from groundproc.cloud.pointsigma import Errors, MountErrors
from groundproc.cloud.surroundings import Surroundings
from groundproc.sensors.model import Ranging
from groundproc.trajectory.trajectory import Trajectory

Stream = Callable[[], Iterator[Points]]
Array = npt.NDArray[np.float64]

NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "scan_angle": ("scan_angle",),
    "incidence": ("incidence",),
    "sigma": ("sigma_h", "sigma_v"),
}
"""What can be asked for, and the columns that it fills."""
_OF_SURROUNDINGS: Final = frozenset({"incidence"})


@dataclass(frozen=True, slots=True)
class Scene:
    """What the attributes follow from.

    Attributes
    ----------
    trajectory : Trajectory
    mount : Mount
    mount_errors : MountErrors
    ranging : Ranging
    """

    trajectory: Trajectory
    mount: Mount
    mount_errors: MountErrors
    ranging: Ranging


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
    return 2 if names & _OF_SURROUNDINGS else 1


def described(stream: Stream, scene: Scene, names: frozenset[str]) -> Iterator[Points]:
    """Points with their attributes, in their order.

    Parameters
    ----------
    stream : callable
        Goes through all points of the flight anew, in the local frame, in pieces; the same ones each time.
    scene : Scene
    names : frozenset of str
        Of `NAMES`.
    """
    if not names & _OF_SURROUNDINGS:
        yield from (_with_attributes(points, scene, names, None) for points in stream())
        return
    ahead, behind = stream(), stream()
    while True:
        around, pieces = _gathered(ahead)
        if not pieces:
            return
        around.find_planes()
        for points in itertools.islice(behind, pieces):
            yield _with_attributes(points, scene, names, around)
        del around  # the next stretch takes its memory


def _gathered(ahead: Iterator[Points]) -> tuple[Surroundings, int]:
    """The surroundings of the next stretch of flight, and the number of its pieces."""
    around, pieces = Surroundings(), 0
    for points in ahead:
        pieces += 1
        if len(points):
            around.add(points.xyz_m, points.time_ns, points["range"])
        if around.full:
            break
    return around, pieces


def _with_attributes(points: Points, scene: Scene, names: frozenset[str], around: Surroundings | None) -> Points:
    """One piece with its attributes."""
    if not len(points):
        return points
    beams = Beams.of(points.time_ns, scene.trajectory, scene.mount)
    origins = beams.origins(points.time_ns)
    columns: dict[str, npt.NDArray[Any]] = {}
    slant = None
    if "scan_angle" in names:
        columns["scan_angle"] = beams.scan_angle_deg(points.xyz_m, points.time_ns, origins)
    if around is not None:
        slant = around.incidence_deg(points.xyz_m, origins, around.of(points.xyz_m))
        columns["incidence"] = slant
    if "sigma" in names:
        errors = Errors.of(points.time_ns, scene.trajectory, scene.mount, scene.mount_errors)
        columns["sigma_h"], columns["sigma_v"] = errors.sigmas_m(
            points.xyz_m, points.time_ns, origins, scene.ranging, slant
        )
    return points.with_columns(**columns)
