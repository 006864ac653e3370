"""`swath process` of part of a flight: points in the products are those that were asked for, and the others are counted."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import shapely

from groundproc.cli import main
from groundproc.vectors.features import Features, write_features

COMPLETE = (0, 3)
"""Exit codes with which the products are there: 3 s of flight are too short to tie the clocks well."""
FEW = ["--method", "ins", "--products", "cloud.laz", "--attributes", "strip"]


@pytest.fixture(scope="module")
def whole(dual_flight: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All of 3 s of flight."""
    folder = tmp_path_factory.mktemp("trim") / "out"
    assert main(["process", str(dual_flight.log), *FEW, "-o", str(folder)]) in COMPLETE
    return folder


def area_of(cloud: laspy.LasData, path: Path) -> Any:
    """A triangle over part of a cloud, in another CRS on disk."""
    x, y = np.percentile(cloud.x, [10, 50, 80]), np.percentile(cloud.y, [20, 70, 40])
    triangle = shapely.Polygon(np.stack([x, y], axis=1))
    crs = cloud.header.parse_crs().sub_crs_list[0]
    write_features(
        path, Features(np.array([triangle], object), {}, crs).into(pyproj.CRS.from_epsg(3006)), "Polygon", "a"
    )
    return triangle


def test_time_and_area_keep_what_numpy_keeps_and_the_rest_is_counted(
    whole: Path, dual_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = laspy.read(whole / "cloud.laz")
    triangle = area_of(before, tmp_path / "area.gpkg")
    folder = tmp_path / "out"
    options = ["--times", "0.5/1.5,2/", "--area", str(tmp_path / "area.gpkg")]
    words = ["process", str(dual_flight.log), *FEW[2:], *options, "-o", str(folder), "--trajectory", str(whole)]
    assert main(words) in COMPLETE
    after = laspy.read(folder / "cloud.laz")
    start_s = (
        np.loadtxt(whole / "trajectory.csv", delimiter=",", skiprows=1, usecols=0, max_rows=1, dtype=np.int64) * 1e-9
    )
    second = np.asarray(before.gps_time) + 1e9 + 315_964_800 - 18 - start_s
    timed = ((second >= 0.5) & (second < 1.5)) | (second >= 2.0)
    inside = shapely.contains_xy(triangle, before.x, before.y)
    far = shapely.distance(shapely.points(before.x, before.y), triangle.exterior) > 0.01
    found, expected = np.asarray(after.gps_time), np.asarray(before.gps_time)[timed & inside & far]
    assert len(expected) > 1000
    assert not len(np.setdiff1d(expected, found))
    assert not len(np.setdiff1d(found, np.asarray(before.gps_time)[timed & (inside | ~far)]))
    points = json.loads((folder / "quality.json").read_text())["points"]
    assert points["left_out"]["times"] == np.count_nonzero(~timed)
    assert points["written"] == len(found)
    assert points["written"] + sum(points["left_out"].values()) == len(before.points)
    assert f"left out: {points['left_out']['times']:,} by times" in capsys.readouterr().out


def test_another_area_in_the_same_file_and_another_choice_place_the_points_anew_and_nothing_else(
    whole: Path, dual_flight: Any, tmp_path: Path
) -> None:
    folder, area = tmp_path / "out", tmp_path / "area.geojson"
    cloud = laspy.read(whole / "cloud.laz")
    area_of(cloud, area)

    def run(*words: str) -> tuple[int, dict[str, str]]:
        assert main(["process", str(dual_flight.log), *FEW, *words, "-o", str(folder)]) in COMPLETE
        ledger = json.loads(next(folder.glob(".*/ledger.json")).read_text())
        written = json.loads((folder / "quality.json").read_text())["points"]["written"]
        return written, {name: each["finished"] for name, each in ledger["steps"].items()}

    inside, first = run("--area", str(area))
    outside, second = run("--area", str(area), "--area-keeps", "outside")
    assert inside + outside == len(cloud.points)
    assert first["trajectory"] == second["trajectory"]
    assert first["place"] != second["place"]
    box = shapely.box(*cloud.header.mins[:2] - 1, *cloud.header.maxs[:2] + 1)
    crs = cloud.header.parse_crs().sub_crs_list[0]
    write_features(area, Features(np.array([box], object), {}, crs), "Polygon", "a")
    everything, _ = run("--area", str(area))
    assert everything == len(cloud.points)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--times", "500/"], "not one point is left"),
        (["--times", "x"], "START/END"),
        (["--area", "missing.gpkg"], "missing.gpkg"),
        (["--area-keeps", "outside"], "expected with an area"),
    ],
)
def test_a_choice_that_cannot_be_is_one_sentence(
    words: list[str], told: str, whole: Path, dual_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    given = ["process", str(dual_flight.log), *FEW[2:], *words, "--trajectory", str(whole), "-o", str(folder)]
    assert main(given) in (1, 2)
    assert told in capsys.readouterr().err
    assert not (folder / "cloud.laz").exists()
