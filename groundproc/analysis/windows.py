"""From a cloud to what is seen through windows: points behind walls of houses whose beams went through an opening.

A point belongs to a window if its beam crossed a wall within that wall's own outline. Where beams are not known,
points that are indoors count (`indoors`). Points are never removed and are no noise: behind a pane only a few beams in
a hundred come back, and their points are isolated.

The cloud is read three times: for its ground (see `terrain.floor`), for squares of ground with all around them, and to
be written anew. Memory: that of the ground and a square of a million points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from groundproc.analysis.facades import Facade, facades
from groundproc.analysis.indoors import Tops, indoors, outer_walls
from groundproc.analysis.terrain.floor import Floor
from groundproc.cloud import reader
from groundproc.cloud.classes import PANE, merged
from groundproc.cloud.metres import unstated
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.tiles import Found, Tile, Tiles, side_for
from groundproc.files import written_aside
from groundproc.radiometry.sensorpath import Flown, SensorPath, Tally, flown, recovered
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Progress = Callable[[int], object]

DEPTH_M: Final = 12.0
"""Deeper behind a wall than this is another place, seen over or past it."""
_LEAST_DEPTH_M: Final = 0.1
"""What lies less deep is the wall."""
_HALO_M: Final = 12.0
_FEWEST_PLANE: Final = 30
_ON_PLANE_M: Final = 0.15
_OLD_FORMATS: Final = 5
_KEPT: Final = {"above": "f4", "east": "f4", "north": "f4", "up": "f4", "pulse": "f8", "rank": "u1"}


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath windows`.

    Attributes
    ----------
    cloud, output : Path
    walls : Path or None
        For the walls as features.
    trajectory : Path or None
    crs : pyproj.CRS or None
    week : int or None
    undulation_m : float
    lever_m : sequence of 3 floats
        As for `swath reflectance`.
    """

    cloud: Path
    output: Path
    walls: Path | None = None
    trajectory: Path | None = None
    crs: Any = None
    week: int | None = None
    undulation_m: float = 0.0
    lever_m: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Wall:
    """A wall with an opening or without.

    Attributes
    ----------
    facade : Facade
    behind : int
        Points seen through it.
    depth_m : float
        Of the plane behind that most of them lie on; NaN where there is none.
    on_plane : int
        How many do.
    """

    facade: Facade
    behind: int
    depth_m: float
    on_plane: int


@dataclass(slots=True)
class Made:
    """What was found."""

    points: int
    beams: str
    walls: list[Wall] = field(default_factory=list)
    behind: int = 0
    panes: int = 0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "points": self.points, "beams": self.beams, "walls": len(self.walls),
            "walls_seen_through": sum(each.behind > 0 for each in self.walls),
            "planes_behind": sum(each.on_plane > 0 for each in self.walls),
            "points_behind": self.behind, "points_on_panes": self.panes, "warnings": self.warnings,
        }  # fmt: skip


def work(task: Task, progress: Progress) -> Made:
    """Find what is seen through windows, and write it; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file is not as it should be.
    """
    cloud = reader.look(task.cloud)
    path = _path(task, cloud)
    beams = "no beams: indoors is what walls and roofs enclose" if path is None else f"beams, the sensor {path.source}"
    made = Made(cloud.points, beams)
    floor = Floor(cloud, task.output.parent, progress)
    found = _found(task, floor, path, made)
    with written_aside(task.output) as aside:
        _write(task, floor, found, aside, made)
        if task.walls is not None:
            with written_aside(task.walls) as other:
                _write_walls(other, task.walls.suffix, floor, made.walls)
    made.warnings += unstated(cloud)
    if not made.walls:
        made.warnings.append("no wall of a house was found")
    elif path is None:
        made.warnings.append(
            "where the beams went is not known: what is indoors is told by walls and roofs alone, with errors near both; "
            "give the trajectory with -t"
        )
    return made


def _path(task: Task, cloud: reader.Cloud) -> SensorPath | None:
    if task.trajectory is not None:
        return flown(
            [cloud], task.trajectory, crs=task.crs, week=task.week, undulation_m=task.undulation_m, lever_m=task.lever_m
        )
    return recovered(cloud) if cloud.timed else None


def _found(task: Task, floor: Floor, path: SensorPath | None, made: Made) -> Found:
    """1 for each point behind a wall, 2 on a pane."""
    grid, cloud = floor.grid, floor.cloud
    side = side_for(cloud.points, (0.0, 0.0), (grid.columns * grid.cell_m, grid.rows * grid.cell_m), _HALO_M)
    tiles = Tiles(task.output.parent, _KEPT, side, _HALO_M)
    tally = Tally(task.trajectory, path, cloud) if task.trajectory is not None and isinstance(path, Flown) else None
    for chunk in reader.chunks(cloud, None if path is None else path.clock, ("return_number",)):
        xyz = np.ascontiguousarray(floor.metres.of(chunk.points.xyz_m))
        away = np.full((len(xyz), 3), np.nan)
        if path is not None:
            place, known = path.at(chunk)
            away[known] = floor.metres.of(place)[known] - xyz[known]
            if tally is not None:
                tally.add(away, known)
        time = np.asarray(chunk.record.gps_time) if cloud.timed else np.zeros(len(xyz))
        tiles.add(xyz, {
            "above": floor.above(xyz), "east": away[:, 0], "north": away[:, 1], "up": away[:, 2], "pulse": time,
            "rank": np.asarray(chunk.record.return_number),
        })  # fmt: skip
        floor.progress(len(xyz))
    if tally is not None:
        tally.check()
    found = Found(task.output.parent, {"kind": "u1"}, cloud.points)
    for tile in tiles:
        kind = _of_tile(tile, made)
        found.put(tile.number[tile.core], {"kind": kind[tile.core]})
    return found


