"""Clouds as laspy and pyproj read them."""

import datetime as dt
import threading
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest

from flightlog.errors import SourceError
from groundproc.cloud.gpstime import gps_time_s
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.geodesy import projected_crs, with_sea_level


def test_adjusted_gps_time_counts_leap_seconds_and_starts_in_september_2011() -> None:
    # 2026-05-20T10:17:03Z is GPS week 2419, 382641 s of the week: 18 leap seconds (navcen's calendar; week 0 began 1980-01-06)
    utc = dt.datetime(2026, 5, 20, 10, 17, 3, tzinfo=dt.UTC)
    since_1980_s = (utc - dt.datetime(1980, 1, 6, tzinfo=dt.UTC)).total_seconds() + 18
    utc_ns = int(utc.timestamp()) * 10**9
    assert gps_time_s(np.array([utc_ns, utc_ns + 1_152])).tolist() == pytest.approx(
        [since_1980_s - 1e9, since_1980_s - 1e9 + 1.152e-6], abs=1e-7
    )
    # 15 leap seconds when the recording of 2012-06-30 was made, 16 a day later
    june, july = (int(dt.datetime(2012, m, d, tzinfo=dt.UTC).timestamp()) * 10**9 for m, d in ((6, 30), (7, 1)))
    assert gps_time_s(np.array([july]))[0] - gps_time_s(np.array([june]))[0] == 86_401.0
    assert gps_time_s(np.empty(0, np.int64)).shape == (0,)


COLUMNS = ("intensity", "return_number", "number_of_returns", "laser", "range")
START_NS = 1_779_272_223_000_000_000


def cloud_of(count: int) -> Points:
    rng = np.random.default_rng(1)
    returns = rng.choice([0x11, 0x21, 0x22], count).astype(np.uint8)
    return Points(
        START_NS + np.sort(rng.integers(0, 100 * 10**9, count)),
        rng.uniform([533_000, 6_472_000, -20], [534_000, 6_473_000, 180], (count, 3)),
        {
            "intensity": rng.integers(0, 256, count).astype(np.uint8),
            "return_number": returns & 15,
            "number_of_returns": returns >> 4,
            "laser": rng.integers(0, 32, count).astype(np.uint8),
            "range": (rng.integers(1, 65_536, count) * 0.002).astype(np.float32),
        },
    )


def write(path: Path, count: int, chunks: int = 1, **options: Any) -> Points:
    points = cloud_of(count)
    with CloudWriter(path, COLUMNS, offset_m=(533_000.0, 6_472_000.0, 0.0), **options) as cloud:
        for part in np.array_split(np.arange(count), chunks):
            cloud.write(points.masked(part))
    assert cloud.points == count
    return points


def few(**columns: np.ndarray) -> Points:
    count = len(next(iter(columns.values())))
    return Points(np.full(count, START_NS), np.zeros((count, 3)), columns)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    points = write(tmp_path / "cloud.laz", 50_000, 7, crs=with_sea_level(projected_crs(32633)))
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert (cloud.header.version.major, cloud.header.version.minor) == (1, 4)
    assert cloud.header.point_format.id == 6
    assert cloud.header.point_count == 50_000
    np.testing.assert_allclose(
        np.stack([cloud.x, cloud.y, cloud.z], axis=1), points.xyz_m, rtol=0.0, atol=0.0005 + 1e-9
    )
    np.testing.assert_allclose(cloud.header.mins, points.xyz_m.min(axis=0), rtol=0.0, atol=0.001)
    np.testing.assert_allclose(cloud.header.maxs, points.xyz_m.max(axis=0), rtol=0.0, atol=0.001)
    # doubles of 4.6e8 s are 6e-8 s apart
    start_s = START_NS // 10**9 - 315_964_800 + 18 - 10**9
    np.testing.assert_allclose(cloud.gps_time - start_s, (points.time_ns - START_NS) * 1e-9, rtol=0, atol=1e-7)
    for name in ("intensity", "return_number", "number_of_returns", "laser"):
        assert (cloud[name] == points[name]).all()
    np.testing.assert_allclose(cloud["range"], points["range"], rtol=0, atol=1e-5)
    assert (cloud.points.array["range"] == np.rint(points["range"] / 0.002)).all()
    assert cloud.header.number_of_points_by_return[0] == np.count_nonzero(points["return_number"] == 1)
    assert cloud.header.number_of_points_by_return[1] == np.count_nonzero(points["return_number"] == 2)
    assert cloud.header.global_encoding.wkt
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD


