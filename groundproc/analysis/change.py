"""`swath change`: two epochs laid on each other, and what appeared or vanished between them."""

import json
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from flightlog.errors import UsageError
from groundproc.analysis import changedetection as detection
from groundproc.analysis.changebeams import Side
from groundproc.analysis.changedetection import Claim
from groundproc.analysis.changemodel import Rule, model
from groundproc.analysis.deformation import surface as surfaces
from groundproc.analysis.deformation.surface import Task as SurfaceTask
from groundproc.analysis.epochs import Epochs, Progress, agreed_crs, laid
from groundproc.cloud import reader
from groundproc.cloud.merger import Merger
from groundproc.cloud.metres import Metres, agreed_metres, unstated
from groundproc.cloud.tiles import Found, Tiles, side_for
from groundproc.files import made_folder, written_aside
from groundproc.radiometry.sensorpath import SensorPath, flown, recovered
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]

CHANGES: Final = "changes.geojson"
REGISTRATION: Final = "registration.json"
CLOUD: Final = "change.laz"
FILES: Final = (CHANGES, REGISTRATION, CLOUD)
_KINDS: Final = ("appeared", "vanished")
_SMALLEST_M: Final = 0.1
_LARGEST_M: Final = 1.0
_PER_EDGE: Final = 3.0
"""Spacings of points that an edge of a voxel holds."""
LEFT_OUT: Final = 4
"""In `change`: noise and what moves, which is not compared."""
_KEPT: Final = {"epoch": "u1", "stands": "?", "east": "f4", "north": "f4", "up": "f4"}
_COLUMNS: Final = {"change": "u1", "change_distance": "f4", "change_sigma": "f4"}


@dataclass(frozen=True, slots=True)
class Task:
    """What to compare.

    Attributes
    ----------
    a, b : Path
        The earlier and the later epoch.
    folder : Path
    trajectory_a, trajectory_b : Path or None
        With both, what was not looked into is told by the beams.
    voxel_m : float or None
        Default: three spacings of the sparser epoch, 0.1 m at least.
    sway_m : float or None
        How far leaves move; default: 0.25 m, or two voxels.
    registered : bool
        They are on each other already.
    week : int or None
    undulation_m : float
    surface : SurfaceTask or None
        Measure the distance of surfaces too, like this.
    all_classes : bool
        Noise and what moves are compared too.
    """

    a: Path
    b: Path
    folder: Path
    trajectory_a: Path | None = None
    trajectory_b: Path | None = None
    voxel_m: float | None = None
    sway_m: float | None = None
    registered: bool = False
    week: int | None = None
    undulation_m: float = 0.0
    surface: SurfaceTask | None = None
    all_classes: bool = False


def run(task: Task, progress: Progress) -> dict[str, Any]:
    """Compare, write, and give what was found.

    Raises
    ------
    SwathError
        Input that cannot be used; nothing is written then.
    """
    if (task.trajectory_a is None) != (task.trajectory_b is None):
        raise UsageError("one trajectory given, expected --trajectory-a and --trajectory-b, or neither")
    clouds = (reader.look(task.a), reader.look(task.b))
    crs = agreed_crs(clouds)
    paths: tuple[SensorPath | None, SensorPath | None] = (None, None)
    if task.trajectory_a is not None and task.trajectory_b is not None:
        options: dict[str, Any] = {"week": task.week, "undulation_m": task.undulation_m}
        paths = (flown(clouds[:1], task.trajectory_a, **options), flown(clouds[1:], task.trajectory_b, **options))
    elif agreed_metres(clouds).plain:
        seen = (recovered(clouds[0]), recovered(clouds[1]))
        paths = seen if None not in seen else paths
    epochs = laid(clouds, paths, task.registered, progress, (task.trajectory_a, task.trajectory_b), task.all_classes)
    per_m2 = epochs.per_m2
    edge = task.voxel_m or float(np.clip(_PER_EDGE / np.sqrt(per_m2), _SMALLEST_M, _LARGEST_M))
    rule = Rule(edge, task.sway_m if task.sway_m is not None else max(0.25, 2.0 * edge), epochs.registration, per_m2)
    with made_folder(task.folder):
        found, claims = _compare(task, epochs, rule, progress)
        told = _told(epochs, rule, claims)
        with ExitStack() as stack:
            for name in FILES[:2]:
                aside = stack.enter_context(written_aside(task.folder / name))
                if name == CHANGES:
                    _write_claims(aside, claims, crs, epochs.metres)
                else:
                    aside.write_text(json.dumps(told["registration"], indent=1) + "\n", encoding="utf-8")
            aside = stack.enter_context(written_aside(task.folder / CLOUD))
            _write_cloud(aside, epochs, found, progress)
            if task.surface is not None:
                told["surface"] = surfaces.compare(task.surface, epochs, task.folder, progress)
    return told


