"""Physical and geodetic constants, each with unit and source."""

from typing import Final

STANDARD_GRAVITY_M_S2: Final = 9.80665
"""Standard acceleration of gravity [m/s^2]; CGPM 1901. Lidar and autopilot accelerometers count in it."""

WGS84_A_M: Final = 6_378_137.0
"""Semi-major axis of the WGS 84 ellipsoid [m]; NIMA TR8350.2."""

WGS84_F: Final = 1.0 / 298.257223563
"""Flattening of the WGS 84 ellipsoid; NIMA TR8350.2."""

WGS84_E2: Final = WGS84_F * (2.0 - WGS84_F)
"""First eccentricity squared of the WGS 84 ellipsoid."""

FORMAT_VERSION: Final = 1
"""Of the flight log; raised when a reader of the old version would misread a new log."""

HDL32E_DATA_PORT: Final = 2368
"""UDP port of the lidar's data packets (HDL-32E user's manual 63-9113 Rev A p. 5)."""
HDL32E_POSITION_PORT: Final = 8308
"""UDP port of its position packets (same page)."""

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
NS_PER_US: Final = 1_000
HOUR_NS: Final = 3600 * NS_PER_S
