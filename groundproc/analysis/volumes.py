"""From a cloud and a file of polygons to volumes."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import CoverageError, GeodesyError, UsageError
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
    together,
    volume,
)
from groundproc.cloud import reader
from groundproc.cloud.classes import GROUND
from groundproc.cloud.metres import Metres, Raster, Stating, metres_in, metres_of, unstated
from groundproc.cloud.sameness import horizontal, same, vertical
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


@dataclass(frozen=True, slots=True)
class Found:
    """All polygons of a file, measured in metres whatever the unit of the cloud.

    Attributes
    ----------
    polygons : list of Measured
    cloud : Cloud
    warnings : list of str
    """

    polygons: list[Measured]
    cloud: reader.Cloud
    warnings: list[str]


def measure(cloud_path: Path, polygons_path: Path, base: str, progress: Callable[[int], object]) -> Found:
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
    unit = metres_of(cloud)
    features = read_features(polygons_path, "Polygon")
    stating: list[Stating] = [cloud, Raster(polygons_path, features.crs)]
    if base not in BASES:
        stating.append(_checked(Path(base), cloud))
    if cloud.horizontal is not None and features.crs is not None:
        features = features.into(cloud.horizontal)
    ids = names_of(features)
    shapes = [_shape(polygons_path, name, each, unit) for name, each in zip(ids, features.geometry, strict=True)]
    points = _around(cloud, unit, shapes, MARGIN_M, progress)
    bare = _ground(cloud, unit, shapes, progress) if base == "dtm" else [_NONE] * len(shapes)
    found = [
        _all_parts(name, each, some, below, base, unit)
        for name, each, some, below in zip(ids, shapes, points, bare, strict=True)
    ]
    if not any(each.volume for each in found):
        raise CoverageError(
            f"{polygons_path}: not one polygon can be measured; the first, {found[0].id}: {found[0].reason}"
        )
    return Found(found, cloud, unstated(*stating))


def _checked(path: Path, cloud: reader.Cloud) -> Raster:
    """The raster of a base, which lies where the cloud lies and has heights of the same kind, as far as both state them.

    Raises
    ------
    CaptureError
        It cannot be read.
    GeodesyError
        It does not.
    """
    with geotiff.opened(path) as raster:
        crs = raster.crs
    if crs is None or cloud.crs is None:
        return Raster(path, horizontal(crs))
    for what, pick in (("coordinates", horizontal), ("heights", vertical)):
        mine, theirs = pick(cloud.crs), pick(crs)
        if mine is not None and theirs is not None and not same(mine, theirs):
            raise GeodesyError(
                f"{path}: {what} in {theirs.name}, but {cloud.path} in {mine.name}; expected one CRS for both; "
                "`swath transform` brings the cloud into another"
            )
    return Raster(path, horizontal(crs))


def _shape(path: Path, name: str, geometry: Any, unit: Metres) -> Any:
    """A polygon, or several that are one thing, in metres.

    Raises
    ------
    UsageError
        It is none that can be measured.
    """
    if not geometry.is_valid:
        raise UsageError(
            f"{path}: {name}: {shapely.is_valid_reason(geometry)}; expected a polygon whose edge does not cross itself"
        )
    shape = shapely.transform(geometry, lambda xy: xy * unit.across)
    for part in shapely.get_parts(shape):
        if part.exterior.length > _LONGEST_EDGE_M:
            raise UsageError(
                f"{path}: {name}: an edge of {part.exterior.length:,.0f} m found, expected {_LONGEST_EDGE_M:,.0f} m at most"
            )
    return shape


def _ground(cloud: reader.Cloud, unit: Metres, shapes: list[Any], progress: Callable[[int], object]) -> list[Array]:
    """Points of the ground in and around each polygon: class 2 where the cloud has it, else as `swath ground` finds it."""
    if "classification" in cloud.columns:
        found = _around(cloud, unit, shapes, AROUND_M, progress, GROUND)
        if any(len(each) for each in found):
            return found
    with tempfile.TemporaryDirectory() as folder:
        classed = Path(folder) / "ground.laz"
        ground.work(ground.Task(cloud.path, classed), progress)
        return _around(reader.look(classed), unit, shapes, AROUND_M, progress, GROUND)


def _around(
    cloud: reader.Cloud, unit: Metres, shapes: list[Any], margin_m: float, progress: Callable[[int], object],
    only: int | None = None,
) -> list[Array]:  # fmt: skip
    """Points of the cloud in and around each polygon, in metres; of one class, or all."""
    boxes = [shapely.box(*each.bounds).buffer(margin_m, join_style="mitre").bounds for each in shapes]
    found: list[list[Array]] = [[] for _ in shapes]
    for chunk in reader.chunks(cloud, columns=() if only is None else ("classification",)):
        xyz = chunk.points.xyz_m if only is None else chunk.points.xyz_m[chunk.points["classification"] == only]
        xyz = unit.of(xyz)
        for own, (west, south, east, north) in zip(found, boxes, strict=True):
            inside = (xyz[:, 0] >= west) & (xyz[:, 0] <= east) & (xyz[:, 1] >= south) & (xyz[:, 1] <= north)
            if inside.any():
                own.append(xyz[inside])
        progress(len(chunk.points.xyz_m))
    return [np.concatenate(parts) if parts else np.empty((0, 3)) for parts in found]


def _all_parts(name: str, shape: Any, points_m: Array, ground_m: Array, base: str, unit: Metres) -> Measured:
    """A polygon, or all parts of one thing together, each above a base of its own."""
    parts = [_one(each, points_m, ground_m, base, unit) for each in shapely.get_parts(shape)]
    for number, each in enumerate(parts, 1):
        if isinstance(each, str):
            return Measured(name, None, each if len(parts) == 1 else f"part {number} of {len(parts)}: {each}")
    return Measured(name, together([each for each in parts if isinstance(each, Volume)]), "")


def _one(polygon: Any, points_m: Array, ground_m: Array, base: str, unit: Metres) -> Volume | str:
    if len(points_m) < 3:
        return "no points of the cloud within it"
    if base == "dtm":
        try:
            return volume(polygon, points_m, Terrain(polygon, ground_m))
        except ValueError:
            return f"only {len(ground_m)} points of ground within {AROUND_M:g} m of it"
    if base in BASES:
        edge, sigma = edge_heights(polygon, points_m)
        known = np.isfinite(edge[:, 2])
        if known.mean() < _EDGE_KNOWN:
            return f"the height of {1 - known.mean():.0%} of its edge is not known"
        below: Base = (Toe if base == "toe" else Plane)(edge[known], sigma[known])
        return volume(polygon, points_m, below)
    with geotiff.opened(Path(base)) as raster:
        up = unit.up if raster.crs is None else metres_in(raster.crs).up
        return volume(polygon, points_m, Known(lambda xy_m: up * heights_at(raster, xy_m / unit.across)))
