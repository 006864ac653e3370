"""Rasters of whole areas on the disk, filled block by block."""

import tempfile
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.raster.grid import Grid, Window

BLOCK: Final = 1024
"""Cells along the side of a block."""


class Sheet:
    """One value for each cell of a grid, in a temporary file without a name.

    Parameters
    ----------
    grid : Grid
    folder : Path
    dtype : data type
        Cells begin as NaN, or 0 where that is none.
    """

    def __init__(self, grid: Grid, folder: Path, dtype: Any = np.float32) -> None:
        file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (open as long as this lives)
        weakref.finalize(self, file.close)
        self.grid = grid
        self.values: npt.NDArray[Any] = np.memmap(file, dtype, "w+", shape=(grid.rows, grid.columns))
        """Shape (rows, columns), the first row in the north."""
        if np.dtype(dtype).kind == "f":
            self.values[:] = np.nan

    def put(self, window: Window, values: npt.NDArray[Any]) -> None:
        """Fill a window that lies within the grid."""
        rows, columns = self._slices(window)
        self.values[rows, columns] = values

    def window(self, window: Window) -> npt.NDArray[Any]:
        """A copy of a window; beyond the grid NaN, or 0."""
        out = np.full((window.rows, window.columns), np.nan if self.values.dtype.kind == "f" else 0, self.values.dtype)
        inner = within(self.grid, window)
        if inner is not None:
            rows, columns = self._slices(inner)
            top = window.row + window.rows - inner.row - inner.rows
            left = inner.column - window.column
            out[top : top + inner.rows, left : left + inner.columns] = self.values[rows, columns]
        return out

    def _slices(self, window: Window) -> tuple[slice, slice]:
        top = self.grid.row + self.grid.rows - window.row - window.rows
        left = window.column - self.grid.column
        return slice(top, top + window.rows), slice(left, left + window.columns)


def within(grid: Grid, window: Window) -> Window | None:
    """The part of a window that lies within a grid."""
    column, row = max(window.column, grid.column), max(window.row, grid.row)
    columns = min(window.column + window.columns, grid.column + grid.columns) - column
    rows = min(window.row + window.rows, grid.row + grid.rows) - row
    return Window(column, row, columns, rows) if columns > 0 and rows > 0 else None


def blocks(grid: Grid, halo: int) -> Iterator[tuple[Window, Window, Callable[[npt.NDArray[Any]], npt.NDArray[Any]]]]:
    """Blocks of a grid, each with the window around it, cut off at the grid, and a function that cuts the block out of values of that."""
    for block in grid.blocks(BLOCK):
        around = within(grid, block.grown(halo))
        assert around is not None
        top, left = around.row + around.rows - block.row - block.rows, block.column - around.column
        rows, columns = slice(top, top + block.rows), slice(left, left + block.columns)

        def cut(values: npt.NDArray[Any], rows: slice = rows, columns: slice = columns) -> npt.NDArray[Any]:
            return values[rows, columns]

        yield block, around, cut
