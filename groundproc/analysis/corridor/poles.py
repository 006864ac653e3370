"""Upright things: poles and masts."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]

MAST_M: Final = 15.0
"""Higher poles are called masts."""
HALO_M: Final = 2.0
ARM_M: Final = 2.6
"""Half a crossarm, and more ..."""
_ARM_SHARE: Final = 0.25
"""... and that of a mast, in its height."""
_LEAST_M: Final = 3.0
_CELL_M: Final = 0.5
_BIN_M: Final = 0.5
_FEWEST_BINS: Final = 4
_FILLED: Final = 0.65
"""Share of its height that has points."""
_CORE_M: Final = 0.35
_SIZES_M: Final = ((_CORE_M, 0.6, 1.6), (0.7, 0.95, 1.95))
"""Radius that holds a pole, or a mast, and a ring around it."""
_RING: Final = 0.35
"""Points around a pole, as a share of its own at the same heights: a crown has many times as many as its stem."""
_CROWN: Final = 2.5
"""The same near its top, where crossarms and wires are."""
_STEPS: Final = 8
_FOOT_M: Final = 0.5
_ON_LINE_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Pole:
    """A pole or a mast.

    Attributes
    ----------
    x, y, foot_m : float
        Of the ground under it.
    height_m : float
    score : float
        Share of its height that has points, less what is around it.
    """

    x: float
    y: float
    foot_m: float
    height_m: float
    score: float

    @property
    def kind(self) -> str:
        """By height."""
        return "mast" if self.height_m >= MAST_M else "pole"

    @property
    def arm_m(self) -> float:
        """How far to the side wires may hang from it."""
        return max(ARM_M, _ARM_SHARE * self.height_m)


def upright(
    xyz_m: Array, above_m: npt.NDArray[np.float32], core: npt.NDArray[np.bool_], lines_m: Array | None = None
) -> list[Pole]:
    """Poles among the points of a tile.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
        Above the ground.
    above_m : ndarray, shape (n,)
        Their heights above it.
    core : ndarray of bool, shape (n,)
        Points of the tile proper: a pole is the tile's that the nearest to its axis is in.
    lines_m : ndarray, shape (m, 3), optional
        Points on level lines: wires that end at a pole are no crown.
    """
    some = above_m > _FOOT_M
    xyz_m, above_m, core = xyz_m[some], above_m[some], core[some]
    if not len(xyz_m):
        return []
    tree = cKDTree(xyz_m[:, :2])
    found: list[Pole] = []
    lines = cKDTree(lines_m) if lines_m is not None and len(lines_m) else None
    for middle in _columns(xyz_m, above_m):
        if any(np.hypot(middle[0] - p.x, middle[1] - p.y) < 1.0 for p in found):
            continue
        near = np.array(tree.query_ball_point(middle, _SIZES_M[-1][-1]))
        if lines is not None:
            away = np.hypot(*(xyz_m[near, :2] - middle).T) > _CORE_M
            away[away] = lines.query(xyz_m[near[away]], distance_upper_bound=_ON_LINE_M)[0] < _ON_LINE_M
            near = near[~away]
        sizes = (_pole(middle, xyz_m[near], above_m[near], size) for size in _SIZES_M)
        pole = next((each for each in sizes if each is not None), None)
        if pole is None or any(np.hypot(pole.x - p.x, pole.y - p.y) < 1.0 for p in found):
            continue
        if core[tree.query([pole.x, pole.y])[1]]:
            found.append(pole)
    return found


def _columns(xyz_m: Array, above_m: npt.NDArray[np.float32]) -> Array:
    """Middles of cells with points at many heights, the fullest first, shape (m, 2)."""
    cell = np.floor(xyz_m[:, :2] / _CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    level = np.floor(above_m / _BIN_M).astype(np.int64).clip(0, 255)
    key = (cell[:, 0] << 36) | (cell[:, 1] << 8) | level
    column, counts = np.unique(np.unique(key) >> 8, return_counts=True)
    full = column[counts >= _FEWEST_BINS]
    number = np.searchsorted(full, key >> 8).clip(0, max(len(full) - 1, 0))
    inside = np.flatnonzero(full[number] == key >> 8) if len(full) else np.empty(0, np.int64)
    if not len(inside):
        return np.empty((0, 2))
    number = number[inside]
    total = np.bincount(number)
    middles = np.stack([np.bincount(number, xyz_m[inside, axis]) / total for axis in (0, 1)], axis=1)
    return middles[np.argsort(-counts[counts >= _FEWEST_BINS], kind="stable")]


def _pole(
    middle: Array, xyz_m: Array, above_m: npt.NDArray[np.float32], size_m: tuple[float, float, float]
) -> Pole | None:
    """The pole of a size near a place, if there is one."""
    core_m, inner_m, outer_m = size_m
    # from a side of a thick mast its middle is some steps away
    for _ in range(_STEPS):
        inside = np.hypot(*(xyz_m[:, :2] - middle).T) < core_m
        if inside.sum() < _FEWEST_BINS:
            return None
        middle = _axis(xyz_m[inside], above_m[inside])
    away = np.hypot(*(xyz_m[:, :2] - middle).T)
    inside = away < core_m
    levels = np.unique(np.floor(above_m[inside] / _BIN_M).astype(np.int64))
    top = float(above_m[inside].max())
    if top < (_LEAST_M if core_m == _CORE_M else MAST_M):
        return None
    filled = len(levels) / (np.floor(top / _BIN_M) - np.floor(_FOOT_M / _BIN_M) + 1.0)
    # crossarms and wires are near its top, bushes near its foot
    body, head = (above_m > 1.5) & (above_m < 0.75 * top), above_m >= 0.75 * top
    ring = (away > inner_m) & (away < outer_m)
    share = int((body & ring).sum()) / max(int((body & inside).sum()), 1)
    crown = int((head & ring).sum()) / max(int((head & inside).sum()), 1)
    if filled < _FILLED or share > _RING or crown > _CROWN:
        return None
    foot = float(np.median(xyz_m[inside, 2] - above_m[inside]))
    return Pole(float(middle[0]), float(middle[1]), foot, top, float(filled * (1.0 - share)))


def _axis(xyz_m: Array, above_m: npt.NDArray[np.float32]) -> Array:
    """Middle of points by the means of their levels: where wires are fastened, many points are beside it.

    Their medians would stay at a side of a thick mast, where most of the points within reach are.
    """
    level = np.floor(above_m / _BIN_M).astype(np.int64)
    return np.asarray(np.median([np.mean(xyz_m[level == each, :2], axis=0) for each in np.unique(level)], axis=0))
