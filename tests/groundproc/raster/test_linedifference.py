"""Differences between flight lines of a made-up surface: known to the millimetre, on slopes too, and silent where there is none."""

import json
import subprocess
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rio_cogeo.cogeo import cog_validate

from groundproc.cli import main
from groundproc.cloud.points import Points
from groundproc.raster.grid import Window
from groundproc.raster.linedifference import LineDifferences

EAST, NORTH = 533_000.0, 6_472_000.0
NOISE_M = 0.02


def line(
    number: int, offset_m: float, *, slope: float = 0.0, side_m: float = 20.0, per_m2: float = 400.0, seed: int = 0
) -> Points:
    """A line's points of a plane that rises to the east and half as much to the north."""
    rng = np.random.default_rng(100 * seed + number)
    count = int(per_m2 * side_m**2)
    x, y = rng.uniform(0.01, side_m - 0.01, (2, count))  # not on the edges of cells
    z = 50.0 + slope * x + 0.5 * slope * y + offset_m + rng.normal(0, NOISE_M, count)
    xyz = np.stack([EAST + x, NORTH + y, z], axis=1)
    return Points(np.zeros(count, np.int64), xyz, {"point_source_id": np.full(count, number, np.uint16)})


def differences(*lines: Points, cell_m: float = 0.5, side_m: float = 20.0) -> np.ndarray:
    cells = LineDifferences(cell_m)
    for each in lines:
        cells.add(each)
    n = int(side_m / cell_m)
    return cells.window(Window(int(EAST / cell_m), int(NORTH / cell_m), n, n))


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.5])
def test_a_step_between_lines_comes_out_whatever_the_slope(slope: float) -> None:
    """Of 100 points of each line in a cell: the error of a mean is a tenth of the noise, of their difference 1.4 of that."""
    found = differences(line(1, 0.0, slope=slope), line(2, 0.07, slope=slope))
    expected_sigma = NOISE_M * np.sqrt(2 / 100)
    error = found - 0.07
    assert np.isfinite(found).mean() > 0.99
    assert abs(error.mean()) < 4 * expected_sigma / np.sqrt(found.size)
    assert error.std() < 1.3 * expected_sigma


def test_the_sign_is_that_of_the_later_line_over_the_earlier_and_of_three_the_two_apart_most_count() -> None:
    assert np.nanmedian(differences(line(2, 0.0), line(5, -0.05))) == pytest.approx(-0.05, abs=0.003)
    assert np.nanmedian(differences(line(5, -0.05), line(2, 0.0))) == pytest.approx(-0.05, abs=0.003), "in any order"
    assert np.nanmedian(differences(line(1, 0.02), line(2, -0.06), line(3, 0.03))) == pytest.approx(0.09, abs=0.005)


def test_lines_that_sampled_other_parts_of_a_steep_cell_do_not_differ() -> None:
    """One saw the western half of each cell, the other the eastern: means alone would differ by a quarter of a metre."""
    one, two = line(1, 0.0, slope=1.0), line(2, 0.0, slope=1.0)
    west = np.modf(one.xyz_m[:, 0] / 0.5)[0] < 0.5
    east = np.modf(two.xyz_m[:, 0] / 0.5)[0] >= 0.5
    found = differences(one.masked(west), two.masked(east))
    assert abs(np.nanmean(found)) < 0.005


def test_points_on_the_edges_of_cells_lie_where_their_cells_are() -> None:
    """A lattice of 0.1 m in cells of 0.3 m: a point taken for one of the far side of its cell would be off by 0.15 m."""
    east, north = (each.ravel() for each in np.meshgrid(np.arange(120), np.arange(120)))
    xyz = np.stack([500_000.0 + 0.1 * east, 5_600_000.0 + 0.1 * north, 50.0 + 0.05 * east + 0.03 * north], axis=1)
    cells = LineDifferences(0.3)
    for number in (1, 2):
        lifted = xyz + np.array([0.0, 0.0, 0.07 * (number - 1)])
        cells.add(
            Points(np.zeros(len(xyz), np.int64), lifted, {"point_source_id": np.full(len(xyz), number, np.uint16)})
        )
    # 500,000 m are 1,666,666 cells and two thirds, 5,600,000 m are 18,666,666 and two thirds: the first whole one is a row and column on
    found = cells.window(Window(1_666_667, 18_666_667, 39, 39))
    np.testing.assert_allclose(found, 0.07, rtol=0, atol=1e-5)


def test_what_is_rough_or_seen_once_says_nothing() -> None:
    rng = np.random.default_rng(3)
    bush = [line(number, 0.0) for number in (1, 2)]
    for each in bush:
        each.xyz_m[:, 2] += rng.uniform(0, 1, len(each))
    assert np.isnan(differences(*bush)).all()
    assert np.isnan(differences(line(1, 0.0))).all()
    half = line(2, 0.1)
    found = differences(line(1, 0.0), half.masked(half.xyz_m[:, 0] < EAST + 10))
    assert np.isfinite(found[:, :19]).all()
    assert np.isnan(found[:, 21:]).all()


