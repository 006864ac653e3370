"""Rasters of areas on the disk, filled block by block."""

import tempfile
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.errors import SourceError
from groundproc.machine.system import take_disk
from groundproc.numerics.layout import to_read
from groundproc.raster.grid import Grid, Window
from groundproc.raster.sampling import around

BLOCK: Final = 1024
"""Cells along the side of a block."""


class Sheet:
    """One value for each cell of a grid, in a temporary file without a name; only blocks that were filled take room.

    A corridor that runs aslant fills little of its bounds, so memory and disk follow the blocks that hold something.

    Parameters
    ----------
    grid : Grid
    folder : Path
    dtype : data type
        Cells begin as NaN, or 0 where that is none.

    Raises
    ------
    SourceError
        When it is filled: the disk has no room.
    """

    def __init__(self, grid: Grid, folder: Path, dtype: Any = np.float32) -> None:
        self._folder = folder
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (open as long as this lives)
        weakref.finalize(self, self._file.close)
        self.grid, self._dtype = grid, np.dtype(dtype)
        self._none: float = np.nan if self._dtype.kind == "f" else 0
        self._slot = np.full((-(-grid.rows // BLOCK), -(-grid.columns // BLOCK)), -1, np.int64)
        self._filled = 0
        self._blocks: npt.NDArray[Any] = np.empty((0, BLOCK, BLOCK), self._dtype)

    def put(self, window: Window, values: npt.NDArray[Any]) -> None:
        """Fill a window that lies within the grid."""
        for key, inside, part in self._parts(window):
            self._block(key)[inside] = values[part]

    def mark(self, down: npt.NDArray[np.int64], right: npt.NDArray[np.int64], value: Any) -> None:
        """Give cells a value, by their rows from the north and columns from the west, shape (n,)."""
        blocks = np.unique(down // BLOCK * self._slot.shape[1] + right // BLOCK)
        for each in blocks:
            self._block(divmod(int(each), self._slot.shape[1]))
        self._blocks[self._slot[down // BLOCK, right // BLOCK], down % BLOCK, right % BLOCK] = value

    def window(self, window: Window) -> npt.NDArray[Any]:
        """A copy of a window; beyond the grid NaN, or 0."""
        out = np.full((window.rows, window.columns), self._none, self._dtype)
        inner = within(self.grid, window)
        if inner is not None:
            top = window.row + window.rows - inner.row - inner.rows
            left = inner.column - window.column
            target = out[top : top + inner.rows, left : left + inner.columns]
            for key, inside, part in self._parts(inner):
                if self._slot[key] >= 0:
                    target[part] = self._blocks[self._slot[key]][inside]
        return out

    def holds(self, window: Window) -> bool:
        """Whether anything was filled in a block that a window reaches into."""
        inner = within(self.grid, window)
        return inner is not None and any(self._slot[key] >= 0 for key, _, _ in self._parts(inner))

    def at(self, down: npt.NDArray[np.int64], right: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        """Values of cells, by their rows from the north and columns from the west, shape (n,)."""
        slot = self._slot[down // BLOCK, right // BLOCK]
        out = np.full(slot.shape, self._none, self._dtype)
        known = slot >= 0
        out[known] = self._blocks[slot[known], down[known] % BLOCK, right[known] % BLOCK]
        return out

    def bilinear(self, xyz_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """Values between the centres of cells, shape (n,), as `sampling.bilinear` has them of a whole raster."""
        grid = self.grid
        frame = (grid.west_m, grid.north_m, grid.cell_m, grid.rows, grid.columns)
        return np.asarray(_bilinear(to_read(self._blocks), self._slot, frame, to_read(xyz_m)))

    def _block(self, key: tuple[int, int]) -> npt.NDArray[Any]:
        """A block to be filled, shape (BLOCK, BLOCK)."""
        if self._slot[key] < 0:
            if self._filled == len(self._blocks):
                count = min(self._filled + self._filled // 4 + 1, self._slot.size)
                self._take(count * BLOCK * BLOCK * self._dtype.itemsize)
                self._blocks = np.memmap(self._file, self._dtype, "r+", shape=(count, BLOCK, BLOCK))
            self._slot[key] = self._filled
            self._filled += 1
            if self._dtype.kind == "f":
                rows, columns = (
                    side - BLOCK * at for side, at in zip((self.grid.rows, self.grid.columns), key, strict=True)
                )
                self._blocks[self._slot[key], :rows, :columns] = self._none
        found: npt.NDArray[Any] = self._blocks[self._slot[key]]
        return found

    def _take(self, size: int) -> None:
        try:
            take_disk(self._file.fileno(), size)
        except OSError as error:
            raise SourceError(
                f"{self._folder}: no room for temporary files, {size:,} bytes asked for ({error.strerror})"
            ) from None

    def _parts(self, window: Window) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
        """Blocks that a window within the grid reaches into: which, the part of the block, and the part of the window."""
        top, left = self.grid.row + self.grid.rows - window.row - window.rows, window.column - self.grid.column
        for i in range(top // BLOCK, (top + window.rows - 1) // BLOCK + 1):
            first, last = max(top, i * BLOCK), min(top + window.rows, (i + 1) * BLOCK)
            for j in range(left // BLOCK, (left + window.columns - 1) // BLOCK + 1):
                west, east = max(left, j * BLOCK), min(left + window.columns, (j + 1) * BLOCK)
                yield (
                    (i, j),
                    (slice(first - i * BLOCK, last - i * BLOCK), slice(west - j * BLOCK, east - j * BLOCK)),
                    (slice(first - top, last - top), slice(west - left, east - left)),
                )


@njit(cache=True, nogil=True)
def _bilinear(blocks: Any, slot: Any, frame: Any, xyz: Any) -> Any:
    out = np.empty(len(xyz), np.float32)
    for n in range(len(xyz)):
        total, weight = 0.0, 0.0
        for a, b, w in around(xyz[n, 0], xyz[n, 1], frame):
            number = slot[a // BLOCK, b // BLOCK]
            if number >= 0:
                value = blocks[number, a % BLOCK, b % BLOCK]
                if value == value:
                    total += w * value
                    weight += w
        out[n] = total / weight if weight > 0.0 else np.nan
    return out


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
