"""Columns of points that may be poles, looked at one after the other: compiled, as a village of walls has many thousands."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.layout import to_read

Array = npt.NDArray[np.float64]

MAST_M: Final = 15.0
"""Higher poles are called masts."""
FOOT_M: Final = 0.5
"""Points of poles are higher above the ground."""
CELL_M: Final = 0.5
BIN_M: Final = 0.5
FEWEST_BINS: Final = 4
_LEAST_M: Final = 3.0
_FILLED: Final = 0.65
"""Share of its height that has points."""
_CORE_M: Final = 0.35
_SIZES_M: Final = ((_CORE_M, 0.6, 1.6), (0.7, 0.95, 1.95))
"""Radius that holds a pole, or a mast, and a ring around it."""
_REACH_M: Final = _SIZES_M[-1][-1]
_REACH_CELLS: Final = int(np.ceil(_REACH_M / CELL_M))
_BUSH_M: Final = 1.5
_RING: Final = 0.35
"""Points around a pole, as a share of its own at the same heights: a crown has many times as many as its stem."""
_CROWN: Final = 2.5
"""The same near its top, where crossarms and wires are."""
_STEPS: Final = 8
_LEVELS: Final = 1024
"""The highest has all that is higher."""
_APART_M: Final = 1.0
"""Of two poles."""


class Columns(NamedTuple):
    """Points by cells in plan.

    Attributes
    ----------
    key : ndarray of int64, shape (n,)
        Cell of each point; sorted.
    width : int
        Cells from south to north.
    first : ndarray of int64, shape (2,)
        The cell at the south-western corner.
    xyz_m : ndarray, shape (n, 3)
    above_m : ndarray of float32, shape (n,)
        Heights above the ground.
    core : ndarray of bool, shape (n,)
        Points of the tile proper.
    lined : ndarray of bool, shape (n,)
        Points on level lines; to be filled in.
    """

    key: npt.NDArray[np.int64]
    width: int
    first: npt.NDArray[np.int64]
    xyz_m: Array
    above_m: npt.NDArray[np.float32]
    core: npt.NDArray[np.bool_]
    lined: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, xyz_m: Array, above_m: npt.NDArray[np.float32], core: npt.NDArray[np.bool_]) -> "Columns":
        """Sort points, one or more."""
        cell = np.floor(xyz_m[:, :2] / CELL_M).astype(np.int64)
        first = cell.min(axis=0)
        cell -= first
        width = int(cell[:, 1].max()) + 1
        key = cell[:, 0] * width + cell[:, 1]
        order = np.argsort(key, kind="stable")
        lined = np.zeros(len(key), np.bool_)
        return cls(key[order], width, first, xyz_m[order], above_m[order], core[order], lined)

    def near(self, middles_m: Array) -> npt.NDArray[np.int64]:
        """Numbers of the points within reach of any of some places in plan, shape (m, 2)."""
        marked = np.zeros(len(self.key), np.bool_)
        _mark(self, to_read(middles_m), marked)
        return np.flatnonzero(marked)


def search(points: Columns, middles_m: Array) -> Array:
    """Poles of a tile: x, y, foot, height and score, shape (m, 5); a pole is the tile's that the nearest point to its axis is in.

    Parameters
    ----------
    points : Columns
    middles_m : ndarray, shape (n, 2)
        Where to look, the likeliest first.
    """
    return np.asarray(_search(points, to_read(middles_m)))


@njit(cache=True, nogil=True)
def _mark(points: Any, middles: Any, marked: Any) -> None:
    near = np.empty(len(points.key), np.int64)
    for k in range(len(middles)):
        for n in near[: _within(points, middles[k], _REACH_M, near)]:
            marked[n] = True


@njit(cache=True, nogil=True)
def _within(points: Any, middle: Any, radius: float, out: Any) -> int:
    """Numbers of the points around a place in plan go to the beginning of an array; how many there are."""
    x = int(np.floor(middle[0] / CELL_M)) - points.first[0]
    y = int(np.floor(middle[1] / CELL_M)) - points.first[1]
    south, north = max(y - _REACH_CELLS, 0), min(y + _REACH_CELLS, points.width - 1)
    count = 0
    for column in range(max(x - _REACH_CELLS, 0), x + _REACH_CELLS + 1):
        n = _begin(points.key, column * points.width + south)
        while n < len(points.key) and points.key[n] <= column * points.width + north:
            if _apart(points.xyz_m[n], middle) <= radius:
                out[count] = n
                count += 1
            n += 1
    return count


@njit(cache=True, nogil=True)
def _begin(key: Any, least: int) -> int:
    """Number of the first of sorted keys that is no less."""
    low, high = 0, len(key)
    while low < high:
        half = (low + high) // 2
        if key[half] < least:
            low = half + 1
        else:
            high = half
    return low


@njit(cache=True, nogil=True)
def _apart(one: Any, other: Any) -> float:
    """Distance in plan."""
    dx, dy = one[0] - other[0], one[1] - other[1]
    return float(np.sqrt(dx * dx + dy * dy))


@njit(cache=True, nogil=True)
def _search(points: Any, middles: Any) -> Any:
    found, count = np.empty((len(middles), 5)), 0
    near = np.empty(len(points.key), np.int64)
    xyz, above = np.empty((len(near), 3)), np.empty(len(near), np.float32)
    for k in range(len(middles)):
        if _known(found, count, middles[k]):
            continue
        kept = 0
        for n in near[: _within(points, middles[k], _REACH_M, near)]:
            # wires that end at a pole are no crown
            if not points.lined[n] or _apart(points.xyz_m[n], middles[k]) <= _CORE_M:
                xyz[kept], above[kept] = points.xyz_m[n], points.above_m[n]
                kept += 1
        for size in range(len(_SIZES_M)):
            pole = found[count]
            if _pole(middles[k], xyz[:kept], above[:kept], _SIZES_M[size], pole):
                if not _known(found, count, pole) and _ours(points, pole, near):
                    count += 1
                break
    return found[:count]


@njit(cache=True, nogil=True)
def _known(found: Any, count: int, place: Any) -> bool:
    """Whether one of some poles stands at a place."""
    known = False
    for n in range(count):
        known |= _apart(found[n], place) < _APART_M
    return known


@njit(cache=True, nogil=True)
def _ours(points: Any, pole: Any, near: Any) -> bool:
    """Whether the point nearest to the axis of a pole is one of the tile proper."""
    best, ours = np.inf, False
    for n in near[: _within(points, pole, _REACH_M, near)]:
        away = _apart(points.xyz_m[n], pole)
        if away < best:
            best, ours = away, points.core[n]
    return ours


@njit(cache=True, nogil=True)
def _pole(begin: Any, xyz: Any, above: Any, size: Any, pole: Any) -> bool:
    """Whether there is a pole of a size near a place; its x, y, foot, height and score are filled in."""
    core = size[0]
    pole[0], pole[1] = begin[0], begin[1]
    away = np.empty(len(xyz))
    # from a side of a thick mast its middle is some steps away
    for _ in range(_STEPS):
        if _measure(xyz, pole, core, away) < FEWEST_BINS:
            return False
        x, y = pole[0], pole[1]
        _to_axis(xyz, above, away, core, pole)
        if pole[0] == x and pole[1] == y:
            break
    inside = _measure(xyz, pole, core, away)
    top, levels = _top(above, away, core)
    if inside == 0 or top < (_LEAST_M if core == _CORE_M else MAST_M):
        return False
    filled = levels / (np.floor(top / BIN_M) - np.floor(FOOT_M / BIN_M) + 1.0)
    share, crown = _shares(above, away, size, np.float32(0.75 * top))
    if filled < _FILLED or share > _RING or crown > _CROWN:
        return False
    feet, count = np.empty(inside), 0
    for n in range(len(xyz)):
        if away[n] < core:
            feet[count] = xyz[n, 2] - above[n]
            count += 1
    pole[2], pole[3], pole[4] = _median(feet), top, filled * (1.0 - share)
    return True


@njit(cache=True, nogil=True)
def _top(above: Any, away: Any, core: float) -> Any:
    """Height of what is within a core, and how many of its levels have points."""
    top, full = np.float32(0.0), np.zeros(_LEVELS, np.bool_)
    for n in range(len(above)):
        if away[n] < core:
            top = max(top, above[n])
            full[_level(above[n])] = True
    return top, full.sum()


@njit(cache=True, nogil=True)
def _shares(above: Any, away: Any, size: Any, head: Any) -> Any:
    """Points in the ring for each within the core: above bushes at its foot, and near its top, where crossarms and wires are."""
    core, inner, outer = size
    counts = np.zeros((2, 2), np.int64)
    for n in range(len(above)):
        upper = above[n] >= head
        if (upper or above[n] > _BUSH_M) and (away[n] < core or inner < away[n] < outer):
            counts[int(upper), int(away[n] >= core)] += 1
    return counts[0, 1] / max(counts[0, 0], 1), counts[1, 1] / max(counts[1, 0], 1)


@njit(cache=True, nogil=True)
def _measure(xyz: Any, pole: Any, within: float, away: Any) -> int:
    """Distances from an axis, and how many are within something."""
    count = 0
    for n in range(len(xyz)):
        away[n] = _apart(xyz[n], pole)
        count += away[n] < within
    return count


@njit(cache=True, nogil=True)
def _level(above: Any) -> int:
    return min(int(above / BIN_M), _LEVELS - 1)


@njit(cache=True, nogil=True)
def _to_axis(xyz: Any, above: Any, away: Any, within: float, pole: Any) -> None:
    """Bring an axis to the middle of its points by the means of their levels: where wires are fastened, many points are beside it.

    Their medians would stay at a side of a thick mast, where most of the points within reach are.
    """
    sums, counts = np.zeros((_LEVELS, 2)), np.zeros(_LEVELS)
    for n in range(len(xyz)):
        if away[n] < within:
            level = _level(above[n])
            sums[level, 0] += xyz[n, 0]
            sums[level, 1] += xyz[n, 1]
            counts[level] += 1.0
    full = 0
    for level in range(_LEVELS):
        if counts[level] > 0.0:
            sums[full, 0], sums[full, 1] = sums[level, 0] / counts[level], sums[level, 1] / counts[level]
            full += 1
    pole[0], pole[1] = _median(sums[:full, 0]), _median(sums[:full, 1])


@njit(cache=True, nogil=True)
def _median(values: Any) -> float:
    """The middle one, or the mean of the two; of few values, by their ranks."""
    low, high = np.nan, np.nan
    for each in values:
        less, same = 0, 0
        for other in values:
            less += other < each
            same += other == each
        if less <= (len(values) - 1) // 2 < less + same:
            low = each
        if less <= len(values) // 2 < less + same:
            high = each
    return (low + high) / 2.0
