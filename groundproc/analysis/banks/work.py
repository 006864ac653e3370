"""`swath banks`: from one cloud, or two of one place, to the edges of banks, the lines of waters and the retreat between the epochs."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import UsageError
from groundproc.analysis.banks import waterline
from groundproc.analysis.banks.axes import Axis, axes, halo_m, lines_of
from groundproc.analysis.banks.edges import LOWER, UPPER, Edge, edge
from groundproc.analysis.banks.ground import Ground
from groundproc.analysis.banks.profile import Profile, fitted
from groundproc.analysis.banks.retreat import Stretch, stretches
from groundproc.analysis.banks.stations import around
from groundproc.analysis.banks.waterline import WaterLine
from groundproc.analysis.terrain.surfaces import blocks
from groundproc.cloud import reader
from groundproc.cloud.metres import unstated
from groundproc.files import written_aside
from groundproc.raster.relief import filled
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

LEAST_DROP_M: Final = 0.5
LEAST_SLOPE_DEG: Final = 30.0
STRETCH_M: Final = 10.0
MOST_RETREAT_M: Final = 5.0
STEP_M: Final = 1.0
"""Between profiles."""
_SHORTEST_M: Final = 5.0
_BESIDE_M: Final = 2.0
"""Of the land above and below a face that belongs to its profile."""
_GAP_CELLS: Final = 3
_UNSURE_M: Final = 0.5
_BEND_RAD: Final = np.deg2rad(10.0)
"""A face is steeper than the land beside it by that, at least."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath banks`."""

    cloud: Path
    output: Path
    before: Path | None = None
    registered: bool = False
    least_drop_m: float = LEAST_DROP_M
    least_slope_deg: float = LEAST_SLOPE_DEG
    stretch_m: float = STRETCH_M
    most_retreat_m: float = MOST_RETREAT_M
    water_level_m: float | None = None
    terrain: str = "auto"


@dataclass(frozen=True, slots=True)
class Bank:
    """One axis with what its profiles tell.

    Attributes
    ----------
    axis : Axis
    profiles : list of lists of Profile or None
        By epoch and station.
    edges : list of tuples of 2 Edge
        Upper and lower, by epoch.
    """

    axis: Axis
    profiles: list[list[Profile | None]]
    edges: list[tuple[Edge, Edge]]


@dataclass(slots=True)
class Made:
    """What was found."""

    epochs: int
    registration_sigma_m: float | None = None
    banks: list[Bank] = field(default_factory=list)
    waters: list[WaterLine] = field(default_factory=list)
    stretches: list[Stretch] = field(default_factory=list)
    alone_m2: list[float] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        length = {
            name: sum(len(each.station) for bank in self.banks for each in [bank.edges[-1][which]]) * STEP_M
            for name, which in (("upper", UPPER), ("lower", LOWER))
        }
        found = {
            "banks": len(self.banks), "upper_m": length["upper"], "lower_m": length["lower"],
            "water_m": sum(each.length_m for each in self.waters if each.epoch == self.epochs),
            "water_levels_m": [each.level_m for each in self.waters if each.epoch == self.epochs],
            "standing_alone": len(self.alone_m2),
            "registration_sigma_m": self.registration_sigma_m, "warnings": self.warnings,
        }  # fmt: skip
        if self.epochs > 1:
            moved = [each for each in self.stretches if each.significant]
            found |= {
                "stretches": len(self.stretches), "moved": len(moved),
                "largest_retreat_m": max((float(np.nanmax(each.retreat_m)) for each in moved), default=None),
                "lost_m3": sum(each.lost_m3 for each in self.stretches),
                "gained_m3": sum(each.gained_m3 for each in self.stretches),
                "volume_sigma_m3": float(np.sqrt(sum(each.net_sigma_m3**2 for each in self.stretches))),
            }  # fmt: skip
        return found


def work(task: Task, progress: Progress) -> Made:
    """Find banks, and write them; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file is not as it should be.
    """
    _check(task)
    clouds = [reader.look(each) for each in ([] if task.before is None else [task.before]) + [task.cloud]]
    made, folder = Made(len(clouds)), task.output.parent
    made.warnings += unstated(*clouds)
    with written_aside(task.output) as aside:
        ground = Ground(clouds, task.registered, folder, progress, task.terrain)
        made.registration_sigma_m = ground.registration_sigma_m
        found = _axes(task, ground, made.alone_m2)
        profiles = [_profiles(task, found, ground, epoch) for epoch in range(len(clouds))]
        for number, axis in enumerate(found):
            of_axis = [each[number] for each in profiles]
            edges = [(edge(each, UPPER, STEP_M), edge(each, LOWER, STEP_M)) for each in of_axis]
            if any(len(each.station) > 1 for both in edges for each in both):
                made.banks.append(Bank(axis, of_axis, edges))
        for epoch in range(len(clouds)):
            made.waters += waterline.find(ground, epoch, task.water_level_m, STEP_M, folder)
        if len(clouds) > 1:
            for number, bank in enumerate(made.banks):
                rule = STEP_M, task.stretch_m, ground.shift
                made.stretches += stretches(
                    number, bank.axis, (bank.profiles[0], bank.profiles[1]), (bank.edges[0], bank.edges[1]), rule
                )
        _write(aside, task.output.suffix, ground, made)
    if not made.banks and not made.waters:
        made.warnings.append(
            f"{task.cloud}: no bank of {task.least_drop_m:g} m and {task.least_slope_deg:g} deg was found, and no water; see --least-drop"
        )
    return made


