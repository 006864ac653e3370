"""From a cloud to where a vehicle can go: slope, steps, obstacles, what nobody saw; and the best route.

The cloud is read for its ground (see `terrain.floor`) and once more for mean heights of the ground and for the highest point below the
vehicle's roof, cell by cell. Memory: that of the ground, and some 30 bytes for each cell; a route takes 100 for each that can be gone on.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.ndimage import distance_transform_edt

from flightlog.config import option
from flightlog.errors import CoverageError, UsageError
from groundproc.analysis.passage.enclosed import enclosed
from groundproc.analysis.passage.relief import REACH, planes, steps
from groundproc.analysis.passage.route import MOST_CELLS, Cell, best_route
from groundproc.analysis.terrain.floor import Floor
from groundproc.analysis.terrain.surfaces import Sheet, blocks
from groundproc.cloud import reader
from groundproc.cloud.classes import GROUND, HIGH_NOISE, LOW_NOISE
from groundproc.cloud.metres import unstated
from groundproc.files import made_folder, written_aside
from groundproc.raster import geotiff
from groundproc.raster.cells import Cells
from groundproc.raster.grid import Grid, Window, checked_cell
from groundproc.vectors.features import Features, write_features

Progress = Callable[[int], object]

PASSABLE, STEEP, STEP, OBSTACLE, NARROW = 1, 2, 3, 4, 5
"""Of passability.tif; 0 is unseen."""
NAMES: Final = {PASSABLE: "passable", STEEP: "too steep", STEP: "a step", OBSTACLE: "an obstacle", NARROW: "too narrow"}
FILES: Final = ("passability.tif", "slope.tif", "step.tif", "obstacle.tif", "route.geojson")
_PER_CELL: Final = 6.0
"""Points that a cell is to hold on the average."""
_CELLS_M: Final = (0.25, 0.5, 1.0)
_GAP_SHARE: Final = 0.5
"""A cell without points is bridged where so many of the eight around it are known."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What goes there.

    Attributes
    ----------
    max_slope_deg, max_step_m, max_obstacle_m, width_m, height_m : float
    """

    max_slope_deg: float = option(20.0, "steepest slope [deg]", minimum=1, maximum=60)
    max_step_m: float = option(0.2, "highest step up or down [m]", minimum=0.02, maximum=5)
    max_obstacle_m: float = option(0.3, "highest thing that it goes over [m]", minimum=0.02, maximum=5)
    width_m: float = option(2.0, "its width [m]", minimum=0.1, maximum=20)
    height_m: float = option(2.5, "its height: what hangs higher is no obstacle [m]", minimum=0.2, maximum=20)

    def __post_init__(self) -> None:
        if self.max_obstacle_m >= self.height_m:
            raise ValueError(f"max_obstacle_m {self.max_obstacle_m:g}: expected less than height_m, {self.height_m:g}")


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath passability`.

    Attributes
    ----------
    cloud, folder : Path
    vehicle : Vehicle
    cell_m : float or None
    ends : tuple of two (float, float), or None
        From where to where, in the CRS of the cloud.
    """

    cloud: Path
    folder: Path
    vehicle: Vehicle = Vehicle()
    cell_m: float | None = None
    ends: tuple[tuple[float, float], tuple[float, float]] | None = None


