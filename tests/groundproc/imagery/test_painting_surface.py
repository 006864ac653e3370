"""The surface that mosaics are laid on, where a lidar saw too little of the ground."""

from pathlib import Path

import numpy as np
import rendered

from groundproc.cloud import reader
from groundproc.imagery.painting.surface import surface_of

SPACING_M = 0.2


def heights(tmp_path: Path, *gaps: tuple[float, float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a slope of 30 m a side with a house of 10 m, without points in boxes (west, east, south, north): heights, places."""
    east, north = (axis.ravel() for axis in np.mgrid[-15.0:15.0:SPACING_M, -15.0:15.0:SPACING_M])
    house = (np.abs(east) < 5.0) & (np.abs(north) < 5.0)
    points = np.column_stack([east, north, 0.05 * east + np.where(house, 6.0, 0.0)])
    for west, right, south, top in gaps:
        points = points[~((east > west) & (east < right) & (north > south) & (north < top))]
        east, north = points[:, 0], points[:, 1]
    rendered.write_cloud(tmp_path / "cloud.laz", points, epsg=None)
    surface = surface_of(reader.look(tmp_path / "cloud.laz"), SPACING_M, 0.1)
    places = np.stack([axis.ravel() for axis in np.mgrid[-14.0:14.0:0.5, -14.0:14.0:0.5]], axis=1)
    return surface.at(places[:, 0], places[:, 1])[0], places[:, 0], places[:, 1]


def test_a_road_that_a_lidar_does_not_see_is_ground_as_beside_it(tmp_path: Path) -> None:
    found, east, north = heights(tmp_path, (-20.0, 20.0, 8.0, 13.0))
    road = (north > 8.0) & (north < 13.0) & (np.abs(east) < 11.0)
    np.testing.assert_allclose(found[road], 0.05 * east[road], rtol=0, atol=0.05)


def test_a_wide_gap_stays_open_and_so_does_one_in_the_lee_of_a_house(tmp_path: Path) -> None:
    wide, east, north = heights(tmp_path, (-15.0, 15.0, 5.0, 14.0))
    middle = (np.abs(north - 9.5) < 2.0) & (np.abs(east) < 12.0)
    assert np.isnan(wide[middle]).all()
    lee, east, north = heights(tmp_path, (-4.0, 4.0, 4.9, 9.0))
    middle = (np.abs(north - 6.5) < 0.5) & (np.abs(east) < 0.6)
    assert np.isnan(lee[middle]).all()
