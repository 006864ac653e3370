"""By how much flight lines differ in height, cell by cell, where several of them saw the same smooth surface.

In each cell every line gets a plane of its own height, all with one slope in common: the least squares solution of one plane a cell with a
step for each line. So neither a slope nor where in the cell a line happened to sample it passes for a difference. A cell whose points
scatter about the planes by more than `ROUGH_M` holds plants or edges, and says nothing.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
from numba import njit

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud.points import Points
from groundproc.numerics.voxelhash import sorted_by
from groundproc.raster import geotiff
from groundproc.raster.cells import SIDE, cells_of, edged
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window, checked_cell

Values = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

LINE: Final = "point_source_id"
CELL_M: Final = 0.5
LEAST_POINTS: Final = 4
"""Of a line in a cell."""
ROUGH_M: Final = 0.1
"""About the planes, one sigma: grass and gravel are below, bushes and edges of roofs above."""
_LEVEL: Final = 9e-4
"""What is known of slopes beforehand: 45 deg, one sigma, where heights scatter by 3 cm. Points in one row do not tell the slope across."""
_CELLS: Final = SIDE * SIDE
BAND: Final = Band("flight line difference", "m")


class _Tile:
    """A square of cells: sums of products about the means of each line, all lines together, and the means of each line."""

    def __init__(self, height_m: float) -> None:
        self.height_m = height_m
        self.sums = np.zeros((_CELLS, 6), np.float32)
        self.lines: dict[int, Values] = {}

    def line(self, number: int) -> Values:
        """Count, mean x, y (of a cell, from its middle) and height of each cell of a line."""
        found = self.lines.get(number)
        if found is None:
            found = self.lines[number] = np.zeros((_CELLS, 4), np.float32)
        return found


class LineDifferences:
    """Gathers points of flight lines in any order.

    Parameters
    ----------
    cell_m : float

    Raises
    ------
    UsageError
        The cell is no size.
    """

    def __init__(self, cell_m: float) -> None:
        self._cell_m = checked_cell(cell_m)
        self._tiles: dict[tuple[int, int], _Tile] = {}

    def add(self, points: Points) -> None:
        """Take points.

        Raises
        ------
        UsageError
            They have no flight line.
        """
        if not len(points):
            return
        lines, line = np.unique(points[LINE], return_inverse=True)
        xyz_m = np.ascontiguousarray(points.xyz_m)
        within, tile, tiles = cells_of(xyz_m, self._cell_m)
        order, first = sorted_by((tile.astype(np.int64) * len(lines) + line).astype(np.int32), len(tiles) * len(lines))
        for each, place in enumerate(tiles):
            for which, number in enumerate(lines.tolist()):
                key = each * len(lines) + which
                some = order[first[key] : first[key + 1]]
                if len(some):
                    found = self._tiles.setdefault(place, _Tile(float(xyz_m[some[0], 2])))
                    _take(xyz_m, within, some, (self._cell_m, found.height_m), found.sums, found.line(number))

    def grid(self) -> Grid | None:
        """The smallest grid that holds all cells with points; None: there are none."""
        bounds = []
        for (x, y), tile in self._tiles.items():
            seen = np.any([line[:, 0] > 0 for line in tile.lines.values()], axis=0).reshape(SIDE, SIDE)
            rows, columns = np.nonzero(seen)
            bounds.append(
                (x * SIDE + columns.min(), y * SIDE + rows.min(), x * SIDE + columns.max(), y * SIDE + rows.max())
            )
        if not bounds:
            return None
        west, south, east, north = np.array(bounds).T
        return Grid(
            int(west.min()),
            int(south.min()),
            int(east.max() - west.min()) + 1,
            int(north.max() - south.min()) + 1,
            self._cell_m,
        )

    def window(self, window: Window) -> Values:
        """Differences of some cells, shape (rows, columns), the first row in the north; NaN where not two lines tell."""
        out = np.full((window.rows, window.columns), np.nan, np.float32)
        top, right = window.row + window.rows, window.column + window.columns
        for y in range(window.row // SIDE, (top - 1) // SIDE + 1):
            for x in range(window.column // SIDE, (right - 1) // SIDE + 1):
                tile = self._tiles.get((x, y))
                if tile is None or len(tile.lines) < 2:
                    continue
                south, west = max(window.row, y * SIDE), max(window.column, x * SIDE)
                north, east = min(top, (y + 1) * SIDE), min(right, (x + 1) * SIDE)
                part = _differences(tile).reshape(SIDE, SIDE)[
                    south - y * SIDE : north - y * SIDE, west - x * SIDE : east - x * SIDE
                ]
                out[top - north : top - south, west - window.column : east - window.column] = part[::-1]
        return out

    @property
    def overlap(self) -> bool:
        """Whether any cell tells a difference."""
        return any(len(tile.lines) > 1 and bool(np.isfinite(_differences(tile)).any()) for tile in self._tiles.values())


class Gathering:
    """A raster of differences, gathered from points: as `kinds.Gathering`.

    Parameters
    ----------
    cell_m : float
    folder : Path
    """

    band: Final = BAND

    def __init__(self, cell_m: float, folder: Path) -> None:
        del folder
        self._cells = LineDifferences(cell_m)

    def add(self, points: Points) -> None:
        """Take points."""
        self._cells.add(points)

    def made(self, path: Path) -> tuple[Grid, Any]:
        """The grid, and what gives its windows.

        Raises
        ------
        CoverageError
            There are no points.
        """
        grid = self._cells.grid()
        if grid is None:
            raise CoverageError(f"{path.name}: there are no points")
        return grid, self._cells.window

    def expect_overlap(self, path: Path) -> None:
        """Refuse points of which no two lines saw a cell.

        Raises
        ------
        UsageError
        """
        if not self._cells.overlap:
            raise UsageError(
                f"{path.name}: no cell of a smooth surface was seen by two flight lines ({LINE}); expected lines that overlap"
            )

    def write(self, path: Path, crs: pyproj.CRS | None) -> None:
        """Write the raster; where no lines overlap, all of it is no data."""
        grid, block = self.made(path)
        geotiff.write(path, grid, crs, BAND, block)


def _differences(tile: _Tile) -> Values:
    """Of the two lines of each cell that differ most: the later less the earlier, shape (cells,)."""
    sxx, sxy, syy, sxz, syz, szz = (tile.sums[:, k].astype(np.float64) for k in range(6))
    sxx, syy = sxx + _LEVEL, syy + _LEVEL
    determinant = sxx * syy - sxy**2
    east, north = (syy * sxz - sxy * syz) / determinant, (sxx * syz - sxy * sxz) / determinant
    low, high = np.full(_CELLS, np.inf), np.full(_CELLS, -np.inf)
    of_low, of_high = np.zeros(_CELLS, np.int64), np.zeros(_CELLS, np.int64)
    points, lines = np.zeros(_CELLS), np.zeros(_CELLS)
    for number in sorted(tile.lines):
        count, x, y, z = tile.lines[number].T.astype(np.float64)
        height = np.where(count >= LEAST_POINTS, z - east * x - north * y, np.nan)
        points, lines = points + count, lines + (count > 0)
        lower, higher = height < low, height > high
        low, of_low = np.where(lower, height, low), np.where(lower, number, of_low)
        high, of_high = np.where(higher, height, high), np.where(higher, number, of_high)
    free = points - lines - 2.0
    rough = np.sqrt(np.maximum(szz - east * sxz - north * syz, 0.0) / np.maximum(free, 1.0))
    told = (of_low != of_high) & np.isfinite(low) & np.isfinite(high) & (free > 0) & (rough <= ROUGH_M)
    with np.errstate(invalid="ignore"):
        found = np.where(told, (high - low) * np.sign(of_high - of_low), np.nan)
    return np.asarray(found, np.float32)


@njit(cache=True, nogil=True)
def _take(xyz_m: Any, within: Any, some: Any, frame: Any, sums: Any, line: Any) -> None:
    """Add points of one line to the cells of a tile: means and products about them by Welford (1962)."""
    cell_m, height_m = frame
    per_m = 1.0 / cell_m
    for i in some:
        cell = within[i]
        east, north = edged(xyz_m[i, 0], per_m), edged(xyz_m[i, 1], per_m)
        x = (east - np.floor(east) - 0.5) * cell_m
        y = (north - np.ceil(north) + 0.5) * cell_m
        z = xyz_m[i, 2] - height_m
        line[cell, 0] += 1
        count = line[cell, 0]
        dx, dy, dz = x - line[cell, 1], y - line[cell, 2], z - line[cell, 3]
        line[cell, 1] += dx / count
        line[cell, 2] += dy / count
        line[cell, 3] += dz / count
        left = (count - 1) / count
        sums[cell, 0] += left * dx * dx
        sums[cell, 1] += left * dx * dy
        sums[cell, 2] += left * dy * dy
        sums[cell, 3] += left * dx * dz
        sums[cell, 4] += left * dy * dz
        sums[cell, 5] += left * dz * dz
