"""What people bring to `swath import`: bags, compressed files, MAVLink in captures, logs of an autopilot alone."""

import bz2
import contextlib
import gzip
import json
import lzma
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dpkt
import lz4.frame
import numpy as np
import pytest
import zstandard
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flightlog import records
from flightlog.logfile import LogReader
from groundproc import packed
from groundproc.cli import main

START_NS = 1_700_000_000_000_000_000
Frames = list[tuple[int, bytes]]


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Exit code of `swath import`, and what it says on stderr."""
    code = main(["import", *map(str, words)])
    return code, capsys.readouterr().err


def content(path: Path) -> list[tuple[str, int, bytes]]:
    """All messages of a log."""
    with LogReader(path) as reader:
        return [(message.topic, message.log_time_ns, bytes(message.data)) for message in reader.messages()]


def chunks(path: Path, topic: str) -> list[tuple[int, bytes]]:
    with LogReader(path) as reader:
        return [chunk for message in reader.messages((topic,)) for chunk in records.decode_raw(message.data)]


def counters(path: Path) -> dict[str, Any]:
    with LogReader(path) as reader:
        return dict(json.loads(reader.metadata["swath.session"]["counters"]))


@pytest.fixture
def packets(turning: Callable[..., Frames]) -> Frames:
    """0.4 s of data packets with their times of reception."""
    return [(START_NS + time_ns, payload) for time_ns, payload in turning(0.4)]


@pytest.fixture
def capture(packets: Frames, ethernet: Callable[..., bytes], pcap: Callable[..., bytes], tmp_path: Path) -> Path:
    path = tmp_path / "plain.pcap"
    path.write_bytes(pcap([(time_ns, ethernet(payload)) for time_ns, payload in packets], nano=True))
    return path


@pytest.fixture
def imported(capture: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> list[tuple[str, int, bytes]]:
    """What the log of the capture holds."""
    log = tmp_path / "plain.mcap"
    assert run(capsys, "--pcap", capture, "-o", log) == (0, "")
    return content(log)


_PACKET = "builtin_interfaces/Time stamp\nuint8[1206] data\n"
_SCAN = "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n"


def scans(store: Any, packets: Frames, size: int = 75) -> list[tuple[int, Any]]:
    """VelodyneScan messages of so many packets, with the time at which the last was received."""
    time_of = store.types["builtin_interfaces/msg/Time"]
    header, packet, scan = (
        store.types[name]
        for name in ("std_msgs/msg/Header", "velodyne_msgs/msg/VelodynePacket", "velodyne_msgs/msg/VelodyneScan")
    )
    found = []
    for first in range(0, len(packets), size):
        part = packets[first : first + size]
        elements = [packet(time_of(*divmod(t, 10**9)), np.frombuffer(payload, np.uint8)) for t, payload in part]
        seq = (0,) if "seq" in header.__dataclass_fields__ else ()
        found.append((part[-1][0], scan(header(*seq, time_of(*divmod(part[0][0], 10**9)), "velodyne"), elements)))
    return found


def store_of(version: Stores) -> Any:
    store = get_typestore(version)
    store.register(get_types_from_msg(_PACKET, "velodyne_msgs/msg/VelodynePacket"))
    store.register(get_types_from_msg(_SCAN, "velodyne_msgs/msg/VelodyneScan"))
    return store


def ros1_bag(path: Path, topics: dict[str, Frames]) -> Path:
    store = store_of(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as writer:
        for topic, packets in topics.items():
            connection = writer.add_connection(topic, "velodyne_msgs/msg/VelodyneScan", typestore=store)
            for time_ns, scan in scans(store, packets):
                writer.write(connection, time_ns, store.serialize_ros1(scan, connection.msgtype))
    return path


def ros2_bag(path: Path, storage: rosbag2.StoragePlugin, topics: dict[str, Frames]) -> Path:
    store = store_of(Stores.ROS2_HUMBLE)
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        for topic, packets in topics.items():
            connection = writer.add_connection(topic, "velodyne_msgs/msg/VelodyneScan", typestore=store)
            for time_ns, scan in scans(store, packets):
                writer.write(connection, time_ns, store.serialize_cdr(scan, connection.msgtype))
    return path


BAGS: dict[str, Callable[[Path, dict[str, Frames]], Path]] = {
    "ROS 1": lambda folder, topics: ros1_bag(folder / "a.bag", topics),
    "ROS 2 folder of db3": lambda folder, topics: ros2_bag(folder / "a", rosbag2.StoragePlugin.SQLITE3, topics),
    "ROS 2 folder of MCAP": lambda folder, topics: ros2_bag(folder / "a", rosbag2.StoragePlugin.MCAP, topics),
    "db3": lambda folder, topics: ros2_bag(folder / "a", rosbag2.StoragePlugin.SQLITE3, topics) / "a.db3",
    "MCAP": lambda folder, topics: ros2_bag(folder / "a", rosbag2.StoragePlugin.MCAP, topics) / "a.mcap",
}


@pytest.mark.parametrize("kind", list(BAGS))
def test_a_bag_gives_the_log_that_the_capture_of_the_same_packets_gives(
    kind: str, packets: Frames, imported: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = BAGS[kind](tmp_path, {"/front/some_packets": packets})
    log = tmp_path / "bag.mcap"
    assert run(capsys, "--bag", bag, "-o", log) == (0, "")
    assert content(log) == imported


def test_bag_and_telemetry_log_are_merged_by_time(
    packets: Frames, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    beats = []
    for i in range(4):
        beats.append(
            (START_NS + i * 100_000_000, bytes(dialect.MAVLink_attitude_message(i, 0, 0, 0, 0, 0, 0).pack(sender)))
        )
        sender.seq += 1
    tlog, log = tmp_path / "t.tlog", tmp_path / "both.mcap"
    tlog.write_bytes(b"".join(struct.pack(">Q", time_ns // 1000) + frame for time_ns, frame in beats))
    bag = ros1_bag(tmp_path / "a.bag", {"/velodyne_packets": packets})
    assert run(capsys, "--bag", bag, "--mavlink", tlog, "-o", log) == (0, "")
    assert chunks(log, "/mavlink/ins") == beats
    times = [time_ns for _, time_ns, _ in content(log)]
    assert times == sorted(times)


def test_of_several_lidars_in_a_bag_the_one_with_most_packets_is_taken_and_any_by_its_topic(
    packets: Frames, imported: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = ros1_bag(tmp_path / "a.bag", {"/a_few": packets[:100], "/many": packets})
    log = tmp_path / "bag.mcap"
    code, said = run(capsys, "--bag", bag, "-o", log)
    assert code == 0
    assert "/many with 723, /a_few with 100" in said
    lidar = [message for message in content(log) if message[0] == "/velodyne_packets"]
    assert lidar == [message for message in imported if message[0] == "/velodyne_packets"]
    assert run(capsys, "--bag", bag, "--sender", "/a_few", "-o", tmp_path / "few.mcap")[0] == 0
    assert counters(tmp_path / "few.mcap")["lidar"]["kept"] == 100
    code, said = run(capsys, "--bag", bag, "--sender", "/none", "-o", tmp_path / "none.mcap")
    assert code == 1
    assert "no packet came from /none" in said


def test_a_scan_without_times_of_its_own_is_taken_by_the_time_of_the_bag(
    packets: Frames, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = store_of(Stores.ROS1_NOETIC)
    with rosbag1.Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/p", "velodyne_msgs/msg/VelodyneScan", typestore=store)
        for time_ns, scan in scans(store, packets):
            for packet in scan.packets:
                packet.stamp.sec = packet.stamp.nanosec = 0
            writer.write(connection, time_ns, store.serialize_ros1(scan, connection.msgtype))
    assert run(capsys, "--bag", tmp_path / "a.bag", "-o", tmp_path / "l.mcap") == (0, "")
    with LogReader(tmp_path / "l.mcap") as reader:
        times = np.concatenate(
            [records.receive_time_ns(records.decode_scan(m.data)) for m in reader.messages(("/velodyne_packets",))]
        )
    # a packet takes 553 us; the fixture's stamps are whole microseconds
    assert np.abs(times - np.array([time_ns for time_ns, _ in packets])).max() < 2_000


def test_what_is_no_bag_or_holds_no_packets_is_one_sentence(
    capture: Path, packets: Frames, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, whole = tmp_path / "l.mcap", ros1_bag(tmp_path / "a.bag", {"/p": packets})
    cut, noise, points = tmp_path / "cut.bag", tmp_path / "noise.bag", tmp_path / "points.bag"
    cut.write_bytes(whole.read_bytes()[:-3000])
    noise.write_bytes(b"#ROSBAG V2.0\n" + bytes(range(256)) * 20)
    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(points) as writer:
        connection = writer.add_connection("/words", "std_msgs/msg/String", typestore=store)
        word = store.types["std_msgs/msg/String"]("hello")
        writer.write(connection, START_NS, store.serialize_ros1(word, connection.msgtype))
    for path, what in (
        (capture, "is a packet capture"),
        (cut, "cannot be read as a bag"),
        (noise, "cannot be read as a bag"),
        (points, "its topics are /words (std_msgs/msg/String)"),
        (tmp_path, "without metadata.yaml"),
        (tmp_path / "none.bag", "No such file"),
    ):
        code, said = run(capsys, "--bag", path, "-o", log)
        assert (code, said.count("\n")) == (1, 1), said
        assert what in said
        assert not log.exists()


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "gz": gzip.compress,
    "bz2": bz2.compress,
    "xz": lzma.compress,
    "zst": lambda data: zstandard.ZstdCompressor().compress(data),
    "lz4": lz4.frame.compress,
}


@pytest.mark.parametrize("ending", list(PACKERS))
def test_compressed_recordings_of_every_kind_are_taken_as_they_are(
    ending: str,
    capture: Path,
    imported: list[Any],
    packets: Frames,
    recordings: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pack = PACKERS[ending]
    packed = tmp_path / f"c.pcap.{ending}"
    packed.write_bytes(pack(capture.read_bytes()))
    assert run(capsys, "--pcap", packed, "-o", tmp_path / "c.mcap") == (0, "")
    assert content(tmp_path / "c.mcap") == imported
    tlog, packed = tmp_path / "t.tlog", tmp_path / f"t.tlog.{ending}"
    tlog.write_bytes((recordings / "mavlink/arducopter313_sim.tlog").read_bytes()[:200_000])
    packed.write_bytes(pack(tlog.read_bytes()))
    for path, log in ((tlog, "plain_t.mcap"), (packed, "t.mcap")):
        assert run(capsys, "--mavlink", path, "-o", tmp_path / log)[0] == 0
    assert content(tmp_path / "t.mcap") == content(tmp_path / "plain_t.mcap")
    bag = ros1_bag(tmp_path / "b.bag", {"/p": packets})
    packed = tmp_path / f"b.bag.{ending}"
    packed.write_bytes(pack(bag.read_bytes()))
    assert run(capsys, "--bag", packed, "-o", tmp_path / "b.mcap") == (0, "")
    assert content(tmp_path / "b.mcap") == imported
    flash = tmp_path / f"f.bin.{ending}"
    flash.write_bytes(pack(b"\xa3\x95\x80" + bytes(range(256)) * 600))
    assert run(capsys, "--mavlink", flash, "-o", tmp_path / "f.mcap") == (0, "")
    assert (
        b"".join(data for _, data in chunks(tmp_path / "f.mcap", "/dataflash/ins"))
        == b"\xa3\x95\x80" + bytes(range(256)) * 600
    )
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("ending", ["gz", "bz2", "xz"])
def test_a_compressed_capture_that_was_cut_off_gives_what_is_whole_and_says_so(
    ending: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    packed = PACKERS[ending](capture.read_bytes() * 1)
    path, log = tmp_path / f"cut.pcap.{ending}", tmp_path / "cut.mcap"
    path.write_bytes(packed[: len(packed) * 9 // 10])
    code, said = run(capsys, "--pcap", path, "-o", log)
    if code == 0:  # bzip2 and xz may have nothing whole but a single block
        assert "end early or are damaged" in said
        assert 0 < counters(log)["lidar"]["kept"] < 723
    else:
        assert (said.count("\n"), log.exists()) == (1, False)


def test_a_file_that_unpacks_without_end_is_refused(
    pcap: Callable[..., bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bomb.pcap.gz"
    with gzip.open(path, "wb", compresslevel=9) as file:
        file.write(pcap([]))
        record = pcap([(START_NS, bytes(60_000))])[24:] * 20
        for _ in range(100):
            file.write(record)
    assert path.stat().st_size < 1_000_000
    code, said = run(capsys, "--pcap", path, "-o", tmp_path / "b.mcap")
    assert code == 1
    assert "unpacks to more than 64 times its size" in said
    assert {each.name for each in tmp_path.iterdir()} == {"bomb.pcap.gz"}


def mavlink(count: int, system: int = 1) -> list[bytes]:
    sender = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    found = []
    for i in range(count):
        found.append(bytes(dialect.MAVLink_attitude_message(i * 20, 0.1, 0, 0, 0, 0, 0).pack(sender)))
        sender.seq = (sender.seq + 1) % 256
    return found


def udp_frame(payload: bytes, source: int, port: int, sender: bytes = b"\x0a\x00\x00\x05") -> bytes:
    udp = dpkt.udp.UDP(sport=source, dport=port, data=payload)
    udp.ulen = len(udp)
    ip = dpkt.ip.IP(src=sender, dst=b"\x0a\x00\x00\x01", p=17, data=udp)
    ip.len = len(ip)
    return bytes(dpkt.ethernet.Ethernet(dst=b"\x01" * 6, src=b"\x02" * 6, data=ip))


@pytest.mark.parametrize(("source", "port"), [(40_000, 14_550), (40_000, 14_555), (14_550, 52_000)])
def test_mavlink_in_a_capture_is_taken_at_its_usual_ports(
    source: int, port: int, pcap: Callable[..., bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = mavlink(300)
    stamped = [(START_NS + i * 20_000_000, udp_frame(frame, source, port)) for i, frame in enumerate(frames)]
    capture, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    capture.write_bytes(pcap(stamped))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 0
    assert "no lidar data packet was found" in said
    assert chunks(log, "/mavlink/ins") == [(START_NS + i * 20_000_000, frame) for i, frame in enumerate(frames)]


def test_mavlink_at_another_port_is_pointed_out_and_can_be_taken(
    pcap: Callable[..., bytes],
    ethernet: Callable[..., bytes],
    packets: Frames,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    frames = mavlink(20)
    stamped = [(START_NS + i * 20_000_000, udp_frame(frame, 40_000, 14_777)) for i, frame in enumerate(frames)]
    capture, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    capture.write_bytes(pcap(stamped))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 1
    assert "--mavlink-port 14777" in said
    assert run(capsys, "--pcap", capture, "--mavlink-port", 14777, "-o", log)[0] == 0
    assert [data for _, data in chunks(log, "/mavlink/ins")] == frames
    both = sorted(stamped + [(time_ns, ethernet(payload)) for time_ns, payload in packets])
    capture.write_bytes(pcap(both))
    code, said = run(capsys, "--pcap", capture, "-o", log, "--force")
    assert code == 0
    assert "20 datagrams with MAVLink at UDP port 14777 left out" in said


def test_streams_of_two_senders_that_straddle_datagrams_do_not_break_each_other(
    pcap: Callable[..., bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    streams = {b"\x0a\x00\x00\x05": b"".join(mavlink(60)), b"\x0a\x00\x00\x06": b"".join(mavlink(60, system=2))}
    stamped = []
    for i in range(0, 60 * 36, 25):  # pieces that no frame ends with
        for sender, stream in streams.items():
            if piece := stream[i : i + 25]:
                stamped.append((START_NS + i * 1_000_000, udp_frame(piece, 40_000, 14_550, sender)))
    capture, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    capture.write_bytes(pcap(stamped))
    assert run(capsys, "--pcap", capture, "-o", log)[0] == 0
    found = [data for _, data in chunks(log, "/mavlink/ins")]
    assert sorted(found) == sorted(mavlink(60) + mavlink(60, system=2))


def test_frames_captured_twice_are_taken_once_and_counted(
    pcap: Callable[..., bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = mavlink(50)
    stamped = []
    for i, frame in enumerate(frames):
        stamped += [(START_NS + i * 20_000_000 + late, udp_frame(frame, 40_000, 14_550)) for late in (0, 900_000)]
    capture, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    capture.write_bytes(pcap(stamped))
    code, said = run(capsys, "--pcap", capture, "-o", log)
    assert code == 0
    assert "50 MAVLink frames were there twice" in said
    assert [data for _, data in chunks(log, "/mavlink/ins")] == frames


def test_a_telemetry_log_goes_before_the_same_link_in_a_capture(
    capture: Path, pcap: Callable[..., bytes], recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stamped = [(START_NS + i * 20_000_000, udp_frame(frame, 40_000, 14_550)) for i, frame in enumerate(mavlink(20))]
    network, log = tmp_path / "m.pcap", tmp_path / "m.mcap"
    network.write_bytes(pcap(stamped))
    tlog = recordings / "mavlink/arducopter313_sim.tlog"
    code, said = run(capsys, "--pcap", capture, network, "--mavlink", tlog, "-o", log)
    assert code == 0
    assert "20 datagrams on the MAVLink ports left out" in said
    words = ("--pcap", capture, network, "--mavlink", tlog, "--mavlink-port", 14550, "-o", log, "--force")
    assert run(capsys, *words)[0] == 0
    assert set(mavlink(20)) <= {data for _, data in chunks(log, "/mavlink/ins")}


def test_a_telemetry_log_alone_is_a_log(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "t.mcap"
    assert run(capsys, "--mavlink", recordings / "mavlink/copter_flight_2015.tlog", "-o", log)[0] == 0
    assert {topic for topic, _, _ in content(log)} == {"/mavlink/ins"}
    with LogReader(log) as reader:
        assert "lidar" not in reader.metadata["swath.session"]


def test_a_dataflash_log_alone_is_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flash, log = tmp_path / "1.BIN", tmp_path / "f.mcap"
    flash.write_bytes(b"\xa3\x95\x80" + bytes(range(256)) * 1000)
    assert run(capsys, "--mavlink", flash, "-o", log) == (0, "")
    assert b"".join(data for _, data in chunks(log, "/dataflash/ins")) == flash.read_bytes()


def test_nothing_given_and_files_of_another_kind_are_named(
    capture: Path, recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, tlog = tmp_path / "l.mcap", recordings / "mavlink/ardusub_2023.tlog"
    archive = tmp_path / "a.zip"
    archive.write_bytes(b"PK\x03\x04" + bytes(100))
    for words, code, what in (
        ((), 2, "give recordings with --pcap, --mavlink or --bag"),
        (("--pcap", tlog), 1, "a telemetry log of a ground station"),
        (("--mavlink", capture), 1, "a packet capture; `swath import --pcap"),
        (("--pcap", archive), 1, "archive"),
        (("--pcap", capture, "--sender", "the lidar"), 2, "is no address"),
        (("--pcap", capture, "--lidar-port", 70_000), 2, "is no UDP port"),
    ):
        got, said = run(capsys, *words, "-o", log)
        assert (got, said.count("\n")) == (code, 1), said
        assert what in said


# What unpacks without end ---------------------------------------------------------------------------------------------


def ros1_packed(path: Path, packets: Frames, form: Any) -> Path:
    store = store_of(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    writer.set_compression(form)
    with writer:
        connection = writer.add_connection("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", typestore=store)
        for time_ns, scan in scans(store, packets):
            writer.write(connection, time_ns, store.serialize_ros1(scan, connection.msgtype))
    return path


def ros2_packed(path: Path, packets: Frames, storage: rosbag2.StoragePlugin, mode: Any) -> Path:
    store = store_of(Stores.ROS2_HUMBLE)
    writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", typestore=store)
        for time_ns, scan in scans(store, packets):
            writer.write(connection, time_ns, store.serialize_cdr(scan, connection.msgtype))
    return path


PACKED: dict[str, Callable[[Path, Frames], Path]] = {
    "ROS 1, bz2": lambda folder, packets: ros1_packed(folder / "a.bag", packets, rosbag1.Writer.CompressionFormat.BZ2),
    "ROS 1, lz4": lambda folder, packets: ros1_packed(folder / "a.bag", packets, rosbag1.Writer.CompressionFormat.LZ4),
    "ROS 2, chunks": lambda folder, packets: (
        ros2_packed(folder / "a", packets, rosbag2.StoragePlugin.MCAP, rosbag2.CompressionMode.STORAGE) / "a.mcap"
    ),
    "ROS 2, messages": lambda folder, packets: ros2_packed(
        folder / "a", packets, rosbag2.StoragePlugin.SQLITE3, rosbag2.CompressionMode.MESSAGE
    ),
    "ROS 2, file": lambda folder, packets: ros2_packed(
        folder / "a", packets, rosbag2.StoragePlugin.SQLITE3, rosbag2.CompressionMode.FILE
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", list(PACKED))
def test_a_bag_that_unpacks_beyond_any_recording_is_one_sentence(
    kind: str, packets: Frames, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = PACKED[kind](tmp_path, packets)
    assert run(capsys, "--bag", path, "-o", tmp_path / "log.mcap") == (0, "")
    monkeypatch.setattr(packed, "_MOST_BYTES", 1 << 12)
    monkeypatch.setattr(packed, "EXPANSION", 1)
    code, said = run(capsys, "--bag", path, "-o", tmp_path / "other.mcap")
    assert (code, said.count("\n")) == (1, 1)
    assert "unpacks to more than 1 times its size" in said
    assert not (tmp_path / "other.mcap").exists()


@pytest.mark.parametrize(
    "hostile",
    [
        """CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)
        SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM n""",
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data AS (zeroblob(1000000000)))",
    ],
)
def test_tables_of_a_bag_that_are_computed_are_refused(
    hostile: str, packets: Frames, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = BAGS["db3"](tmp_path, {"/velodyne_packets": packets})
    with contextlib.closing(sqlite3.connect(path)) as bag:
        bag.execute("DROP TABLE messages")
        bag.execute(hostile)
        bag.commit()
    code, said = run(capsys, "--bag", path, "-o", tmp_path / "log.mcap")
    assert code == 1
    assert "messages are computed" in said
