"""Hard targets on the ground, under leaves or in the open; and where the light came down at all.

The cloud is read for its ground (see `terrain.floor`), for counts by cell and height, for the points around the places that score, and to
be written anew if that is asked for. Memory: that of the ground, some 40 bytes for each cell of half a metre in squares of 128 m that have
points, and the points around places.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.spatial import cKDTree

from groundproc.analysis.detection.bodies import AROUND_M, Body, body
from groundproc.analysis.detection.layers import Layers
from groundproc.analysis.detection.targets import SIZES_M, scan, top_m
from groundproc.analysis.terrain.floor import Floor
from groundproc.analysis.terrain.surfaces import Sheet
from groundproc.cloud import reader
from groundproc.cloud.metres import unstated
from groundproc.cloud.rewriter import Rewriter
from groundproc.files import written_aside
from groundproc.raster import geotiff
from groundproc.raster.grid import Grid, Window
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

CELL_M: Final = 0.5
LEAST_SCORE: Final = 12.0
"""In woods of 14 points in a square metre some five false alarms a hectare score higher."""
_PLACE_SCORE: Final = 2.0
"""Of counts alone, for places that are looked at more closely."""
LOW_M: Final = 0.5
_FEWEST: Final = 4.0
"""Pulses that have to come down into the area of a target, to claim anything."""
_SHOWN_CELLS: Final = 4
"""Cells of the penetration map, in cells of the counts."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath detect`."""

    cloud: Path
    output: Path
    copy: Path | None = None
    penetration: Path | None = None
    highest_m: float = 3.0
    least_score: float = LEAST_SCORE


@dataclass(slots=True)
class Made:
    """What was found.

    Attributes
    ----------
    bodies : list of Body
        The best first.
    points : int
    penetration : float
        Mean share of pulses that came down.
    hectares : float
        With any pulses.
    blind : float
        Share of that with too few pulses from below to claim anything.
    """

    bodies: list[Body] = field(default_factory=list)
    points: int = 0
    penetration: float = 0.0
    hectares: float = 0.0
    blind: float = 0.0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "points": self.points, "objects": len(self.bodies), "penetration": self.penetration, "area_ha": self.hectares,
            "blind_share": self.blind, "warnings": self.warnings,
        }  # fmt: skip


def work(task: Task, progress: Progress) -> Made:
    """Find objects, and write what was asked for; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError
        A file is not as it should be.
    """
    cloud = reader.look(task.cloud)
    made = Made(points=cloud.points)
    with written_aside(task.output) as aside:
        floor = Floor(cloud, task.output.parent, progress)
        floor.refuse_thin("objects")
        layers = _counted(task, floor)
        _judge_light(layers, made)
        if task.penetration is not None:
            _write_penetration(task.penetration, floor, layers)
        made.bodies = _bodies(task, floor, layers)
        _write_objects(aside, task.output.suffix, floor, made.bodies)
        if task.copy is not None:
            with (
                written_aside(task.copy) as other,
                Rewriter(cloud, other, task.copy.suffix.lower() != ".las", ("hag", "object")) as out,
            ):
                for record, xyz, _ in floor.pieces():
                    above = _above(floor, xyz)
                    out.write(
                        record, columns={"hag": above, "object": _numbers(made.bodies, xyz, above, task.highest_m)}
                    )
    made.warnings += unstated(cloud)
    if made.blind > 0.5:
        made.warnings.append(
            f"over {made.blind:.0%} of the area too few pulses came down to claim anything; --penetration shows where"
        )
    return made


def _above(floor: Floor, xyz: Array) -> npt.NDArray[np.float32]:
    """Heights above the smoothed ground: of one cell to the next it does not jump, and flat tops stay flat."""
    return (xyz[:, 2] - floor.base.bilinear(xyz)).astype(np.float32)


def _counted(task: Task, floor: Floor) -> Layers:
    grid = floor.grid
    column, row = int(np.floor(grid.west_m / CELL_M)), int(np.floor(grid.row * grid.cell_m / CELL_M))
    right = int(np.ceil((grid.column + grid.columns) * grid.cell_m / CELL_M))
    top = int(np.ceil(grid.north_m / CELL_M))
    layers = Layers(Grid(column, row, right - column, top - row, CELL_M), LOW_M, task.highest_m)
    for record, xyz, noise in floor.pieces():
        above = np.where(noise, np.float32(-np.inf), _above(floor, xyz))
        number = np.asarray(record.return_number)
        layers.add(xyz, above, (number <= 1) & ~noise)
    return layers


def _judge_light(layers: Layers, made: Made) -> None:
    length, width = SIZES_M[0]
    cells, share, few = 0, 0.0, 0
    for _, _, tile in layers:
        through = tile.penetration()
        seen = np.isfinite(through)
        down = tile.counts.sum(axis=2, dtype=np.float32)[seen]
        cells += len(down)
        share += float(through[seen].sum(dtype=np.float64))
        few += int(np.count_nonzero(down < _FEWEST * CELL_M**2 / (length * width)))
    made.penetration = share / cells if cells else 0.0
    made.hectares = float(cells * CELL_M**2 / 1e4)
    made.blind = few / cells if cells else 1.0


