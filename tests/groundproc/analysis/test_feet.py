"""Clouds in feet: what the commands find of a place is what they find of it in metres, and lies where it lies in feet."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
import pytest
import rasterio

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
