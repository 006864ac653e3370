"""What a page is told of a cloud: units of its CRS, and an origin from which millimetres keep in single precision."""

import numpy as np
import pyproj
import pytest

from flightlog.errors import GeodesyError
from groundproc.viewer.scene import origin_of, units_of


@pytest.mark.parametrize(
    ("code", "units"),
    [
        ("EPSG:32633", ("m", "m")),
        ("EPSG:2225", ("US ft", "US ft")),
        ("EPSG:2992", ("ft", "ft")),
        ("EPSG:32633+5773", ("m", "m")),
        ("EPSG:2225+5773", ("US ft", "m")),
    ],
)
def test_lengths_are_in_the_units_of_the_crs(code: str, units: tuple[str, str]) -> None:
    assert units_of(pyproj.CRS(code)) == units


def test_nothing_can_be_measured_in_angles_and_nobody_guesses_a_unit() -> None:
    with pytest.raises(GeodesyError, match="coordinates in WGS 84 are angles, expected a projected CRS"):
        units_of(pyproj.CRS(4326))
    with pytest.raises(GeodesyError, match="are angles"):
        units_of(pyproj.CRS(4979))
    assert units_of(None) == ("units", "units")


def test_millimetres_keep_in_single_precision_up_to_eight_kilometres_from_the_middle() -> None:
    low, high = np.array([527_000.0, 6_466_000.0, 0.0]), np.array([539_000.0, 6_478_000.0, 300.0])
    origin = origin_of(low, high)
    place = np.array([high - 0.001, low + 0.001])
    back = (place - origin).astype(np.float32).astype(np.float64) + origin
    assert abs(back - place).max() < 0.0005
