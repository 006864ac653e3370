"""From a surface or a cloud and a place to a raster of what is seen."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis import voxelsight
from groundproc.analysis.sighttask import VOXELS, Task, accompanied, alone, along
from groundproc.analysis.viewshed import EXACT, FAST, UNKNOWN, VISIBLE, Sight, bend_per_m, height_at, viewshed
from groundproc.cloud import reader
from groundproc.cloud.metres import METRES, Metres, Raster, flat, metres_in, metres_of, unstated
from groundproc.cloud.sameness import agreed_crs
from groundproc.cloud.selection import SURFACES
from groundproc.files import written_aside
from groundproc.raster import geotiff
from groundproc.raster.cells import Cells
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window, checked_cell
from groundproc.raster.relief import filled_by_bands

Array = npt.NDArray[np.float64]

MODES: Final = (EXACT, FAST, VOXELS)
SUFFIXES: Final = (".tif", ".tiff")
_CELL_M: Final = 0.5
_MOSTLY_UNKNOWN: Final = 0.5
_GAP_M: Final = 1.0
"""Gaps of a cloud's surface that are bridged, as in hillshades."""
_MOST_CELLS: Final = 400_000_000
"""Cells that are held in memory at once: lines go everywhere."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Heights in memory, and where they are."""

    height_m: npt.NDArray[np.floating[Any]]
    west_m: float
    north_m: float
    grid: Grid
    crs: pyproj.CRS | None
    unit: Metres
    warnings: tuple[str, ...] = ()

    def cell(self, place_m: Sequence[float]) -> tuple[float, float]:
        """Column and row of a place, from the centre of the first cell."""
        return (place_m[0] - self.west_m) / self.grid.cell_m - 0.5, (self.north_m - place_m[1]) / self.grid.cell_m - 0.5


def run(task: Task, progress: Callable[[int], object]) -> dict[str, Any]:
    """Make the raster, and give its figures.

    Raises
    ------
    SwathError
        What is asked for cannot be, or a file is not as it should be.
    """
    if task.mode not in MODES:
        raise UsageError(f"--mode {task.mode}: expected {', '.join(MODES)}")
    if (task.at_m is None) == (task.path is None):
        raise UsageError("expected a place with --at E,N, or lines with --path FILE, and not both")
    if task.mode == VOXELS:
        return voxelsight.run(task, progress)
    surface = _surface(task, progress)
    places = _places(task, surface)
    seen = np.zeros(surface.height_m.shape, np.min_scalar_type(len(places)))
    known = np.zeros(surface.height_m.shape, np.bool_)
    above, target = (task.target_m, task.height_m) if task.reverse else (task.height_m, task.target_m)
    unit = surface.unit
    bend = bend_per_m(task.curved) * unit.across**2 / unit.up
    for place in places:
        column, row = surface.cell(place)
        # heights in the unit of the surface; a straight line stays one in any
        sight = Sight(column, row, above / unit.up, target / unit.up, bend, surface.grid.cell_m)
        one = viewshed(surface.height_m, sight, task.mode)
        seen += one == VISIBLE
        known |= one != UNKNOWN
        progress(1)
    one_place = task.path is None
    band = Band("visible" if one_place else "places that see it", "", "uint8", float(UNKNOWN), "nearest")
    if not one_place:
        band = Band("places that see it", "", "float32")

    def block(window: Window) -> npt.NDArray[Any]:
        top = surface.grid.row + surface.grid.rows - window.row - window.rows
        left = window.column - surface.grid.column
        part = slice(top, top + window.rows), slice(left, left + window.columns)
        return np.where(known[part], seen[part].astype(np.float32), np.float32(np.nan))

    with written_aside(task.output) as aside:
        geotiff.write(aside, surface.grid, surface.crs, band, block, corner_m=(surface.west_m, surface.north_m))
    angles = surface.crs is not None and surface.crs.is_geographic
    area = (surface.grid.cell_m * unit.across) ** 2
    return {
        "mode": task.mode, "places": len(places), "cells": int(known.size), "visible_cells": int((seen > 0).sum()),
        "unknown_cells": int((~known).sum()), "visible_m2": None if angles else float((seen > 0).sum() * area),
        "warnings": [*surface.warnings, *_gaps(task, surface, known)],
    }  # fmt: skip


