"""From a cloud to its power lines: conductors, poles, stays and fences, and how far everything is from the nearest conductor.

The cloud is read for the ground (see `terrain.floor`), for what is thin, and for clearances, which are written on the way. What is thin is
looked for square by square; of points on lines one of each voxel of 0.2 m is kept for the whole area. Memory: that of the ground, a square
of a million points, and 60 bytes for each kept point.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from groundproc.analysis.corridor.catenary import Catenary
from groundproc.analysis.corridor.chains import chained
from groundproc.analysis.corridor.clearance import Clearance
from groundproc.analysis.corridor.poles import HALO_M, Pole, upright
from groundproc.analysis.corridor.spans import attached, box_of, conductors, touching
from groundproc.analysis.corridor.strips import FENCE_HEIGHTS_M, fences, low_strips, stay
from groundproc.analysis.corridor.thin import RADIUS_M, thin_points
from groundproc.analysis.corridor.whole import Whole
from groundproc.analysis.terrain.floor import Floor
from groundproc.cloud import reader
from groundproc.cloud.classes import (
    CONDUCTOR,
    FENCE,
    GROUND,
    GUARD,
    HIGH_NOISE,
    LOW_NOISE,
    MAST,
    POLE,
    STAY,
    TOWER,
    UNCLASSIFIED,
    merged,
)  # fmt: skip
from groundproc.cloud.metres import unstated
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.tiles import Tiles, side_for
from groundproc.files import written_aside
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

_OLD_FORMATS: Final = 5
_LAST_OLD_CLASS: Final = 31
_OWN: Final = (GUARD, CONDUCTOR, TOWER, MAST, POLE, FENCE, STAY)
_ON_WIRE_M: Final = 0.3
_ON_POLE_M: Final = 0.5
_AT_POLE_M: Final = 1.5
_VERTEX_M: Final = 0.9
_LOWEST_M: Final = 0.8
"""Height above ground from which lines are looked for: the foot of a stay."""
_GROWTH_M: Final = 40.0
"""Growth further away is not told of."""
_LEVEL: Final = 0.7
_GUARD_REACH_M: Final = 8.0
"""To the side of others of its span ..."""
_GUARD_M: Final = 1.5
"""A wire that hangs so much above all others of its span, by itself or with one more, is a guard."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath wires`."""

    cloud: Path
    output: Path
    clearance: Path | None = None
    least_height_m: float = 3.0


@dataclass(slots=True)
class Made:
    """What was found.

    Attributes
    ----------
    wires : list of Catenary
    guard : list of bool
        Wires above the conductors.
    poles : list of Pole
    stays : list of (shapely.LineString, float)
    fences : list of shapely.LineString
    nearest : ndarray, shape (wires, 2)
        Least height of each wire above the ground, and distance to what grows or stands on that [m]; infinite where none is near.
    places : ndarray, shape (wires, 2, 3)
        Where that is.
    warnings : list of str
    """

    wires: list[Catenary] = field(default_factory=list)
    guard: list[bool] = field(default_factory=list)
    poles: list[Pole] = field(default_factory=list)
    stays: list[tuple[Any, float]] = field(default_factory=list)
    fences: list[Any] = field(default_factory=list)
    nearest: Array = field(default_factory=lambda: np.empty((0, 2)))
    places: Array = field(default_factory=lambda: np.empty((0, 2, 3)))
    points: int = 0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "points": self.points,
            "wires": [
                {
                    "number": n, "kind": "guard" if guard else "conductor", "length_m": wire.length_m, "sag_m": wire.sag_m,
                    "rms_m": wire.rms_m, "points": wire.points,
                    "clearance_ground_m": _finite(near[0]), "clearance_vegetation_m": _finite(near[1]),
                }
                for n, (wire, guard, near) in enumerate(zip(self.wires, self.guard, self.nearest, strict=True))
            ],
            "poles": sum(each.kind == "pole" for each in self.poles),
            "masts": sum(each.kind == "mast" for each in self.poles),
            "stays": len(self.stays),
            "fences": len(self.fences),
            "warnings": self.warnings,
        }  # fmt: skip


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def work(task: Task, progress: Progress) -> Made:
    """Find the lines of a cloud, and write what was asked for; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError
        A file is not as it should be.
    """
    cloud = reader.look(task.cloud)
    with written_aside(task.output) as aside:
        floor = Floor(cloud, task.output.parent, progress)
        made = _found(task, floor)
        made.points = cloud.points
        if task.clearance is None:
            for _ in _cleared(floor, made):
                pass
        else:
            with written_aside(task.clearance) as other:
                _write_clearance(task.clearance, other, floor, made)
        _write_lines(aside, task.output.suffix, floor, made)
    made.warnings += unstated(cloud)
    if not made.wires:
        made.warnings.append("no wire was found")
    return made


