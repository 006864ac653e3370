"""Signed distance of a surface between two epochs, square by square: core points, areas lost and gained, their volumes."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis.deformation import cores as choice
from groundproc.analysis.deformation import m3c2
from groundproc.analysis.deformation.areas import Area, Measured, areas, excess_m, volume_sigma
from groundproc.analysis.epochs import Epochs, Progress
from groundproc.cloud.points import Points
from groundproc.cloud.tiles import Tiles, side_for
from groundproc.cloud.writer import CloudWriter
from groundproc.files import written_aside
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]

CLOUD: Final = "surface.laz"
AREAS: Final = "surface.geojson"
FILES: Final = (CLOUD, AREAS)
_POINTS: Final = 30.0
"""In a cylinder of the sparser epoch, on level ground: fewer tell no scatter."""
_LEAST_M, _MOST_M = 0.05, 2.0
_REACH_M: Final = 2.0
_GROUND: Final = 2
_SIGMAS: Final = ("sigma_h", "sigma_v")
_COLUMNS: Final = ("change", "change_distance", "change_sigma", "change_lod")
_SAME, _GAINED, _LOST, _UNSEEN = range(4)
_MILLIMETRE: Final = 1e-3
"""Coordinates are stored to this: a scatter of none is not known better."""
_RECORD: Final = np.dtype(
    [
        ("xyz", "f8", (3,)),
        ("normal", "f4", (3,)),
        ("area", "f4"),
        ("distance", "f4"),
        ("own", "f4"),
        ("shared", "f4"),
        ("seen", "?"),
    ]
)


@dataclass(frozen=True, slots=True)
class Task:
    """How a surface is compared.

    Attributes
    ----------
    radius_m : float or None
        Of the cylinders; default: of 30 points.
    reach_m : float
        How far the surface may have moved along its normal.
    spacing_m : float or None
        Between core points; default: two radii, so that no point counts twice.
    ground : bool
        Points of class 2 only.
    registration_m : float
        Sigma of clouds that were registered elsewhere.
    """

    radius_m: float | None = None
    reach_m: float = _REACH_M
    spacing_m: float | None = None
    ground: bool = False
    registration_m: float = 0.0


@dataclass(frozen=True, slots=True)
class _Shape:
    radius_m: float
    reach_m: float
    spacing_m: float


def compare(task: Task, epochs: Epochs, folder: Path, progress: Progress) -> dict[str, Any]:
    """Measure, write `surface.laz` and `surface.geojson`, and give the figures.

    Parameters
    ----------
    task : Task
    epochs : Epochs
    folder : Path
        That is there.
    progress : callable

    Raises
    ------
    CoverageError
        No surface of the first cloud is seen in the second.
    UsageError
        Ground is asked for that a cloud does not tell.
    """
    shape = _shape(task, epochs)
    with tempfile.TemporaryFile(dir=folder) as file:
        count = 0
        for some in _measured(task, epochs, shape, folder, progress):
            some.tofile(file)
            count += len(some)
        if not count:
            raise CoverageError(
                f"{epochs.clouds[0].path}: has no surface to measure from, expected ground, rock or walls"
            )
        file.flush()
        records = np.memmap(file, _RECORD, "r+", shape=(count,))
        return _finish(task, epochs, shape, records, folder)


def _shape(task: Task, epochs: Epochs) -> _Shape:
    radius = task.radius_m or float(np.clip(np.sqrt(_POINTS / (np.pi * epochs.per_m2)), _LEAST_M, _MOST_M))
    return _Shape(radius, task.reach_m, task.spacing_m or 2.0 * radius)


def distances(task: Task, epochs: Epochs, folder: Path, progress: Progress) -> npt.NDArray[np.void]:
    """Distances at all core points: fields xyz, normal, distance, own and shared (variances), and seen.

    Parameters
    ----------
    task : Task
    epochs : Epochs
    folder : Path
        For a temporary file.
    progress : callable
    """
    parts = list(_measured(task, epochs, _shape(task, epochs), folder, progress))
    return np.concatenate(parts) if parts else np.empty(0, _RECORD)


def _measured(
    task: Task, epochs: Epochs, shape: _Shape, folder: Path, progress: Progress
) -> Iterator[npt.NDArray[np.void]]:
    """Records of core points, square by square."""
    halo = max(choice.HALO_M, shape.reach_m + shape.radius_m)
    points = sum(cloud.points for cloud in epochs.clouds)
    tiles = Tiles(
        folder, {"epoch": "u1", **dict.fromkeys(_SIGMAS, "f4")},
        side_for(points, epochs.low.tolist(), epochs.high.tolist(), halo), halo,
    )  # fmt: skip
    for number, cloud in enumerate(epochs.clouds):
        asked = tuple(name for name in (*_SIGMAS, "classification") if name in cloud.columns)
        for chunk, xyz, _ in epochs.chunks(number, asked):
            keep = epochs.standing(chunk)
            if task.ground:
                keep &= np.asarray(chunk.points.columns.get("classification", np.zeros(len(xyz)))) == _GROUND
            sigmas = {name: _sigma(chunk.points, name)[keep] for name in _SIGMAS}
            tiles.add(xyz[keep], {"epoch": np.full(int(keep.sum()), number, np.uint8), **sigmas})
            progress("placing", len(xyz))
    if task.ground and not tiles.points:
        raise UsageError(
            f"{epochs.clouds[0].path}: has no point of class 2, expected some with --ground; see swath ground"
        )
    for tile in tiles:
        origin = np.floor(tile.xyz_m.min(axis=0) / shape.spacing_m) * shape.spacing_m
        epoch = tile.columns["epoch"]
        known = np.column_stack([tile.columns[name] for name in _SIGMAS]).astype(np.float64)
        first = np.flatnonzero(epoch == 0)
        chosen = choice.cores(tile.xyz_m[first] - origin, shape.spacing_m)
        kept = tile.core[first[chosen.row]]
        index, normal, area = first[chosen.row[kept]], chosen.normal[kept], chosen.area_m2[kept]
        if len(index):
            bins = [
                m3c2.bins(tile.xyz_m[own] - origin, shape.radius_m, shape.reach_m, known[own])
                for own in (first, np.flatnonzero(epoch == 1))
            ]
            yield _records(task, epochs, shape, (tile.xyz_m[index], origin, normal, area), (bins[0], bins[1]))
        progress("measuring", int(tile.core.sum()))


def _sigma(points: Points, name: str) -> npt.NDArray[np.float32]:
    column = points.columns.get(name)
    return np.full(len(points), np.nan, np.float32) if column is None else np.asarray(column, np.float32)


def _records(
    task: Task, epochs: Epochs, shape: _Shape, at: tuple[Array, Array, Array, Array], bins: tuple[m3c2.Bins, m3c2.Bins]
) -> npt.NDArray[np.void]:
    xyz, origin, normal, area = at
    found = m3c2.distances(xyz - origin, normal, bins, shape.radius_m, shape.reach_m)
    records = np.empty(len(xyz), _RECORD)
    records["xyz"], records["area"], records["seen"] = xyz, area, found.seen
    records["normal"] = normal
    records["distance"] = found.distance_m
    records["own"] = np.maximum(found.own_m2, _MILLIMETRE**2)
    if epochs.registered:
        # what the poses are off by is in the difference; a registration takes it out
        records["shared"] = task.registration_m**2 + found.shared_m2
    else:
        arm = np.concatenate([normal, np.cross(xyz - epochs.registration.about_m, normal)], axis=1)
        records["shared"] = np.einsum("ni,ij,nj->n", arm, epochs.registration.covariance, arm)
    return records


def _finish(task: Task, epochs: Epochs, shape: _Shape, records: Any, folder: Path) -> dict[str, Any]:
    seen = np.flatnonzero(records["seen"])
    if not len(seen):
        raise CoverageError(
            f"{epochs.clouds[1].path}: has no surface within {shape.reach_m:g} m of that of {epochs.clouds[0].path}; expected some, "
            "or a larger --reach"
        )
    distance, own, shared = (np.asarray(records[name][seen], np.float64) for name in ("distance", "own", "shared"))
    excess = 0.0 if epochs.registered else excess_m(distance, own + shared)
    shared += excess**2
    measured = Measured(
        np.asarray(records["xyz"][seen]), np.asarray(records["area"][seen], np.float64), distance, own, shared
    )
    tries = max(round(len(seen) * min(shape.spacing_m / (2.0 * shape.radius_m), 1.0) ** 2), 1)
    found = areas(_widened(measured, shape), shape.spacing_m, tries)
    state = np.full(len(records), _UNSEEN, np.uint8)
    lod = m3c2.detectable(own + shared)
    state[seen] = np.where(np.abs(distance) <= lod, _SAME, np.where(distance > 0.0, _GAINED, _LOST))
    with ExitStack() as stack:
        aside = stack.enter_context(written_aside(folder / AREAS))
        _write_areas(aside, found, epochs)
        aside = stack.enter_context(written_aside(folder / CLOUD))
        _write_cloud(aside, epochs, records, state, (seen, np.sqrt(own + shared), lod))
    return {
        **{name: _total(found, name.removesuffix("_m3")) for name in ("lost_m3", "gained_m3")},
        "lost_sigma_m3": _total_sigma(found, "lost"), "gained_sigma_m3": _total_sigma(found, "gained"),
        "net_m3": float(measured.area_m2 @ distance), "net_sigma_m3": volume_sigma(_widened(measured, shape), np.arange(len(seen))),
        "areas": len(found), "cores": len(records), "unseen_cores": len(records) - len(seen),
        "significant_cores": int((np.abs(distance) > lod).sum()), "median_distance_m": float(np.median(distance)),
        "lod95_m": float(np.median(lod)), "excess_sigma_m": excess,
        "radius_m": shape.radius_m, "reach_m": shape.reach_m, "spacing_m": shape.spacing_m,
    }  # fmt: skip


def _widened(measured: Measured, shape: _Shape) -> Measured:
    """With what overlapping cylinders share counted once for each of them: their sum is known no better for their number."""
    overlap = max(np.pi * shape.radius_m**2 / shape.spacing_m**2, 1.0)
    return measured._replace(own_m2=measured.own_m2 * overlap)


def _total(found: list[Area], kind: str) -> float:
    return float(sum(each.volume_m3 for each in found if each.kind == kind))


def _total_sigma(found: list[Area], kind: str) -> float:
    """As if all areas were off together, which the registration makes them."""
    return float(sum(each.sigma_m3 for each in found if each.kind == kind))


def _write_areas(path: Path, found: list[Area], epochs: Epochs) -> None:
    def column(name: str) -> npt.NDArray[Any]:
        return np.array([getattr(each, name) for each in found], np.float64)

    metres = epochs.metres
    places = metres.back(np.array([each.place_m for each in found]).reshape(-1, 3))
    columns = {
        "kind": np.array([each.kind for each in found], object),
        **{name: column(name) for name in ("volume_m3", "sigma_m3", "area_m2", "mean_m", "most_m")},
        "x": places[:, 0], "y": places[:, 1], "z": places[:, 2], "cores": np.array([each.cores for each in found], np.int64),
    }  # fmt: skip
    shapes = np.array([_many(each.outline) for each in found], object)
    if not metres.plain:
        shapes = shapely.transform(shapes, lambda xy: xy / metres.across)  # outlines are flat
    write_features(path, Features(shapes, columns, epochs.crs), "MultiPolygon", "surface", ".geojson")


def _many(outline: Any) -> Any:
    return outline if outline.geom_type == "MultiPolygon" else shapely.MultiPolygon([outline])


def _write_cloud(
    path: Path, epochs: Epochs, records: Any, state: npt.NDArray[np.uint8], told: tuple[npt.NDArray[Any], Array, Array]
) -> None:
    """Core points with what was measured there."""
    seen, sigma, lod = told
    values = {name: np.full(len(records), np.nan, np.float32) for name in ("change_sigma", "change_lod")}
    values["change_sigma"][seen], values["change_lod"][seen] = sigma, lod
    metres = epochs.metres
    offset = np.floor(metres.back(records["xyz"][0]))
    with CloudWriter(
        path, _COLUMNS, crs=epochs.clouds[0].crs, offset_m=offset.tolist(), gps=False, about="swath"
    ) as out:
        for start in range(0, len(records), 1_000_000):
            part = slice(start, start + 1_000_000)
            columns = {"change": state[part], "change_distance": np.array(records["distance"][part])}
            columns |= {name: each[part] for name, each in values.items()}
            out.write(
                Points(np.zeros(len(columns["change"]), np.int64), metres.back(np.array(records["xyz"][part])), columns)
            )