def _check(task: Task) -> None:
    for word, value, low, high, unit in (
        ("least-drop", task.least_drop_m, 0.1, 100.0, "m"), ("least-slope", task.least_slope_deg, 10.0, 85.0, "deg"),
        ("stretch", task.stretch_m, 1.0, 1000.0, "m"), ("most-retreat", task.most_retreat_m, 0.5, 50.0, "m"),
    ):  # fmt: skip
        if not low <= value <= high:
            raise UsageError(f"--{word} {value:g} {unit}: expected {low:g} to {high:g} {unit}")


def _axes(task: Task, ground: Ground, alone_m2: list[float]) -> list[Axis]:
    """Axes of the first epoch, and those of the second that are new there."""
    found: list[Axis] = []
    for cells in ground.cells:
        grid = cells.grid()
        if grid is None:
            continue
        lines: list[tuple[Array, float]] = []
        for block, wide, _ in blocks(grid, int(np.ceil(halo_m() / grid.cell_m))):
            heights = filled(cells.window(wide, "mean"), _GAP_CELLS)
            for line, width in lines_of(
                heights, wide, grid.cell_m, task.least_drop_m, np.deg2rad(task.least_slope_deg)
            ):
                column, row = np.floor(line / grid.cell_m).astype(np.int64).T
                own = (column >= block.column) & (column < block.column + block.columns)
                own &= (row >= block.row) & (row < block.row + block.rows)
                cuts = np.flatnonzero(np.diff(own.astype(np.int8))) + 1
                lines += [
                    (line[rows], width)
                    for rows in np.split(np.arange(len(line)), cuts)
                    if own[rows[0]] and len(rows) > 1
                ]
        have = shapely.MultiLineString([each.places_m for each in found if len(each.places_m) > 1])
        for each in axes(lines, grid.cell_m, STEP_M, _SHORTEST_M, alone_m2):
            away = shapely.distance(have, shapely.points(each.places_m)) if found else np.array([np.inf])
            if np.median(away) > each.width_m / 2.0 + task.most_retreat_m:
                found.append(each)
    return found


def _profiles(task: Task, found: list[Axis], ground: Ground, epoch: int) -> list[list[Profile | None]]:
    """Profiles of an epoch, by axis and station."""
    out: list[list[Profile | None]] = [[None] * len(each.places_m) for each in found]
    more = task.most_retreat_m if epoch else 0.0
    reach = [each.width_m / 2.0 + _BESIDE_M + more for each in found]
    for number, station, s, z in around(found, reach, ground.pieces(epoch), task.output.parent, STEP_M):
        one = fitted(s, z, max(found[number].width_m, 2.0 * ground.cell_m))
        if one is not None and _is_bank(one, task):
            out[number][station] = one
    return out


def _is_bank(one: Profile, task: Task) -> bool:
    beside = float(np.arctan(max(-one.values[4], -one.values[5], 0.0)))
    sigma = min(s[0] for s, told in zip(one.sigmas(), (one.upper, one.lower), strict=True) if told)
    return (
        one.drop_m >= task.least_drop_m
        and one.slope_rad >= max(np.deg2rad(task.least_slope_deg), beside + _BEND_RAD)
        and float(sigma) < _UNSURE_M
    )


def _write(aside: Path, ending: str, ground: Ground, made: Made) -> None:
    """Edges, lines of waters and stretches."""
    rows: list[tuple[Array, dict[str, Any]]] = []
    for number, bank in enumerate(made.banks):
        for epoch, edges in enumerate(bank.edges, 1):
            for kind, one in zip(("upper", "lower"), edges, strict=True):
                for part in one.parts():
                    told = [
                        each for n in one.station[part] for each in [bank.profiles[epoch - 1][n]] if each is not None
                    ]
                    rows.append((one.places(bank.axis)[part], {
                        "kind": kind, "bank": number, "epoch": epoch,
                        "sigma_m": _rms(one.sigma_across_m[part]), "sigma_most_m": float(one.sigma_across_m[part].max()),
                        "height_sigma_m": _rms(one.sigma_height_m[part]),
                        "drop_m": float(np.median([each.drop_m for each in told])),
                        "slope_deg": float(np.rad2deg(np.median([each.slope_rad for each in told]))),
                    }))  # fmt: skip
    rows += [(each.line_m, each.figures()) for each in made.waters]
    rows += [
        (each.line_m, {"kind": "stretch", "bank": each.axis, "epoch": 1} | each.figures()) for each in made.stretches
    ]
    metres = ground.floor.metres
    shapes = np.array([shapely.LineString(metres.back(line)) for line, _ in rows], object)
    columns: dict[str, npt.NDArray[Any]] = {
        "length_m": np.array([float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line, _ in rows])
    }
    for name, none in _COLUMNS.items():
        dtype: Any = object if isinstance(none, str) else np.int32 if isinstance(none, int) else np.float64
        columns[name] = np.array([told.get(name, none) for _, told in rows], dtype)
    if made.epochs == 1:
        columns = {name: values for name, values in columns.items() if name not in _OF_TWO}
    write_features(aside, Features(shapes, columns, ground.floor.cloud.horizontal), "LineString Z", "banks", ending)


_OF_TWO: Final = (
    "retreat_m", "retreat_sigma_m", "foot_retreat_m", "foot_retreat_sigma_m", "lost_m3", "gained_m3", "volume_sigma_m3", "significant",
)  # fmt: skip
_COLUMNS: Final[dict[str, Any]] = {
    "kind": "", "bank": -1, "epoch": 1, "sigma_m": np.nan, "sigma_most_m": np.nan, "height_sigma_m": np.nan, "drop_m": np.nan,
    "slope_deg": np.nan, "level_m": np.nan, "told_by": "", **dict.fromkeys(_OF_TWO[:-1], np.nan), "significant": 0,
}  # fmt: skip
"""Of each feature, and what stands where it has none."""


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