def _of_tile(tile: Tile, made: Made) -> npt.NDArray[np.uint8]:
    """What points of a square and around it are; its walls are noted."""
    xyz, above = tile.xyz_m, tile.columns["above"]
    kind = np.zeros(len(xyz), np.uint8)
    walls = facades(xyz[above > 0.3])
    tops = Tops(xyz)
    outer = outer_walls(walls, tops)
    origin = xyz + np.stack([tile.columns[name] for name in ("east", "north", "up")], axis=1)
    for number, facade in enumerate(walls):
        near = np.flatnonzero(np.abs(facade.off(xyz)) < DEPTH_M)
        unknown = np.isnan(origin[near, 0])
        depth = np.full(len(near), np.nan)
        depth[~unknown] = facade.through(origin[near[~unknown]], xyz[near[~unknown]])
        if unknown.any() and number in outer:
            depth[unknown] = indoors(outer[number], list(outer.values()), tops, xyz[near[unknown]])
        behind = np.nan_to_num(depth, nan=0.0) > _LEAST_DEPTH_M
        kind[near[behind]] = 1
        ends = facade.ends.mean(axis=0)
        core = tile.core[int(np.argmin(np.hypot(*(xyz[:, :2] - ends).T)))]
        if core:
            made.walls.append(Wall(facade, int(behind.sum()), *_plane_behind(depth[behind])))
    _panes(tile, walls, kind)
    return kind


def _plane_behind(depth_m: Array) -> tuple[float, int]:
    """Depth of the plane that most points behind a wall lie on, and how many do."""
    if len(depth_m) < _FEWEST_PLANE:
        return float("nan"), 0
    deep = depth_m[depth_m > 0.5]
    count, edges = np.histogram(deep, np.arange(0.5, DEPTH_M + 0.1, 0.1))
    both = count[:-1] + count[1:]
    best = int(np.argmax(both))
    on = np.abs(deep - edges[best + 1]) < _ON_PLANE_M
    if on.sum() < max(_FEWEST_PLANE, 0.2 * len(deep)):
        return float("nan"), 0
    return float(np.median(deep[on])), int(on.sum())


def _panes(tile: Tile, walls: Sequence[Facade], kind: npt.NDArray[np.uint8]) -> None:
    """First echoes near a wall of shots whose later echo lies behind it: on the glass."""
    later = (kind == 1) & (tile.columns["rank"] > 1)
    first = np.flatnonzero((tile.columns["rank"] == 1) & (kind == 0))
    if not later.any() or not len(first):
        return
    same = first[np.isin(tile.columns["pulse"][first], tile.columns["pulse"][later])]
    for facade in walls:
        near = (np.abs(facade.off(tile.xyz_m[same])) < 0.5) & facade.holds(tile.xyz_m[same])
        kind[same[near]] = 2


def _write(task: Task, floor: Floor, found: Found, aside: Path, made: Made) -> None:
    """The cloud with classes."""
    at, narrow = 0, 0
    with Rewriter(floor.cloud, aside, task.output.suffix.lower() != ".las", ("classification",)) as out:
        for chunk in reader.chunks(floor.cloud, columns=()):
            record = chunk.record
            kind = found.take(at, len(chunk.points))["kind"]
            at += len(chunk.points)
            made.behind += int((kind == 1).sum())
            made.panes += int((kind == 2).sum())
            old = record.point_format.id <= _OLD_FORMATS
            narrow += int((kind > 0).sum()) * old
            kind = merged(record.classification, np.where((kind > 0) & (not old), PANE, 0), (PANE,))
            out.write(record, columns={"classification": kind})
            floor.progress(len(chunk.points))
    if narrow:
        made.warnings.append(
            f"{task.output}: points of its format have classes up to 31 only, so that {narrow:,} behind panes keep theirs; `swath export` "
            "makes a cloud of the new formats"
        )


def _write_walls(aside: Path, ending: str, floor: Floor, walls: Sequence[Wall]) -> None:
    shapes = []
    for each in walls:
        ends = np.column_stack([each.facade.ends, np.full(2, each.facade.low_m)])
        shapes.append(shapely.LineString(floor.metres.back(ends)))
    columns: dict[str, npt.NDArray[Any]] = {
        "area_m2": np.array([each.facade.area_m2 for each in walls], np.float64),
        "height_m": np.array([each.facade.height_m for each in walls], np.float64),
        "behind": np.array([each.behind for each in walls], np.int32),
        "depth_m": np.array([each.depth_m for each in walls], np.float64),
        "on_plane": np.array([each.on_plane for each in walls], np.int32),
    }
    write_features(
        aside, Features(np.array(shapes, object), columns, floor.cloud.horizontal), "LineString Z", "walls", ending
    )
