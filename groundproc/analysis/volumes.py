"""From a cloud and a file of polygons to volumes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis.volume import MARGIN_M, Base, Known, Plane, Toe, Volume, edge_heights, polygons_of, volume
from groundproc.cloud import reader
from groundproc.raster import geotiff
from groundproc.raster.grid import Window
from groundproc.vectors.features import Features, read_features

Array = npt.NDArray[np.float64]

BASES: Final = ("toe", "plane")
_IDS: Final = ("id", "name", "ID", "Name")
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
    cloud = reader.look(cloud_path)
    features = read_features(polygons_path, "Polygon")
    if cloud.horizontal is not None and features.crs is not None:
        features = features.into(cloud.horizontal)
    shapes = polygons_of(features.geometry)
    ids = _ids(features)
    for name, each in zip(ids, shapes, strict=True):
        if each.geom_type != "Polygon" or not each.is_valid:
            raise UsageError(f"{polygons_path}: {name}: expected one polygon whose edge does not cross itself")
        if each.exterior.length > _LONGEST_EDGE_M:
            raise UsageError(
                f"{polygons_path}: {name}: an edge of {each.exterior.length:,.0f} m found, expected {_LONGEST_EDGE_M:,.0f} m at most"
            )
    points = _around(cloud, shapes, progress)
    found = [_one(name, each, some, base) for name, each, some in zip(ids, shapes, points, strict=True)]
    if not any(each.volume for each in found):
        raise CoverageError(
            f"{polygons_path}: not one polygon can be measured; the first, {found[0].id}: {found[0].reason}"
        )
    return found, cloud


def _ids(features: Features) -> list[str]:
    """What the polygons are called: by their column id or name, else by number."""
    for name in _IDS:
        if name in features.columns:
            values = features.columns[name]
            return [str(value) if value not in (None, "") else str(n) for n, value in enumerate(values.tolist(), 1)]
    return [str(n) for n in range(1, len(features) + 1)]


def _around(cloud: reader.Cloud, shapes: list[Any], progress: Callable[[int], object]) -> list[Array]:
    """Points of the cloud in and around each polygon."""
    boxes = [shapely.box(*each.bounds).buffer(MARGIN_M, join_style="mitre").bounds for each in shapes]
    found: list[list[Array]] = [[] for _ in shapes]
    for chunk in reader.chunks(cloud, columns=()):
        xyz = chunk.points.xyz_m
        for own, (west, south, east, north) in zip(found, boxes, strict=True):
            inside = (xyz[:, 0] >= west) & (xyz[:, 0] <= east) & (xyz[:, 1] >= south) & (xyz[:, 1] <= north)
            if inside.any():
                own.append(xyz[inside])
        progress(len(xyz))
    return [np.concatenate(parts) if parts else np.empty((0, 3)) for parts in found]


def _one(name: str, polygon: Any, points_m: Array, base: str) -> Measured:
    if len(points_m) < 3:
        return Measured(name, None, "no points of the cloud within it")
    if base in BASES:
        edge, sigma = edge_heights(polygon, points_m)
        known = np.isfinite(edge[:, 2])
        if known.mean() < _EDGE_KNOWN:
            return Measured(name, None, f"the height of {1 - known.mean():.0%} of its edge is not known")
        below: Base = (Toe if base == "toe" else Plane)(edge[known], sigma[known])
        found = volume(polygon, points_m, below)
    else:
        with geotiff.opened(Path(base)) as raster:
            found = volume(polygon, points_m, Known(lambda xy: bilinear(raster, xy)))
    return Measured(name, None, found) if isinstance(found, str) else Measured(name, found, "")


def bilinear(raster: geotiff.Raster, xy_m: Array) -> Array:
    """Heights of a raster between the centres of its cells, shape (n, 2) -> (n,); NaN beside unknown cells."""
    grid = raster.grid
    column = (xy_m[:, 0] - raster.west_m) / grid.cell_m - 0.5
    down = (raster.north_m - xy_m[:, 1]) / grid.cell_m - 0.5
    left, top = int(np.floor(column.min())), int(np.floor(down.min()))
    width, height = int(np.floor(column.max())) - left + 2, int(np.floor(down.max())) - top + 2
    window = Window(grid.column + left, grid.row + grid.rows - top - height, width, height)
    values = raster.window(window).astype(np.float64)
    i, j = np.floor(column).astype(int) - left, np.floor(down).astype(int) - top
    u, v = column - left - i, down - top - j
    return np.asarray(
        (1 - v) * ((1 - u) * values[j, i] + u * values[j, i + 1])
        + v * ((1 - u) * values[j + 1, i] + u * values[j + 1, i + 1])
    )
