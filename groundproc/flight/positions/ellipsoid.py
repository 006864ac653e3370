"""WGS 84: geocentric and geodetic coordinates, and the level axes of a place."""

from functools import cache

import numpy as np
import numpy.typing as npt
import pyproj

Array = npt.NDArray[np.float64]


@cache
def _transformer() -> pyproj.Transformer:
    return pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
    )


def ecef_from_geodetic(latitude_deg: Array, longitude_deg: Array, height_m: Array) -> Array:
    """Geocentric coordinates [m], shape (n, 3), of geodetic ones, shape (n,) each; heights above the ellipsoid."""
    return np.stack(_transformer().transform(longitude_deg, latitude_deg, height_m), axis=-1)


def geodetic_from_ecef(place_m: Array) -> tuple[Array, Array, Array]:
    """Latitude [deg], longitude [deg] and ellipsoidal height [m] of geocentric coordinates, shape (n, 3)."""
    x, y, z = np.moveaxis(np.asarray(place_m, np.float64), -1, 0)
    longitude, latitude, height = _transformer().transform(x, y, z, direction="INVERSE")
    return np.asarray(latitude), np.asarray(longitude), np.asarray(height)


def mat_ecef_enu(latitude_deg: Array, longitude_deg: Array) -> Array:
    """Column matrices "geocentric from east, north, up of the place", shape (..., 3, 3)."""
    lat, lon = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    with np.errstate(invalid="ignore"):  # what is no place has no axes; whoever reads files sorts them out
        sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lat)], axis=-1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=-1)
    return np.stack([east, north, up], axis=-1)


def turned(mat_ab: Array, covariance_b: Array) -> Array:
    """Covariances of b seen in a: M C M^T, shape (..., 3, 3)."""
    return np.asarray(mat_ab @ covariance_b @ np.swapaxes(mat_ab, -1, -2))