def _bodies(task: Task, floor: Floor, layers: Layers) -> list[Body]:
    """Places that score, looked at with all their points."""
    places = scan(layers, _PLACE_SCORE)
    if not places:
        return []
    grid = layers.grid
    near, reach = Sheet(grid, task.output.parent, np.uint8), int(np.ceil(AROUND_M / CELL_M))
    for each in places:
        rows = np.arange(max(each.row - reach, 0), min(each.row + reach + 1, grid.rows))
        columns = np.arange(max(each.column - reach, 0), min(each.column + reach + 1, grid.columns))
        near.mark(np.repeat(rows, len(columns)), np.tile(columns, len(rows)), 1)
    parts = []
    for _, xyz, noise in floor.pieces():
        above = _above(floor, xyz)
        row = np.floor((grid.north_m - xyz[:, 1]) / CELL_M).astype(np.int64).clip(0, grid.rows - 1)
        column = np.floor((xyz[:, 0] - grid.west_m) / CELL_M).astype(np.int64).clip(0, grid.columns - 1)
        keep = (near.at(row, column) > 0) & ~noise & (above > -1.0) & (above < layers.high_m)
        parts.append(np.column_stack([xyz[keep], above[keep].astype(np.float64)]))
    points = np.concatenate(parts)
    tree = cKDTree(points[:, :2])
    found = []
    for place in places:
        middle = np.array([grid.west_m + (place.column + 0.5) * CELL_M, grid.north_m - (place.row + 0.5) * CELL_M])
        some = points[np.sort(tree.query_ball_point(middle, AROUND_M))]
        seen = body(place, middle, some[:, :3], some[:, 3], top_m(layers, place), LOW_M)
        if seen is not None and seen.score + place.score >= task.least_score:
            found.append((seen.score + place.score, seen))
    found.sort(key=lambda each: -each[0])
    return [
        Body(b.middle_m, b.length_m, b.width_m, b.height_m, b.turn_rad, b.points, score) for score, b in found
    ]  # fmt: skip


def _numbers(
    bodies: list[Body], xyz: Array, above: npt.NDArray[np.float32], highest_m: float
) -> npt.NDArray[np.uint16]:
    """Number of the object that each point is of, from 1; 0: none."""
    out = np.zeros(len(xyz), np.uint16)
    up = np.flatnonzero((above > 0.3) & (above < highest_m))
    for number, each in reversed(list(enumerate(bodies[:65_535], 1))):
        d = xyz[up, :2] - each.middle_m[:2]
        c, s = np.cos(each.turn_rad), np.sin(each.turn_rad)
        inside = (np.abs(d @ [c, s]) < each.length_m / 2 + 0.1) & (np.abs(d @ [-s, c]) < each.width_m / 2 + 0.1)
        out[up[inside & (above[up] < each.height_m + 0.3)]] = number
    return out


def _write_objects(aside: Path, ending: str, floor: Floor, bodies: list[Body]) -> None:
    metres = floor.metres
    shapes = [shapely.Polygon(each.outline / metres.across) for each in bodies]
    middles = [metres.back(each.middle_m[None])[0] for each in bodies]
    columns: dict[str, npt.NDArray[Any]] = {
        "number": np.arange(1, len(bodies) + 1, dtype=np.int32),
        "score": np.array([each.score for each in bodies], np.float64),
        "points": np.array([each.points for each in bodies], np.int32),
        "length_m": np.array([each.length_m for each in bodies], np.float64),
        "width_m": np.array([each.width_m for each in bodies], np.float64),
        "height_m": np.array([each.height_m for each in bodies], np.float64),
    }
    for axis, name in enumerate("xyz"):
        columns[name] = np.array([each[axis] for each in middles], np.float64)
    features = Features(np.array(shapes, object), columns, floor.cloud.horizontal)
    write_features(aside, features, "Polygon", "objects", ending)


def _write_penetration(path: Path, floor: Floor, layers: Layers) -> None:
    """Shares of pulses that came down, in cells of two metres."""
    grid, times = layers.grid, _SHOWN_CELLS
    column, row = grid.column // times, grid.row // times
    columns = -(-(grid.column + grid.columns) // times) - column
    rows = -(-(grid.row + grid.rows) // times) - row
    shown = Grid(column, row, columns, rows, CELL_M * times / floor.metres.across)

    def block(window: Window) -> npt.NDArray[np.float32]:
        top = grid.row + grid.rows - times * (window.row + window.rows)
        some = layers.window(top, times * window.column - grid.column, times * window.rows, times * window.columns)
        down = some.counts.sum(axis=2, dtype=np.float64)
        sums = np.stack([down, np.maximum(some.pulses, down)])
        down, all_ = sums.reshape(2, window.rows, times, window.columns, times).sum(axis=(2, 4))
        return np.where(all_ > 0, down / np.maximum(all_, 1.0), np.nan).astype(np.float32)

    with written_aside(path) as aside:
        geotiff.write(aside, shown, floor.cloud.crs, geotiff.Band("share of pulses that came down"), block)
