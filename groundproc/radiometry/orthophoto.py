"""An orthophoto of any attribute of clouds: moving planes over the uppermost echoes, square by square."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.metres import flat, metres_in
from groundproc.cloud.selection import SURFACES
from groundproc.files import written_aside
from groundproc.raster import geotiff
from groundproc.raster.cells import Cells, column_and_row
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window, checked_cell
from groundproc.raster.movingplanes import moving_planes
from groundproc.raster.work import common_crs

Array = npt.NDArray[np.float64]

SUFFIXES: Final = (".tif", ".tiff")
_MARGIN_CELLS: Final = 6
"""Around a block: as far as a plane looks."""
_TOP_M: Final = 0.3
"""Echoes so far below the highest of a cell are under it, and not seen from above."""
_BLOCK: Final = 512
_STRENGTHS: Final = ("intensity", "reflectance")


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it."""

    columns: int
    rows: int
    cell_m: float
    points: int
    used: int
    filled: int
    warnings: tuple[str, ...]


def orthophoto(
    paths: Sequence[Path],
    output: Path,
    attribute: str,
    cell_m: float,
    crs: str | None,
    progress: Callable[[int], object],
) -> Made:
    """Make the raster.

    Raises
    ------
    SwathError
        The clouds have no such attribute, differ in their CRS, or cannot be read.
    """
    checked_cell(cell_m)
    clouds = [reader.look(path, SURFACES) for path in paths]
    common, warnings = common_crs(clouds, crs)
    flat(paths[0], common)
    unit = metres_in(clouds[0].crs if crs is None else common)
    cell = cell_m / unit.across
    for cloud in clouds:
        if attribute not in cloud.columns:
            helps = "; `swath reflectance` makes it" if attribute == "reflectance" else ""
            raise UsageError(f"{cloud.path}: has no {attribute}, but {', '.join(cloud.columns)}{helps}")
    tops, points, told = Cells(cell, {"max"}), 0, attribute not in _STRENGTHS
    for cloud in clouds:
        for chunk in reader.chunks(cloud, columns=(attribute,)):
            good = np.isfinite(chunk.points[attribute].astype(np.float64))
            told = told or bool(np.any(chunk.points[attribute][good]))
            tops.add(chunk.points.xyz_m[good], chunk.points.xyz_m[good, 2])
            points += len(chunk.points)
            progress(len(chunk.points))
    grid = tops.grid()
    if grid is None:
        raise CoverageError(f"{paths[0]}: not one point has a value of {attribute}")
    if not told:
        raise CoverageError(f"{paths[0]}: {attribute} is 0 for all points, expected the strength of each echo")
    kept = _Blocks(grid, output.parent, _TOP_M / unit.up)
    for cloud in clouds:
        for chunk in reader.chunks(cloud, columns=(attribute,)):
            kept.add(chunk.points.xyz_m, chunk.points[attribute].astype(np.float64), tops)
            progress(len(chunk.points))
    filled = 0

    def block(window: Window) -> npt.NDArray[np.float32]:
        nonlocal filled
        values = kept.block(window)
        filled += int(np.isfinite(values).sum())
        return values

    with written_aside(output) as aside:
        geotiff.write(aside, grid, common, Band(attribute), block)
    return Made(grid.columns, grid.rows, cell_m, points, kept.used, filled, warnings)


class _Blocks:
    """Points that are seen from above, on the disk by block of the raster, with those around it."""

    def __init__(self, grid: Grid, folder: Path, top: float) -> None:
        from groundproc.cloud.spool import Spool

        folder.mkdir(parents=True, exist_ok=True)
        self._grid, self._top_within = grid, top
        self._dtype = np.dtype([("x", "f8"), ("y", "f8"), ("value", "f8")])
        self._spool = Spool(self._dtype, folder)
        self.used = 0

    def add(self, xyz_m: Array, values: Array, tops: Cells) -> None:
        """Take points, shape (n, 3) and (n,)."""
        good = np.isfinite(values)
        if good.any():
            good[good] = xyz_m[good, 2] >= tops.at(xyz_m[good], "max") - self._top_within
        self.used += int(good.sum())
        records = np.empty(int(good.sum()), self._dtype)
        records["x"], records["y"], records["value"] = xyz_m[good, 0], xyz_m[good, 1], values[good]
        grid = self._grid
        column, row = column_and_row(np.stack([records["x"], records["y"]], axis=1), grid.cell_m).T
        right, down = column - grid.column, grid.row + grid.rows - 1 - row
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                near = self._near(right, i) & self._near(down, j)
                column, row = right[near] // _BLOCK + i, down[near] // _BLOCK + j
                for key in np.unique(column * (1 << 32) + row):
                    own = (column * (1 << 32) + row) == key
                    place = (int(column[own][0]), int(row[own][0]))
                    if 0 <= place[0] * _BLOCK < grid.columns and 0 <= place[1] * _BLOCK < grid.rows:
                        self._spool.add(place, records[near][own])

    @staticmethod
    def _near(cell: npt.NDArray[np.int64], step: int) -> npt.NDArray[np.bool_]:
        """Cells that the block `step` blocks on looks at."""
        within = cell % _BLOCK
        if step == 0:
            return np.ones(len(cell), np.bool_)
        return np.asarray(within < _MARGIN_CELLS if step < 0 else within >= _BLOCK - _MARGIN_CELLS)

    def block(self, window: Window) -> npt.NDArray[np.float32]:
        """Values of a block of the raster."""
        grid = self._grid
        place = ((window.column - grid.column) // _BLOCK, (grid.row + grid.rows - window.row - window.rows) // _BLOCK)
        records: npt.NDArray[Any] = self._spool.take(place)
        corner = (window.column * grid.cell_m, (window.row + window.rows) * grid.cell_m)
        xy = np.column_stack([records["x"], records["y"]])
        return moving_planes(xy, records["value"], corner, (window.rows, window.columns), grid.cell_m).value