def test_the_crs_is_stated_as_wkt_that_pyproj_understands(tmp_path: Path) -> None:
    write(tmp_path / "cloud.laz", 10, crs=with_sea_level(projected_crs(32633)))
    crs = laspy.read(tmp_path / "cloud.laz").header.parse_crs()
    assert crs is not None
    assert [part.to_epsg() for part in crs.sub_crs_list] == [32633, 5773]
    write(tmp_path / "flat.laz", 10, crs=projected_crs(3006))
    with laspy.open(tmp_path / "flat.laz") as flat:
        (record,) = [vlr for vlr in flat.header.vlrs if vlr.record_id == 2112]
        assert record.user_id == "LASF_Projection"
        assert pyproj.CRS.from_wkt(record.string).to_epsg(min_confidence=20) == 3006
        assert record.string.startswith("PROJCS[")  # WKT 1, as LAS 1.4 asks


def test_time_of_a_free_sensor_is_not_called_gps_time(tmp_path: Path) -> None:
    write(tmp_path / "cloud.laz", 10, gps=False, about="sensor frame, sensor time")
    header = laspy.read(tmp_path / "cloud.laz").header
    assert header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    assert header.system_identifier == "sensor frame, sensor time"
    assert header.parse_crs() is None


def test_azimuths_are_stored_in_hundredths_of_a_degree(tmp_path: Path) -> None:
    with CloudWriter(tmp_path / "a.laz", ["azimuth"]) as cloud:
        cloud.write(few(azimuth=np.array([0.0, 359.99], np.float32)))
    stored = laspy.read(tmp_path / "a.laz")
    assert stored.points.array["azimuth"].tolist() == [0, 35_999]
    # of an echo of which nothing is known LAS is told that it is the only one
    assert stored.points.array["bit_fields"].tolist() == [0x11, 0x11]


@pytest.mark.parametrize("beyond", [131.08, -0.002, np.nan, np.inf])
def test_a_value_that_its_bytes_cannot_hold_is_refused_by_name(tmp_path: Path, beyond: float) -> None:
    with pytest.raises(SourceError, match=r"range .* found, expected 0 to 131.07"), CloudWriter(
        tmp_path / "a.laz", ["range"]
    ) as cloud:  # fmt: skip
        cloud.write(few(range=np.array([1.0, beyond], np.float32)))


def test_a_point_too_far_for_whole_millimetres_is_refused(tmp_path: Path) -> None:
    points = few(intensity=np.ones(2, np.uint8))
    points.xyz_m[1, 1] = 6_472_000.0
    with pytest.raises(SourceError, match="more than 2147 km"), CloudWriter(tmp_path / "a.laz", ["intensity"]) as cloud:
        cloud.write(points)


def test_colours_choose_the_point_format(tmp_path: Path) -> None:
    colours = {name: np.array([i, 65_535], np.uint16) for i, name in enumerate(("red", "green", "blue", "nir"))}
    for names, number in (((), 6), (("red", "green", "blue"), 7), (tuple(colours), 8)):
        columns = {"intensity": np.ones(2, np.uint8)} | {name: colours[name] for name in names}
        with CloudWriter(tmp_path / "a.laz", columns) as cloud:
            cloud.write(few(**columns))
        stored = laspy.read(tmp_path / "a.laz")
        assert stored.header.point_format.id == number
        for name in names:
            assert (stored[name] == colours[name]).all()


def test_an_error_of_the_compressor_reaches_the_writer_and_leaves_no_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    def fill() -> None:
        with CloudWriter(tmp_path / "a.laz", ["laser"]) as cloud:
            monkeypatch.setattr(cloud._las.point_writer, "write_points", full)
            for _ in range(50):
                cloud.write(few(laser=np.ones(100_000, np.uint8)))

    with pytest.raises(SourceError, match="No space left"):
        fill()
    assert not [thread for thread in threading.enumerate() if thread.name == "laz"]


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot be written"):
        CloudWriter(tmp_path / "no" / "cloud.laz", ["laser"])
