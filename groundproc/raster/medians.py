"""The median of values by cell: needs all of them, so they wait in a temporary file."""

import tempfile
import weakref
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.raster.cells import SIDE, column_and_row
from groundproc.raster.grid import Grid, Window

Array = npt.NDArray[np.float64]

_BUFFERED: Final = 1 << 22
"""Values in memory before they are written."""
_VALUE: Final = np.dtype([("tile_x", "i4"), ("tile_y", "i4"), ("cell", "u2"), ("value", "f4")])


class Medians:
    """Gathers values by cell, in memory that does not grow with their number.

    Parameters
    ----------
    cell_m : float
    folder : Path
        For the temporary file, which has no name and is gone when this is.
    """

    def __init__(self, cell_m: float, folder: Path) -> None:
        self.cell_m = cell_m
        self._spool = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (open as long as this lives)
        weakref.finalize(self, self._spool.close)
        self._waiting: list[npt.NDArray[np.void]] = []
        self._count = 0
        self._parts: dict[tuple[int, int], list[tuple[int, int]]] = {}

    def add(self, xyz_m: Array, values: npt.NDArray[Any]) -> None:
        """Take points, shape (n, 3) of which two are used, and a value of each, shape (n,); what is not finite is left out."""
        values = np.asarray(values, np.float64)
        keep = np.isfinite(values) & np.isfinite(xyz_m[:, :2]).all(axis=1)
        cell = column_and_row(xyz_m[keep], self.cell_m)
        record = np.empty(len(cell), _VALUE)
        record["tile_x"], record["tile_y"] = cell[:, 0] // SIDE, cell[:, 1] // SIDE
        record["cell"] = cell[:, 1] % SIDE * SIDE + cell[:, 0] % SIDE
        record["value"] = values[keep]
        self._waiting.append(record)
        self._count += len(record)
        if self._count >= _BUFFERED:
            self._write()

    def grid(self) -> Grid | None:
        """The smallest grid that holds all cells with a value; None: there is none."""
        self._write()
        low, high = None, None
        for x, y in self._parts:
            rows, columns = np.nonzero(np.isfinite(self._tile(x, y)))
            first = np.array([x * SIDE + columns.min(), y * SIDE + rows.min()])
            last = np.array([x * SIDE + columns.max(), y * SIDE + rows.max()])
            low = first if low is None else np.minimum(low, first)
            high = last if high is None else np.maximum(high, last)
        if low is None or high is None:
            return None
        return Grid(int(low[0]), int(low[1]), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1, self.cell_m)

    def window(self, window: Window, statistic: str = "median") -> npt.NDArray[np.float32]:
        """The medians of some cells, shape (rows, columns), the first row in the north; NaN without values."""
        assert statistic == "median", statistic
        out = np.full((window.rows, window.columns), np.nan, np.float32)
        top, right = window.row + window.rows, window.column + window.columns
        for y in range(window.row // SIDE, (top - 1) // SIDE + 1):
            for x in range(window.column // SIDE, (right - 1) // SIDE + 1):
                if (x, y) in self._parts:
                    south, west = max(window.row, y * SIDE), max(window.column, x * SIDE)
                    north, east = min(top, (y + 1) * SIDE), min(right, (x + 1) * SIDE)
                    part = self._tile(x, y)[south - y * SIDE : north - y * SIDE, west - x * SIDE : east - x * SIDE]
                    out[top - north : top - south, west - window.column : east - window.column] = part[::-1]
        return out

    def _write(self) -> None:
        """Write what waits, sorted by tile."""
        if not self._count:
            return
        record = np.concatenate(self._waiting)
        self._waiting, self._count = [], 0
        record = record[np.lexsort((record["tile_x"], record["tile_y"]))]
        place = np.stack([record["tile_x"], record["tile_y"]], axis=1)
        starts = np.concatenate([[0], np.flatnonzero((np.diff(place, axis=0) != 0).any(axis=1)) + 1, [len(record)]])
        self._spool.seek(0, 2)
        begin = self._spool.tell()
        self._spool.write(record.tobytes())
        for first, last in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
            x, y = place[first].tolist()
            self._parts.setdefault((x, y), []).append((begin + first * _VALUE.itemsize, last - first))

    def _tile(self, x: int, y: int) -> npt.NDArray[np.float32]:
        """Medians of one tile, shape (SIDE, SIDE), rows northwards."""
        pieces = []
        for begin, count in self._parts[x, y]:
            self._spool.seek(begin)
            pieces.append(np.frombuffer(self._spool.read(count * _VALUE.itemsize), _VALUE))
        record = np.concatenate(pieces)
        order = np.lexsort((record["value"], record["cell"]))
        cell, value = record["cell"][order], record["value"][order]
        found, first, many = np.unique(cell, return_index=True, return_counts=True)
        out = np.full(SIDE * SIDE, np.nan, np.float32)
        out[found] = (value[first + (many - 1) // 2].astype(np.float64) + value[first + many // 2]) / 2.0
        return out.reshape(SIDE, SIDE)
