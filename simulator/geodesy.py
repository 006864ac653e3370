"""From the local level frame to latitude, longitude and height, by way of earth-centred coordinates."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flightlog.constants import WGS84_A_M, WGS84_E2

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Origin:
    """Where the local frame touches the earth."""

    latitude_deg: float = 58.394
    longitude_deg: float = 15.574
    height_msl_m: float = 61.3
    undulation_m: float = 29.354
    """Ellipsoid height minus height above mean sea level; EGM96 near the origin."""


def geodetic(points_m: Array, origin: Origin) -> tuple[Array, Array, Array]:
    """Latitude [deg], longitude [deg] and height above mean sea level [m] of local points.

    Parameters
    ----------
    points_m : ndarray, shape (n, 3)
        East, north, up.
    origin : Origin
        Of the local frame.

    Notes
    -----
    Bowring's (1976) iteration, three times: exact to nanometres near the ground.
    """
    lat, lon = np.radians(origin.latitude_deg), np.radians(origin.longitude_deg)
    slat, clat, slon, clon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    height_m = origin.height_msl_m + origin.undulation_m
    normal_m = WGS84_A_M / np.sqrt(1 - WGS84_E2 * slat**2)
    centre = np.array(
        [
            (normal_m + height_m) * clat * clon,
            (normal_m + height_m) * clat * slon,
            (normal_m * (1 - WGS84_E2) + height_m) * slat,
        ]
    )
    mat_ecef_local = np.array([[-slon, -slat * clon, clat * clon], [clon, -slat * slon, clat * slon], [0, clat, slat]])
    x, y, z = (np.asarray(points_m) @ mat_ecef_local.T + centre).T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - WGS84_E2))
    for _ in range(3):
        radius = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + WGS84_E2 * radius * np.sin(latitude), across)
    radius = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(latitude) ** 2)
    height = across * np.cos(latitude) + z * np.sin(latitude) - WGS84_A_M**2 / radius
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), height - origin.undulation_m
