"""An area on the map from a file of polygons: all of them together, in the CRS of the points."""

from pathlib import Path

import pyproj
import shapely

from flightlog.errors import CaptureError, GeodesyError
from groundproc.cloud.selection import Area
from groundproc.vectors.features import read_features


def read_area(path: Path, crs: pyproj.CRS | None, outside: bool) -> Area:
    """Read polygons.

    Parameters
    ----------
    path : Path
        GeoPackage or GeoJSON.
    crs : pyproj.CRS or None
        Of the points; the horizontal part of it counts. None: they state none, and the polygons may not either.
    outside : bool
        Points outside of it are kept.

    Raises
    ------
    CaptureError
        It cannot be read, states no CRS, or a polygon crosses itself.
    GeodesyError
        It has no place in the CRS of the points.
    """
    features = read_features(path, "Polygon")
    flat = crs.sub_crs_list[0] if crs is not None and crs.is_compound else crs
    if (features.crs is None) != (flat is None):
        who, other = (path, flat) if features.crs is None else ("the points", features.crs)
        raise GeodesyError(
            f"{path}: {who} state{'s' if who is path else ''} no CRS, expected one: the other is in {other and other.name}"
        )
    if flat is not None:
        features = features.into(flat)
    for number, each in enumerate(features.geometry, 1):
        if not each.is_valid:
            raise CaptureError(
                f"{path}: polygon {number}: {shapely.is_valid_reason(each)}; expected polygons that do not cross themselves"
            )
    return Area(shapely.union_all(shapely.force_2d(features.geometry)), outside)
