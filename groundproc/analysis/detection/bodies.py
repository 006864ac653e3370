"""From a place that scores to a body: its own plane on top, its sides, and how likely it is something solid."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from groundproc.analysis.detection.targets import SIZES_M, TURNS, Target

Array = npt.NDArray[np.float64]

AROUND_M: Final = 4.5
"""Points so far from a place are looked at."""
_FLAT_M: Final = 0.06
"""Sigma of a roof or bonnet about its plane, noise included."""
_THICKET_M: Final = 0.35
"""Leaves spread over so much at least, one sigma."""
_RANGE_M: Final = 3.0
_SOLID: Final = 0.8
"""Share of a body's points that are on its plane."""
_ON_M: Final = 0.2
_STEPS_M: Final = tuple(np.arange(0.25, 1.3, 0.1))
"""A bonnet or a bed is so much lower than the rest."""
_STARTS: Final = (-0.15, 0.0, 0.15, 0.3)
"""Where it begins, in lengths from the middle."""
_GROUND_SOLID, _GROUND_THICKET = 0.03, 0.15
_MOST: Final = 80
"""Points that count, of any number: neighbours are no independent witnesses."""


@dataclass(frozen=True, slots=True)
class Body:
    """Something solid.

    Attributes
    ----------
    middle_m : ndarray, shape (3,)
        Of its top.
    length_m, width_m, height_m : float
        Height is above the ground.
    turn_rad : float
        Of its length, from east.
    points : int
        Above the ground and within its outline.
    score : float
        Logarithm of how much likelier its points are by a body than by a thicket.
    """

    middle_m: Array
    length_m: float
    width_m: float
    height_m: float
    turn_rad: float
    points: int
    score: float

    @property
    def outline(self) -> Array:
        """Corners in plan, shape (4, 2)."""
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        u = np.array([1, 1, -1, -1]) * self.length_m / 2
        v = np.array([1, -1, -1, 1]) * self.width_m / 2
        return np.asarray(self.middle_m[:2] + np.stack([c * u - s * v, s * u + c * v], axis=1))


def body(target: Target, place_m: Array, xyz_m: Array, above_m: Array, top_m: float, low_m: float) -> Body | None:
    """Look at a place more closely.

    Parameters
    ----------
    target : Target
    place_m : ndarray, shape (2,)
    xyz_m : ndarray, shape (n, 3)
        All points around it that came down.
    above_m : ndarray, shape (n,)
        Their heights above the ground.
    top_m : float
        Height of its top above the ground, as the layers have it.
    low_m : float
        What is lower counts as ground.
    """
    turn, sides = np.pi * target.turn / TURNS, SIZES_M[target.size]
    d = xyz_m[:, :2] - place_m
    u, v = d @ [np.cos(turn), np.sin(turn)], d @ [-np.sin(turn), np.cos(turn)]
    inside = (np.abs(u) < sides[0] / 2) & (np.abs(v) < sides[1] / 2)
    up = inside & (above_m >= low_m)
    if up.sum() < 4:
        return None
    design = np.column_stack([np.ones(len(d)), d])
    # the top is parallel to the ground under it, or nearly: heights above that are told by a mean, and a small tilt
    on = up & (np.abs(above_m - top_m) < 0.3)
    for _ in range(4):
        if on.sum() < 4:
            return None
        tilt = design[on].T @ design[on] + np.diag([1e-6, 20.0, 20.0])
        plane = np.linalg.solve(tilt, design[on].T @ above_m[on])
        residual = above_m - design @ plane
        on = up & (np.abs(residual) < _ON_M)
    score = _score(residual[up], u[up] / sides[0], int((inside & ~up).sum()), above_m[up])
    near = (above_m >= low_m) & (np.abs(residual) < _ON_M) & (np.hypot(u, v) < AROUND_M)
    near &= (np.abs(u) < sides[0] / 2 + 0.6) & (np.abs(v) < sides[1] / 2 + 0.6)
    length, width, angle, middle = _sides(xyz_m[near, :2])
    height = float(np.median(above_m[on]))
    z = float(np.median(xyz_m[on, 2]))
    return Body(np.append(middle, z), length, width, height, angle, int(up.sum()), score)


def _score(residual_m: Array, along: Array, ground: int, above_m: Array) -> float:
    """How much likelier heights and ground pulses are by a body than by a thicket, as a logarithm.

    Places along its length are told in lengths from the middle.
    """
    sigma = max(float(above_m.std()), _THICKET_M)
    spread = np.exp(-0.5 * ((above_m - above_m.mean()) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    thicket = np.log(0.8 * spread + 0.2 / _RANGE_M)
    gain = _solid(residual_m, along) - float(thicket.sum())
    gain += len(above_m) * float(np.log((1 - _GROUND_SOLID) / (1 - _GROUND_THICKET)))
    gain += ground * float(np.log(_GROUND_SOLID / _GROUND_THICKET))
    return gain * min(1.0, _MOST / (len(above_m) + ground))


def _solid(residual_m: Array, along: Array) -> float:
    """Logarithm of the likelihood of heights by one flat top, or by one with a bonnet or a bed at one end.

    The best of all ends and steps is as likely as it is less their number.
    """
    whole = _flat(residual_m)
    lower = np.stack([_flat(residual_m + step) for step in _STEPS_M])
    beyond = np.stack([side * along > start for side in (-1.0, 1.0) for start in _STARTS])
    ends = (lower - whole) @ beyond.T
    return float(whole.sum()) + max(0.0, float(ends.max()) - float(np.log(ends.size)))


def _flat(residual_m: Array) -> Array:
    """Logarithm of the density of points of a flat top, by their distance from it."""
    flat = np.exp(-0.5 * (residual_m / _FLAT_M) ** 2) / (_FLAT_M * np.sqrt(2 * np.pi))
    return np.asarray(np.log(_SOLID * flat + (1 - _SOLID) / _RANGE_M))


def _sides(xy_m: Array) -> tuple[float, float, float, Array]:
    """Length, width, turn and middle of the smallest rectangle around points."""
    if len(xy_m) < 3:
        return 0.0, 0.0, 0.0, xy_m.mean(axis=0)
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shapely.MultiPoint(xy_m)))
    if len(corners) < 5:
        return float(np.linalg.norm(np.ptp(xy_m, axis=0))), 0.0, 0.0, xy_m.mean(axis=0)
    a, b = corners[1] - corners[0], corners[2] - corners[1]
    if np.linalg.norm(a) < np.linalg.norm(b):
        a, b = b, a
    return float(np.linalg.norm(a)), float(np.linalg.norm(b)), float(np.arctan2(a[1], a[0])), corners[:4].mean(axis=0)
