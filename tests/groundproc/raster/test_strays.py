"""Rasters of points and files that nobody would draw: one sentence, before memory and minutes go."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin

from flightlog.errors import CaptureError, CoverageError
from groundproc.cloud.points import Points
from groundproc.raster import geotiff
from groundproc.raster.kinds import Gathering, kind


def test_one_stray_point_makes_no_raster_of_the_whole_country(tmp_path: Path) -> None:
    xyz = np.random.default_rng(1).uniform(0.0, 100.0, (1000, 3))
    near, far = Gathering(kind("dsm", None), 0.25, tmp_path), Gathering(kind("dsm", None), 0.25, tmp_path)
    near.add(Points(np.arange(1000), xyz))
    near.write(tmp_path / "near.tif", None)
    xyz[500] += 20_000.0
    far.add(Points(np.arange(1000), xyz))
    with pytest.raises(CoverageError, match=r"far\.tif: 1,000 points lie within 20,\d\d\d x 20,\d\d\d m, .*strays"):
        far.write(tmp_path / "far.tif", None)
    assert not (tmp_path / "far.tif").exists()


def heights(path: Path, value: float, transform: Affine) -> Path:
    values = np.full((8, 8), 70.0, np.float32)
    values[3, 3] = value
    with rasterio.open(
        path, "w", driver="GTiff", width=8, height=8, count=1, dtype="float32", crs="EPSG:32633", transform=transform
    ) as file:
        file.write(values, 1)
    return path


@pytest.mark.parametrize("value", [3.4e38, -3.4e38, float("inf"), -1e6])
def test_heights_that_cannot_be_are_named(tmp_path: Path, value: float) -> None:
    path = heights(tmp_path / "a.tif", value, from_origin(533_600.0, 6_470_020.0, 1.0, 1.0))
    with (
        geotiff.opened(path) as raster,
        pytest.raises(CaptureError, match=r"a\.tif: values such as .*which value stands for none\?"),
    ):
        raster.window(raster.grid.blocks(512).__iter__().__next__())


@pytest.mark.parametrize("cell", [1e-300, 1e-9, 1e9])
def test_cells_of_no_size_are_named(tmp_path: Path, cell: float) -> None:
    path = heights(tmp_path / "a.tif", 70.0, from_origin(533_600.0, 6_470_020.0, cell, cell))
    with pytest.raises(CaptureError, match=r"a\.tif: cells of .* found, expected"), geotiff.opened(path):
        pass
