"""Counts of points by cell and height above the ground, and how much of the light came down."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.raster.grid import Grid

Array = npt.NDArray[np.float64]

STEP_M: Final = 0.15
"""Height of a layer."""
_LOW_M: Final = -1.0


class Layers:
    """Points by cell and layer.

    Memory: two bytes for each layer and four for each cell of the grid.

    Parameters
    ----------
    grid : Grid
    low_m, high_m : float
        What is lower than the first above the ground counts as ground, what is higher than the second as not come down.
    """

    def __init__(self, grid: Grid, low_m: float, high_m: float) -> None:
        self.grid, self.low_m = grid, low_m
        self.layers = max(round((high_m - low_m) / STEP_M), 1)
        self.counts: npt.NDArray[np.uint16] = np.zeros((grid.rows, grid.columns, self.layers + 1), np.uint16)
        """Shape (rows, columns, layers + 1): ground, then layers upwards."""
        self.pulses: npt.NDArray[np.uint32] = np.zeros((grid.rows, grid.columns), np.uint32)
        """First returns, wherever they came from."""

    @property
    def high_m(self) -> float:
        """Top of the highest layer."""
        return self.low_m + self.layers * STEP_M

    def add(self, xyz_m: Array, above_m: npt.NDArray[np.float32], first: npt.NDArray[np.bool_]) -> None:
        """Take points: places, shape (n, 3), heights above the ground, and whether each is the first return of its pulse."""
        where = (self.grid.west_m, self.grid.north_m, self.grid.cell_m, self.low_m)
        _count(xyz_m, above_m, first, where, self.counts, self.pulses)

    def penetration(self) -> npt.NDArray[np.float32]:
        """Share of pulses that came down to the highest layer or below it, shape (rows, columns); NaN without any."""
        down = self.counts.sum(axis=2, dtype=np.float32)
        all_ = np.maximum(self.pulses, down)
        return np.where(all_ > 0, down / np.maximum(all_, 1), np.float32(np.nan)).astype(np.float32)


@njit(cache=True, nogil=True)
def _count(xyz: Any, above: Any, first: Any, where: Any, counts: Any, pulses: Any) -> None:
    west, north, cell, low = where
    rows, columns, layers = counts.shape
    for n in range(len(xyz)):
        i, j = int((north - xyz[n, 1]) / cell), int((xyz[n, 0] - west) / cell)
        if i < 0 or j < 0 or i >= rows or j >= columns:
            continue
        if first[n]:
            pulses[i, j] += 1
        h = above[n]
        if h < _LOW_M:
            continue
        layer = 0 if h < low else int((h - low) / STEP_M) + 1
        if layer < layers and counts[i, j, layer] < 65535:
            counts[i, j, layer] += 1
