"""Clouds as laspy and pyproj read them."""

import datetime as dt
import threading
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from flightlog.errors import SourceError
from groundproc.cloud.las import AZIMUTH, LASER, RANGE, CloudWriter, gps_time_s
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


def write(path: Path, count: int, chunks: int = 1, **options: object) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    columns = {
        "xyz": rng.uniform([533_000, 6_472_000, -20], [534_000, 6_473_000, 180], (count, 3)),
        "time": np.sort(rng.uniform(4.6e8, 4.6e8 + 100, count)),
        "intensity": rng.integers(0, 256, count).astype(np.uint8),
        "returns": rng.choice([0x11, 0x21, 0x22], count).astype(np.uint8),
        "laser": rng.integers(0, 32, count).astype(np.uint8),
        "range": rng.integers(1, 65_536, count).astype(np.uint16),
    }
    with CloudWriter(path, [LASER, RANGE], offset_m=(533_000.0, 6_472_000.0, 0.0), **options) as cloud:  # type: ignore[arg-type]
        for part in np.array_split(np.arange(count), chunks):
            extras = {name: columns[name][part] for name in ("laser", "range")}
            cloud.write(
                columns["xyz"][part],
                columns["time"][part],
                columns["intensity"][part],
                columns["returns"][part],
                extras,
            )
    assert cloud.points == count
    return columns


def test_what_was_written_is_read(tmp_path: Path) -> None:
    columns = write(tmp_path / "cloud.laz", 50_000, 7, crs=with_sea_level(projected_crs(32633)))
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert (cloud.header.version.major, cloud.header.version.minor) == (1, 4)
    assert cloud.header.point_format.id == 6
    assert cloud.header.point_count == 50_000
    np.testing.assert_allclose(np.stack([cloud.x, cloud.y, cloud.z], axis=1), columns["xyz"], atol=0.0005 + 1e-9)
    np.testing.assert_allclose(cloud.header.mins, columns["xyz"].min(axis=0), atol=0.001)
    np.testing.assert_allclose(cloud.header.maxs, columns["xyz"].max(axis=0), atol=0.001)
    assert (cloud.gps_time == columns["time"]).all()
    assert (cloud.intensity == columns["intensity"]).all()
    assert (cloud.return_number == columns["returns"] & 15).all()
    assert (cloud.number_of_returns == columns["returns"] >> 4).all()
    assert (cloud["laser"] == columns["laser"]).all()
    np.testing.assert_allclose(cloud["range"], columns["range"] * 0.002, atol=1e-9)
    assert cloud.header.number_of_points_by_return[0] == np.count_nonzero(columns["returns"] & 15 == 1)
    assert cloud.header.number_of_points_by_return[1] == np.count_nonzero(columns["returns"] & 15 == 2)
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
    with CloudWriter(tmp_path / "a.laz", [AZIMUTH]) as cloud:
        one = np.ones(2, np.uint8)
        cloud.write(np.zeros((2, 3)), np.zeros(2), one, one * 0x11, {"azimuth": np.array([0, 35_999], np.uint16)})
    np.testing.assert_allclose(laspy.read(tmp_path / "a.laz")["azimuth"], [0.0, 359.99], atol=1e-9)


def test_an_error_of_the_compressor_reaches_the_writer_and_leaves_no_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    one = np.ones(1000, np.uint8)

    def fill() -> None:
        with CloudWriter(tmp_path / "a.laz", [LASER]) as cloud:
            monkeypatch.setattr(cloud._las.point_writer, "write_points", full)
            for _ in range(50):
                cloud.write(np.zeros((1000, 3)), np.zeros(1000), one, one, {"laser": one})

    with pytest.raises(OSError, match="No space left"):
        fill()
    assert not [thread for thread in threading.enumerate() if thread.name == "laz"]


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot be written"):
        CloudWriter(tmp_path / "no" / "cloud.laz", [LASER])
