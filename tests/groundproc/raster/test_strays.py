"""Rasters of points and files that nobody would draw: one sentence, before memory and minutes go."""

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import Affine, from_origin

from flightlog.errors import CaptureError, CoverageError
from groundproc.cli import main
from groundproc.cloud.points import Points
from groundproc.raster import geotiff
from groundproc.raster.kinds import Gathering, kind
from groundproc.raster.strays import Accompanied


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


def waved(per_m2: float, side_m: float, seed: int = 2) -> np.ndarray:
    """Points of a waved slope, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, side_m, (int(per_m2 * side_m**2), 2))
    return np.column_stack([xy, 70.0 + 0.1 * xy[:, 0] + np.sin(xy[:, 1] / 9.0)])


def passed_on(xyz: np.ndarray, pieces: int) -> tuple[np.ndarray, int]:
    """What has company, in the order of the file, and how many points have none."""
    taken: list[np.ndarray] = []
    near = Accompanied(lambda points: taken.append(points.time_ns))
    for some in np.array_split(np.arange(len(xyz)), pieces):
        near.add(Points(some, xyz[some]))
    alone = near.finish()
    return np.sort(np.concatenate(taken)), alone


@pytest.mark.parametrize("pieces", [1, 40, 1000])
@pytest.mark.parametrize(("per_m2", "side_m"), [(20.0, 20.0), (1.0, 90.0), (0.02, 600.0)])
def test_points_that_are_alone_are_told_however_the_cloud_comes(pieces: int, per_m2: float, side_m: float) -> None:
    """And a sparse cloud is no heap of strays."""
    xyz = waved(per_m2, side_m)
    strays = np.array([5, 300, len(xyz) - 1])
    xyz[strays, 2] += (200.0, -150.0, 400.0)
    kept, alone = passed_on(xyz, pieces)
    np.testing.assert_array_equal(kept, np.delete(np.arange(len(xyz)), strays))
    assert alone == len(strays)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_where_nothing_has_company_nothing_stands_out(count: int) -> None:
    xyz = np.random.default_rng(1).uniform(0.0, 1e6, (count, 3))
    assert passed_on(xyz, 1)[1] == 0


def test_a_bird_is_no_surface_and_a_pit_of_one_echo_neither(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Density and strengths count it, and so does a surface if all points shall."""
    xyz = waved(20.0, 20.0) + np.array([533_000.0, 6_472_000.0, 0.0])
    xyz[100, 2], xyz[200, 2] = 130.0, 10.0
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [533_000.0, 6_472_000.0, 0.0]
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.xyz, las.intensity = xyz, np.full(len(xyz), 7)
    las.write(tmp_path / "c.laz")

    def made(*words: str) -> tuple[np.ndarray, str]:
        assert main(["raster", str(tmp_path / "c.laz"), *words, "--force", "-o", str(tmp_path / "d.tif")]) == 0
        with rasterio.open(tmp_path / "d.tif") as file:
            return file.read(1, masked=True).compressed(), capsys.readouterr().out

    for statistic in ("max", "min", "mean", "median"):
        heights, said = made("--statistic", statistic)
        assert "; 2 points that are alone left out" in said
        assert heights.min() > 68.0
        assert heights.max() < 74.0
    relief, _ = made("--what", "local-relief")
    assert np.abs(relief).max() < 1.0
    heights, said = made("--all-classes")
    assert heights.max() == 130.0
    assert "alone" not in said
    density, _ = made("--what", "density", "--cell", "1")
    assert density.sum() == len(xyz)
