"""A line scanner with IMU and GPS, from its files to points, against the truth they were made from."""

import json
from pathlib import Path

import laspy
import linekit
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightlog import records
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from groundproc.cli import main
from groundproc.flight.importers.lines import read_imu, read_lines
from groundproc.geodesy import Projection, projected_crs
from groundproc.trajectory.table import read_trajectory


@pytest.fixture(scope="module")
def kit(tmp_path_factory: pytest.TempPathFactory) -> linekit.Kit:
    return linekit.fly(tmp_path_factory.mktemp("kit"))


@pytest.fixture(scope="module")
def log(kit: linekit.Kit) -> Path:
    path = kit.scans.with_name("kit.mcap")
    line = ["--scans", kit.scans, "--imu", kit.imu, "--positions", kit.positions, "--mount", kit.mount, "-o", path]
    assert main(["import", *map(str, line)]) == 0
    return path


def test_the_log_holds_every_line_as_it_was_given(kit: linekit.Kit, log: Path) -> None:
    given = np.load(kit.scans)
    with LogReader(log) as reader:
        lines = [records.decode_line(message.data)[0] for message in reader.messages((records.LINE_SCAN.topic,))]
        assert reader.metadata["swath.session"]["lidar"] == "line scanner"
    assert [int(line["time_ns"]) for line in lines] == given["time_ns"].tolist()
    assert (np.array([line["ranges"] for line in lines]) == given["range_m"].astype(np.float32)).all()


def test_a_csv_of_shots_reads_as_the_arrays_do(kit: linekit.Kit, tmp_path: Path) -> None:
    given = np.load(kit.scans)
    rows = [
        f"{time_ns},{angle:.2f},{reach!r},{strength:.0f}"
        for time_ns, ranges, strengths in zip(
            given["time_ns"][:5], given["range_m"][:5], given["intensity"][:5], strict=True
        )
        for angle, reach, strength in zip(given["angle_deg"], ranges.tolist(), strengths, strict=True)
    ]
    path = tmp_path / "scans.csv"
    path.write_text("time_ns,angle_deg,range_m,intensity\n" + "\n".join(rows) + "\n")
    found, expected = read_lines(path), read_lines(kit.scans)[:5]
    for name in ("time_ns", "ranges", "intensities", "angle_min", "angle_increment"):
        assert (found[name] == expected[name]).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_ns,angle_deg,range_m\n1,2,3\n", "no column intensity"),
        ("time_ns,angle_deg,range_m,intensity\n1,0,3,4\n1,1,3,4\n2,0,3,4\n", "lines of 1 to 2 shots"),
        ("time_ns,angle_deg,range_m,intensity\n2,0,3,4\n2,1,3,4\n1,0,3,4\n1,1,3,4\n", "do not grow"),
        (
            "time_ns,angle_deg,range_m,intensity\n" + "".join(f"{t},{a},3,4\n" for t in (1, 2) for a in (0, 1, 5)),
            "even",
        ),
        ("", "no column time_ns"),
    ],
)
def test_what_is_no_file_of_lines_is_refused_in_one_sentence(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "scans.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=words):
        read_lines(path)
    with pytest.raises(LogError, match="IMU"):
        read_imu(path)


def test_points_in_the_scanners_frame_are_where_angle_and_range_put_them(
    kit: linekit.Kit, log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "d.laz"
    assert main(["decode", str(log), "-o", str(out), "--fov", "all"]) == 0
    given, cloud = np.load(kit.scans), laspy.read(out)
    turned = np.deg2rad(np.tile(given["angle_deg"], len(given["time_ns"])))
    ranges = given["range_m"].ravel()
    seen = ranges > 0.0
    expected = np.stack([ranges * np.sin(turned), ranges * np.cos(turned), 0.0 * turned], axis=1)[seen]
    assert len(cloud) == seen.sum()
    np.testing.assert_allclose(cloud.xyz, expected, rtol=0, atol=0.0006)  # millimetres, and angles of float32


def test_the_flight_is_processed_and_its_points_are_true_to_what_the_positions_allow(
    kit: linekit.Kit, log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ["--height", "ellipsoid", "--crs", "32633", "--products", "cloud.laz"]
    assert main(["process", str(log), "-o", str(out), *words]) == 0
    quality = json.loads((out / "quality.json").read_text())
    assert quality["trajectory"]["method"] == "filtered"
    assert "not adjusted, because a line scanner has 1 laser" in quality["trajectory"]["note"]
    assert quality["lidar"]["model"] == "line scanner"
    trajectory = read_trajectory(out / "trajectory.csv")
    inside = (kit.time_ns > kit.time_ns[0] + 2 * 10**9) & (kit.time_ns < kit.time_ns[-1] - 2 * 10**9)
    poses = trajectory.at(kit.time_ns[inside])
    found = linekit.FRAME.from_geodetic(*trajectory.frame.to_geodetic(poses.position_m))
    off = found - kit.position_m[inside]
    # 60 fixes of 0.1, 0.1, 0.2 m, smoothed: better than any one of them, and not better than all together
    assert (np.sqrt(np.square(off).mean(axis=0)) < [0.1, 0.1, 0.2]).all()
    turned = Rotation.from_quat(np.roll(poses.quat_local_ins_wxyz, -1, axis=1))
    astray = np.rad2deg((turned * Rotation.from_quat(kit.quat_xyzw[inside]).inv()).as_rotvec())
    # an accelerometer's bias of 0.02 m/s^2 is 0.12 deg of tilt; heading by accelerations of 0.3 m/s^2 against second differences of
    # positions, 2.5 x 0.1 m in 16 s^2: 0.05 rad each, about 10 of them apart in a minute: 1 deg
    assert (np.sqrt(np.square(astray).mean(axis=0)) < [0.2, 0.2, 1.0]).all()
    cloud = laspy.read(out / "cloud.laz")
    hits = Projection(linekit.FRAME, projected_crs(32633)).exact(kit.hits_m)
    assert len(cloud) == len(hits)  # shot by shot, in the order of time
    distance = np.linalg.norm(cloud.xyz - hits, axis=1)
    # path 0.24 m, tilt 0.2 deg and heading 1 deg at 25 m at most, range 1 cm
    assert np.sqrt(np.square(distance).mean()) < np.hypot(0.24, 25.0 * np.deg2rad(1.02)) + 0.01


def test_a_head_without_rows_and_values_beyond_any_scanner_are_one_sentence(tmp_path: Path) -> None:
    imu, scans = tmp_path / "imu.csv", tmp_path / "scans.csv"
    head = "time_ns,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
    for rows in ("", "\n\n"):
        imu.write_text(head + rows)
        with pytest.raises(LogError, match=r"imu\.csv.*no rows"):
            read_imu(imu)
    lines = "".join(f"{time},{angle},{1e300 if time else 5},7\n" for time in range(3) for angle in (0, 1))
    scans.write_text("time_ns,angle_deg,range_m,intensity\n" + lines)
    with pytest.raises(LogError, match=r"scans\.csv: a range of 1e\+300, expected at most 1e\+09"):
        read_lines(scans)
