"""Upright things: poles and masts."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.columns import BIN_M, CELL_M, FEWEST_BINS, FOOT_M, MAST_M, Columns, search

Array = npt.NDArray[np.float64]

HALO_M: Final = 2.0
ARM_M: Final = 2.6
"""Half a crossarm, and more ..."""
_ARM_SHARE: Final = 0.25
"""... and that of a mast, in its height."""
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
    some = above_m > FOOT_M
    xyz_m, above_m, core = xyz_m[some], above_m[some], core[some]
    middles = _columns(xyz_m, above_m) if len(xyz_m) else np.empty((0, 2))
    if not len(middles):
        return []
    points = Columns.of(xyz_m, above_m, core)
    if lines_m is not None and len(lines_m):
        near = points.near(middles)
        away = cKDTree(lines_m).query(points.xyz_m[near], distance_upper_bound=_ON_LINE_M)[0]
        points.lined[near[away < _ON_LINE_M]] = True
    return [Pole(*each) for each in search(points, middles)]


def _columns(xyz_m: Array, above_m: npt.NDArray[np.float32]) -> Array:
    """Middles of cells with points at many heights, the fullest first, shape (m, 2)."""
    cell = np.floor(xyz_m[:, :2] / CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    level = np.floor(above_m / BIN_M).astype(np.int64).clip(0, 255)
    key = (cell[:, 0] << 36) | (cell[:, 1] << 8) | level
    column, counts = np.unique(np.unique(key) >> 8, return_counts=True)
    full = column[counts >= FEWEST_BINS]
    number = np.searchsorted(full, key >> 8).clip(0, max(len(full) - 1, 0))
    inside = np.flatnonzero(full[number] == key >> 8) if len(full) else np.empty(0, np.int64)
    if not len(inside):
        return np.empty((0, 2))
    number = number[inside]
    total = np.bincount(number)
    middles = np.stack([np.bincount(number, xyz_m[inside, axis]) / total for axis in (0, 1)], axis=1)
    return middles[np.argsort(-counts[counts >= FEWEST_BINS], kind="stable")]