def _gaps(task: Task, surface: Surface, known: npt.NDArray[np.bool_]) -> list[str]:
    """What is said of a surface with so many gaps that of most of its cells nothing is known."""
    heights = np.isfinite(surface.height_m)
    share = float(np.count_nonzero(heights & ~known)) / max(int(np.count_nonzero(heights)), 1)
    if share < _MOSTLY_UNKNOWN:
        return []
    remedy = "choose a larger --cell"
    if task.source.suffix.lower() in SUFFIXES:
        remedy = f"give the cloud itself, in which gaps up to {_GAP_M:g} m are bridged, or a raster of larger cells"
    return [
        f"{task.source}: of {share:.0%} of its cells nothing is known, since lines to them cross cells without height; {remedy}"
    ]


def _surface(task: Task, progress: Callable[[int], object]) -> Surface:
    if task.source.suffix.lower() in SUFFIXES:
        if task.cell_m is not None:
            raise UsageError(f"--cell {task.cell_m:g}: is for clouds; {task.source} has cells of its own")
        with geotiff.opened(task.source) as raster:
            _check_size(raster.grid)
            angles = raster.crs is not None and raster.crs.is_geographic
            if task.curved:
                flat(task.source, raster.crs)
            heights = raster.window(raster.grid)
            return Surface(
                heights,
                raster.west_m,
                raster.north_m,
                raster.grid,
                raster.crs,
                METRES if angles else metres_in(raster.crs),
                tuple(unstated(Raster(task.source, raster.crs))),
            )
    cloud = reader.look(task.source, SURFACES)
    unit = metres_of(cloud)
    cell_m = checked_cell(task.cell_m or _CELL_M)
    crs = agreed_crs([cloud])
    cells = Cells(cell_m / unit.across, {"max"})
    company, strays = accompanied(cloud, unit, cell_m, progress), 0
    for chunk in reader.chunks(cloud, columns=()):
        xyz = chunk.points.xyz_m
        stray = company.alone(unit.of(xyz))
        cells.add(xyz[~stray], xyz[~stray, 2])
        strays += int(stray.sum())
        progress(len(chunk.points))
    grid = cells.grid()
    if grid is None:
        raise CoverageError(f"{task.source}: all its points are classed as noise or as what moves, or are alone")
    _check_size(grid)
    heights = filled_by_bands(lambda window: cells.window(window, "max"), grid, max(round(_GAP_M / cell_m), 1))
    told = (*alone(task.source, strays), *unstated(cloud))
    return Surface(heights, grid.west_m, grid.north_m, grid, crs, unit, told)


def _check_size(grid: Grid) -> None:
    if grid.columns * grid.rows > _MOST_CELLS:
        raise UsageError(
            f"{grid.columns} x {grid.rows} cells found, expected at most {_MOST_CELLS:,} for lines of sight; cut out the part of "
            "interest, or choose larger cells"
        )


def _places(task: Task, surface: Surface) -> list[tuple[float, float]]:
    """Places of the observer.

    Raises
    ------
    CoverageError
        There is no surface at one place, or at any of a path.
    """
    rows, columns = surface.height_m.shape

    def known(place: tuple[float, float]) -> bool:
        column, row = surface.cell(place)
        inside = -0.5 <= column <= columns - 0.5 and -0.5 <= row <= rows - 0.5
        return inside and bool(np.isfinite(height_at(surface.height_m, column, row)))

    places = [task.at_m] if task.at_m is not None else along(task, surface.crs)
    found = [place for place in places if known(place)]
    if not found:
        cell, (west, north) = surface.grid.cell_m, (surface.west_m, surface.north_m)
        raise CoverageError(
            f"{places[0][0]:.2f},{places[0][1]:.2f}: the surface has no height there, expected a place within {west:.2f} to "
            f"{west + columns * cell:.2f} E and {north - rows * cell:.2f} to {north:.2f} N with heights around it"
        )
    return found
