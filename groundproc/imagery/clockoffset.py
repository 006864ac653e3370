"""By how many seconds a camera's clock is off: the offset at which rays of common points fit the trajectory's poses best.

The bundle adjustment finds tenths of a second. A clock that was set by hand is off by seconds, and images then begin
tens of metres and several degrees wrong. Two rays of one point and the base between the two camera positions lie in a
plane, whatever the depth. The deviation from that, over all pairs, is least at the right offset, because attitudes
change from image to image, and strips of other headings move against each other.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.imagery.measurements import Measurements
from groundproc.imagery.poses import NO_TIME
from groundproc.imagery.rig import RigCamera
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SPAN_S: Final = 30.0
"""Offsets looked at, to both sides."""
_STEPS_S: Final = (0.1, 0.01)
_WITHIN: Final = 3.0
"""Of the clock's sigma: what is less far off is left to the adjustment."""
_BETTER: Final = 0.5
"""What is found leaves at most this share of what is left within those."""
_LEAST_PAIRS: Final = 50
_MOST_PAIRS: Final = 2000
_FLOOR_RAD: Final = 1e-3
"""Below this attitudes are no better."""


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Two sightings of one point: images, and rays in the ins frame, shape (n, 3)."""

    images: tuple[Ints, Ints]
    rays: tuple[Array, Array]


def found(
    trajectory: Trajectory, camera: RigCamera, own: npt.NDArray[np.bool_], time_ns: Ints, measured: Measurements
) -> float:
    """Seconds to be added to the shift of a camera's clock; 0 where the clock is right or nothing tells.

    Parameters
    ----------
    trajectory : Trajectory
    camera : RigCamera
    own : ndarray of bool, shape (i,)
        Images of this camera.
    time_ns : ndarray of int64, shape (i,)
        Stamps, before the rig's shift.
    measured : Measurements
    """
    pairs = _pairs(camera, own & (time_ns != NO_TIME), measured)
    if len(pairs.images[0]) < _LEAST_PAIRS or not camera.sigma.get("timeshift_s"):
        return 0.0
    stamps = time_ns + round(camera.timeshift_s * 1e9)
    tried = np.arange(-SPAN_S, SPAN_S + 0.5 * _STEPS_S[0], _STEPS_S[0])
    off = np.array([_off_rad(trajectory, stamps, pairs, camera, float(shift_s)) for shift_s in tried])
    near = np.abs(tried) <= _WITHIN * camera.sigma["timeshift_s"]
    best = int(np.argmin(off))
    if near[best] or not off[best] < _BETTER * off[near].min():
        return 0.0
    fine = tried[best] + np.arange(-_STEPS_S[0], _STEPS_S[0] + 0.5 * _STEPS_S[1], _STEPS_S[1])
    least = int(np.argmin([_off_rad(trajectory, stamps, pairs, camera, float(shift_s)) for shift_s in fine]))
    return round(float(fine[least]), 2)


def _pairs(camera: RigCamera, own: npt.NDArray[np.bool_], measured: Measurements) -> _Pairs:
    """Neighbours among the sightings of each point, and its first and last."""
    points = measured.points
    mine = np.flatnonzero(own[points.image])
    point = points.point[mine]
    _, first, count = np.unique(point, return_index=True, return_counts=True)
    follows = np.flatnonzero(point[1:] == point[:-1])
    ends = first[count > 2], (first + count - 1)[count > 2]
    one, two = np.concatenate([follows, ends[0]]), np.concatenate([follows + 1, ends[1]])
    if len(one) > _MOST_PAIRS:
        some = np.random.default_rng(1).choice(len(one), _MOST_PAIRS, replace=False)
        one, two = one[some], two[some]
    rays, reached = camera.camera.unproject(points.pixel[mine])
    good = reached[one] & reached[two]
    one, two, rays = one[good], two[good], rays @ camera.mat_cam_ins
    image = points.image[mine]
    return _Pairs((image[one], image[two]), (rays[one], rays[two]))


def _off_rad(trajectory: Trajectory, stamps: Ints, pairs: _Pairs, camera: RigCamera, shift_s: float) -> float:
    """How far second rays are from the planes of the first and the base: geometric mean; infinite where too few images are covered."""
    poses, covered = trajectory.where_covered(stamps + round(shift_s * 1e9))
    a, b = pairs.images
    both = covered[a] & covered[b]
    if both.sum() < max(_LEAST_PAIRS, 0.5 * len(a)):
        return float("inf")
    a, b = a[both], b[both]
    ins = frames.mat_from_quat(np.where(covered[:, None], poses.quat_local_ins_wxyz, [1.0, 0.0, 0.0, 0.0]))
    place = poses.position_m + ins @ camera.lever_arm_m
    one, two = (np.einsum("nij,nj->ni", ins[at], ray[both]) for at, ray in zip((a, b), pairs.rays, strict=True))
    base = place[b] - place[a]
    normal = np.cross(one, base)
    size = np.linalg.norm(normal, axis=1)
    apart = size > 1e-3 * np.linalg.norm(base, axis=1)
    if not apart.any():
        return float("inf")
    off = np.abs(np.einsum("ni,ni->n", normal, two)[apart] / size[apart])
    return float(np.exp(np.log(off + _FLOOR_RAD).mean()))