def _found(task: Task, floor: Floor) -> Made:
    """All that is thin."""
    cloud = floor.cloud
    halo = RADIUS_M + HALO_M
    grid = floor.grid
    extent = (grid.columns * grid.cell_m, grid.rows * grid.cell_m)
    side = side_for(cloud.points, (0.0, 0.0), extent, halo)
    tiles = Tiles(task.output.parent, {"above": np.float32}, side, halo)
    for _, xyz, noise in floor.pieces():
        above = floor.above(xyz)
        some = ~noise & (above > FENCE_HEIGHTS_M[0])
        tiles.add(xyz[some], {"above": above[some]})
    lines: list[Array] = []
    strips: list[Array] = []
    made = Made()
    for tile in tiles:
        above = tile.columns["above"]
        up = above > _LOWEST_M
        found = thin_points(tile.xyz_m[up], tile.core[up])
        lines.append(np.hstack([found.xyz_m, found.direction])[found.core])
        level = np.abs(found.direction[:, 2]) < _LEVEL
        made.poles += upright(tile.xyz_m, above, tile.core, found.xyz_m[level])
        strips.append(low_strips(tile.xyz_m, above, tile.core))
    points = np.concatenate(lines) if lines else np.empty((0, 6))
    _sort_lines(task, floor, points[:, :3], points[:, 3:], made)
    made.fences = fences(np.concatenate(strips)) if strips else []
    return made


def _sort_lines(task: Task, floor: Floor, xyz_m: Array, direction: Array, made: Made) -> None:
    """Conductors and stays of points on lines."""
    flat = np.abs(direction[:, 2]) < 0.7
    tall = floor.above(xyz_m) > task.least_height_m
    chains = [
        xyz_m[flat & tall][each] for each in chained(xyz_m[flat & tall], direction[flat & tall], 6, 5.0, made.poles)
    ]
    whole = Whole(conductors(chains))
    for _, xyz, noise in floor.pieces():
        whole.add(xyz[~noise])
    made.wires = attached(whole.fitted(), made.poles)
    made.guard = _guards(made.wires)
    steep = np.abs(direction[:, 2]) > 0.4
    for each in chained(xyz_m[steep], direction[steep], 6, 2.0):
        line = stay(xyz_m[steep][each], made.poles, floor.above)
        if line is not None:
            made.stays.append(line)
    made.nearest = np.full((len(made.wires), 2), np.inf)
    made.places = np.full((len(made.wires), 2, 3), np.nan)


def _guards(wires: list[Catenary]) -> list[bool]:
    """Wires that hang well above two or more others of their span."""
    out = []
    boxes = np.array([box_of(each.along_plan()) for each in wires]).reshape(-1, 4)
    for wire in wires:
        middle = wire.between(wire.start_m, wire.middle_of).places(1e9)[-1]
        below, beside = 0, 0
        for number in touching(boxes, box_of(middle[None]), _GUARD_REACH_M):
            other = wires[number]
            s, off, up = other.local(middle[None])
            if (
                other is not wire
                and abs(off[0]) < _GUARD_REACH_M
                and other.start_m < s[0] < other.end_m
                and abs(wire.along @ other.along) > 0.99
            ):
                below += up[0] > _GUARD_M
                beside += abs(up[0]) <= _GUARD_M
        out.append(below >= 2 and beside <= 1)
    return out


