"""`swath bag`: what the readers of ROS and Foxglove find in the file, and that it is what the log says."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp

from flightlog import frames
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.accuracy.truth import read_truth
from groundproc.cli import main
from groundproc.cloud.georeference import georeference
from groundproc.flight.flight import read_clocks, read_flight
from groundproc.flight.pairing import legs
from groundproc.flight.shots import shots
from groundproc.ros.clouds import LONGEST_NS, clouds
from groundproc.ros.messages import POINT, rotation_covariance
from groundproc.sensors.hdl32e import LIDAR
from groundproc.sensors.shots import Gate, Gated, Shots
from groundproc.trajectory.covariance import mat_attitude_turn
from groundproc.trajectory.table import read_trajectory, write_trajectory
from groundproc.trajectory.trajectory import Trajectory
from groundproc.verdict import DOUBTFUL, EXIT_CODES

LAYOUT = Path(__file__).parents[3] / "docs" / "foxglove" / "flight.json"
SECONDS = 4.0


@dataclass(frozen=True)
class Bag:
    """A bag, what it was made of, and its messages as mcap-ros2-support decodes them."""

    path: Path
    flight: Any
    messages: dict[str, list[tuple[int, Any]]]


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, value in reader.iter_decoded_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.log_time, value))
    return found


@pytest.fixture(scope="module")
def flown(simulated: Any) -> Any:
    """Four seconds round the village with perfect instruments; beams without width, which are quicker to cast."""
    from simulator.config import Options, perfect

    options = perfect(Options())
    return simulated(
        "bag_flight", "village", SECONDS, replace(options, lidar=replace(options.lidar, footprint_mrad=0.0))
    )


@pytest.fixture(scope="module")
def own(flown: Any, tmp_path_factory: pytest.TempPathFactory) -> Bag:
    """With the autopilot's own trajectory."""
    path = tmp_path_factory.mktemp("own") / "own.mcap"
    assert main(["bag", str(flown.log), "-o", str(path)]) == 0
    return Bag(path, flown, decoded(path))


@pytest.fixture(scope="module")
def true_way(flown: Any) -> Trajectory:
    """The true trajectory in UTC."""
    truth = read_truth(flown.folder)
    since_s = (truth.trajectory.time_ns - truth.lidar.start_ns) * 1e-9 / (1 + truth.lidar.drift_ppm * 1e-6)
    utc_ns = truth.utc.start_ns + np.rint(since_s * (1 + truth.utc.drift_ppm * 1e-6) * 1e9).astype(np.int64)
    return replace(truth.trajectory, time_ns=utc_ns)


