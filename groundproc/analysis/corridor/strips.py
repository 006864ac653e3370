"""Low upright strips, such as fences, and stays: straight, steep, from a pole to the ground."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.chains import chained
from groundproc.analysis.corridor.poles import Pole
from groundproc.analysis.corridor.thin import VOXEL_M, thin_points
from groundproc.numerics.voxelhash import assign

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

FENCE_HEIGHTS_M: Final = (0.3, 2.5)
"""Of the points that fences are looked for in."""
_FENCE_TOP_M: Final = (0.7, 2.6)
_FENCE_RANGE_M: Final = 0.4
_FENCE_SHARE: Final = 0.8
"""Of its metres that have points, and of those that have them at all heights."""
_FENCE_M: Final = 8.0
_HEIGHTS: Final = 16
"""Points of a small square that are kept."""
_STEP_M: Final = 1.0
_STEEP: Final = 0.5
"""Rise of a stay, in its length."""
_STEEPEST: Final = 0.97
_STAY_FOOT_M: Final = 3.0
"""A stay goes on so far below its lowest point, if it meets the ground there."""
_STAY_ROUGH_M: Final = 0.15
_STAY_OFF_M: Final = 1.5


def low_strips(xyz_m: Array, above_m: npt.NDArray[np.float32], core: npt.NDArray[np.bool_]) -> Array:
    """Low points on lines in plan with nothing above them: place, direction, height above the ground, shape (n, 7).

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    above_m : ndarray, shape (n,)
        Heights above the ground.
    core : ndarray of bool, shape (n,)
        Which are asked for; the others are there for their neighbours.
    """
    cell = np.floor(xyz_m[:, :2]).astype(np.int64)
    key = cell[:, 0] * (1 << 32) + cell[:, 1]
    tall = np.unique(key[(above_m > FENCE_HEIGHTS_M[1] + 0.2) & (above_m < 6.0)])
    low = (above_m < FENCE_HEIGHTS_M[1]) & ~np.isin(key, tall)
    flat = np.column_stack([xyz_m[low, :2], np.zeros(int(low.sum()))])
    found = thin_points(flat, core[low])
    if not len(found.xyz_m):
        return np.empty((0, 7))
    # a line in plan has a direction; the points themselves are taken anew, all of them
    near = np.asarray(cKDTree(found.xyz_m[:, :2]).query(flat[:, :2], distance_upper_bound=0.2)[1], np.int64)
    some = (near < len(found.xyz_m)) & core[low]
    some &= _few_of_each(_squares(flat)[0])
    return np.column_stack([xyz_m[low][some], found.direction[near[some]], above_m[low][some].astype(np.float64)])


def _few_of_each(square: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """Of the points of each square so many as tell its heights, evenly among them."""
    order = np.argsort(square, kind="stable")
    count = np.bincount(square)
    rank = np.arange(len(square)) - (np.cumsum(count) - count)[square[order]]
    chosen = np.empty(len(square), np.bool_)
    chosen[order] = rank % (-(-count // _HEIGHTS))[square[order]] == 0
    return chosen


def fences(low: Array) -> list[Any]:
    """Lines of fences through low points on lines, shape (n, 7) as `low_strips` has them."""
    flat = np.column_stack([low[:, :2], np.zeros(len(low))])
    square, first = _squares(flat)
    # one point of each small square is enough to see which hang together
    chain = np.full(len(first), -1, np.int64)
    for number, each in enumerate(chained(flat[first], low[first, 3:6], 12, 5.0)):
        chain[each] = number
    found = []
    of = chain[square]
    order = np.argsort(of, kind="stable")
    order = order[of[order] >= 0]
    for members in np.split(order, np.flatnonzero(np.diff(of[order])) + 1) if len(order) else []:
        line = _fence(low[members, :3], low[members, 6])
        if line is not None:
            found.append(line)
    return found


def _squares(flat_m: Array) -> tuple[npt.NDArray[np.int32], Ints]:
    """Number of the small square of each point, and the first point of each square."""
    if not len(flat_m):
        return np.empty(0, np.int32), np.empty(0, np.int64)
    square, count = assign(flat_m - np.floor(flat_m.min(axis=0)), VOXEL_M)
    first = np.empty(count, np.int64)
    first[square[::-1]] = np.arange(len(square))[::-1]
    return square, first


def _fence(xyz_m: Array, above_m: Array) -> Any | None:
    """The line of a fence through a chain of points, or None where they are none.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    above_m : ndarray, shape (n,)
        Heights above the ground.
    """
    middle = xyz_m[:, :2].mean(axis=0)
    d = xyz_m[:, :2] - middle
    _, vectors = np.linalg.eigh(d.T @ d)
    s = d @ vectors[:, 1]
    if np.ptp(s) < _FENCE_M:
        return None
    number = np.floor((s - s.min()) / _STEP_M).astype(np.int64)
    kept, good = [], 0
    for each in np.unique(number):
        inside = number == each
        top, low = np.percentile(above_m[inside], (95, 5))
        good += bool(_FENCE_TOP_M[0] < top < _FENCE_TOP_M[1] and top - low > _FENCE_RANGE_M)
        kept.append(np.median(xyz_m[inside], axis=0))
    if good < _FENCE_SHARE * len(kept) or len(kept) < _FENCE_SHARE * (number.max() + 1):
        return None
    return shapely.LineString(np.array(kept)).simplify(0.15)


def stay(xyz_m: Array, poles: Sequence[Pole], above: Callable[[Array], npt.NDArray[Any]]) -> tuple[Any, float] | None:
    """The line of a stay through a chain of points, from its pole down, and how far they are off it; or None where they are none.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    poles : sequence of Pole
    above : callable
        Heights of places above the ground.
    """
    middle = xyz_m.mean(axis=0)
    _, spread, vectors = np.linalg.svd(xyz_m - middle, full_matrices=False)
    way = vectors[0] * np.sign(vectors[0, 2] or 1.0)
    rms = float(np.sqrt((spread[1] ** 2 + spread[2] ** 2) / len(xyz_m)))
    if not _STEEP <= way[2] <= _STEEPEST or rms > _STAY_ROUGH_M:
        return None
    s = (xyz_m - middle) @ way
    flat = way[:2] / np.hypot(*way[:2])
    for pole in poles:
        d = np.array([pole.x, pole.y]) - middle[:2]
        off = abs(float(d @ np.array([-flat[1], flat[0]])))
        up = float(d @ flat) / float(np.hypot(*way[:2]))
        top = middle + up * way
        if off < _STAY_OFF_M and s.min() < up < s.max() + 4.0 and top[2] < pole.foot_m + pole.height_m + 1.0:
            down = s.min() - np.arange(0.0, _STAY_FOOT_M, 0.05)
            heights = np.abs(above(middle + down[:, None] * way))
            foot = down[np.argmin(heights)] if heights.min() < 0.1 else s.min()
            return shapely.LineString([top, middle + foot * way]), rms
    return None
