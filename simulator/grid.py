"""Map coordinates of the simulated places: UTM, by Krueger's series in the third flattening (Karney 2011, eq. 7 to 14)."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import WGS84_A_M, WGS84_E2

Array = npt.NDArray[np.float64]

ZONE_EPSG: Final = 32633
"""UTM zone 33 north, in which all scenes lie."""
_MERIDIAN_DEG: Final = 15.0
_SCALE: Final = 0.9996
_FALSE_EASTING_M: Final = 500_000.0


def on_grid(latitude_deg: Array, longitude_deg: Array) -> tuple[Array, Array]:
    """Easting and northing [m] of places on the ellipsoid, to a hundredth of a millimetre within the zone."""
    e = np.sqrt(WGS84_E2)
    n = WGS84_E2 / (1.0 + np.sqrt(1.0 - WGS84_E2)) ** 2
    lat, lon = np.radians(latitude_deg), np.radians(np.asarray(longitude_deg) - _MERIDIAN_DEG)
    t = np.sinh(np.arctanh(np.sin(lat)) - e * np.arctanh(e * np.sin(lat)))
    xi, eta = np.arctan2(t, np.cos(lon)), np.arcsinh(np.sin(lon) / np.hypot(t, np.cos(lon)))
    series = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    )
    north, east = xi.copy(), eta.copy()
    for j, alpha in enumerate(series, 1):
        north = north + alpha * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        east = east + alpha * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    radius = WGS84_A_M / (1.0 + n) * (1.0 + n**2 / 4 + n**4 / 64)
    return _FALSE_EASTING_M + _SCALE * radius * east, _SCALE * radius * north
