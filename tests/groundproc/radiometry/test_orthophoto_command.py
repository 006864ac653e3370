"""`swath orthophoto`: a plane of values comes back exactly, at the border of blocks too, and what lies under something is not seen."""

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from strips import ORIGIN

from groundproc.cli import main
from groundproc.raster.movingplanes import moving_planes


def test_a_plane_is_exact_and_the_scatter_about_it_is_told() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 20, (40_000, 2))
    exact = 0.3 + 0.01 * xy[:, 0] - 0.02 * xy[:, 1]
    centres = np.arange(2, 18, 0.25) + 0.125
    expected = 0.3 + 0.01 * centres - 0.02 * centres[::-1, None]
    found = moving_planes(xy, exact, (2.0, 18.0), (64, 64), 0.25)
    np.testing.assert_allclose(found.value, expected, rtol=0, atol=1e-6)
    noisy = moving_planes(xy, exact + rng.normal(0, 0.05, len(xy)), (2.0, 18.0), (64, 64), 0.25)
    assert abs(float(np.sqrt(np.mean(noisy.sigma0**2))) / 0.05 - 1) < 0.05
    lonely = moving_planes(np.array([[5.0, 5.0]]), np.array([0.4]), (0.0, 20.0), (80, 80), 0.25)
    assert np.isclose(lonely.value[60, 20], 0.4)
    assert np.isnan(lonely.value[0, 0])


def test_reflectance_seen_from_above(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, (70, 12), (200_000, 2))
    roof = (xy[:, 0] > 30) & (xy[:, 0] < 36) & (rng.random(len(xy)) < 0.5)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(32633))
    header.add_extra_dim(laspy.ExtraBytesParams("reflectance", np.float32, "diffuse reflectance"))
    las = laspy.LasData(header)
    las.xyz = np.column_stack([xy, np.where(roof, 5.0, 0.0)]) + ORIGIN
    value = np.where(roof, 0.45, 0.1 + 0.002 * xy[:, 0])
    value[::100] = np.nan
    las["reflectance"] = value
    las.write(tmp_path / "a.laz")
    words = ["orthophoto", str(tmp_path / "a.laz"), "--cell", "0.25", "-o", str(tmp_path / "a.tif")]
    assert main([*words, "--attribute", "reflectance"]) == 0
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs.to_epsg() == 32633
        assert raster.overviews(1) or raster.width < 1024
        image = raster.read(1, masked=True).filled(np.nan)
        x = raster.transform.c + (np.arange(raster.width) + 0.5) * 0.25 - ORIGIN[0]
    open_ground = (x < 28) | (x > 38)
    inner = image[2:-2, 2:-2]
    np.testing.assert_allclose(
        inner[:, open_ground[2:-2]], np.broadcast_to(0.1 + 0.002 * x[2:-2][open_ground[2:-2]], inner[:, open_ground[2:-2]].shape),
        rtol=0, atol=2e-4,
    )  # fmt: skip
    # one cell in a hundred has no echo of the roof, and is seen through
    assert np.mean(np.abs(image[2:-2, (x > 31) & (x < 35)] - 0.45) < 0.01) > 0.95
    capsys.readouterr()
    assert main(["orthophoto", str(tmp_path / "a.laz"), "--attribute", "range", "-o", str(tmp_path / "b.tif")]) == 2
    assert "has no range" in capsys.readouterr().err