def test_pieces_in_any_order_give_the_same() -> None:
    both = [line(1, 0.0), line(2, 0.07)]
    whole = differences(*both)
    order = np.random.default_rng(1).permutation(len(both[0]))
    pieces = [each.masked(part) for part in np.array_split(order, 7) for each in both]
    np.testing.assert_allclose(differences(*pieces), whole, rtol=0, atol=1e-4)


def cloud(path: Path, lines: tuple[Points, ...], compound: bool = True) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [EAST, NORTH, 0.0]
    header.global_encoding.wkt = True
    crs = pyproj.CRS.from_epsg(32633)
    if compound:
        crs = pyproj.crs.CompoundCRS("both", [crs, pyproj.CRS.from_epsg(5773)])
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
    for name, about in (("sigma_h", "sigma horizontal [m]"), ("sigma_v", "sigma vertical [m]")):
        header.add_extra_dim(laspy.ExtraBytesParams(name, "u2", about, offsets=[0.0], scales=[0.001]))
    las = laspy.LasData(header)
    las.xyz = np.concatenate([each.xyz_m for each in lines])
    las.point_source_id = np.concatenate([each["point_source_id"] for each in lines])
    las.sigma_h, las.sigma_v = np.full(len(las.points), 0.02), np.full(len(las.points), 0.01)
    las.write(path)


def checked(path: Path) -> np.ndarray:
    """A raster that GDAL and rio-cogeo find as it should be; its values, NaN for no data."""
    told = json.loads(
        subprocess.run(["gdalinfo", "-json", str(path)], capture_output=True, check=True, text=True).stdout
    )
    assert "COMPD" in told["coordinateSystem"]["wkt"] or "COMPOUND" in told["coordinateSystem"]["wkt"]
    assert "EGM96" in told["coordinateSystem"]["wkt"]
    valid, errors, warnings = cog_validate(str(path), quiet=True, strict=True)
    assert valid, (errors, warnings)
    with rasterio.open(path) as raster:
        if max(raster.shape) > 512:
            assert raster.overviews(1)
        return np.asarray(raster.read(1, masked=True).astype(np.float64).filled(np.nan))


@pytest.mark.parametrize(("what", "expected"), [("strip-difference", 0.07), ("sigma", 0.03)])
def test_the_rasters_are_whole_cogs_with_a_compound_crs(what: str, expected: float, tmp_path: Path) -> None:
    cloud(tmp_path / "c.laz", (line(1, 0.0), line(2, 0.07)))
    assert main(["raster", str(tmp_path / "c.laz"), "--what", what, "-o", str(tmp_path / "o.tif")]) == 0
    assert np.nanmedian(checked(tmp_path / "o.tif")) == pytest.approx(expected, abs=0.002)


def test_lines_that_do_not_overlap_are_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud(tmp_path / "c.laz", (line(1, 0.0),))
    assert main(["raster", str(tmp_path / "c.laz"), "--what", "strip-difference", "-o", str(tmp_path / "o.tif")]) == 2
    assert "seen by two flight lines" in capsys.readouterr().err
    assert (
        main(
            [
                "raster",
                str(tmp_path / "c.laz"),
                "--what",
                "strip-difference",
                "--statistic",
                "max",
                "-o",
                str(tmp_path / "o.tif"),
            ]
        )
        == 2
    )
    assert [path.name for path in tmp_path.iterdir()] == ["c.laz"]


@pytest.mark.parametrize("what", ["dsm", "density", "hillshade", "strip-difference"])
def test_tiles_are_the_raster_in_pieces_and_their_index_is_the_whole(what: str, tmp_path: Path) -> None:
    cloud(tmp_path / "c.laz", (line(1, 0.0, slope=0.2), line(2, 0.07, slope=0.2)))
    words = ["raster", str(tmp_path / "c.laz"), "--what", what, "--cell", "0.5"]
    assert main([*words, "-o", str(tmp_path / "o.tif")]) == 0
    assert main([*words, "-o", str(tmp_path / "tiles"), "--tiles", "16"]) == 0
    whole = checked(tmp_path / "o.tif")
    tiles = sorted((tmp_path / "tiles").glob("*.tif"))
    assert len(tiles) == 4
    for path in tiles:
        with rasterio.open(path) as tile:
            assert (tile.bounds.left % 16, tile.bounds.bottom % 16) == (0.0, 0.0)
        checked(path)
    with rasterio.open(tmp_path / "tiles" / f"{what}.vrt") as index, rasterio.open(tmp_path / "o.tif") as one:
        window = rasterio.windows.from_bounds(*one.bounds, index.transform)
        found = np.asarray(index.read(1, window=window, masked=True).astype(np.float64).filled(np.nan))
        assert index.crs is not None
    np.testing.assert_allclose(found, whole, rtol=0, atol=1e-6)


def test_tiles_of_a_size_that_cells_do_not_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud(tmp_path / "c.laz", (line(1, 0.0),))
    words = ["raster", str(tmp_path / "c.laz"), "--cell", "0.3", "--tiles", "10", "-o", str(tmp_path / "tiles")]
    assert main(words) == 2
    assert "whole multiple of the cell" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["c.laz"]
