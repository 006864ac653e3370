"""Statistics of points by cell, in one pass and any order: lowest, highest, mean, deviation, count.

Cells lie in tiles that are made where points come, so that memory follows the area that was flown over and not its bounding box.
"""

from collections.abc import Collection
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.voxelhash import sorted_by
from groundproc.raster.grid import Grid, Window

Array = npt.NDArray[np.float64]

STATISTICS: Final = ("max", "min", "mean", "sigma", "count")
"""Of the values in a cell; sigma is the standard deviation, of cells with two values or more."""
_BITS: Final = 8
SIDE: Final = 1 << _BITS
"""Cells along one side of a tile."""
_MASK: Final = SIDE - 1
_ROUNDING, _ROUNDED = 1e-9, 2e-15
"""Of a cell, and of its number: some steps of double precision, of coordinates with an offset, their unit and the size of the cell."""
_DIRECT: Final = 1 << 22
"""Tiles within the bounds of one piece of points up to which they are found by a table."""


class Cells:
    """Gathers the statistics of values by cell.

    Parameters
    ----------
    cell_m : float
    wanted : collection of str
        Of `STATISTICS`.
    """

    def __init__(self, cell_m: float, wanted: Collection[str]) -> None:
        assert set(wanted) <= set(STATISTICS), wanted
        self.cell_m, self._wanted = cell_m, set(wanted)
        self._tiles: dict[tuple[int, int], Tile] = {}

    def keep(self, statistic: str) -> None:
        """Gather one statistic more; no value was taken yet."""
        assert not self._tiles
        self._wanted.add(statistic)

    def add(self, xyz_m: Array, values: npt.NDArray[Any]) -> None:
        """Take points, shape (n, 3) of which two are used, and a value of each, shape (n,); what is not finite is left out."""
        values = np.ascontiguousarray(values, np.float64)
        keep = np.isfinite(values) & np.isfinite(xyz_m[:, 0]) & np.isfinite(xyz_m[:, 1])
        if not keep.all():
            xyz_m, values = xyz_m[keep], values[keep]
        if len(values):
            self.add_placed(in_cells(xyz_m, self.cell_m), values)

    def add_placed(self, placed: "Placed", values: Array) -> None:
        """Take finite values, shape (n,), of points whose cells, of this size, are known."""
        for each, place in enumerate(placed.tiles):
            tile = self._tiles.get(place)
            if tile is None:
                tile = self._tiles[place] = Tile(self._kept())
            tile.add(placed.within, values, placed.order[placed.first[each] : placed.first[each + 1]])

    def _kept(self) -> dict[str, bool]:
        """Which arrays a tile has."""
        wanted = self._wanted
        moments = bool({"mean", "sigma"} & wanted)
        return {
            "count": moments or "count" in wanted, "min": "min" in wanted, "max": "max" in wanted,
            "mean": moments, "squares": "sigma" in wanted,
        }  # fmt: skip

    def __len__(self) -> int:
        return len(self._tiles)

    def grid(self) -> Grid | None:
        """The smallest grid that holds all cells with a value; None: there is none."""
        bounds = [(x << _BITS, y << _BITS, *tile.bounds()) for (x, y), tile in self._tiles.items()]
        if not bounds:
            return None
        x, y, left, low, right, high = np.array(bounds).T
        column, row = int((x + left).min()), int((y + low).min())
        return Grid(column, row, int((x + right).max()) - column + 1, int((y + high).max()) - row + 1, self.cell_m)

    def holds(self, window: Window) -> bool:
        """Whether there may be a value in some cells: whether they reach into a tile that was made."""
        rows = range(window.row >> _BITS, (window.row + window.rows - 1 >> _BITS) + 1)
        columns = range(window.column >> _BITS, (window.column + window.columns - 1 >> _BITS) + 1)
        return any((x, y) in self._tiles for y in rows for x in columns)

    def at(self, xyz_m: Array, statistic: str) -> npt.NDArray[np.float32]:
        """A statistic of the cells that finite points lie in, shape (n,); NaN without values, a count then is 0."""
        out = np.full(len(xyz_m), 0.0 if statistic == "count" else np.nan, np.float32)
        placed = in_cells(xyz_m, self.cell_m)
        for each, place in enumerate(placed.tiles):
            some = placed.order[placed.first[each] : placed.first[each + 1]]
            if place in self._tiles:
                out[some] = self._tiles[place].statistic(statistic).ravel()[placed.within[some]]
        return out

    def window(self, window: Window, statistic: str) -> npt.NDArray[np.float32]:
        """A statistic of some cells, shape (rows, columns), the first row in the north; NaN without values, a count then is 0."""
        out = np.full((window.rows, window.columns), 0.0 if statistic == "count" else np.nan, np.float32)
        top, right = window.row + window.rows, window.column + window.columns
        for y in range(window.row >> _BITS, (top - 1 >> _BITS) + 1):
            for x in range(window.column >> _BITS, (right - 1 >> _BITS) + 1):
                tile = self._tiles.get((x, y))
                if tile is not None:
                    south, west = max(window.row, y << _BITS), max(window.column, x << _BITS)
                    north, east = min(top, (y + 1) << _BITS), min(right, (x + 1) << _BITS)
                    part = tile.statistic(statistic)[
                        south - (y << _BITS) : north - (y << _BITS), west - (x << _BITS) : east - (x << _BITS)
                    ]
                    out[top - north : top - south, west - window.column : east - window.column] = part[::-1]
        return out


