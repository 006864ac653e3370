"""`swath raster`: files that GDAL reads, from clouds of any origin."""

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio

from groundproc.cli import main
from groundproc.raster import geotiff
from groundproc.raster.grid import Window


def cloud(path: Path, epsg: int | None = 32633, seed: int = 3, count: int = 5000) -> np.ndarray:
    """A cloud of another program's; gives its points as stored."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [533_000.0, 6_472_000.0, 0.0]
    if epsg is not None:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    las = laspy.LasData(header)
    rng = np.random.default_rng(seed)
    las.x, las.y = 533_400.0 + rng.uniform(0, 200, count), 6_472_100.0 + rng.uniform(0, 150, count)
    las.z, las.intensity = rng.uniform(50, 60, count), rng.integers(0, 255, count)
    las.write(path)
    return np.asarray(las.xyz)


def test_a_surface_model_is_a_cog_whose_cells_hold_their_highest_point(tmp_path: Path) -> None:
    xyz = cloud(tmp_path / "c.laz")
    assert main(["raster", str(tmp_path / "c.laz"), "--cell", "0.5", "-o", str(tmp_path / "dsm.tif")]) == 0
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert (file.count, file.nodata, file.crs.to_epsg()) == (1, -9999.0, 32633)
        assert file.transform.c % 0.5 == file.transform.f % 0.5 == 0.0
        heights = file.read(1)
        for x, y, z in xyz[:500]:
            row, column = file.index(x, y)
            assert heights[row, column] >= np.float32(z)
        known = heights != -9999.0
        assert np.isin(heights[known], xyz[:, 2].astype(np.float32)).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.laz", "dsm.tif"]


def test_density_adds_up_to_the_number_of_points(tmp_path: Path) -> None:
    xyz = cloud(tmp_path / "c.laz")
    main(["raster", str(tmp_path / "c.laz"), "--what", "density", "-o", str(tmp_path / "d.tif")])
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.read(1).sum() * 0.25**2 == len(xyz)


def test_large_rasters_have_overviews_and_windows_that_reach_beyond_the_file_are_unknown(tmp_path: Path) -> None:
    cloud(tmp_path / "c.laz", count=200)
    main(["raster", str(tmp_path / "c.laz"), "--cell", "0.1", "--what", "intensity", "-o", str(tmp_path / "i.tif")])
    with rasterio.open(tmp_path / "i.tif") as file:
        assert file.overviews(1)
        whole = file.read(1, masked=True).filled(np.nan)
    with geotiff.opened(tmp_path / "i.tif") as raster:
        grid = raster.grid
        read = raster.window(Window(grid.column - 2, grid.row - 3, grid.columns + 4, grid.rows + 6))
    np.testing.assert_array_equal(read[3:-3, 2:-2], whole)
    assert np.isnan(read[:3]).all()
    assert np.isnan(read[:, -2:]).all()


def test_a_hillshade_of_a_raster_is_the_hillshade_of_its_points(tmp_path: Path) -> None:
    """Made block by block: its edges may not show."""
    cloud(tmp_path / "c.laz", count=100_000)
    main(["raster", str(tmp_path / "c.laz"), "-o", str(tmp_path / "dsm.tif")])
    main(["raster", str(tmp_path / "c.laz"), "--what", "hillshade", "-o", str(tmp_path / "a.tif")])
    main(["raster", str(tmp_path / "dsm.tif"), "--what", "hillshade", "-o", str(tmp_path / "b.tif")])
    with rasterio.open(tmp_path / "a.tif") as one, rasterio.open(tmp_path / "b.tif") as other:
        assert one.profile["dtype"] == "uint8"
        np.testing.assert_array_equal(one.read(1), other.read(1))


def test_a_cloud_without_a_crs_gives_a_raster_without_one_and_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud(tmp_path / "c.laz", None)
    assert main(["raster", str(tmp_path / "c.laz"), "-o", str(tmp_path / "d.tif")]) == 0
    assert "states no CRS" in capsys.readouterr().err
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.crs is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["c.laz", "-o", "d.png"], "ends in .png"),
        (["c.laz", "--what", "dtm", "-o", "d.tif"], "expected one of dsm"),
        (["c.laz", "--cell", "0", "-o", "d.tif"], "cell 0 m"),
        (["c.laz", "--cell", "nan", "-o", "d.tif"], "cell nan m"),
        (["c.laz", "--statistic", "mode", "-o", "d.tif"], "expected one of max"),
        (["c.laz", "--what", "range", "-o", "d.tif"], "has no range"),
        (["c.laz", "other.laz", "-o", "d.tif"], "expected one CRS"),
        (["c.laz", "-o", "there.tif"], "--force to write over"),
        (["there.tif", "--what", "hillshade", "-o", "d.tif"], "is a text file; expected a cloud"),
        (["none.laz", "-o", "d.tif"], "none.laz"),
    ],
)
def test_what_cannot_be_made_is_one_sentence(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cloud(tmp_path / "c.laz", count=10)
    cloud(tmp_path / "other.laz", 32634, count=10)
    (tmp_path / "there.tif").write_text("mine")
    before = sorted(tmp_path.iterdir())
    assert main(["raster", *words]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "there.tif").read_text() == "mine"