def _cleared(floor: Floor, made: Made) -> Iterator[tuple[Any, Array, npt.NDArray[np.uint8], Array]]:
    """Records, places, classes and distances to the nearest wire; the nearest ground and growth of each wire is kept."""
    _note_ground(floor, made)
    clearance = Clearance(made.wires)
    for record, xyz, noise in floor.pieces():
        above, kind = floor.heights(xyz, noise)
        distance, wire = clearance.of(xyz)
        kind = _classes(xyz, above, kind, distance, wire, made)
        _note_growth(made, xyz[(kind == UNCLASSIFIED) & (distance < _GROWTH_M)])
        yield record, xyz, kind, distance


def _note_growth(made: Made, xyz: Array) -> None:
    """Keep the nearest of what grows or stands beside each wire."""
    for number, wire in enumerate(made.wires if len(xyz) else ()):
        s, off, up = wire.local(xyz)
        beyond = np.maximum(np.maximum(wire.start_m - s, s - wire.end_m), 0.0)
        # off the curve across it, not upright; the slope of a wire is small, and so is what its own slope changes
        slope = np.sinh((np.clip(s, wire.start_m, wire.end_m) - wire.middle_m) / wire.a_m)
        apart = np.sqrt(off**2 + beyond**2 + up**2 / (1.0 + slope**2))
        nearest = int(np.argmin(apart))
        if apart[nearest] < made.nearest[number, 1]:
            made.nearest[number, 1], made.places[number, 1] = apart[nearest], xyz[nearest]


def _note_ground(floor: Floor, made: Made) -> None:
    """Keep where each wire is lowest above the ground."""
    for number, wire in enumerate(made.wires):
        places = wire.places(_VERTEX_M)
        above = floor.above(places)
        lowest = int(np.argmin(above))
        made.nearest[number, 0], made.places[number, 0] = above[lowest], places[lowest]


def _classes(
    xyz: Array,
    above: npt.NDArray[Any],
    kind: npt.NDArray[np.uint8],
    distance: Array,
    wire: npt.NDArray[np.int64],
    made: Made,
) -> npt.NDArray[np.uint8]:
    """Classes of points with those of wires, poles, stays and fences."""
    free = (kind != GROUND) & (kind != LOW_NOISE)
    for line in made.fences:
        kind[_along(line, xyz, free & (above < FENCE_HEIGHTS_M[1] + 0.2), False, 0.25)] = FENCE
    for line, _ in made.stays:
        kind[_along(line, xyz, free, True, 0.25)] = STAY
    for pole in made.poles:
        near = free & (np.abs(xyz[:, 0] - pole.x) < _ON_POLE_M) & (np.abs(xyz[:, 1] - pole.y) < _ON_POLE_M)
        kind[near & (above < pole.height_m + 0.5)] = (
            TOWER if _carries(pole, made) else MAST if pole.kind == "mast" else POLE
        )
    on = free & (distance < _ON_WIRE_M)
    kind[on] = np.where(np.array([*made.guard, False])[wire[on]], GUARD, CONDUCTOR)
    return kind


def _carries(pole: Pole, made: Made) -> bool:
    """Whether it is a tower of wires, as the class has it: a mast that wires end at."""
    if pole.kind != "mast":
        return False
    for wire in made.wires:
        tips = wire.places(1e9)[:, :2]
        if np.hypot(*(tips - (pole.x, pole.y)).T).min() < 6.0:
            return True
    return False


