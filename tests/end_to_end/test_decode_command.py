"""`swath decode`: the lidar's points in its own frame, as laspy reads them."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import velodyne_decoder
from velodynes import by_velodyne_decoder

from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.flight import load
from groundproc.sensors import hdl32e as model
from groundproc.sensors.shots import Gate


def run(output: Path, *words: Any) -> laspy.LasData:
    assert main(["decode", *(str(word) for word in words), "-o", str(output)]) == 0
    assert [path.name for path in output.parent.iterdir()] == [output.name]
    return laspy.read(output)


def xyz(cloud: laspy.LasData) -> np.ndarray:
    return np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)


def test_a_recording_is_written_point_by_point_as_velodyne_decoder_reads_it(monterey_log: Path, tmp_path: Path) -> None:
    cloud = run(tmp_path / "out" / "all.laz", monterey_log, "--fov", "all")
    with LogReader(monterey_log) as reader:
        packets = [p.tobytes() for b in load.lidar_batches([reader]) for p in b.packets["data"]]
    theirs = by_velodyne_decoder(packets, velodyne_decoder.Model.HDL32E, 553e-6, 131.07 + 0.001)
    assert len(cloud.points) == len(theirs) > 800_000
    assert (np.asarray(cloud.intensity) == theirs["intensity"]).all()
    # their x is forward and their y left; millimetres in the file
    across = np.hypot(np.asarray(cloud.x) + theirs["y"], np.asarray(cloud.y) - theirs["x"])
    assert across.mean() < 0.001 + 0.0005
    # the sensor's own GPS: UTC 22:06:32 on 2012-12-11, 16 leap seconds then
    first = np.datetime64("1980-01-06") + np.timedelta64(round((cloud.gps_time[0] + 1e9 - 16) * 1e6), "us")
    assert np.datetime64("2012-12-11T22:06:32") < first < np.datetime64("2012-12-11T22:06:34")
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert cloud.header.parse_crs() is None
    np.testing.assert_allclose(np.linalg.norm(xyz(cloud), axis=1), np.asarray(cloud["range"]), rtol=0, atol=0.0011)


def test_the_airframe_is_left_out_unless_asked_for(plain_flight: Any, tmp_path: Path) -> None:
    ahead = run(tmp_path / "a" / "ahead.laz", plain_flight.log)
    azimuth = np.asarray(ahead["azimuth"])
    assert ((azimuth <= 105.0) | (azimuth >= 255.0)).all()
    full = run(tmp_path / "b" / "all.laz", plain_flight.log, "--fov", "all")
    behind = np.asarray(full["azimuth"])
    assert np.asarray(full["range"])[(behind > 106) & (behind < 254)].min() < 0.5
    kept = np.asarray(full["azimuth"])
    inside = ((kept < 104.9) | (kept > 255.1)).sum()
    assert inside <= len(ahead.points) <= ((kept < 105.1) | (kept > 254.9)).sum()


def test_without_gps_times_are_the_sensors_own(
    plain_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = run(tmp_path / "out" / "a.laz", plain_flight.log, "--fov", "all", "--min-range", "2", "--max-range", "40")
    assert "sensor time" in capsys.readouterr().out
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    assert "sensor time" in cloud.header.system_identifier
    with LogReader(plain_flight.log) as reader:
        batches = [b for b in load.lidar_batches([reader]) if len(b.packets)]
    packets = np.concatenate([b.packets for b in batches])
    # on from 1012.25 s past the hour, by the bytes themselves
    sent_ns = packets["data"]["stamp_us"].astype(np.int64) * 1000
    (shots,) = model.LIDAR.decode(packets, sent_ns, Gate(0.0, 360.0, 2.0, 40.0))
    np.testing.assert_allclose(np.asarray(cloud.gps_time), shots.time_ns * 1e-9, rtol=0, atol=1e-8)
    np.testing.assert_allclose(xyz(cloud), shots.xyz_m, rtol=0, atol=0.00051)
    assert (np.asarray(cloud["laser"]) == shots.laser).all()
    away = (np.asarray(cloud["azimuth"]) - np.rad2deg(shots.azimuth_rad) + 180.0) % 360.0 - 180.0
    assert np.abs(away).max() < 0.0051
    ranges = np.asarray(cloud["range"])
    assert 2.0 <= ranges.min() <= ranges.max() <= 40.0


def test_dual_returns_keep_both(dual_flight: Any, tmp_path: Path) -> None:
    cloud = run(tmp_path / "out" / "a.laz", dual_flight.log)
    number, of = np.asarray(cloud.return_number), np.asarray(cloud.number_of_returns)
    assert set(zip(number.tolist(), of.tolist(), strict=True)) == {(1, 1), (1, 2), (2, 2)}


def test_a_tripod_sees_its_panels(still_flight: Any, tmp_path: Path) -> None:
    """No autopilot is needed: the ground of the scene is 1.5 m below."""
    cloud = run(tmp_path / "out" / "a.laz", still_flight.log)
    heights = np.asarray(cloud.z)
    near = np.hypot(np.asarray(cloud.x), np.asarray(cloud.y)) < 8.0
    assert np.median(heights[near]) == pytest.approx(-1.5, abs=0.005)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--fov", "round"], 2, "round"),
        (["--min-range", "90", "--max-range", "100"], 1, "no return"),
        (["--min-range", "50", "--max-range", "20"], 2, "range"),
    ],
)
def test_what_gives_no_point_is_refused_and_leaves_no_file(
    still_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, said: str
) -> None:
    output = tmp_path / "out" / "a.laz"
    assert main(["decode", str(still_flight.log), "-o", str(output), *words]) == code
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1
    assert not output.parent.exists() or not list(output.parent.iterdir())


def test_what_is_no_log_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.mcap").write_text("these are notes\n")
    for name in ("notes.mcap", "none.mcap"):
        assert main(["decode", str(tmp_path / name), "-o", str(tmp_path / "out" / "a.laz")]) == 1
        error = capsys.readouterr().err
        assert name in error
        assert len(error.strip().splitlines()) == 1


def test_a_place_that_cannot_be_written_is_refused(
    still_flight: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way\n")
    assert main(["decode", str(still_flight.log), "-o", str(tmp_path / "file" / "a.laz")]) == 1
    assert str(tmp_path / "file") in capsys.readouterr().err
    (tmp_path / "a.laz").mkdir()
    assert main(["decode", str(still_flight.log), "-o", str(tmp_path / "a.laz")]) == 2
    assert f"{tmp_path / 'a.laz'}: is a folder" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.laz", "file"]
