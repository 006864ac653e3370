"""The floor of a cloud: the ground by its lowest points, over which heights of all its points are told.

One reading of the cloud, of a sparse one two, of a very sparse one three; rasters lie in temporary files without a name.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError
from groundproc.analysis.terrain.filter import bare_ground, smoothed
from groundproc.analysis.terrain.halls import HALO_M
from groundproc.analysis.terrain.settings import COARSE_M, FINE_M, PRESETS, settings_for
from groundproc.analysis.terrain.sparse import SPARSE_M2, bounds_m2, cell_for, density_of
from groundproc.analysis.terrain.surfaces import Sheet, blocks
from groundproc.cloud import reader
from groundproc.cloud.classes import GROUND, HIGH_NOISE, LOW_NOISE, NO_SURFACE, PANE, UNCLASSIFIED
from groundproc.cloud.metres import metres_of
from groundproc.numerics.lonely import LEAST_SIDE_M, Lonely
from groundproc.raster.cells import Cells
from groundproc.raster.grid import Grid, Window

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

NOISE_HEIGHT_M: Final = 3.0
"""Lower than this above ground nothing is called high noise."""
LEAST_DEPTH_M: Final = 0.5
"""Points are low noise that lie so far below the ground, and beyond its own tolerance."""
FILL_M: Final = 60.0
"""Halo of a block within which gaps are filled alike from both sides of its edge."""
_BASE_CELLS: Final = 1.5
_RIM_M: Final = 6.0
"""Beyond the outermost points of a block: models of the ground reach 5 m beyond them."""


class Floor:
    """The ground of a cloud.

    Parameters
    ----------
    cloud : reader.Cloud
    folder : Path
        For temporary files.
    progress : callable
        Told of points done, also while `pieces` are taken.
    terrain : str
        See `settings.PRESETS`.
    cell_m, window_m : float, optional

    Attributes
    ----------
    height, reach : Sheet
        Lowest ground, and how far from it points are ground.
    base : Sheet
        The same, smoothed.
    """

    def __init__(
        self,
        cloud: reader.Cloud,
        folder: Path,
        progress: Progress,
        terrain: str = "auto",
        cell_m: float | None = None,
        window_m: float | None = None,
    ) -> None:
        self.cloud, self.metres, self.progress, self._folder = cloud, metres_of(cloud), progress, folder
        thin_m2 = self._thin_m2()
        if thin_m2 is not None and cell_m is None:
            cell_m = cell_for(thin_m2, PRESETS["auto"].window_m if window_m is None else window_m)
        lowest = Cells(FINE_M if cell_m is None else cell_m, {"min", "count"})
        self._lonely = Lonely()
        for _, xyz, noise in self.pieces():
            lowest.add(xyz[~noise], xyz[~noise, 2])
            self._lonely.add(xyz)
        fine = lowest.grid()
        if fine is None:
            raise CoverageError(f"{cloud.path}: all its points are classed as noise or as what moves")
        self.density_m2 = _density(lowest, fine) if thin_m2 is None else thin_m2
        self.settings = settings_for(terrain, self.density_m2, cell_m, window_m)
        side_m = 4.0 / np.sqrt(self.density_m2)
        if side_m > LEAST_SIDE_M:  # of a sparse cloud most points are further than that from each other
            self._lonely = Lonely(side_m)
            for _, xyz, _ in self.pieces():
                self._lonely.add(xyz)
        self._find(lowest, fine)

    def _thin_m2(self) -> float | None:
        """Points in a square metre of a cloud that was thinned so far that cells have to go by it; None for all others."""
        if self.cloud.points >= SPARSE_M2 * bounds_m2(self.cloud.path, self.metres.across):
            return None
        found = density_of(xyz for _, xyz, _ in self.pieces())
        return found if found < SPARSE_M2 else None

    def refuse_thin(self, wanted: str) -> None:
        """Refuse a cloud that is too sparse for small cells over its whole area.

        Raises
        ------
        CoverageError
        """
        if self.density_m2 < SPARSE_M2:
            raise CoverageError(
                f"{self.cloud.path}: {self.density_m2:.2g} points on a square metre, expected {SPARSE_M2:g} or more to look for {wanted}"
            )

    def pieces(self) -> Iterator[tuple[Any, Array, npt.NDArray[np.bool_]]]:
        """Records, their places in metres, and which belong to no surface outdoors: by their class noise, what moved, or behind panes."""
        for chunk in reader.chunks(self.cloud, columns=("classification",)):
            kind = chunk.points.columns.get("classification")
            xyz = np.ascontiguousarray(self.metres.of(chunk.points.xyz_m))
            none = np.zeros(len(xyz), np.bool_)
            yield chunk.record, xyz, none if kind is None else np.isin(kind, (*NO_SURFACE, PANE))
            self.progress(len(xyz))

    def _find(self, lowest: Cells, fine: Grid) -> None:
        """The ground of the lowest points."""
        settings = self.settings
        times = round(settings.cell_m / lowest.cell_m)
        self.grid = _coarser(fine, times, settings.cell_m)
        self.height, self.reach = Sheet(self.grid, self._folder), Sheet(self.grid, self._folder)
        self.base = Sheet(self.grid, self._folder)
        halo_m = max(2.0 * settings.window_m + 4.0 * settings.smoothing_m + FILL_M, HALO_M if settings.hall_m else 0.0)
        halo = round(halo_m / settings.cell_m)
        for block, around, cut in blocks(self.grid, halo):
            if not lowest.holds(_finer(block, times)):
                continue
            values = _least(lowest, around, times)
            known = np.isfinite(values)
            if cut(known).any():
                # what lies beyond all points of a block and its halo is as what lies beyond the cloud: a corridor fills few of them
                part = _occupied(known, round(_RIM_M / settings.cell_m))
                bare = bare_ground(values[part], settings)
                smooth = smoothed(bare.height_m, _BASE_CELLS)
                sheets = (self.height, bare.height_m), (self.reach, bare.reach_m), (self.base, smooth)
                for sheet, found in sheets:
                    sheet.put(block, cut(_beyond(found, part, known.shape)))

    def above(self, xyz: Array) -> npt.NDArray[np.float32]:
        """Height above the lowest ground, shape (n,)."""
        return (xyz[:, 2] - self.height.bilinear(xyz)).astype(np.float32)

    def heights(self, xyz: Array, noise: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[Any], npt.NDArray[np.uint8]]:
        """Height above the lowest ground, and class as far as height tells it: ground, noise, or something above the ground."""
        above = self.above(xyz)
        reach = self.reach.bilinear(xyz)
        kind = np.full(len(xyz), UNCLASSIFIED, np.uint8)
        kind[np.abs(above) <= reach] = GROUND
        kind[above < -np.maximum(reach, LEAST_DEPTH_M)] = LOW_NOISE
        high = np.flatnonzero(above > NOISE_HEIGHT_M)
        kind[high[self._lonely.alone(xyz[high])]] = HIGH_NOISE
        kind[noise & (above < 0.0)], kind[noise & (above >= 0.0)] = LOW_NOISE, HIGH_NOISE
        return above, kind


def _density(cells: Cells, grid: Grid) -> float:
    """Points in a square metre, of the square metres that have any."""
    times = max(round(COARSE_M / cells.cell_m), 1)
    points, seen = 0.0, 0
    for block, _, _ in blocks(_coarser(grid, times, cells.cell_m * times), 0):
        if not cells.holds(_finer(block, times)):
            continue
        count = cells.window(_finer(block, times), "count").astype(np.float64)
        count = count.reshape(block.rows, times, block.columns, times).sum(axis=(1, 3))
        points, seen = points + float(count.sum()), seen + int((count > 0).sum())
    return points / seen / (cells.cell_m * times) ** 2


def _least(cells: Cells, window: Window, times: int) -> npt.NDArray[np.float32]:
    """Lowest points of cells that are made of several smaller ones."""
    if times == 1:
        return cells.window(window, "min")
    values = cells.window(_finer(window, times), "min").reshape(window.rows, times, window.columns, times)
    low = np.where(np.isfinite(values), values, np.float32(np.inf)).min(axis=(1, 3))
    return np.where(np.isfinite(low), low, np.float32(np.nan))


def _occupied(known: npt.NDArray[np.bool_], rim: int) -> tuple[slice, slice]:
    """Rows and columns between the first and the last that hold anything, and a few more."""
    ends = [
        (np.flatnonzero(known.any(axis=axis))[[0, -1]], size)
        for axis, size in ((1, known.shape[0]), (0, known.shape[1]))
    ]
    rows, columns = (slice(max(int(e[0]) - rim, 0), min(int(e[1]) + 1 + rim, size)) for e, size in ends)
    return rows, columns


def _beyond(
    values: npt.NDArray[np.float32], part: tuple[slice, slice], shape: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """A raster of which a part is known, with the nearest of that beyond."""
    sides = [(each.start, size - each.stop) for each, size in zip(part, shape, strict=True)]
    return np.pad(values, sides, mode="edge") if np.any(sides) else values


def _coarser(grid: Window, times: int, cell_m: float) -> Grid:
    column, row = grid.column // times, grid.row // times
    columns, rows = -(-(grid.column + grid.columns) // times) - column, -(-(grid.row + grid.rows) // times) - row
    return Grid(column, row, columns, rows, cell_m)


def _finer(window: Window, times: int) -> Window:
    return Window(window.column * times, window.row * times, window.columns * times, window.rows * times)
