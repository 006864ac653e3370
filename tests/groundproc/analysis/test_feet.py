"""Clouds in feet: what the commands find of a place is what they find of it in metres, and lies where it lies in feet."""

import csv
import json
from pathlib import Path
from typing import Any

import ezdxf
import laspy
import numpy as np
import numpy.typing as npt
import pyogrio
import pyproj
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin

from groundproc.cli import main

METRES, FEET, FOOT_M = 32119, 2264, 1200 / 3937
"""North Carolina in metres, and in feet of the US survey."""
ORIGIN_M = np.array([610_000.0, 180_000.0, 0.0])
SHIFT_M = np.array([0.15, -0.1, 0.05])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A waved slope with a hut and blocks, before and after a crate came, the later epoch shifted; each in metres and in feet."""
    folder, rng = tmp_path_factory.mktemp("feet"), np.random.default_rng(4)
    for name, crate in (("a", False), ("b", True)):
        xy = rng.uniform(0, 24, (25_000, 2))
        z = 50.0 + 0.08 * xy[:, 0] + 0.6 * np.sin(xy[:, 1] / 3) + 0.4 * np.sin(xy[:, 0] / 2)
        for east, north, half, high in ((18, 18, 2, 3.0), (6, 16, 0.8, 1.2), (16, 5, 0.7, 0.9)):
            z[(np.abs(xy[:, 0] - east) < half) & (np.abs(xy[:, 1] - north) < half)] += high
        if crate:
            z[(np.abs(xy[:, 0] - 8) < 0.4) & (np.abs(xy[:, 1] - 8) < 0.4)] += 0.8
        xyz = np.column_stack([xy, z]) + rng.normal(0, 0.01, (len(xy), 3)) + ORIGIN_M + (SHIFT_M if crate else 0.0)
        for unit, crs, length in (("m", METRES, 1.0), ("ft", FEET, FOOT_M)):
            header = laspy.LasHeader(version="1.4", point_format=6)
            header.scales, header.offsets = [0.0005] * 3, np.floor(ORIGIN_M / length)
            header.add_crs(pyproj.CRS.from_epsg(crs))
            las = laspy.LasData(header)
            las.xyz = xyz / length
            las.intensity = np.full(len(xyz), 20)
            las.write(folder / f"{name}_{unit}.laz")
    return folder


def _swath(*words: str | Path) -> None:
    assert main([*map(str, words), "--force"]) == 0, words


def _features(path: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(path.read_text())["features"]
    return found


def test_a_crate_that_came_is_found_where_it_stands(place: Path, tmp_path: Path) -> None:
    told = []
    for unit, length in (("m", 1.0), ("ft", FOOT_M)):
        out = tmp_path / unit
        _swath("change", place / f"a_{unit}.laz", place / f"b_{unit}.laz", "--surface", "-o", out)
        claim = max(_features(out / "changes.geojson"), key=lambda each: each["properties"]["volume_m3"])
        at = np.array([claim["properties"][axis] for axis in "xyz"]) * length - ORIGIN_M
        np.testing.assert_allclose(at[:2], (8, 8), rtol=0, atol=0.15)
        np.testing.assert_allclose(claim["geometry"]["coordinates"], (at + ORIGIN_M) / length, rtol=0, atol=2e-3)
        matrix = np.array(json.loads((out / "registration.json").read_text())["matrix"])
        middle = ORIGIN_M + np.array([12, 12, 50])
        moved = (matrix @ [*((middle + SHIFT_M) / length), 1.0])[:3] * length
        np.testing.assert_allclose(moved, middle, rtol=0, atol=0.01)
        cores = np.asarray(laspy.read(out / "surface.laz").xyz) * length - ORIGIN_M
        np.testing.assert_allclose((cores[:, :2].min(), cores[:, :2].max()), (0, 24), rtol=0, atol=1.0)
        told.append(claim["properties"]["volume_m3"])
    assert told[1] == pytest.approx(told[0], rel=0.1)


def test_patches_that_did_not_move_are_told_so(place: Path, tmp_path: Path) -> None:
    out = tmp_path / "v.geojson"
    _swath("displacement", place / "a_ft.laz", place / "b_ft.laz", "-o", out)
    found = _features(out)
    assert found
    for each in found:
        at = np.array(each["geometry"]["coordinates"][0]) * FOOT_M - ORIGIN_M
        assert np.all(np.abs(at[:2] - 12) < 13)
        assert abs(at[2] - 52) < 4
        assert each["properties"]["moved_m"] < 0.1


def test_a_fused_cloud_lies_on_the_first(place: Path, tmp_path: Path) -> None:
    _swath("fuse", place / "a_ft.laz", place / "b_ft.laz", "-o", tmp_path / "f.laz")
    las = laspy.read(tmp_path / "f.laz")
    came, first = np.asarray(las["epoch"]) == 1, laspy.read(place / "b_ft.laz").xyz
    moved = (np.asarray(las.xyz)[came] - first) * FOOT_M
    np.testing.assert_allclose(moved.mean(axis=0), -SHIFT_M, rtol=0, atol=0.01)


@pytest.mark.parametrize("mode", ["exact", "voxels"])
def test_an_observer_stands_as_many_metres_over_feet(place: Path, tmp_path: Path, mode: str) -> None:
    seen: list[npt.NDArray[Any]] = []
    for unit, length in (("m", 1.0), ("ft", FOOT_M)):
        east, north = (ORIGIN_M[:2] + 12.0) / length
        words = ("--at", f"{east},{north}", "--height", "1.7", "--target-height", "0.5", "--mode", mode)
        _swath("viewshed", place / f"a_{unit}.laz", *words, "-o", tmp_path / f"{unit}.tif")
        with rasterio.open(tmp_path / f"{unit}.tif") as raster:
            assert raster.res[0] * length == pytest.approx(0.5)
            seen.append(raster.read(1))
    assert seen[0].shape == seen[1].shape
    assert np.mean(np.nan_to_num(np.abs(seen[0].astype(float) - seen[1])) < 0.05) > 0.98


def test_widths_cells_and_ways_are_in_metres(place: Path, tmp_path: Path) -> None:
    cloud, corner = place / "a_ft.laz", ORIGIN_M[:2] / FOOT_M
    ends = f"{corner[0]},{corner[1] + 12 / FOOT_M},{corner[0] + 24 / FOOT_M},{corner[1] + 12 / FOOT_M}"
    _swath("section", cloud, "--line", ends, "--width", "1", "-o", tmp_path / "s.laz")
    cut = laspy.read(tmp_path / "s.laz")
    assert 23.5 < np.asarray(cut["along"]).max() < 24.1
    assert np.ptp(np.asarray(cut.y)) * FOOT_M == pytest.approx(1.0, abs=0.02)
    _swath("orthophoto", cloud, "--attribute", "intensity", "--cell", "0.5", "-o", tmp_path / "o.tif")
    with rasterio.open(tmp_path / "o.tif") as raster:
        assert raster.res[0] * FOOT_M == pytest.approx(0.5)
    for what, unit, least, most in (("dsm", None, 49.0 / FOOT_M, 57.0 / FOOT_M), ("density", "1/m2", 39.9, 40.1)):
        _swath("raster", cloud, "--what", what, "--cell", "0.5", "-o", tmp_path / f"{what}.tif")
        with rasterio.open(tmp_path / f"{what}.tif") as raster:
            assert raster.res[0] * FOOT_M == pytest.approx(0.5)
            assert raster.units[0] == unit
            values = raster.read(1, masked=True).compressed()
        assert least < values.mean() < most


def test_contours_stand_at_whole_feet_and_say_so(tmp_path: Path) -> None:
    """A slope of one foot in ten to the east: the line of 105 ft runs 50 ft east of that of 100 ft."""
    west, north = np.round(ORIGIN_M[:2] / FOOT_M)
    with rasterio.open(
        tmp_path / "d.tif", "w", driver="GTiff", width=200, height=50, count=1, dtype="float32", crs=f"EPSG:{FEET}",
        transform=from_origin(west, north, 1.0, 1.0),
    ) as file:  # fmt: skip
        file.write(np.tile((100.0 + (np.arange(200) + 0.5) / 10).astype(np.float32), (50, 1)), 1)
    _swath("contours", tmp_path / "d.tif", "--interval", "1", "--shortest", "14", "-o", tmp_path / "c.gpkg")
    meta, _, wkb, fields = pyogrio.raw.read(tmp_path / "c.gpkg")
    columns = dict(zip(meta["fields"], fields, strict=True))
    assert set(columns) == {"height_ft", "index", "length_m"}
    np.testing.assert_array_equal(columns["height_ft"], np.arange(101.0, 120.0))
    np.testing.assert_allclose(columns["length_m"], 49 * FOOT_M, rtol=0, atol=1e-6)
    for line, height in zip(shapely.from_wkb(wkb), columns["height_ft"], strict=True):
        np.testing.assert_allclose(shapely.get_coordinates(line)[:, 0], west + 10 * (height - 100), rtol=0, atol=1e-3)
    _swath("contours", tmp_path / "d.tif", "--interval", "1", "-o", tmp_path / "c.dxf")
    _swath("tin", tmp_path / "d.tif", "-o", tmp_path / "t.dxf")
    drawn = ezdxf.readfile(tmp_path / "c.dxf")
    assert [each.dxf.height * FOOT_M for each in drawn.modelspace().query("TEXT")] == pytest.approx([0.5] * 3)
    assert {drawn.units, ezdxf.readfile(tmp_path / "t.dxf").units} == {ezdxf.enums.InsertUnits.USSurveyFeet}


def test_a_profile_of_feet_is_in_metres_as_its_columns_say(place: Path, tmp_path: Path) -> None:
    _swath("raster", place / "a_ft.laz", "--cell", "0.5", "--statistic", "mean", "-o", tmp_path / "d.tif")
    east, north = ORIGIN_M[:2] / FOOT_M
    line = f"{east + 2 / FOOT_M},{north + 12 / FOOT_M},{east + 22 / FOOT_M},{north + 12 / FOOT_M}"
    sources = (tmp_path / "d.tif", place / "a_ft.laz")
    _swath("profile", *sources, "--line", line, "--step", "1", "-o", tmp_path / "p.csv")
    with (tmp_path / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["source"] for row in rows] == ["d.tif"] * 21 + ["a_ft.laz"] * 21
    for row in rows:
        along = float(row["along_m"])
        x = 2.0 + along
        assert along == pytest.approx(round(along), abs=1e-3)
        assert float(row["easting"]) == pytest.approx(east + x / FOOT_M, abs=1e-3)
        # the wave rises by 0.28 in a metre, and a station stands for what is half a metre around it
        expected = 50.0 + 0.08 * x + 0.6 * np.sin(4.0) + 0.4 * np.sin(x / 2)
        assert float(row["height_m"]) == pytest.approx(expected, abs=0.15)


def test_tiles_are_metres_wide(place: Path, tmp_path: Path) -> None:
    _swath("tile", place / "a_ft.laz", "--size", "8", "-o", tmp_path / "tiles")
    found = [path for path in (tmp_path / "tiles").glob("*.copc.laz") if path.name != "overview.copc.laz"]
    for path in found:
        corner_m = np.array([float(each) for each in path.name.removesuffix(".copc.laz").split("_")]) * FOOT_M
        np.testing.assert_allclose(corner_m, np.round(corner_m / 8) * 8, rtol=0, atol=1e-3)
        within = np.asarray(laspy.read(path).xyz)[:, :2] * FOOT_M - corner_m
        assert within.min() > -1e-3
        assert within.max() < 8.001
    assert len(found) >= 9
