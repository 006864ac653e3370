"""`swath export` of part of a cloud: held against numpy's own choice of the same points, with all their fields."""

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import shapely

from groundproc.cli import main
from groundproc.vectors.features import Features, write_features

EAST, NORTH = 533_000.0, 6_472_000.0
START_S = 430_000_000.0


def made(path: Path) -> laspy.LasData:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [EAST, NORTH, 0.0]
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(pyproj.CRS.from_epsg(32633))
    header.add_extra_dim(laspy.ExtraBytesParams("theirs", "f8"))
    las = laspy.LasData(header)
    rng, count = np.random.default_rng(3), 30_000
    las.x, las.y = EAST + rng.uniform(0, 100, count), NORTH + rng.uniform(0, 100, count)
    las.z, las.theirs = rng.normal(50, 2, count), rng.normal(0, 1, count)
    las.classification = rng.choice(np.array([1, 2, 7, 18, 69], np.uint8), count)
    las.point_source_id = rng.integers(1, 6, count)
    las.gps_time = START_S + np.arange(count) * 0.01
    las.write(path)
    return laspy.read(path)


def area(path: Path, epsg: int) -> None:
    box = shapely.box(EAST + 20, NORTH + 20, EAST + 60, NORTH + 80)
    here = Features(np.array([box], object), {}, pyproj.CRS.from_epsg(32633))
    write_features(path, here.into(pyproj.CRS.from_epsg(epsg)), "Polygon", "area")


@pytest.mark.parametrize(("name", "epsg"), [("a.gpkg", 32633), ("a.gpkg", 3006), ("a.geojson", 4326)])
@pytest.mark.parametrize("keeps", ["inside", "outside"])
def test_an_area_in_any_crs_keeps_the_points_on_its_side(name: str, epsg: int, keeps: str, tmp_path: Path) -> None:
    source = made(tmp_path / "c.laz")
    area(tmp_path / name, epsg)
    words = ["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "o.laz"), "--area", str(tmp_path / name)]
    assert main([*words, "--area-keeps", keeps]) == 0
    found = laspy.read(tmp_path / "o.laz")
    edge = np.max([np.abs(source.x - EAST - 40) / 20 - 1, np.abs(source.y - NORTH - 50) / 30 - 1], axis=0)
    inside = edge < 0
    expected = inside if keeps == "inside" else ~inside
    near = np.abs(edge) < 1e-3  # straight lines of one CRS are bent in another, by less than a centimetre here
    missing = np.setdiff1d(source.gps_time[expected & ~near], found.gps_time)
    more = np.setdiff1d(found.gps_time, source.gps_time[expected | near])
    assert not len(missing)
    assert not len(more)


def test_time_line_and_class_together_keep_every_field_and_say_what_each_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = made(tmp_path / "c.laz")
    words = ["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "o.copc.laz"), "--times", "50/100,200/"]
    assert main([*words, "--lines", "1,3-4", "--without-classes", "7,18,69"]) == 0
    second = np.asarray(source.gps_time) - START_S
    timed = (second >= 50) & (second < 100) | (second >= 200)
    expected = timed & np.isin(source.point_source_id, [1, 3, 4]) & np.isin(source.classification, [1, 2])
    found = laspy.read(tmp_path / "o.copc.laz")
    order = np.argsort(found.gps_time)
    for field in ("X", "Y", "Z", "theirs", "classification", "point_source_id", "gps_time"):
        np.testing.assert_array_equal(np.asarray(found[field])[order], np.asarray(source[field])[expected])
    said = capsys.readouterr().out
    assert f"{expected.sum():,} points" in said
    assert f"{(~timed).sum():,} by times" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.laz", "o.copc.laz"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--lines", "9"], "not one of 30,000 points is left: 30,000 by lines"),
        (["--lines", "3-1"], "expected whole numbers"),
        (["--times", "5"], "START/END"),
        (["--area", "missing.gpkg"], "missing.gpkg"),
        (["--area-keeps", "outside"], "expected with --area"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_leaves_nothing(
    words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(tmp_path / "c.laz")
    assert main(["export", str(tmp_path / "c.laz"), "-o", str(tmp_path / "o.laz"), *words]) in (1, 2)
    said = capsys.readouterr().err
    assert told in said
    assert len(said.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["c.laz"]
