"""`swath merge`: every point of every cloud as it was, its flight line under a number of its own, and a table of whose it is."""

import json
import tracemalloc
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest

from groundproc.cli import main
from groundproc.cloud import reader

PLAN = 32633
HEIGHTS = {"egm96": 5773, "egm2008": 3855}


def cloud(
    path: Path, seed: int, *, heights: str = "egm96", plan: int = PLAN, lines: int = 3, extra: str = "", weekly: bool = False,
    step: float = 0.001, point_format: int = 6, count: int = 5_000,
) -> laspy.LasData:  # fmt: skip
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = [step] * 3, [533_000.0 + 100.0 * seed, 6_472_000.0, 0.0]
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType(0 if weekly else 1)
    if plan:
        flat = pyproj.CRS.from_epsg(plan)
        whole = pyproj.crs.CompoundCRS("both", [flat, pyproj.CRS.from_epsg(HEIGHTS[heights])]) if heights else flat
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(whole.to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    if extra:
        header.add_extra_dim(laspy.ExtraBytesParams("theirs", extra))
    las = laspy.LasData(header)
    rng = np.random.default_rng(seed)
    las.x, las.y = 533_000.0 + rng.uniform(0, 300, count), 6_472_000.0 + rng.uniform(0, 200, count)
    las.z, las.intensity = rng.normal(50, 2, count), rng.integers(0, 255, count)
    las.point_source_id = 1 + np.arange(count) * lines // count
    las.classification = rng.integers(0, 19, count)
    las.gps_time = (100_000.0 if weekly else 430_000_000.0 + 10_000.0 * seed) + np.arange(count) * 0.01
    if extra:
        las.theirs = rng.normal(0, 1, count)
    if point_format == 7:
        las.red = rng.integers(0, 65535, count)
    las.write(path)
    return laspy.read(path)


def merged(tmp_path: Path, *words: str, name: str = "o.laz") -> laspy.LasData:
    assert main(["merge", *words, "-o", str(tmp_path / name)]) == 0
    return laspy.read(tmp_path / name)


def test_points_stay_as_they_are_and_each_line_has_a_number_of_its_own(tmp_path: Path) -> None:
    first = cloud(tmp_path / "a.laz", 1, lines=3, extra="f8")
    second = cloud(tmp_path / "b.laz", 2, lines=2, point_format=7)
    found = merged(tmp_path, str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "--json", str(tmp_path / "t.json"))
    count = len(first.points)
    for axis in "xyz":
        both = np.concatenate([first[axis], second[axis]])
        np.testing.assert_allclose(found[axis], both, rtol=0, atol=1e-9)
    for field in ("intensity", "classification", "gps_time"):
        np.testing.assert_array_equal(found[field], np.concatenate([first[field], second[field]]))
    np.testing.assert_array_equal(found.point_source_id[:count], first.point_source_id)
    np.testing.assert_array_equal(found.point_source_id[count:], second.point_source_id + 3)
    np.testing.assert_array_equal(found.theirs[:count], first.theirs)
    assert np.isnan(found.theirs[count:]).all(), "what a cloud does not have is not known, and not 0"
    np.testing.assert_array_equal(found.red, np.concatenate([np.zeros(count), second.red]))
    assert [part.to_epsg() for part in found.header.parse_crs().sub_crs_list] == [PLAN, 5773]
    told = json.loads((tmp_path / "t.json").read_text())
    (record,) = [each for each in found.evlrs if each.user_id == "swath"]
    assert json.loads(bytes(record.record_data_bytes())) == told
    assert [line["id"] for line in told["flight_lines"]] == [1, 2, 3, 4, 5]
    assert [line["was"] for line in told["flight_lines"]] == [1, 2, 3, 1, 2]
    assert [Path(line["file"]).name for line in told["flight_lines"]] == ["a.laz"] * 3 + ["b.laz"] * 2
    for line in told["flight_lines"]:
        assert line["points"] == np.count_nonzero(found.point_source_id == line["id"])
    assert told["flight_lines"][0]["first"].startswith("2025-04-")


def test_folders_of_products_are_taken_and_a_copc_keeps_the_table(tmp_path: Path) -> None:
    for seed, name in ((1, "one"), (2, "two")):
        (tmp_path / name).mkdir()
        cloud(tmp_path / name / "cloud.laz", seed)
    found = merged(tmp_path, str(tmp_path / "one"), str(tmp_path / "two"), name="o.copc.laz")
    assert len(found.points) == 10_000
    assert np.array_equal(np.unique(found.point_source_id), np.arange(1, 7))
    (record,) = [each for each in found.header.vlrs if each.user_id == "swath"]
    assert len(json.loads(bytes(record.record_data_bytes()))["flight_lines"]) == 6
    assert sorted(path.name for path in tmp_path.iterdir()) == ["o.copc.laz", "one", "two"]


@pytest.mark.parametrize(
    ("other", "told"),
    [
        ({"plan": 32634}, "coordinates in WGS 84 / UTM zone 34N"),
        ({"heights": "egm2008"}, "heights in EGM2008 height"),
        ({"heights": ""}, "heights in none that is stated"),
        ({"plan": 0}, "coordinates in none that is stated"),
        ({"weekly": True}, "seconds of the GPS week"),
        ({"extra": "f4"}, "expected one meaning of one name"),
    ],
)
def test_what_does_not_go_together_is_one_sentence_and_leaves_nothing(
    other: dict[str, Any], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud(tmp_path / "a.laz", 1, extra="f8", count=100)
    cloud(tmp_path / "b.laz", 2, count=100, **other)
    assert main(["merge", str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "-o", str(tmp_path / "o.laz")]) == 1
    said = capsys.readouterr().err
    assert told in said
    assert len(said.strip().splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.laz", "b.laz"]


@pytest.mark.parametrize("names", [("a.laz", "b.laz"), ("b.laz", "a.laz")])
def test_a_cloud_whose_times_are_all_zero_goes_with_any(tmp_path: Path, names: tuple[str, str]) -> None:
    timed = cloud(tmp_path / "a.laz", 1, count=100)
    dark = cloud(tmp_path / "b.laz", 2, count=100, weekly=True)
    dark.gps_time = np.zeros(100)
    dark.write(tmp_path / "b.laz")
    found = merged(tmp_path, *(str(tmp_path / name) for name in names))
    assert found.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    times = {"a.laz": np.asarray(timed.gps_time), "b.laz": np.zeros(100)}
    np.testing.assert_array_equal(found.gps_time, np.concatenate([times[name] for name in names]))


def test_one_cloud_twice_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud(tmp_path / "a.laz", 1, count=100)
    assert main(["merge", str(tmp_path / "a.laz"), str(tmp_path / "a.laz"), "-o", str(tmp_path / "o.laz")]) == 2
    assert "a.laz: given twice; expected each cloud once" in capsys.readouterr().err
    assert main(["merge", str(tmp_path / "a.laz"), "-o", str(tmp_path / "o.laz")]) == 2
    assert "one cloud given" in capsys.readouterr().err


def test_memory_does_not_follow_the_number_of_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen times the points in pieces of the same size take the same memory."""
    monkeypatch.setattr(reader, "CHUNK", 20_000)
    peaks = []
    for count in (20_000, 320_000):
        for seed, name in ((1, "a.laz"), (2, "b.laz")):
            cloud(tmp_path / name, seed, count=count)
        words = ["merge", str(tmp_path / "a.laz"), str(tmp_path / "b.laz"), "-o", str(tmp_path / "o.laz"), "--force"]
        tracemalloc.start()
        assert main(words) == 0
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]
