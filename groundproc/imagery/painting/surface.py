"""The surface that mosaics are laid on: the tops of a cloud, between its points, and which way they look."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from groundproc.cloud import reader
from groundproc.cloud.selection import CLASS, standing
from groundproc.raster.cells import Cells
from groundproc.raster.fill import fill
from groundproc.raster.grid import Grid
from groundproc.raster.openings import opened
from groundproc.raster.sampling import bilinear

Array = npt.NDArray[np.float64]
Raster = npt.NDArray[np.float32]

_CELL: Final = 1.5
"""Of the surface, in spacings of the points: few cells are then empty."""
_BRIDGED: Final = 3
"""Cells that a gap may be from the nearest point."""
_ROAD_M: Final = 6.0
"""Between ground on all sides a gap may be so wide: a lidar sees little of fresh asphalt or a puddle, and cameras see it."""
_STEP_M: Final = 0.4
"""Between neighbouring cells: an edge, across which nothing is interpolated."""
_OBJECT_M: Final = 2.0
_WIDEST_M: Final = 30.0
"""An object stands so much above what is left when everything narrower is levelled."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Heights on a grid.

    Attributes
    ----------
    grid : Grid
    height_m : ndarray of float32, shape (rows, columns)
        NaN where there is none.
    part : ndarray of int32, shape (rows, columns)
        Number of the object that stands there, such as a house; 0: the ground.
    parts : int
    """

    grid: Grid
    height_m: Raster
    part: npt.NDArray[np.int32]
    parts: int

    def at(self, east_m: Array, north_m: Array) -> tuple[Raster, npt.NDArray[np.int32], Raster]:
        """Heights, objects and normals, shape (n, 3), at places, shape (n,); edges stay sharp."""
        row, column = self._cell(east_m, north_m)
        own = self.height_m[row, column]
        smooth = bilinear(self.height_m, self.grid, np.stack([east_m, north_m], axis=1))
        with np.errstate(invalid="ignore"):
            height = np.where(np.abs(smooth - own) < _STEP_M, smooth, own).astype(np.float32)
        return height, self.part[row, column], self._normals(row, column)

    def _cell(self, east_m: Array, north_m: Array) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        grid = self.grid
        row = np.clip(np.floor((grid.north_m - north_m) / grid.cell_m), 0, grid.rows - 1).astype(np.intp)
        column = np.clip(np.floor((east_m - grid.west_m) / grid.cell_m), 0, grid.columns - 1).astype(np.intp)
        return row, column

    def _normals(self, row: npt.NDArray[np.intp], column: npt.NDArray[np.intp]) -> Raster:
        """From the slopes to the neighbours that are no edge away."""
        height, cell = self.height_m, self.grid.cell_m

        def slope(down: int, right: int) -> Raster:
            ahead = height[np.clip(row + down, 0, height.shape[0] - 1), np.clip(column + right, 0, height.shape[1] - 1)]
            back = height[np.clip(row - down, 0, height.shape[0] - 1), np.clip(column - right, 0, height.shape[1] - 1)]
            found = (ahead - back) / (2.0 * cell)
            with np.errstate(invalid="ignore"):
                return np.where(np.abs(found) * cell < _STEP_M, found, 0.0).astype(np.float32)

        normal = np.stack([-slope(0, 1), slope(1, 0), np.ones(len(row), np.float32)], axis=1)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True), np.float32)


def surface_of(cloud: reader.Cloud, spacing_m: float, least_m: float, all_classes: bool = False) -> Surface:
    """The tops of what stands of a cloud, whose points are so far apart; cells are no smaller than `least_m`."""
    cells = Cells(max(round(_CELL * spacing_m, 3), least_m), ("max",))
    for chunk in reader.chunks(cloud, columns=(CLASS,)):
        xyz_m = chunk.points.xyz_m[standing(chunk.points, all_classes)]
        cells.add(xyz_m, xyz_m[:, 2])
    grid = cells.grid()
    assert grid is not None
    known = _topped(cells.window(grid, "max"))
    there = np.isfinite(known)
    filled = fill(known)
    near = ndimage.distance_transform_edt(~there) <= _BRIDGED
    radius = max(1, round(0.5 * _WIDEST_M / grid.cell_m))
    with np.errstate(invalid="ignore"):
        high = filled - opened(filled, radius) > _OBJECT_M
    bridged = _closed(there & ~high, 0.5 * _ROAD_M / grid.cell_m) & ~high
    height = np.where(near | bridged, filled, np.nan).astype(np.float32)
    part, parts = ndimage.label(high & np.isfinite(height))
    return Surface(grid, height, part.astype(np.int32), int(parts))


def _closed(there: npt.NDArray[np.bool_], radius: float) -> npt.NDArray[np.bool_]:
    """Cells that no disc of a radius [cells] can hold without meeting some that are there: gaps that are narrow, and no surroundings."""
    wide = int(np.ceil(radius)) + 1
    padded = np.pad(there, wide)
    if not padded.any():
        return there
    reached = ndimage.distance_transform_edt(~padded) <= radius
    kept = ndimage.distance_transform_edt(reached) > radius
    return np.asarray(kept[wide:-wide, wide:-wide] | there)


def _topped(known: Raster) -> Raster:
    """Heights without those seen through gaps between the points of what stands above them: these cells are as if they were empty.

    A roof of points at random leaves cells without any, and there the ground below it, seen from aside, would be the top. Such a gap is
    deeper than a step below all around, and not three cells wide both ways.
    """
    high = ndimage.maximum_filter(np.where(np.isfinite(known), known, -np.inf), 3, mode="nearest")
    closed = ndimage.minimum_filter(high, 3, mode="nearest")
    with np.errstate(invalid="ignore"):
        return np.where(closed - known > _STEP_M, np.nan, known).astype(np.float32)
