"""From a cloud to its bare ground: classes, height above ground, terrain and canopy models, buildings.

The cloud is read three times: for the lowest point of each cell, for the ground points' mean heights, and to be written anew. Points never
wait in memory; rasters lie in temporary files beside the output, and are made block by block. Memory: about 60 bytes for each cell with
points, and some 200 MB for a block.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.ndimage import binary_dilation, distance_transform_edt

from groundproc.analysis.terrain.building import LOW_M, roof_outlines, roofs
from groundproc.analysis.terrain.floor import FILL_M, Floor
from groundproc.analysis.terrain.holdout import HoldOut
from groundproc.analysis.terrain.settings import Settings, settings_for
from groundproc.analysis.terrain.surfaces import Sheet, blocks
from groundproc.analysis.terrain.water import read_water
from groundproc.cloud import classes as table
from groundproc.cloud import reader
from groundproc.cloud.classes import (
    BUILDING,
    GROUND,
    HIGH,
    HIGH_NOISE,
    LOW,
    LOW_NOISE,
    MEDIUM,
    OF_USES,
    UNCLASSIFIED,
    WATER,
    merged,
)
from groundproc.cloud.metres import unstated
from groundproc.cloud.rewriter import Rewriter
from groundproc.files import written_aside
from groundproc.raster import geotiff
from groundproc.raster.cells import Cells
from groundproc.raster.fill import fill
from groundproc.raster.grid import Grid, Window
from groundproc.raster.openings import dilated, eroded
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

NAMES: Final = {
    kind: table.NAMES[kind] for kind in (GROUND, LOW, MEDIUM, HIGH, BUILDING, LOW_NOISE, WATER, HIGH_NOISE, *OF_USES)
}
_LOW_M, _MEDIUM_M = 0.5, 2.0
"""Tops of low and of medium vegetation."""
_GRASS_M: Final = 0.1
"""Ground for the terrain model is no higher above the lowest points than their scatter and this ..."""
_GRASS_SHARE: Final = 0.3
"""... and this share of what slope adds to the tolerance of the class: grass belongs to the class, but shall not lift the model."""
_REACH_M: Final = 5.0
"""Models end so far from the nearest point."""
_SPIKE_M: Final = 1.0
"""A cell of a crown that lies so much lower than those around it was looked into by chance."""
_SPIKE_RADIUS_M: Final = 1.0


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath ground`."""

    cloud: Path
    output: Path
    dtm: Path | None = None
    confidence: Path | None = None
    chm: Path | None = None
    buildings: Path | None = None
    water: Path | None = None
    terrain: str = "auto"
    cell_m: float | None = None
    window_m: float | None = None