def _along(line: Any, xyz: Array, some: npt.NDArray[np.bool_], solid: bool, within_m: float) -> npt.NDArray[np.int64]:
    """Numbers of points near a line, in plan or in space."""
    west, south, east, north = line.bounds
    near = some & (xyz[:, 0] > west - within_m) & (xyz[:, 0] < east + within_m)
    near &= (xyz[:, 1] > south - within_m) & (xyz[:, 1] < north + within_m)
    number = np.flatnonzero(near)
    places = shapely.get_coordinates(line, include_z=True)
    best = np.full(len(number), np.inf)
    axes = slice(0, 3 if solid else 2)
    for a, b in zip(places[:-1, axes], places[1:, axes], strict=True):
        t = np.clip((xyz[number, axes] - a) @ (b - a) / max((b - a) @ (b - a), 1e-9), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(xyz[number, axes] - a - t[:, None] * (b - a), axis=1))
    return number[best < within_m]


def _write_clearance(path: Path, aside: Path, floor: Floor, made: Made) -> None:
    """The cloud with clearances and classes."""
    with Rewriter(floor.cloud, aside, path.suffix.lower() != ".las", ("classification", "clearance")) as out:
        narrow = None
        for record, _, kind, distance in _cleared(floor, made):
            narrow = record.point_format.id <= _OLD_FORMATS
            if narrow:
                kind = np.where(kind > _LAST_OLD_CLASS, UNCLASSIFIED, kind)
            ours = (kind >= GUARD) & (kind != HIGH_NOISE)
            out.write(
                record,
                columns={
                    "classification": merged(record.classification, np.where(ours, kind, 0), _OWN),
                    "clearance": distance.astype(np.float32),
                },
            )
        if narrow and (made.fences or made.stays or made.poles):
            made.warnings.append(
                f"{path}: points of its format have classes up to 31 only, so that those of poles, stays and fences keep theirs; "
                "`swath export` makes a cloud of the new formats"
            )


def _write_lines(aside: Path, ending: str, floor: Floor, made: Made) -> None:
    """All lines as features."""
    rows: list[tuple[Any, dict[str, Any]]] = []
    for number, (wire, guard, near) in enumerate(zip(made.wires, made.guard, made.nearest, strict=True)):
        rows.append((shapely.LineString(wire.places(_VERTEX_M)), {
            "kind": "guard" if guard else "conductor", "number": number, "length_m": wire.length_m, "sag_m": wire.sag_m,
            "rms_m": wire.rms_m, "points": wire.points, "clearance_ground_m": near[0], "clearance_vegetation_m": near[1],
        }))  # fmt: skip
    for pole in made.poles:
        line = shapely.LineString([(pole.x, pole.y, pole.foot_m), (pole.x, pole.y, pole.foot_m + pole.height_m)])
        rows.append((line, {"kind": pole.kind, "height_m": pole.height_m, "score": pole.score}))
    for line, rms in made.stays:
        rows.append((line, {"kind": "stay", "length_m": _length(line), "rms_m": rms}))
    for line in made.fences:
        rows.append((line, {"kind": "fence", "length_m": line.length}))
    names = (
        "kind", "number", "length_m", "sag_m", "rms_m", "points", "clearance_ground_m", "clearance_vegetation_m", "height_m",
        "score",
    )  # fmt: skip
    columns: dict[str, npt.NDArray[Any]] = {}
    for name in names:
        values = [row.get(name, None) for _, row in rows]
        if name == "kind":
            columns[name] = np.array(values, object)
        else:
            columns[name] = np.array(
                [np.nan if v is None or not np.isfinite(v) else float(v) for v in values], np.float64
            )
    shapes = [shapely.transform(each, floor.metres.back, include_z=True) for each, _ in rows]
    features = Features(np.array(shapes, object), columns, floor.cloud.horizontal)
    write_features(aside, features, "LineString Z", "wires", ending)


def _length(line: Any) -> float:
    return float(np.linalg.norm(np.diff(shapely.get_coordinates(line, include_z=True), axis=0), axis=1).sum())
