"""Counts of points by cell and height above the ground, and how much of the light came down."""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.raster.grid import Grid

Array = npt.NDArray[np.float64]

STEP_M: Final = 0.15
"""Height of a layer."""
_LOW_M: Final = -1.0
SIDE: Final = 256
"""Cells along the side of a tile."""


class Layers:
    """Points by cell and layer, in tiles that are made where points come: a corridor fills little of its bounds.

    Memory: two bytes for each layer and four for each cell of these tiles.

    Parameters
    ----------
    grid : Grid
    low_m, high_m : float
        What is lower than the first above the ground counts as ground, what is higher than the second as not come down.
    """

    def __init__(self, grid: Grid, low_m: float, high_m: float) -> None:
        self.grid, self.low_m = grid, low_m
        self.layers = max(round((high_m - low_m) / STEP_M), 1)
        self._tiles: dict[tuple[int, int], Counts] = {}

    @property
    def high_m(self) -> float:
        """Top of the highest layer."""
        return self.low_m + self.layers * STEP_M

    def add(self, xyz_m: Array, above_m: npt.NDArray[np.float32], first: npt.NDArray[np.bool_]) -> None:
        """Take points: places, shape (n, 3), heights above the ground, and whether each is the first return of its pulse."""
        grid = self.grid
        down = ((grid.north_m - xyz_m[:, 1]) / grid.cell_m).astype(np.int64)
        right = ((xyz_m[:, 0] - grid.west_m) / grid.cell_m).astype(np.int64)
        across = -(-grid.columns // SIDE)
        tile = down // SIDE * across + right // SIDE
        tile[(down < 0) | (right < 0) | (down >= grid.rows) | (right >= grid.columns)] = -1
        order = np.argsort(tile, kind="stable")
        numbers, starts = np.unique(tile[order], return_index=True)
        for number, some in zip(numbers.tolist(), np.split(order, starts[1:]), strict=True):
            if number < 0:
                continue
            counts, pulses = self._tile(divmod(number, across))
            within = np.stack([down[some] % SIDE, right[some] % SIDE], axis=1)
            _count(within, above_m[some], first[some], self.low_m, counts, pulses)

    def __iter__(self) -> Iterator[tuple[int, int, "Counts"]]:
        """Tiles that have points, from north to south: first row from the north and column from the west, and what is in them."""
        for down, right in sorted(self._tiles):
            yield down * SIDE, right * SIDE, self._tiles[down, right]

    def window(self, row: int, column: int, rows: int, columns: int) -> "Counts":
        """Some cells, from a row from the north and a column from the west on; beyond the grid there are no points."""
        out = self._empty(rows, columns)
        for down in range(row // SIDE, (row + rows - 1) // SIDE + 1):
            for right in range(column // SIDE, (column + columns - 1) // SIDE + 1):
                tile = self._tiles.get((down, right))
                if tile is not None:
                    y, x = down * SIDE - row, right * SIDE - column
                    into = slice(max(y, 0), min(y + SIDE, rows)), slice(max(x, 0), min(x + SIDE, columns))
                    part = slice(into[0].start - y, into[0].stop - y), slice(into[1].start - x, into[1].stop - x)
                    out.counts[into], out.pulses[into] = tile.counts[part], tile.pulses[part]
        return out

    def _tile(self, key: tuple[int, int]) -> "Counts":
        if key not in self._tiles:
            self._tiles[key] = self._empty(SIDE, SIDE)
        return self._tiles[key]

    def _empty(self, rows: int, columns: int) -> "Counts":
        return Counts(np.zeros((rows, columns, self.layers + 1), np.uint16), np.zeros((rows, columns), np.uint32))


class Counts(NamedTuple):
    """Points of some cells.

    Attributes
    ----------
    counts : ndarray of uint16, shape (rows, columns, layers + 1)
        Ground, then layers upwards.
    pulses : ndarray of uint32, shape (rows, columns)
        First returns, wherever they came from.
    """

    counts: npt.NDArray[np.uint16]
    pulses: npt.NDArray[np.uint32]

    def penetration(self) -> npt.NDArray[np.float32]:
        """Share of pulses that came down to the highest layer or below it, shape (rows, columns); NaN without any."""
        down = self.counts.sum(axis=2, dtype=np.float32)
        all_ = np.maximum(self.pulses, down)
        return np.where(all_ > 0, down / np.maximum(all_, 1), np.float32(np.nan)).astype(np.float32)


@njit(cache=True, nogil=True)
def _count(within: Any, above: Any, first: Any, low: Any, counts: Any, pulses: Any) -> None:
    layers = counts.shape[2]
    for n in range(len(within)):
        i, j = within[n, 0], within[n, 1]
        if first[n]:
            pulses[i, j] += 1
        h = above[n]
        if h < _LOW_M:
            continue
        layer = 0 if h < low else int((h - low) / STEP_M) + 1
        if layer < layers and counts[i, j, layer] < 65535:
            counts[i, j, layer] += 1