class Tile:
    """A square of cells; rows go northwards.

    Parameters
    ----------
    kept : dict of str to bool
        Which arrays it has.
    """

    def __init__(self, kept: dict[str, bool]) -> None:
        def array(name: str, dtype: type, start: float) -> npt.NDArray[Any]:
            return np.full(SIDE * SIDE if kept[name] else 0, start, dtype)

        self._count = array("count", np.uint32, 0)
        self._low, self._high = array("min", np.float32, np.inf), array("max", np.float32, -np.inf)
        self._mean, self._squares = array("mean", np.float64, 0.0), array("squares", np.float64, 0.0)

    def add(self, within: npt.NDArray[np.uint16], values: Array, some: npt.NDArray[np.int64]) -> None:
        """Take some of the values, numbers shape (m,), with the cells that they lie in."""
        _fill(within, values, some, (self._count, self._low, self._high, self._mean, self._squares))

    def statistic(self, name: str) -> npt.NDArray[Any]:
        """One of `STATISTICS`, shape (SIDE, SIDE)."""
        if name == "count":
            found: npt.NDArray[Any] = self._count
        elif name in ("min", "max"):
            limit = self._low if name == "min" else self._high
            found = np.where(np.isfinite(limit), limit, np.float32(np.nan))
        elif name == "mean":
            found = np.where(self._count > 0, self._mean, np.nan)
        else:
            found = np.sqrt(np.where(self._count > 1, self._squares, np.nan) / np.maximum(self._count - 1.0, 1.0))
        return found.reshape(SIDE, SIDE)

    def bounds(self) -> tuple[int, int, int, int]:
        """First column, first row, last column, last row that hold a value."""
        full = self._count > 0 if len(self._count) else np.isfinite(self._low if len(self._low) else self._high)
        rows, columns = np.nonzero(full.reshape(SIDE, SIDE))
        return int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max())


class Placed(NamedTuple):
    """Points sorted by the tile that they lie in.

    Attributes
    ----------
    within : ndarray of uint16, shape (n,)
        Cell of each point within its tile.
    order : ndarray of int64, shape (n,)
        Numbers of the points, tile by tile.
    first : ndarray of int64, shape (tiles + 1,)
        Where each tile begins among them.
    tiles : list of tuple of int
        Column and row, counted in tiles.
    """

    within: npt.NDArray[np.uint16]
    order: npt.NDArray[np.int64]
    first: npt.NDArray[np.int64]
    tiles: list[tuple[int, int]]


def in_cells(xyz_m: Array, cell_m: float) -> Placed:
    """Points, shape (n, 3), of which two finite coordinates are used, sorted into cells; at least one."""
    within, number, tiles = cells_of(xyz_m, cell_m)
    order, first = sorted_by(number, len(tiles))
    return Placed(within, order, first, tiles)


