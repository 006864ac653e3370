"""From a cloud and a file of polygons to volumes."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis import ground
from groundproc.analysis.volume import (
    AROUND_M,
    MARGIN_M,
    Base,
    Known,
    Plane,
    Terrain,
    Toe,
    Volume,
    edge_heights,
    polygons_of,
    volume,
)
from groundproc.cloud import reader
from groundproc.cloud.classes import GROUND
from groundproc.cloud.selection import SURFACES
from groundproc.raster import geotiff
from groundproc.raster.sampling import heights_at
from groundproc.vectors.features import names_of, read_features

Array = npt.NDArray[np.float64]

BASES: Final = ("toe", "plane", "dtm")
_NONE: Final = np.empty((0, 3))
_LONGEST_EDGE_M: Final = 50_000.0
_EDGE_KNOWN: Final = 0.5
"""Share of the edge whose height has to be known."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A polygon and its volume, or why there is none."""

    id: str
    volume: Volume | None
    reason: str


def measure(
    cloud_path: Path, polygons_path: Path, base: str, progress: Callable[[int], object]
) -> tuple[list[Measured], reader.Cloud]:
    """Measure all polygons of a file.

    Parameters
    ----------
    cloud_path, polygons_path : Path
    base : str
        Of `BASES`, or the path of a raster of heights in the CRS of the cloud.
    progress : callable
        Told of points done.

    Raises
    ------
    UsageError, CaptureError, GeodesyError, CoverageError
        A file is not as it should be, or not one polygon can be measured.
    """
    cloud = reader.look(cloud_path, SURFACES)
    features = read_features(polygons_path, "Polygon")
    if cloud.horizontal is not None and features.crs is not None:
        features = features.into(cloud.horizontal)
    shapes = polygons_of(features.geometry)
    ids = names_of(features)
    for name, each in zip(ids, shapes, strict=True):
        if each.geom_type != "Polygon" or not each.is_valid:
            raise UsageError(f"{polygons_path}: {name}: expected one polygon whose edge does not cross itself")
        if each.exterior.length > _LONGEST_EDGE_M:
            raise UsageError(
                f"{polygons_path}: {name}: an edge of {each.exterior.length:,.0f} m found, expected {_LONGEST_EDGE_M:,.0f} m at most"
            )
    points = _around(cloud, shapes, MARGIN_M, progress)
    bare = _ground(cloud, shapes, progress) if base == "dtm" else [_NONE] * len(shapes)
    found = [
        _one(name, each, some, below, base) for name, each, some, below in zip(ids, shapes, points, bare, strict=True)
    ]
    if not any(each.volume for each in found):
        raise CoverageError(
            f"{polygons_path}: not one polygon can be measured; the first, {found[0].id}: {found[0].reason}"
        )
    return found, cloud


def _ground(cloud: reader.Cloud, shapes: list[Any], progress: Callable[[int], object]) -> list[Array]:
    """Points of the ground in and around each polygon: class 2 where the cloud has it, else as `swath ground` finds it."""
    if "classification" in cloud.columns:
        found = _around(cloud, shapes, AROUND_M, progress, GROUND)
        if any(len(each) for each in found):
            return found
    with tempfile.TemporaryDirectory() as folder:
        classed = Path(folder) / "ground.laz"
        ground.work(ground.Task(cloud.path, classed), progress)
        return _around(reader.look(classed), shapes, AROUND_M, progress, GROUND)


def _around(
    cloud: reader.Cloud, shapes: list[Any], margin_m: float, progress: Callable[[int], object], only: int | None = None
) -> list[Array]:
    """Points of the cloud in and around each polygon; of one class, or all."""
    boxes = [shapely.box(*each.bounds).buffer(margin_m, join_style="mitre").bounds for each in shapes]
    found: list[list[Array]] = [[] for _ in shapes]
    for chunk in reader.chunks(cloud, columns=() if only is None else ("classification",)):
        xyz = chunk.points.xyz_m if only is None else chunk.points.xyz_m[chunk.points["classification"] == only]
        for own, (west, south, east, north) in zip(found, boxes, strict=True):
            inside = (xyz[:, 0] >= west) & (xyz[:, 0] <= east) & (xyz[:, 1] >= south) & (xyz[:, 1] <= north)
            if inside.any():
                own.append(xyz[inside])
        progress(len(chunk.points.xyz_m))
    return [np.concatenate(parts) if parts else np.empty((0, 3)) for parts in found]


def _one(name: str, polygon: Any, points_m: Array, ground_m: Array, base: str) -> Measured:
    if len(points_m) < 3:
        return Measured(name, None, "no points of the cloud within it")
    if base == "dtm":
        try:
            found = volume(polygon, points_m, Terrain(polygon, ground_m))
        except ValueError:
            return Measured(name, None, f"only {len(ground_m)} points of ground within {AROUND_M:g} m of it")
    elif base in BASES:
        edge, sigma = edge_heights(polygon, points_m)
        known = np.isfinite(edge[:, 2])
        if known.mean() < _EDGE_KNOWN:
            return Measured(name, None, f"the height of {1 - known.mean():.0%} of its edge is not known")
        below: Base = (Toe if base == "toe" else Plane)(edge[known], sigma[known])
        found = volume(polygon, points_m, below)
    else:
        with geotiff.opened(Path(base)) as raster:
            found = volume(polygon, points_m, Known(lambda xy: heights_at(raster, xy)))
    return Measured(name, None, found) if isinstance(found, str) else Measured(name, found, "")