def _compare(task: Task, epochs: Epochs, rule: Rule, progress: Progress) -> tuple[Found, list[tuple[str, Claim]]]:
    """Square by square, each epoch against the other."""
    points = epochs.clouds[0].points + epochs.clouds[1].points
    side = side_for(points, epochs.low.tolist(), epochs.high.tolist(), detection.HALO_M)
    tiles = Tiles(task.folder, _KEPT, side, detection.HALO_M)
    for number in range(2):
        for chunk, xyz, away in epochs.chunks(number):
            columns: dict[str, npt.NDArray[Any]] = dict(zip(("east", "north", "up"), away.T, strict=True))
            columns |= {"epoch": np.full(len(xyz), number, np.uint8), "stands": epochs.standing(chunk)}
            tiles.add(xyz, columns)
            progress("placing", len(xyz))
    found = Found(task.folder, _COLUMNS, points)
    claims: list[tuple[str, Claim]] = []
    for tile in tiles:
        origin = np.floor(tile.xyz_m.min(axis=0))
        way = np.stack([tile.columns[name] for name in ("east", "north", "up")], axis=1).astype(np.float64)
        local = replace(rule, registration=epochs.registration.seen_from(origin))
        stands = tile.columns["stands"]
        rows = [np.flatnonzero((tile.columns["epoch"] == number) & stands) for number in range(2)]
        others = tile.number[tile.core & ~stands]
        unknown = np.full(len(others), np.nan, np.float32)
        left_out = np.full(len(others), LEFT_OUT, np.uint8)
        found.put(others, {"change": left_out, "change_distance": unknown, "change_sigma": unknown})
        sides = [Side(tile.xyz_m[own] - origin, way[own]) for own in rows]
        models = [model(each, local) for each in sides]
        for number in (1, 0):
            own, other = rows[number], 1 - number
            compared = detection.compare(models[number], models[other], local)
            state = np.where((compared.state == detection.APPEARED) & (number == 0), detection.VANISHED, compared.state)
            core = tile.core[own]
            found.put(
                tile.number[own[core]],
                {
                    "change": state[core], "change_distance": compared.distance_m[core], "change_sigma": compared.sigma_m[core],
                },
            )  # fmt: skip
            # a change that lies in several squares is told in that of its first point
            for claim in compared.claims:
                if core[claim.first]:
                    placed = Claim(
                        claim.place_m + origin,
                        claim.volume_m3,
                        claim.points,
                        claim.missed,
                        int(tile.number[own[claim.first]]),
                    )
                    claims.append((_KINDS[1 - number], placed))
        progress("comparing", int(tile.core.sum()))
    return found, claims


def _told(epochs: Epochs, rule: Rule, claims: list[tuple[str, Claim]]) -> dict[str, Any]:
    registration, metres = epochs.registration, epochs.metres
    sigma = np.sqrt(np.diag(registration.covariance))
    kinds = [kind for kind, _ in claims]
    return {
        "appeared": kinds.count("appeared"), "vanished": kinds.count("vanished"),
        "appeared_m3": sum(c.volume_m3 for kind, c in claims if kind == "appeared"),
        "vanished_m3": sum(c.volume_m3 for kind, c in claims if kind == "vanished"),
        "warnings": unstated(*epochs.clouds), "voxel_m": rule.edge_m, "sway_m": rule.sway_m, "points_per_m2": epochs.per_m2,
        "unseen_by": "points behind, as seen from above" if epochs.paths[0] is None else f"beams, the sensor {epochs.paths[0].source}",
        "registration": {
            "matrix": metres.matrix(registration.matrix).tolist(), "about_m": registration.about_m.tolist(), "sigma_m": sigma[:3].tolist(),
            "sigma_deg": np.rad2deg(sigma[3:]).tolist(), "residual_m": registration.residual_m, "overlap": registration.overlap,
            "fit": registration.fit,
        },
    }  # fmt: skip


def _write_claims(path: Path, claims: list[tuple[str, Claim]], crs: pyproj.CRS | None, metres: Metres) -> None:
    places = metres.back(np.array([claim.place_m for _, claim in claims]).reshape(-1, 3))
    columns = {
        "kind": np.array([kind for kind, _ in claims], dtype="U8"),
        "volume_m3": np.array([claim.volume_m3 for _, claim in claims], np.float64),
        "x": places[:, 0], "y": places[:, 1], "z": places[:, 2],
        "score": np.array([1.0 - np.exp(-claim.missed) for _, claim in claims], np.float64),
        "points": np.array([claim.points for _, claim in claims], np.int64),
    }  # fmt: skip
    geometry = np.array([shapely.Point(*place) for place in places], object)
    write_features(path, Features(geometry, columns, crs), "Point Z", "changes", ".geojson")


def _write_cloud(path: Path, epochs: Epochs, found: Found, progress: Progress) -> None:
    """All points of both, as they came, with what became of them."""
    start = 0
    with Merger(epochs.clouds, path, ("epoch", *_COLUMNS)) as merged:
        for number, cloud in enumerate(epochs.clouds):
            for chunk in reader.chunks(cloud, columns=()):
                count = len(chunk.points)
                columns = found.take(start, count)
                start += count
                merged.write(chunk.record, {"epoch": np.full(count, number, np.uint8), **columns})
                progress("writing", count)