@dataclass(slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    cell_m : float
    area_m2 : dict of str to float
        By what a cell is; `unseen` counts what lies amid seen cells.
    route : dict or None
        Length, rise, fall, steepest slope and highest step of the way.
    """

    cell_m: float
    vehicle: Vehicle
    points: int
    area_m2: dict[str, float] = field(default_factory=dict)
    route: dict[str, float] | None = None
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "points": self.points, "cell_m": self.cell_m, "vehicle": asdict(self.vehicle), "area_m2": self.area_m2,
            "route": self.route, "warnings": self.warnings,
        }  # fmt: skip


class _Area:
    """Rasters of one cloud: ground, highest points below the roof, and what follows from them."""

    def __init__(self, task: Task, floor: Floor) -> None:
        self.task, self.floor = task, floor
        floor.refuse_thin("steps and obstacles")
        cell_m = checked_cell(_cell_for(floor.density_m2) if task.cell_m is None else task.cell_m)
        ground, east, north = (Cells(cell_m, {"mean"}) for _ in range(3))
        top, seen = Cells(cell_m, {"max"}), Cells(cell_m, {"count"})
        for _, xyz, noise in floor.pieces():
            above, kind = floor.heights(xyz, noise)
            bare = xyz[kind == GROUND]
            ground.add(bare, bare[:, 2])
            # where in its cell the mean of its points lies: on a slope that moves their mean height
            within = bare[:, :2] * (1.0 / cell_m)
            within[:, 0] -= np.floor(within[:, 0]) + 0.5
            within[:, 1] -= np.ceil(within[:, 1]) - 0.5  # as cells have it: a point on an edge is of the southern one
            east.add(bare, within[:, 0] * cell_m)
            north.add(bare, within[:, 1] * cell_m)
            below = ~noise & (above < task.vehicle.height_m) & (kind != HIGH_NOISE) & (kind != LOW_NOISE)
            top.add(xyz[below], xyz[below, 2])
            seen.add(xyz[~noise], xyz[~noise, 2])
        grid = seen.grid()
        assert grid is not None
        self.grid = grid
        self._ground, self._within, self._top, self._seen = ground, (east, north), top, seen
        folder = task.folder
        self.slope, self.step = Sheet(grid, folder), Sheet(grid, folder)
        self.obstacle, self.height = Sheet(grid, folder), Sheet(grid, folder)
        self.kind = Sheet(grid, folder, np.uint8)
        self._relief()
        self._classes()

    def _relief(self) -> None:
        vehicle, cell_m = self.task.vehicle, self.grid.cell_m
        radius = max(round(vehicle.width_m / 2.0 / cell_m), 1)
        for block, around, cut in blocks(self.grid, 2 * radius + REACH + 1):
            if not self._seen.holds(around):
                continue
            mean = self._ground.window(around, "mean").astype(np.float64)
            first = planes(mean, cell_m, radius)
            beside = [cells.window(around, "mean") for cells in self._within]
            mean -= np.nan_to_num(first.east * beside[0] + first.north * beside[1])
            near = planes(mean, cell_m, 1)
            bridged = np.isnan(mean) & (near.share > _GAP_SHARE)
            height = np.where(bridged, near.height_m, mean)
            wide = planes(height, cell_m, radius)
            rise_m = np.where(np.isfinite(wide.slope), wide.slope, 0.0) * cell_m / np.sqrt(2.0)
            # the ground below a thing without any is that around it
            base = np.where(np.isfinite(height), height, self._under(around, wide.height_m))
            obstacle = np.maximum(self._top.window(around, "max") - base - rise_m, 0.0)
            smooth = np.where(np.isfinite(wide.height_m), wide.height_m, height)
            self.height.put(block, cut(smooth).astype(np.float32))
            self.slope.put(
                block, cut(np.where(np.isfinite(height), np.rad2deg(np.arctan(wide.slope)), np.nan)).astype(np.float32)
            )
            self.step.put(block, cut(np.where(np.isfinite(height), steps(height), np.nan)).astype(np.float32))
            self.obstacle.put(block, cut(obstacle).astype(np.float32))

    def _under(self, around: Window, otherwise: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Heights of the floor at the middles of cells; of another grid, and filled where nothing was seen."""
        cell = self.grid.cell_m
        x = (around.column + np.arange(around.columns) + 0.5) * cell
        y = (around.row + around.rows - np.arange(around.rows) - 0.5) * cell
        places = np.stack([*np.meshgrid(x, y), np.zeros((around.rows, around.columns))], axis=-1).reshape(-1, 3)
        floor = -self.floor.above(places).reshape(around.rows, around.columns)
        return np.where(np.isfinite(floor), floor, otherwise)

    def _classes(self) -> None:
        vehicle = self.task.vehicle
        for block, _, _ in blocks(self.grid, 0):
            if self.slope.holds(block):
                slope = self.slope.window(block)
                kind = np.where(np.isfinite(slope), PASSABLE, 0).astype(np.uint8)
                kind[slope > vehicle.max_slope_deg] = STEEP
                kind[self.step.window(block) > vehicle.max_step_m] = STEP
                kind[self.obstacle.window(block) > vehicle.max_obstacle_m] = OBSTACLE
                self.kind.put(block, kind)
        halo = int(np.ceil(vehicle.width_m / 2.0 / self.grid.cell_m)) + 1
        narrow = Sheet(self.grid, self.task.folder, np.uint8)
        for block, _, _ in blocks(self.grid, 0):
            if self.kind.holds(block):
                # beyond the raster nobody has looked either
                around = self.kind.window(block.grown(halo))
                closed = (around != PASSABLE) & (around != STEEP)
                if closed.any():
                    # a cell's own edge lies half a cell from its middle
                    away_m = np.asarray(distance_transform_edt(~closed)) * self.grid.cell_m - 0.5 * self.grid.cell_m
                    near = ~closed & (away_m < vehicle.width_m / 2.0)
                    narrow.put(block, near[halo:-halo, halo:-halo].astype(np.uint8))
        for block, _, _ in blocks(self.grid, 0):
            if narrow.holds(block):
                self.kind.put(block, np.where(narrow.window(block) > 0, np.uint8(NARROW), self.kind.window(block)))

    def areas(self) -> dict[str, float]:
        """By what cells are [m2]."""
        cell_m2 = self.grid.cell_m**2
        counts = np.zeros(NARROW + 1, np.int64)
        for block, _, _ in blocks(self.grid, 0):
            if self.kind.holds(block):
                counts += np.bincount(self.kind.window(block).ravel(), minlength=NARROW + 1)
        found = {name: float(counts[number] * cell_m2) for number, name in NAMES.items()}
        return found | {"unseen": float(enclosed(self.kind) * cell_m2)}

    def route(self) -> tuple[Any, dict[str, float]] | None:
        """The best way from end to end as a line, and figures of it."""
        assert self.task.ends is not None
        start, end = (self._cell(place, word) for place, word in zip(self.task.ends, ("--from", "--to"), strict=True))
        row, column, steep = self._free()
        if len(row) > MOST_CELLS:
            raise UsageError(
                f"a route over {len(row):,} cells asked for, expected {MOST_CELLS:,} at most; choose larger cells with --cell"
            )
        way = best_route((row, column), 1.0 + (steep / self.task.vehicle.max_slope_deg) ** 2, start, end)
        if way is None:
            return None
        row, column = way.T
        height = self.height.at(row, column).astype(np.float64)
        places = np.stack([
            self.grid.west_m + (column + 0.5) * self.grid.cell_m, self.grid.north_m - (row + 0.5) * self.grid.cell_m, height
        ], axis=1)  # fmt: skip
        climbs = np.diff(height)
        figures = {
            "length_m": float(np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1).sum()),
            "rise_m": float(climbs[climbs > 0].sum()), "fall_m": float(-climbs[climbs < 0].sum()),
            "steepest_deg": float(self.slope.at(row, column).max()),
            "highest_step_m": float(np.nanmax(self.step.at(row, column), initial=0.0)),
            "highest_obstacle_m": float(np.nanmax(self.obstacle.at(row, column), initial=0.0)),
        }  # fmt: skip
        if len(places) == 1:
            places = np.repeat(places, 2, axis=0)
        return shapely.LineString(self.floor.metres.back(places)), figures

    def _free(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Rows and columns of passable cells, in the order of rows, and their slopes [deg]."""
        parts, grid = [np.empty((0, 3))], self.grid
        for block, _, _ in blocks(self.grid, 0):
            if self.kind.holds(block):
                down, right = np.nonzero(self.kind.window(block) == PASSABLE)
                top, left = grid.row + grid.rows - block.row - block.rows, block.column - grid.column
                slope = self.slope.window(block)[down, right]
                parts.append(np.column_stack([down + top, right + left, slope]))
        found = np.concatenate(parts)
        found = found[np.lexsort((found[:, 1], found[:, 0]))]
        return found[:, 0].astype(np.int64), found[:, 1].astype(np.int64), found[:, 2]

    def _cell(self, place: tuple[float, float], word: str) -> Cell:
        """Row and column of a place, which has to be passable."""
        grid, across = self.grid, self.floor.metres.across
        x, y = place[0] * across, place[1] * across
        column, row = int(np.floor((x - grid.west_m) / grid.cell_m)), int(np.floor((grid.north_m - y) / grid.cell_m))
        if not (0 <= row < grid.rows and 0 <= column < grid.columns):
            raise CoverageError(
                f"{word} {place[0]:.2f},{place[1]:.2f}: lies outside of the cloud, which spans {grid.west_m / across:.0f} to "
                f"{(grid.west_m + grid.columns * grid.cell_m) / across:.0f} E and "
                f"{(grid.north_m - grid.rows * grid.cell_m) / across:.0f} to {grid.north_m / across:.0f} N"
            )
        kind = int(self.kind.at(np.array([row]), np.array([column]))[0])
        if kind != PASSABLE:
            free = np.column_stack(self._free()[:2])
            if not len(free):
                raise CoverageError(f"{word} {place[0]:.2f},{place[1]:.2f}: no cell of the cloud is passable")
            near = free[int(np.argmin(((free - (row, column)) ** 2).sum(axis=1)))]
            east, north = grid.west_m + (near[1] + 0.5) * grid.cell_m, grid.north_m - (near[0] + 0.5) * grid.cell_m
            why = NAMES.get(kind, "unseen")
            raise CoverageError(
                f"{word} {place[0]:.2f},{place[1]:.2f}: there is {why}, expected a passable place; the nearest is "
                f"{east / across:.2f},{north / across:.2f}"
            )
        return row, column


def work(task: Task, progress: Progress) -> Made:
    """Find where the vehicle can go, and write it; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file or a place is not as it should be.
    """
    cloud = reader.look(task.cloud)
    _refuse_outside(task, cloud, progress)
    with made_folder(task.folder):
        floor = Floor(cloud, task.folder, progress)
        area = _Area(task, floor)
        made = Made(area.grid.cell_m, task.vehicle, cloud.points, area.areas())
        made.warnings += unstated(cloud)
        route = None if task.ends is None else area.route()
        _write_rasters(task.folder, area)
        if route is not None:
            line, made.route = route
            columns = {name: np.array([value]) for name, value in made.route.items()}
            with written_aside(task.folder / FILES[-1]) as aside:
                write_features(
                    aside,
                    Features(np.array([line], object), columns, cloud.horizontal),
                    "LineString Z",
                    "route",
                    ".geojson",
                )
        elif task.ends is not None:
            made.warnings.append("there is no way from --from to --to that the vehicle can go")
    return made


def _refuse_outside(task: Task, cloud: reader.Cloud, progress: Progress) -> None:
    """Refuse ends of a route beyond the cloud before its ground is looked for. A head may state wrong bounds, points do not."""
    with reader.opened(cloud.path) as file:
        low, high = file.header.mins[:2], file.header.maxs[:2]
    slack = task.cell_m or _CELLS_M[-1]
    for word, place in zip(("--from", "--to"), task.ends or (), strict=False):
        if np.any(place < low - slack) or np.any(place > high + slack):
            low, high = np.full(2, np.inf), np.full(2, -np.inf)
            for chunk in reader.chunks(cloud, columns=()):
                xy = chunk.points.xyz_m[:, :2]
                low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
                progress(len(xy))
        if np.any(place < low - slack) or np.any(place > high + slack):
            raise CoverageError(
                f"{word} {place[0]:.2f},{place[1]:.2f}: lies outside of the cloud, which spans {low[0]:.0f} to {high[0]:.0f} E and "
                f"{low[1]:.0f} to {high[1]:.0f} N"
            )


def _write_rasters(folder: Path, area: _Area) -> None:
    metres, crs = area.floor.metres, area.floor.cloud.crs
    grid = Grid.of_window(area.grid, area.grid.cell_m / metres.across)
    kinds = "1 passable, 2 steep, 3 step, 4 obstacle, 5 narrow"
    with written_aside(folder / FILES[0]) as aside:
        band = geotiff.Band(kinds, "", "uint8", 0, "nearest")
        geotiff.write(aside, grid, crs, band, area.kind.window)
    for name, title, unit, sheet in (
        ("slope.tif", "slope of the ground", "deg", area.slope),
        ("step.tif", "step of the ground", "m", area.step),
        ("obstacle.tif", "height of obstacles", "m", area.obstacle),
    ):
        with written_aside(folder / name) as aside:
            geotiff.write(aside, grid, crs, geotiff.Band(title, unit), sheet.window)


def _cell_for(density_m2: float) -> float:
    """The smallest of the usual cells that holds enough points."""
    return next((cell for cell in _CELLS_M if density_m2 * cell**2 >= _PER_CELL), _CELLS_M[-1])