@dataclass(slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    settings : Settings
    density_m2 : float
        Points in a square metre of the ground that was seen.
    classes : Counter
        Points by class.
    holdout : HoldOut
    buildings : int
    warnings : list of str
    """

    settings: Settings
    density_m2: float
    classes: Counter[int] = field(default_factory=Counter)
    holdout: HoldOut = field(default_factory=HoldOut.none)
    buildings: int = 0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        settings = self.settings
        return {
            "points": self.classes.total(),
            "classes": {NAMES[kind]: self.classes[kind] for kind in sorted(NAMES)},
            "density_per_m2": self.density_m2,
            "cell_m": settings.cell_m,
            "window_m": settings.window_m,
            "holdout_rmse_m": self.holdout.rmse_m,
            "holdout_by_distance": self.holdout.by_distance(settings.cell_m),
            "buildings": self.buildings,
            "warnings": self.warnings,
        }


class _Area:
    """Rasters of one cloud above its floor: terrain, its sigma, canopy and roofs."""

    def __init__(self, task: Task, floor: Floor) -> None:
        self.task, self.floor = task, floor
        self.grid, self.settings, self.folder = floor.grid, floor.settings, task.output.parent
        self.made = Made(floor.settings, floor.density_m2)

    def survey(self) -> None:
        """Mean heights of the ground, and tops of all."""
        ground, top = Cells(self.settings.cell_m, {"mean", "sigma", "count"}), Cells(self.settings.cell_m, {"max"})
        low = Cells(self.settings.cell_m, {"count"})
        grass_m: float | None = None
        for _, xyz, noise in self.floor.pieces():
            above, kind = self.floor.heights(xyz, noise)
            bare = kind == GROUND
            if grass_m is None:
                grass_m = _scatter(above[bare]) if bare.any() else None
            slack = self.floor.reach.bilinear(xyz) - self.settings.height_m
            bare &= above < (grass_m or 0.0) + slack * _GRASS_SHARE
            # above a surface so smooth that its mean within a cell is its value in the middle: slopes do no harm
            ground.add(xyz[bare], xyz[bare, 2] - self.floor.base.bilinear(xyz[bare]))
            seen = (kind != LOW_NOISE) & (kind != HIGH_NOISE)
            top.add(xyz[seen], xyz[seen, 2])
            under = seen & (above < LOW_M)
            low.add(xyz[under], above[under])
        self._model(ground, top, low)

    def _model(self, ground: Cells, top: Cells, low: Cells) -> None:
        """Terrain, its sigma, canopy and roofs."""
        cell_m, folder = self.settings.cell_m, self.folder
        self.terrain, self.sigma = Sheet(self.grid, folder), Sheet(self.grid, folder)
        self.canopy, self.roof = Sheet(self.grid, folder), Sheet(self.grid, folder, np.uint8)
        self.seen = Sheet(self.grid, folder, np.uint8)
        water = (
            None
            if self.task.water is None
            else read_water(self.task.water, self.floor.cloud, self.floor.metres, self._bounds_m())
        )
        halo = round(FILL_M / cell_m)
        for number, (block, around, cut) in enumerate(blocks(self.grid, halo)):
            if not self.floor.base.holds(block):
                continue
            base = self.floor.base.window(around)
            if not np.isfinite(cut(base)).any():
                continue
            residual = ground.window(around, "mean")
            inside = np.zeros(base.shape, np.bool_)
            cut(inside)[:] = True
            self.made.holdout.add(residual, inside, number)
            highest = top.window(around, "max")
            roof = roofs(highest, fill(base), low.window(around, "count"), cell_m)
            # feet of walls pass for ground
            residual[binary_dilation(roof, np.ones((3, 3), np.bool_))] = np.nan
            terrain = fill(base) + (fill(residual) if np.isfinite(residual).any() else np.float32(0.0))
            if water is not None:
                water.flatten(terrain, around, cell_m)
            self.terrain.put(block, cut(terrain))
            self.roof.put(block, cut(roof))
            self.canopy.put(block, cut(canopy(highest - terrain, cell_m)))
            known = np.isfinite(highest)
            near = distance_transform_edt(~known) * cell_m <= _REACH_M if known.any() else known
            self.seen.put(block, cut(near))
            measured = np.isfinite(residual)
            away = distance_transform_edt(~measured) if measured.any() else np.full(base.shape, np.inf)
            self.sigma.put(block, np.where(cut(measured), -cut(_of_mean(ground, around)), cut(away)).astype(np.float32))
        self.water = water

    def _bounds_m(self) -> tuple[float, float, float, float]:
        grid = self.grid
        east, south = grid.west_m + grid.columns * grid.cell_m, grid.north_m - grid.rows * grid.cell_m
        return grid.west_m, south, east, grid.north_m

    def sigma_block(self, window: Window) -> npt.NDArray[Any]:
        """Sigma of heights of the terrain model [m]: kept as less than 0 where measured, else as the distance to what is.

        A measured cell is no better than what the cells around it say of one that was left out: grass and relief are in that.
        """
        kept = self.sigma.window(window)
        kept = np.where(kept <= 0.0, np.minimum(kept, -(self.made.holdout.rmse_m or 0.0)), kept)
        filled = self.made.holdout.sigma_m(np.maximum(kept, 0.0).astype(np.float64), self.settings.cell_m)
        return np.where(kept <= 0.0, -kept, filled)

    def classes(self, xyz: Array, noise: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[Any], npt.NDArray[np.uint8]]:
        """Height above the terrain, and class."""
        _, kind = self.floor.heights(xyz, noise)
        hag = (xyz[:, 2] - self.terrain.bilinear(xyz)).astype(np.float32)
        other = kind == UNCLASSIFIED
        grid = self.grid
        column = np.floor((xyz[:, 0] - grid.west_m) / grid.cell_m).astype(np.int64).clip(0, grid.columns - 1)
        down = np.floor((grid.north_m - xyz[:, 1]) / grid.cell_m).astype(np.int64).clip(0, grid.rows - 1)
        kind[other & (hag <= _LOW_M)] = LOW
        kind[other & (hag > _LOW_M) & (hag <= _MEDIUM_M)] = MEDIUM
        kind[other & (hag > _MEDIUM_M)] = HIGH
        kind[other & (hag > 1.0) & (self.roof.at(down, column) > 0)] = BUILDING
        if self.water is not None:
            kind[(np.abs(hag) < _LOW_M) & ((kind == GROUND) | (kind == LOW)) & self.water.covers(xyz)] = WATER
        return hag, kind


def work(task: Task, progress: Progress) -> Made:
    """Find the ground of a cloud, and write what was asked for; `progress` is told of points done, three times in all.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, UsageError, SourceError
        A file is not as it should be, or what is asked for is not possible.
    """
    settings_for(task.terrain, 1.0, task.cell_m, task.window_m)  # before anything is read
    cloud = reader.look(task.cloud)
    with written_aside(task.output) as aside:
        area = _Area(task, Floor(cloud, task.output.parent, progress, task.terrain, task.cell_m, task.window_m))
        area.survey()
        _write_models(area)
        compressed = task.output.suffix.lower() != ".las"
        with Rewriter(cloud, aside, compressed, ("classification", "hag")) as out:
            for record, xyz, noise in area.floor.pieces():
                hag, kind = area.classes(xyz, noise)
                kind = merged(record.classification, kind)
                area.made.classes.update(dict(zip(*_counted(kind), strict=True)))
                out.write(record, columns={"classification": kind, "hag": hag})
    area.made.warnings += unstated(cloud)
    if not area.made.classes[GROUND]:
        area.made.warnings.append("no ground was found")
    if area.made.holdout.rmse_m is None:
        area.made.warnings.append("too little ground to hold any of it out: sigmas of the terrain model are guessed")
    return area.made


def _write_models(area: _Area) -> None:
    """The rasters and outlines that were asked for."""
    task, metres, crs = area.task, area.floor.metres, area.floor.cloud.crs
    grid = Grid.of_window(area.grid, area.grid.cell_m / metres.across)

    def block(sheet: Callable[[Window], npt.NDArray[Any]]) -> Callable[[Window], npt.NDArray[Any]]:
        return lambda window: np.where(area.seen.window(window) > 0, sheet(window) / metres.up, np.nan)

    for path, name, sheet in (
        (task.dtm, "terrain height", area.terrain.window),
        (task.confidence, "sigma of the terrain height", area.sigma_block),
        (task.chm, "canopy height", area.canopy.window),
    ):
        if path is not None:
            with written_aside(path) as aside:
                geotiff.write(aside, grid, crs, geotiff.Band(name, "m" if metres.plain else ""), block(sheet))
    found = roof_outlines(area.roof)
    area.made.buildings = len(found)
    if task.buildings is not None:
        heights = [_height_within(area, each) for each in found]
        shapes = [shapely.transform(each, lambda xy: xy / metres.across) for each in found]
        columns = {"area_m2": np.array([each.area for each in found]), "height_m": np.array(heights)}
        features = Features(np.array(shapes, object), columns, area.floor.cloud.horizontal)
        with written_aside(task.buildings) as aside:
            write_features(aside, features, "Polygon", "buildings", task.buildings.suffix)


def _height_within(area: _Area, polygon: Any) -> float:
    """Median height of a building above the ground."""
    grid = area.grid
    low_x, low_y, high_x, high_y = polygon.bounds
    left, right = int((low_x - grid.west_m) / grid.cell_m), int((high_x - grid.west_m) / grid.cell_m) + 1
    top, bottom = int((grid.north_m - high_y) / grid.cell_m), int((grid.north_m - low_y) / grid.cell_m) + 1
    top, left = max(top, 0), max(left, 0)
    rows, columns = min(bottom, grid.rows) - top, min(right, grid.columns) - left
    part = Window(grid.column + left, grid.row + grid.rows - top - rows, columns, rows)
    heights = area.canopy.window(part)[area.roof.window(part) > 0]
    return float(np.nanmedian(heights)) if np.isfinite(heights).any() else float("nan")


def _scatter(above_m: npt.NDArray[np.float32]) -> float:
    """How far above the lowest points of cells bare ground itself scatters: what is higher is grass.

    Lowest points lie as far below the most frequent height as the highest lie above it.
    """
    counts, edges = np.histogram(above_m, np.arange(-0.1, 0.5, 0.02))
    smooth = np.convolve(counts, np.ones(3), "same")
    mode_m = float(edges[int(np.argmax(smooth))] + 0.01)
    return 2.0 * max(mode_m, 0.0) + _GRASS_M


def canopy(height_m: npt.NDArray[np.float32], cell_m: float) -> npt.NDArray[np.float32]:
    """Canopy heights without the holes of beams that went deep into a crown; not below the ground.

    Parameters
    ----------
    height_m : ndarray, shape (rows, columns)
        Highest point of each cell above the ground; NaN without any.
    cell_m : float
    """
    known = np.isfinite(height_m)
    if not known.any():
        return height_m
    surface = np.maximum(fill(height_m), np.float32(0.0))
    radius = max(round(_SPIKE_RADIUS_M / cell_m), 1)
    closed = eroded(dilated(surface, radius), radius)
    # a gap between trees is wider than a beam's; only what is low amid crowns on all sides is closed
    spike = (closed - surface > _SPIKE_M) & (closed > _MEDIUM_M)
    return np.where(spike, closed, surface)


def _counted(kind: npt.NDArray[np.uint8]) -> tuple[list[int], list[int]]:
    values, counts = np.unique(kind, return_counts=True)
    return values.tolist(), counts.tolist()


def _of_mean(ground: Cells, window: Window) -> npt.NDArray[Any]:
    """Sigma of the mean height of a cell's ground; of one point the typical scatter of the others."""
    sigma, count = ground.window(window, "sigma"), ground.window(window, "count")
    typical = np.nanmedian(sigma) if np.isfinite(sigma).any() else np.float32(0.1)
    return np.asarray(np.where(np.isfinite(sigma), np.maximum(sigma, 0.003), typical) / np.sqrt(np.maximum(count, 1.0)))
