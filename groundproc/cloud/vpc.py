"""Virtual point clouds (.vpc): one JSON that lists the files of a cloud, as PDAL wrench and QGIS read it.

It is a STAC API ItemCollection (STAC 1.0.0) with the point cloud and the projection extension: an item a file, whose bounds stand there in
WGS 84 and in the CRS of the points.
"""

import itertools
import json
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

import laspy
import numpy as np
import pyproj

from flightlog.errors import CaptureError
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.tiling import OVERVIEW, Tile

_EXTENSIONS: Final = (
    "https://stac-extensions.github.io/pointcloud/v1.0.0/schema.json",
    "https://stac-extensions.github.io/projection/v1.1.0/schema.json",
)
_NAMES: Final = {
    "intensity": "Intensity", "return_number": "ReturnNumber", "number_of_returns": "NumberOfReturns", "synthetic": "Synthetic",
    "key_point": "KeyPoint", "withheld": "Withheld", "overlap": "Overlap", "scanner_channel": "ScanChannel",
    "scan_direction_flag": "ScanDirectionFlag", "edge_of_flight_line": "EdgeOfFlightLine", "classification": "Classification",
    "user_data": "UserData", "scan_angle": "ScanAngleRank", "point_source_id": "PointSourceId", "gps_time": "GpsTime", "red": "Red",
    "green": "Green", "blue": "Blue", "nir": "Infrared",
}  # fmt: skip
"""What PDAL calls the fields of LAS."""
_FLOATING: Final = ("X", "Y", "Z", "scan_angle")
_KINDS: Final = {"f": "floating", "u": "unsigned", "i": "signed"}
_EDGE: Final = 8
"""Points along each side of a rectangle that is drawn in another CRS: its sides are bent there."""


def write_vpc(
    path: Path, tiles: Sequence[Tile], overview: bool, header: laspy.LasHeader, crs: pyproj.CRS | None
) -> None:
    """Write the index of some tiles that lie beside it.

    Parameters
    ----------
    path : Path
        Written in place: the caller writes aside.
    tiles : sequence of Tile
    overview : bool
        There is one.
    header : laspy.LasHeader
        Of all tiles.
    crs : pyproj.CRS or None
        Of the points.
    """
    schemas = _schemas(header.point_format)
    standard = header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    items = [_item(tile, overview, crs, schemas, _when(path, tile, standard, header)) for tile in tiles]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": items}, indent=1) + "\n", encoding="utf-8")


def read_vpc(path: Path) -> tuple[list[Path], Path | None]:
    """Files that an index lists, ours or another program's, and their overview where there is one.

    Raises
    ------
    CaptureError
        It is none, or lists what is no file of this machine.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        assets = [feature["assets"] for feature in tree["features"]]
        data = [
            next(each["href"] for each in some.values() if "data" in each.get("roles", ["data"])) for some in assets
        ]
        overviews = [some["overview"]["href"] for some in assets[:1] if "overview" in some]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, LookupError, TypeError, AttributeError, StopIteration, RecursionError):
        raise CaptureError(
            f"{path}: is no virtual point cloud: expected features with an asset for each file"
        ) from None
    if not data:
        raise CaptureError(f"{path}: lists no files")
    files = [_beside(path, href) for href in data]
    return files, _beside(path, overviews[0]) if overviews else None


def _beside(path: Path, href: Any) -> Path:
    """A file by its address in an index."""
    place = urlsplit(str(href))
    if place.scheme not in ("", "file"):
        raise CaptureError(f"{path}: lists {href}, expected files of this machine: fetch them first")
    found = path.parent / unquote(place.path if place.scheme else str(href))
    if not found.is_file():
        raise CaptureError(f"{path}: lists {href}, and there is no such file; expected the tiles beside their index")
    return found


def _item(
    tile: Tile, overview: bool, crs: pyproj.CRS | None, schemas: list[dict[str, Any]], when: dict[str, str]
) -> dict[str, Any]:
    low, high = tile.low_m.tolist(), tile.high_m.tolist()
    ring = _ring(low, high)
    on_earth = ring if crs is None else _on_earth(ring, crs)
    west, south = on_earth.min(axis=0).tolist()
    east, north = on_earth.max(axis=0).tolist()
    assets: dict[str, Any] = {"data": {"href": f"./{tile.name}", "roles": ["data"]}}
    if overview:
        assets["overview"] = {"href": f"./{OVERVIEW}", "roles": ["overview"]}
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": list(_EXTENSIONS),
        "id": tile.square,
        "geometry": {"type": "Polygon", "coordinates": [on_earth.tolist()]},
        "bbox": [west, south, low[2], east, north, high[2]],
        "properties": when
        | {
            "pc:count": tile.points,
            "pc:type": "lidar",
            "pc:encoding": "LASzip",
            "pc:schemas": schemas,
            "proj:wkt2": "" if crs is None else crs.to_wkt("WKT2_2019"),
            "proj:geometry": {"type": "Polygon", "coordinates": [ring[::_EDGE].tolist()]},
            "proj:bbox": [*low, *high],
        },
        "links": [],
        "assets": assets,
    }


def _ring(low: Sequence[float], high: Sequence[float]) -> Any:
    """The outline of a tile's points, shape (k, 2), against the clock, its first corner at the end again."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]])
    along = np.arange(_EDGE)[:, None] / _EDGE
    sides = [a + along * (b - a) for a, b in itertools.pairwise(corners)]
    return np.concatenate([*sides, corners[-1:]])


def _on_earth(ring: Any, crs: pyproj.CRS) -> Any:
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    transformer = pyproj.Transformer.from_crs(flat, 4326, always_xy=True)
    return np.stack(transformer.transform(ring[:, 0], ring[:, 1]), axis=1)


def _when(path: Path, tile: Tile, standard: bool, header: laspy.LasHeader) -> dict[str, str]:
    """Time of the points; where it is not told, the day on which the file was made."""
    stamps = np.array([tile.first_s, tile.last_s])
    if standard and stamps.any() and np.isfinite(stamps).all():
        first, last = (_text(int(each)) for each in Clock().utc_ns(path, False, stamps))
        return {"datetime": first, "start_datetime": first, "end_datetime": last}
    day = header.creation_date
    return {"datetime": f"{day.isoformat() if day is not None else '1970-01-01'}T00:00:00Z"}


def _text(utc_ns: int) -> str:
    """As RFC 3339 has it."""
    return (
        (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=utc_ns // 1000)).isoformat().replace("+00:00", "Z")
    )


def _schemas(form: Any) -> list[dict[str, Any]]:
    """Attributes of all points by name, size and type as PDAL reads them."""
    found = []
    for each in form.dimensions:
        name = _NAMES.get(each.name, each.name)
        if each.name in _FLOATING or each.is_scaled:
            size, kind = (4 if each.name == "scan_angle" else 8), "floating"
        else:
            dtype = np.dtype(np.uint8) if each.dtype is None else np.dtype(each.dtype)
            size, kind = dtype.itemsize, _KINDS.get(dtype.kind, "unsigned")
        found.append({"name": name, "size": size, "type": kind})
    return found