@pytest.fixture(scope="module")
def adjusted(flown: Any, true_way: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Bag:
    """With a trajectory from elsewhere: the true one."""
    folder = tmp_path_factory.mktemp("adjusted")
    write_trajectory(folder / "trajectory.csv", true_way)
    path = folder / "adjusted.mcap"
    assert main(["bag", str(flown.log), "-o", str(path), "--trajectory", str(folder / "trajectory.csv")]) == 0
    return Bag(path, flown, decoded(path))


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def points_of(message: Any) -> np.ndarray:
    """Rows of a PointCloud2 by its own fields."""
    kinds = {4: "<u2", 7: "<f4"}
    dtype = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [kinds[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(bytes(message.data), dtype)


def test_every_topic_is_there_in_the_order_of_its_stamps(own: Bag, adjusted: Bag) -> None:
    shared = {"/points", "/lidar/imu", "/autopilot/imu", "/autopilot/attitude", "/autopilot/fix", "/tf", "/tf_static"}
    assert set(own.messages) == shared | {"/autopilot/odometry", "/autopilot/path"}
    assert set(adjusted.messages) == shared | {"/odometry", "/path"}
    for bag in (own, adjusted):
        for topic, found in bag.messages.items():
            times = [time_ns for time_ns, _ in found]
            assert times == sorted(times), topic
            for time_ns, message in found:
                header = message.transforms[0].header if hasattr(message, "transforms") else message.header
                assert stamp_ns(header) == time_ns
        assert len(bag.messages["/tf_static"]) == 1


def test_rosbags_reads_all_of_it(own: Bag) -> None:
    with AnyReader([own.path], default_typestore=get_typestore(Stores.EMPTY)) as bag:
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
        assert counts == {topic: len(found) for topic, found in own.messages.items()}
        for connection, _, data in bag.messages():
            message = bag.deserialize(data, connection.msgtype)
            if connection.topic == "/points":
                assert message.row_step == len(message.data) == 22 * message.width
        latched = {c.topic: c.ext.offered_qos_profiles for c in bag.connections}
    assert latched["/tf_static"] != latched["/tf"]


def test_messages_of_the_autopilot_are_those_of_the_log(own: Bag) -> None:
    with LogReader(own.flight.log) as log:
        boot = read_flight([log], "ins").boots[0]
    assert len(own.messages["/autopilot/attitude"]) == len(boot.tables["ATTITUDE"])
    assert len(own.messages["/autopilot/fix"]) == len(boot.tables["GPS_RAW_INT"])
    table = boot.tables["ATTITUDE"]
    for row, (_, message) in zip(table, own.messages["/autopilot/attitude"], strict=True):
        q = message.orientation
        forward, left, up = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix().T
        # heading clockwise from north, in axes east, north, up; pitch nose up; roll right side down lifts the left
        assert np.arctan2(forward[0], forward[1]) == pytest.approx(float(row["yaw"]), abs=1e-6)
        assert np.arcsin(forward[2]) == pytest.approx(float(row["pitch"]), abs=1e-6)
        assert np.arctan2(left[2], up[2]) == pytest.approx(float(row["roll"]), abs=1e-6)
        assert message.angular_velocity.x == pytest.approx(float(row["rollspeed"]))
        assert message.angular_velocity.y == pytest.approx(-float(row["pitchspeed"]))
        assert message.angular_velocity.z == pytest.approx(-float(row["yawspeed"]))
        assert message.linear_acceleration_covariance[0] == -1.0
    fix, row = own.messages["/autopilot/fix"][-1][1], boot.tables["GPS_RAW_INT"][-1]
    assert (fix.latitude, fix.longitude) == (pytest.approx(row["lat"] * 1e-7), pytest.approx(row["lon"] * 1e-7))
    # above the ellipsoid, as the message wants it; above the sea would be another number
    assert fix.altitude == pytest.approx(row["alt_ellipsoid"] * 1e-3) or (
        np.isnan(fix.altitude) and not row["alt_ellipsoid"]
    )


@pytest.mark.parametrize("topic", ["/autopilot/imu", "/lidar/imu"])
def test_what_the_imus_feel_points_up(own: Bag, topic: str) -> None:
    force = np.array(
        [[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for _, m in own.messages[topic]]
    )
    assert own.messages[topic][0][1].orientation_covariance[0] == -1.0
    mean = force.mean(axis=0)
    assert np.linalg.norm(mean) == pytest.approx(9.81, abs=0.8)  # in four seconds it gains speed by up to 3 m/s
    # the lidar looks 20 deg down ahead: what is up lies behind its own up
    static = {each.child_frame_id: each.transform for each in own.messages["/tf_static"][0][1].transforms}
    turn = Rotation.identity()
    if topic == "/lidar/imu":
        q = static["velodyne"].rotation
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w])
        assert mean[0] < -2.5
    assert np.degrees(np.arccos(turn.apply(mean)[2] / np.linalg.norm(mean))) < 8.0


def test_rings_count_from_the_lowest_laser_and_times_from_the_stamp(own: Bag) -> None:
    scans = own.messages["/points"]
    assert len(scans) == pytest.approx(SECONDS * 10, abs=2)
    for time_ns, message in scans[1:-1]:
        rows = points_of(message)
        assert [field.name for field in message.fields] == ["x", "y", "z", "intensity", "ring", "time"]
        elevation = np.degrees(np.arctan2(rows["z"], np.hypot(rows["x"], rows["y"])))
        means = [elevation[rows["ring"] == ring].mean() for ring in np.unique(rows["ring"])]
        assert (np.diff(means) > 1.2).all()  # 1.33 deg apart
        assert rows["time"].min() == 0.0
        assert rows["time"].max() < 0.101
        # the head turns clockwise, a turn in 0.1 s, from straight behind on
        azimuth = np.degrees(np.arctan2(-rows["y"], rows["x"]))
        np.testing.assert_allclose(azimuth, -180.0 + 3600.0 * rows["time"].astype(np.float64), rtol=0, atol=4.0)
        assert stamp_ns(message.header) == time_ns


def test_no_shot_is_lost_or_doubled(own: Bag) -> None:
    with LogReader(own.flight.log) as log:
        runs, boots, _ = read_clocks([log], "ins")
        timeline = legs(runs, boots, read_truth(own.flight.folder).nominal_mount.mat_ins_lidar(), "auto")
        seen = list(shots([log], timeline, Gate()))
    assert sum(message.width for _, message in own.messages["/points"]) == sum(map(len, seen))
    rows = np.concatenate([points_of(message) for _, message in own.messages["/points"]])
    xyz = np.concatenate([each.xyz_m for each in seen])
    np.testing.assert_array_equal(rows["x"], xyz[:, 1])
    np.testing.assert_array_equal(rows["y"], -xyz[:, 0])
    np.testing.assert_array_equal(rows["z"], xyz[:, 2])


def placed(bag: Bag, scan: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a scan in the map by /tf and /tf_static alone, as any ROS program places them, and their times [s]."""
    moves = [(t, m.transforms[0].transform) for t, m in bag.messages["/tf"]]
    zero = moves[0][0]
    times = np.array([(t - zero) * 1e-9 for t, _ in moves])
    places = np.array([[m.translation.x, m.translation.y, m.translation.z] for _, m in moves])
    turns = Rotation.from_quat([[m.rotation.x, m.rotation.y, m.rotation.z, m.rotation.w] for _, m in moves])
    static = {each.child_frame_id: each.transform for each in bag.messages["/tf_static"][0][1].transforms}["velodyne"]
    mount = Rotation.from_quat([static.rotation.x, static.rotation.y, static.rotation.z, static.rotation.w])
    arm = np.array([static.translation.x, static.translation.y, static.translation.z])
    time_ns, message = bag.messages["/points"][scan]
    rows = points_of(message)
    at = (time_ns - zero) * 1e-9 + rows["time"].astype(np.float64)
    body = mount.apply(np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(np.float64)) + arm
    way = np.stack([np.interp(at, times, column) for column in places.T], axis=1)
    return Slerp(times, turns)(at).apply(body) + way, at


def test_points_placed_by_tf_are_those_of_the_cloud(adjusted: Bag, true_way: Trajectory) -> None:
    truth = read_truth(adjusted.flight.folder)
    folder = adjusted.path.parent
    way = read_trajectory(folder / "trajectory.csv")
    with LogReader(adjusted.flight.log) as log:
        runs, boots, _ = read_clocks([log], "ins")
        timeline = legs(runs, boots, truth.nominal_mount.mat_ins_lidar(), "auto")
        seen = list(shots([log], timeline, Gate()))
    first = sum(message.width for _, message in adjusted.messages["/points"][:20])
    xyz = np.concatenate([georeference(each, way, truth.nominal_mount).xyz_m for each in seen])
    # not all shots lie within the trajectory: those of the twentieth turn do, and are found by their number from the end
    lost = sum(map(len, seen)) - len(xyz)
    found, _ = placed(adjusted, 20)
    wanted = xyz[first - lost : first - lost + len(found)] if lost <= first else xyz[first : first + len(found)]
    # straight lines over 10 ms where the way bends with 5 m/s2 leave 0.06 mm, and turns with 10 rad/s2 0.12 mrad of 60 m
    assert np.linalg.norm(found - wanted, axis=1).max() < 0.01


def test_odometry_is_the_transform_with_its_speed(adjusted: Bag) -> None:
    moves, states = adjusted.messages["/tf"], adjusted.messages["/odometry"]
    assert len(moves) == len(states)
    where = np.array([[s.pose.pose.position.x, s.pose.pose.position.y, s.pose.pose.position.z] for _, s in states])
    for (_, move), (_, state) in zip(moves, states, strict=True):
        assert move.transforms[0].transform.translation.x == state.pose.pose.position.x
        assert move.transforms[0].transform.rotation.w == state.pose.pose.orientation.w
        assert (state.header.frame_id, state.child_frame_id) == ("map", "base_link")
    turns = Rotation.from_quat(
        [[s.pose.pose.orientation.x, s.pose.pose.orientation.y, s.pose.pose.orientation.z, s.pose.pose.orientation.w] for _, s in states]
    )  # fmt: skip
    speed = np.array([[s.twist.twist.linear.x, s.twist.twist.linear.y, s.twist.twist.linear.z] for _, s in states])
    times = np.array([t for t, _ in states]) * 1e-9
    slope = np.gradient(where, times, axis=0)
    np.testing.assert_allclose(turns.apply(speed)[2:-2], slope[2:-2], rtol=0, atol=0.05)
    path = adjusted.messages["/path"][0][1].poses
    assert len(path) == pytest.approx(SECONDS * 10, abs=3)
    ends = [path[0].pose.position, path[-1].pose.position]
    np.testing.assert_allclose([[p.x, p.y, p.z] for p in ends], where[[0, -1]], rtol=0, atol=1e-9)


def test_covariances_of_angles_become_those_of_turns_about_the_axes_of_the_map() -> None:
    heading, pitch, roll = np.array([1.2]), np.array([0.3]), np.array([-0.2])
    rng = np.random.default_rng(4)
    turns = rng.normal(0, 1e-3, (20_000, 3))
    mats = Rotation.from_rotvec(turns).as_matrix() @ frames.mat_local_ins(heading, pitch, roll)[0]
    found = np.stack(frames.attitude_of(mats)[::-1], axis=1) - np.array([roll[0], pitch[0], heading[0]])
    covariance = np.zeros((1, 6, 6))
    covariance[0, 3:, 3:] = np.cov(found.T)
    back = rotation_covariance(covariance, heading, pitch)[0, 3:, 3:]
    # about each axis 1 mrad, independent: 20,000 draws tell a variance to 1 %, four times that
    np.testing.assert_allclose(back, 1e-6 * np.eye(3), rtol=0, atol=0.04e-6)
    assert mat_attitude_turn(heading, pitch).shape == (1, 3, 3)


def lidar_only(flown: Any, path: Path) -> Path:
    with LogReader(flown.log) as log, path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for message in log.messages():
            if not message.topic.startswith("/mavlink/"):
                writer.write(message.topic, message.log_time_ns, bytes(message.data))
        writer.finish()
    return path


def test_a_lidar_alone_is_written_on_log_time_and_that_is_said(
    flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = lidar_only(flown, tmp_path / "lidar.mcap")
    assert (
        main(["bag", str(log), "-o", str(tmp_path / "out.mcap"), "--fov", "255-105", "--min-range", "5"])
        == EXIT_CODES[DOUBTFUL]
    )
    said = capsys.readouterr()
    assert "times are log time, and there is no /tf of the map: the log has no autopilot" in said.err
    found = decoded(tmp_path / "out.mcap")
    assert set(found) == {"/points", "/lidar/imu", "/tf_static"}
    with LogReader(log) as reader:
        assert found["/points"][0][0] == pytest.approx(reader.start_ns, abs=0.2e9)
    rows = points_of(found["/points"][5][1])
    azimuth = np.degrees(np.arctan2(-rows["y"], rows["x"]))
    assert np.abs(azimuth).max() <= 105.01
    assert np.sqrt(rows["x"] ** 2 + rows["y"] ** 2 + rows["z"] ** 2).min() >= 4.99


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["LOG", "-o", "out.bag"], "ends in .bag"),
        (["LOG", "-o", "there.mcap"], "--force to write over"),
        (["LOG", "-o", "LOG", "--force"], "is an input"),
        (["none.mcap", "-o", "out.mcap"], "no such file"),
        (["text.txt", "-o", "out.mcap"], "expected a flight log"),
        (["LOG", "-o", "out.mcap", "--fov", "north"], "--fov 'north'"),
        (["LOG", "-o", "out.mcap", "--min-range", "-1"], "expected 0 or more"),
        (["LOG", "-o", "out.mcap", "--trajectory", "text.txt"], "expected a folder of products"),
        (["LOG", "-o", "out.mcap", "--mount", "none.yaml"], "none.yaml"),
    ],
)
def test_what_cannot_be_written_is_one_sentence_and_leaves_nothing(
    flown: Any,
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.mcap").write_bytes(b"")
    Path("text.txt").write_text("a text\n")
    before = sorted(tmp_path.rglob("*"))
    assert main(["bag", *(str(flown.log) if word == "LOG" else word for word in words)]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_clouds_are_given_as_soon_as_they_are_whole() -> None:
    """However long a flight is, one turn of it is in memory: a turn later at the most, each cloud has left."""
    taken = 0

    def pieces() -> Iterator[Shots]:
        nonlocal taken
        azimuth = np.linspace(-np.pi, np.pi, 1000, endpoint=False) + 0.001
        xyz = np.stack([10 * np.sin(azimuth), 10 * np.cos(azimuth), np.zeros(1000)], axis=1).astype(np.float32)
        blank = np.zeros(1000, np.uint8)
        while True:
            time_ns = taken * 100_000_000 + np.arange(1000, dtype=np.int64) * 100_000
            taken += 1
            yield Shots(
                time_ns, xyz, np.full(1000, 10.0, np.float32), blank, blank, blank + 0x11, LIDAR.lasers, Gated()
            )

    for number, (time_ns, points) in zip(range(50), clouds(pieces()), strict=False):
        assert taken <= number + 2
        assert len(points) == 1000
        assert points.dtype == POINT
        assert time_ns == number * 100_000_000


def test_a_scanner_that_stands_still_is_cut_all_the_same() -> None:
    count = 20
    time_ns = np.arange(count, dtype=np.int64) * 50_000_000
    xyz = np.tile(np.float32([[0, 10, 0]]), (count, 1))
    blank = np.zeros(count, np.uint8)
    whole = Shots(time_ns, xyz, np.full(count, 10.0, np.float32), blank, blank, blank + 0x11, LIDAR.lasers, Gated())
    found = list(clouds(whole[i : i + 1] for i in range(count)))
    assert sum(len(points) for _, points in found) == count
    assert all(points["time"].max() <= LONGEST_NS * 1e-9 for _, points in found)


def test_kiss_icp_finds_the_way_in_it(adjusted: Bag) -> None:
    """An odometry that knows neither the project nor the gyros: over 2 s and 3.5 m it is off by 12 mm."""
    pytest.importorskip("kiss_icp")
    from kiss_icp.config import KISSConfig
    from kiss_icp.datasets.rosbag import RosbagDataset
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.mapping.voxel_size = 1.0
    config.data.max_range, config.data.min_range = 100.0, 2.0
    odometry = KissICP(config)
    scans = RosbagDataset(adjusted.path, "/points")
    assert len(scans) == len(adjusted.messages["/points"])
    first, last = 18, 38
    poses = []
    for number in range(last + 1):
        points, times = scans[number]
        if number >= first:
            odometry.register_frame(points, times)
            poses.append(odometry.last_pose)
    scans.bag.close()
    del scans.bag
    moves = [(t, m.transforms[0].transform) for t, m in adjusted.messages["/tf"]]
    starts = [adjusted.messages["/points"][scan][0] for scan in (first, last)]
    times = np.array([t - starts[0] for t, _ in moves])
    where = np.array([[m.translation.x, m.translation.y, m.translation.z] for _, m in moves])
    way = np.linalg.norm(np.subtract(*(
        [np.interp(start - starts[0], times, column) for column in where.T] for start in starts
    )))  # fmt: skip
    found = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert way > 2.0
    assert found == pytest.approx(way, abs=0.1)


def test_the_layout_for_foxglove_shows_topics_that_are_there(own: Bag, adjusted: Bag) -> None:
    layout = json.loads(LAYOUT.read_text())
    panels = layout["configById"]
    there = {*own.messages, *adjusted.messages}
    named = set()
    for panel in panels.values():
        named |= set(panel.get("topics", {})) | {panel.get("topicPath", "").partition(".")[0]}
        named |= {each["value"].partition(".")[0] for each in panel.get("paths", [])}
    named -= {""}
    assert named <= there
    assert {"/points", "/path", "/autopilot/path", "/autopilot/fix"} <= named

    def leaves(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)
    frames_named = {panel.get("followTf") for panel in panels.values()} - {None}
    assert frames_named <= {"map", "base_link", "velodyne"}