def cells_of(
    xyz_m: Array, cell_m: float
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.int32], list[tuple[int, int]]]:
    """Cell within its tile and number of the tile of each point, shape (n,) each, and the tiles: column and row counted in tiles."""
    within, column, row = _cells(xyz_m, 1.0 / cell_m)
    number, tiles = _numbered(column, row)
    return within, number, tiles


def column_and_row(xyz_m: Array, cell_m: float) -> npt.NDArray[np.int64]:
    """Column and row of the cell of each point, shape (n, 2), counted from the origin."""
    return np.asarray(_columns_and_rows(xyz_m, 1.0 / cell_m))


def _numbered(
    column: npt.NDArray[np.int32], row: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.int32], list[tuple[int, int]]]:
    """Number of the tile of each point, and the tiles."""
    x0, y0 = int(column.min()), int(row.min())
    width, height = int(column.max()) - x0 + 1, int(row.max()) - y0 + 1
    if width * height <= _DIRECT:
        number, found = _by_table(column, row, (x0, y0, width), np.full(width * height, -1, np.int32))
    else:
        keys = (row.astype(np.int64) - y0) * width + (column.astype(np.int64) - x0)
        found, number = np.unique(keys, return_inverse=True)
        number = number.astype(np.int32)
    return number, [(int(key % width) + x0, int(key // width) + y0) for key in found]


@njit(cache=True, nogil=True, inline="always")
def edged(place_m: float, per_m: float) -> float:
    """A place in cells; what only rounding keeps off an edge lies on it.

    Sizes such as 0.3 m and steps of a millimetre have no exact binary numbers: without this, a point of a lattice on the edges would
    fall into either cell beside it as the last bit has it.
    """
    cells = place_m * per_m
    near = np.rint(cells)
    return near if abs(cells - near) <= _ROUNDING + _ROUNDED * abs(near) else cells


@njit(cache=True, nogil=True)
def _cells(xyz_m: Any, per_m: float) -> Any:
    """Cell within its tile, and column and row of the tile, of each point."""
    n = len(xyz_m)
    within, column, row = np.empty(n, np.uint16), np.empty(n, np.int32), np.empty(n, np.int32)
    for i in range(n):
        x, y = np.int64(np.floor(edged(xyz_m[i, 0], per_m))), np.int64(np.ceil(edged(xyz_m[i, 1], per_m))) - 1
        within[i] = (y & _MASK) << _BITS | (x & _MASK)
        column[i], row[i] = x >> _BITS, y >> _BITS
    return within, column, row


@njit(cache=True, nogil=True)
def _columns_and_rows(xyz_m: Any, per_m: float) -> Any:
    out = np.empty((len(xyz_m), 2), np.int64)
    for i in range(len(xyz_m)):
        out[i, 0] = np.int64(np.floor(edged(xyz_m[i, 0], per_m)))
        out[i, 1] = np.int64(np.ceil(edged(xyz_m[i, 1], per_m))) - 1
    return out


@njit(cache=True, nogil=True)
def _by_table(column: Any, row: Any, bounds: Any, table: Any) -> Any:
    """Number of the tile of each point, and the key of each tile, by a table of all within the bounds (x0, y0, width)."""
    x0, y0, width = bounds
    number, found, tiles = np.empty(len(column), np.int32), np.empty(len(table), np.int64), 0
    for i in range(len(column)):
        key = np.int64(row[i] - y0) * width + (column[i] - x0)
        if table[key] < 0:
            table[key], found[tiles] = tiles, key
            tiles += 1
        number[i] = table[key]
    return number, found[:tiles]


@njit(cache=True, nogil=True)
def _fill(within: Any, values: Any, some: Any, arrays: Any) -> None:
    """Add values to the cells of one tile; an array of no cells is not kept. Mean and squares by Welford (1962)."""
    count, low, high, mean, squares = arrays
    for i in some:
        cell, value = within[i], values[i]
        if len(low):
            low[cell] = min(low[cell], value)
        if len(high):
            high[cell] = max(high[cell], value)
        if len(count):
            count[cell] += 1
            if len(mean):
                step = value - mean[cell]
                mean[cell] += step / count[cell]
                if len(squares):
                    squares[cell] += step * (value - mean[cell])
