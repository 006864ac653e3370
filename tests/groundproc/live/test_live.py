"""The parts of `swath live`: what is received, cut, put on the grid, kept and shown."""

import http.client
import json
import os
import shutil
import socket
import struct
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import records
from flightlog.errors import LogError, SourceError, UsageError
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS
from groundproc.estimation.odometry.motion import on_grid
from groundproc.estimation.odometry.spline import Path as SensorPath
from groundproc.flight.sync import Sync
from groundproc.live.clocks import Tie
from groundproc.live.estimator import Estimator, Options
from groundproc.live.following import Follower
from groundproc.live.inbox import Inbox, LogClock, Received, scan_packets
from groundproc.live.lag import Lag
from groundproc.live.motion import GrowingMotion, MotionBuilder, Samples
from groundproc.live.pathline import PathLine
from groundproc.live.place import Figures
from groundproc.live.receivers import Port, Receivers, open_mavlink
from groundproc.live.server import PageServer
from groundproc.live.slicer import Slicer
from groundproc.live.telemetry import Telemetry
from groundproc.live.voxelcloud import VoxelCloud
from groundproc.sensors.shots import Gate


def until(condition: Callable[[], bool], seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


# Inertial unit --------------------------------------------------------------------------------------------------------


def test_a_known_delay_of_the_lidars_unit_is_taken_off_its_stamps() -> None:
    """What a later flight states of a unit: read 4 ms late, the samples belong 4 ms earlier."""
    stamps = np.arange(0, 4_000_000_000, 20_000_000, np.int64)
    rate, force = np.zeros((len(stamps), 3)), np.tile([0.0, 0.0, 9.81], (len(stamps), 1))
    newest = {}
    for late_ms in (0, 4):
        options = Options(Mount(), gyro_delay_ns=late_ms * 1_000_000)
        estimator = Estimator(options, Telemetry(), Figures(), None)
        estimator.inertial(stamps, rate, force)
        gyro = estimator._units.own_gyro()
        assert gyro is not None
        newest[late_ms] = gyro.time_ns
    assert np.array_equal(newest[4], newest[0] - 4_000_000)


# Inbox ----------------------------------------------------------------------------------------------------------------


def piece(number: int, size: int = 1_000_000) -> Received:
    return Received("/mavlink/", 0.0, chunks=[(number, bytes(size))])


def test_an_inbox_for_sensors_drops_the_oldest_and_counts_it() -> None:
    inbox = Inbox()
    for number in range(50):
        inbox.put(piece(number))
    kept = [item.chunks[0][0] for item in inbox.take(0.0, 100)]
    assert kept == list(range(50 - len(kept), 50))
    assert inbox.dropped == 50 - len(kept) > 0


def test_an_inbox_for_files_loses_nothing_however_slow_the_reader_is() -> None:
    inbox, got = Inbox(waits=True), []
    writer = threading.Thread(target=lambda: [inbox.put(piece(number)) for number in range(40)])
    writer.start()
    while len(got) < 40:
        got += [item.chunks[0][0] for item in inbox.take(1.0, 3)]
    writer.join()
    assert got == list(range(40))
    assert inbox.dropped == 0


def test_packets_keep_their_bytes_and_times(data_payload: Callable[..., bytes]) -> None:
    chunks = [(1_700_000_000_123_456_789 + i, data_payload(1000 * i, [100 * i] * 12)) for i in range(3)]
    packets = scan_packets(chunks)
    assert [np.asarray(p).tobytes() for p in packets["data"]] == [data for _, data in chunks]
    assert records.receive_time_ns(packets).tolist() == [time_ns for time_ns, _ in chunks]


# Receivers ------------------------------------------------------------------------------------------------------------


class Heard:
    """Receivers on free ports, and what came."""

    def __init__(self, mavlink: str) -> None:
        self.lidar, self.position = free_port(), free_port()
        self.inbox = Inbox()
        self.receivers = Receivers(self.inbox, "127.0.0.1", self.lidar, self.position, mavlink, 57600)
        self.items: list[Received] = []
        self.receivers.start()

    def bytes_of(self, topic: str) -> bytes:
        self.items += self.inbox.take(0.0)
        return b"".join(data for item in self.items if item.topic == topic for _, data in item.chunks)

    def packets(self) -> int:
        self.items += self.inbox.take(0.0)
        return sum(len(item.packets) for item in self.items)


@pytest.fixture
def heard() -> Iterator[Callable[[str], Heard]]:
    made: list[Heard] = []

    def make(mavlink: str) -> Heard:
        made.append(Heard(mavlink))
        return made[-1]

    yield make
    for each in made:
        each.receivers.close()


def test_udp_of_all_three_kinds_is_told_apart_and_stamped_by_the_kernel(
    heard: Callable[[str], Heard], data_payload: Callable[..., bytes], position_payload: Callable[..., bytes]
) -> None:
    mavlink = free_port()
    all_three = heard(f"udp:127.0.0.1:{mavlink}")
    before_ns = time.time_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for i in range(100):
            sock.sendto(data_payload(553 * i, [20 * i] * 12), ("127.0.0.1", all_three.lidar))
        sock.sendto(bytes(1000), ("127.0.0.1", all_three.lidar))
        sock.sendto(position_payload(7), ("127.0.0.1", all_three.position))
        sock.sendto(b"mavlink", ("127.0.0.1", mavlink))
    until(lambda: all_three.packets() == 100 and all_three.bytes_of("/mavlink/") == b"mavlink")
    until(lambda: all_three.bytes_of(records.POSITION.topic) == position_payload(7))
    assert all_three.receivers.counts().rejected == 1
    stamps = np.concatenate([records.receive_time_ns(item.packets) for item in all_three.items])
    assert (np.diff(stamps) >= -1_000_000).all()
    assert before_ns - 2_000_000 <= stamps[0] <= time.time_ns()


def test_only_the_first_sender_is_the_lidar(data_payload: Callable[..., bytes]) -> None:
    number = free_port()
    port = Port(records.LIDAR.topic, "127.0.0.1", number, LogClock(), 1206)
    try:
        for sender in ("127.0.0.2", "127.0.0.3", "127.0.0.2"):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.bind((sender, 0))
                sock.sendto(data_payload(1, [0] * 12), ("127.0.0.1", number))
        got: list[Any] = []
        until(lambda: bool(got.extend(port.read())) or len(got) == 2)
        assert (port.sender, port.rejected) == ("127.0.0.2", 1)
    finally:
        port.close()


def test_a_pseudo_terminal_is_read_raw(heard: Callable[[str], Heard]) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    line = heard(os.ttyname(slave))
    data = bytes(range(256))
    os.write(master, data)
    until(lambda: line.bytes_of("/mavlink/") == data)
    os.close(slave)
    os.close(master)


def test_tcp_is_taken_up_again_when_it_broke(heard: Callable[[str], Heard]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = heard(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        first, _ = server.accept()
        first.sendall(b"one ")
        until(lambda: line.bytes_of("/mavlink/") == b"one ")
        first.close()
        second, _ = server.accept()
        second.sendall(b"two")
        until(lambda: line.bytes_of("/mavlink/") == b"one two")
        assert line.receivers.counts().trouble == ""
        second.close()


@pytest.mark.parametrize("text", ["udp:127.0.0.1", "udp::14550", "tcp:host:0", "tcp:host:99999"])
def test_a_wrong_mavlink_source_is_named(text: str) -> None:
    with pytest.raises(UsageError, match="expected udp:ADDRESS:PORT, tcp:HOST:PORT or a serial device"):
        open_mavlink(text, 57600, LogClock())


def test_sources_that_are_not_there_are_named(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    with pytest.raises(SourceError, match=f"TCP 127.0.0.1:{port}: cannot be reached"):
        open_mavlink(f"tcp:127.0.0.1:{port}", 57600, LogClock())
    with pytest.raises(SourceError, match="cannot be opened"):
        open_mavlink(str(tmp_path / "none"), 57600, LogClock())
    (tmp_path / "file").touch()
    with pytest.raises(SourceError, match="is no serial device"):
        open_mavlink(str(tmp_path / "file"), 57600, LogClock())
    with pytest.raises(UsageError, match="--baud 1234: expected one of"):
        open_mavlink(str(tmp_path / "file"), 1234, LogClock())


# A growing log --------------------------------------------------------------------------------------------------------


def raw_of(items: list[Received]) -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    for item in items:
        data = b"".join(chunk for _, chunk in item.chunks) + item.packets.tobytes()
        found[item.topic] = found.get(item.topic, b"") + data
    return found


def all_of(log: Path) -> dict[str, bytes]:
    items = []
    with LogReader(log) as reader:
        for message in reader.messages((records.LIDAR.topic, records.POSITION.topic, "/mavlink/ins")):
            if message.topic == records.LIDAR.topic:
                items.append(Received(message.topic, 0.0, packets=records.decode_scan(message.data)))
            else:
                topic = message.topic.removesuffix("ins")
                items.append(Received(topic, 0.0, chunks=records.decode_raw(message.data)))
    return raw_of(items)


@pytest.mark.parametrize("piece_bytes", [9_973, 1 << 20])
def test_a_growing_log_gives_what_the_whole_one_holds(tmp_path: Path, dual_flight: Any, piece_bytes: int) -> None:
    content, grown = dual_flight.log.read_bytes(), tmp_path / "grown.mcap"
    grown.write_bytes(content[:1000])
    inbox = Inbox(waits=True)
    follower = Follower(inbox, grown, "ins")
    follower.start()
    items: list[Received] = []
    try:
        with grown.open("ab") as out:
            for start in range(1000, len(content), piece_bytes):
                out.write(content[start : start + piece_bytes])
                out.flush()
                items += inbox.take(0.0)
        while not inbox.ended:
            items += inbox.take(0.1)
        items += inbox.take(0.0, 1000)
    finally:
        follower.close()
    assert inbox.failure is None
    assert raw_of(items) == all_of(dual_flight.log)


def test_a_damaged_chunk_is_counted_and_passed_over(tmp_path: Path, dual_flight: Any) -> None:
    damaged = tmp_path / "damaged.mcap"
    shutil.copy(dual_flight.log, damaged)
    with LogReader(damaged) as reader:
        chunk = reader._chunks[len(reader._chunks) // 2]
    with damaged.open("r+b") as file:
        file.seek(chunk.offset + chunk.size // 2)
        file.write(bytes(64))
    inbox = Inbox(waits=True)
    follower = Follower(inbox, damaged, "ins")
    follower.start()
    items = []
    try:
        while not inbox.ended:
            items += inbox.take(0.1)
        items += inbox.take(0.0, 1000)
    finally:
        follower.close()
    assert follower.counts().rejected == 1
    whole, rest = all_of(dual_flight.log), raw_of(items)
    assert 0 < sum(map(len, rest.values())) < sum(map(len, whole.values()))


def test_a_log_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be opened"):
        Follower(Inbox(waits=True), tmp_path / "none.mcap", "ins")


# Motion ---------------------------------------------------------------------------------------------------------------


def swing(time_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    t = time_ns[:, None] * 1e-9
    return np.sin(2 * np.pi * t * np.array([0.7, 1.3, 2.1]) + np.array([0.0, 1.0, 2.0]))


def irregular(seconds: float, rate_hz: float, seed: int = 1) -> npt.NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.6, 1.4, int(seconds * rate_hz)) / rate_hz
    return np.round(np.cumsum(steps) * 1e9).astype(np.int64)


@pytest.mark.parametrize(("rate_hz", "tolerance"), [(200.0, 1e-12), (50.0, 1e-3)])
def test_motion_built_piece_by_piece_is_that_built_at_once(rate_hz: float, tolerance: float) -> None:
    """At 200 Hz exactly; a cubic through slow samples looks two samples ahead, not to the end: 1e-3 of its size."""
    time_ns = irregular(20.0, rate_hz)
    samples, motion = Samples("lidar"), GrowingMotion(SLICE_NS, 1e-3, 1e-2, "lidar")
    builder = MotionBuilder(motion, samples, samples, None)
    for start in range(0, len(time_ns), 7):
        part = time_ns[start : start + 7]
        samples.add(part, swing(part), swing(part) * 9.8)
        builder.advance(0)
    whole, known = on_grid(time_ns, swing(time_ns), SLICE_NS, len(motion))
    assert len(motion) > 19 * 200 - 40
    assert known.all()
    assert motion.known.all()
    assert np.abs(motion.rate_rad_s - whole).max() < tolerance
    assert np.abs(motion.force_m_s2 - 9.8 * whole).max() < 9.8 * tolerance
    assert builder.filled == 0


def test_a_gap_is_filled_from_the_other_unit_less_what_it_differs_by() -> None:
    time_ns = irregular(10.0, 200.0)
    quiet = (time_ns > 6_000_000_000) & (time_ns < 7_000_000_000)
    own, other = Samples("lidar"), Samples("autopilot")
    motion = GrowingMotion(SLICE_NS, 1e-3, 1e-2, "lidar")
    builder = MotionBuilder(motion, own, own, other)
    at = irregular(10.0, 50.0, seed=2)
    other.add(at, swing(at), 9.8 * swing(at))
    for start in range(0, len(time_ns), 20):
        part = time_ns[start : start + 20][~quiet[start : start + 20]]
        if len(part):
            own.add(part, swing(part) + 0.5, 9.8 * swing(part))
        builder.advance(int(time_ns[min(start + 19, len(time_ns) - 1)]) - 400_000_000)
    middle = SLICE_NS + (np.arange(len(motion)) + 0.5) * STEP_NS
    off = motion.rate_rad_s - 0.5 - swing(middle.astype(np.int64))
    assert not motion.known.all()
    assert builder.filled == (~motion.known).sum()
    assert np.abs(off).max() < 0.02


def test_motion_forgets_its_beginning_and_nothing_else() -> None:
    motion = GrowingMotion(0, 1e-3, 1e-2, "lidar")
    values = np.arange(3000.0)[:, None] * np.ones(3)
    motion.extend(values, values, np.ones(3000, np.bool_))
    end_ns = motion.end_ns
    motion.forget(50)
    assert (motion.start_ns, motion.end_ns, len(motion)) == (50 * SLICE_NS, end_ns, 2000)
    assert motion.rate_rad_s[0, 0] == 1000.0
    assert motion.force_m_s2[-1, 2] == 2999.0


# Slices, cloud, clocks ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [1, 7, 400])
def test_slices_do_not_depend_on_how_packets_came(turning: Callable[..., Any], batch: int) -> None:
    stream = turning(0.55, start_us=40_000)
    packets = scan_packets([(time_ns, data) for time_ns, data in stream])
    times = np.array([time_ns for time_ns, _ in stream], np.int64)
    slicer = Slicer(Gate())
    for start in range(0, len(packets), batch):
        slicer.feed(packets[start : start + batch], times[start : start + batch])
    shots = [slicer.take(number) for number in range(7)]
    for number, each in enumerate(shots):
        assert (each.time_ns // SLICE_NS == number).all()
        assert len(each.time_ns) == len(each.xyz_m) == len(each.intensity)
    assert sum(len(each.time_ns) for each in shots) == len(packets) * 384
    assert slicer.late == 0
    slicer.feed(packets[:1], times[:1])
    assert slicer.late == 384


def at_rest() -> SensorPath:
    return SensorPath(0, np.tile([1.0, 0.0, 0.0, 0.0], (21, 1)), np.tile([10.0, 20.0, 30.0], (21, 1)))


def test_the_live_cloud_has_one_point_for_each_voxel_and_never_too_many() -> None:
    rng = np.random.default_rng(3)
    cloud = VoxelCloud(0.1, 50_000)
    for _ in range(40):
        points = rng.uniform(-5.0, 5.0, (10_000, 3)).astype(np.float32)
        cloud.add(np.sort(rng.integers(0, SLICE_NS, 10_000)), points, np.full(10_000, 7, np.uint8), at_rest())
        assert cloud.count <= 50_000
    xyz, intensity, _ = cloud.points()
    cells = np.floor(xyz.astype(np.float64) / cloud.voxel_m).astype(int)
    assert len(np.unique(cells, axis=0)) == len(xyz) > 10_000
    assert cloud.generation > 0
    assert cloud.voxel_m == pytest.approx(0.1 * 1.5**cloud.generation)
    assert (intensity == 7).all()
    assert (np.abs(xyz - np.array([10.0, 20.0, 30.0])) <= 5.0 + 1e-5).all()


def test_parts_of_the_cloud_make_the_whole_and_a_new_generation_begins_anew() -> None:
    rng = np.random.default_rng(4)
    cloud = VoxelCloud(0.5, 1_000_000)
    points = rng.uniform(-50.0, 50.0, (30_000, 3)).astype(np.float32)
    cloud.add(np.zeros(30_000, np.int64), points, np.zeros(30_000, np.uint8), at_rest())
    parts, start = [], 0
    while start < cloud.count:
        generation, first, xyz, _ = cloud.part(0, start, 9_999)
        assert (generation, first) == (0, start)
        parts.append(xyz)
        start += len(xyz)
    assert np.array_equal(np.concatenate(parts), cloud.points()[0])
    assert cloud.part(5, 100, 10)[:2] == (0, 0)
    assert cloud.part(0, cloud.count + 1, 10)[:2] == (0, 0)


def test_points_are_placed_by_the_pose_of_their_own_time() -> None:
    quat = np.array([[np.cos(a / 2), 0.0, 0.0, np.sin(a / 2)] for a in np.linspace(0.0, 0.2, 21)])
    place = np.linspace(0.0, 1.0, 21)[:, None] * np.array([1.0, 2.0, 0.0])
    cloud = VoxelCloud(0.01, 100_000)
    cloud.add(
        np.array([0, SLICE_NS // 2]), np.array([[10, 0, 0], [10, 0, 0]], np.float32), np.zeros(2, np.uint8),
        SensorPath(0, quat, place),
    )  # fmt: skip
    expected = [[10.0, 0.0, 0.0], [0.5 + 10 * np.cos(0.1), 1.0 + 10 * np.sin(0.1), 0.0]]
    assert np.allclose(cloud.points()[0], expected, rtol=0, atol=1e-5)


def test_a_tie_undoes_what_the_synchronisation_says() -> None:
    sync = Sync("gyro", -928_839_255_000, 3e5, 1_700_000_000_000_000_000, drift_ppm=58.0)
    tie = Tie("gyro", 3e5, sync.offset_ns, sync.reference_ns, sync.drift_ppm * 1e-6, 0, "host", None, "")
    lidar_ns = sync.reference_ns + np.arange(-5, 6) * 77_123_456_789
    assert np.abs(tie.lidar_ns(sync.ins_time_ns(lidar_ns)) - lidar_ns).max() <= 1


def test_the_lag_is_what_comes_on_top_of_the_fastest_packet() -> None:
    lag = Lag()
    assert np.isnan(lag.of(0, 0))
    for i in range(1000):
        lag.arrived(i * 10_000_000, i * 10_000_000 + 5_000_000_000 + (0 if i % 10 == 0 else 30_000_000))
    assert lag.of(9_000_000_000, 14_200_000_000) == pytest.approx(0.2)


def test_a_long_path_is_thinned_and_keeps_its_ends() -> None:
    line = PathLine()
    for i in range(250_000):
        line.add(np.array([float(i), 0.0, 0.0]))
    shown = line.xyz[: line.count, 0]
    assert line.count <= 100_000
    assert line.generation == 2
    assert (np.diff(shown) > 0).all()
    assert shown[-1] > 249_990
    assert shown[0] < 10


# The page -------------------------------------------------------------------------------------------------------------


class StandIn:
    """What the page is served from."""

    def __init__(self) -> None:
        self.cloud, self.path = VoxelCloud(0.5, 1_000_000), PathLine()
        self.status = {"state": "tracking"}


@pytest.fixture
def served() -> Iterator[tuple[StandIn, int]]:
    session = StandIn()
    server = PageServer(session, 0)  # type: ignore[arg-type]
    yield session, server.port
    server.close()


def get(port: int, path: str, host: str | None = None) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    try:
        connection.request("GET", path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def test_the_page_stands_alone(served: tuple[StandIn, int]) -> None:
    _, port = served
    code, _, page = get(port, "/")
    assert code == 200
    text = page.decode()
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert "https://" not in text
    assert json.loads(get(port, "/status")[2]) == {"state": "tracking"}
    assert get(port, "/etc/passwd")[0] == 404


def test_points_and_path_come_in_parts(served: tuple[StandIn, int]) -> None:
    session, port = served
    rng = np.random.default_rng(5)
    points = rng.uniform(-100.0, 100.0, (150_000, 3)).astype(np.float32)
    strength = rng.integers(0, 255, 150_000).astype(np.uint8)
    session.cloud.add(np.zeros(150_000, np.int64), points, strength, at_rest())
    session.path.add(np.array([1.0, 2.0, 3.0]))
    got, start = [], 0
    while True:
        _, head, body = get(port, f"/points?generation=0&from={start}")
        count = int(head["X-Count"])
        assert (int(head["X-From"]), len(body)) == (start, 13 * count)
        if not count:
            break
        got.append(np.frombuffer(body[: 12 * count], np.float32).reshape(-1, 3))
        start += count
    assert np.array_equal(np.concatenate(got), session.cloud.points()[0])
    assert struct.unpack("<3f", get(port, "/path?generation=0&from=0")[2]) == (1.0, 2.0, 3.0)
    assert get(port, "/path?generation=0&from=x")[0] == 200
    assert get(port, "/points?from=999999999999999999999")[0] == 200


def test_a_page_of_another_site_reads_nothing(served: tuple[StandIn, int]) -> None:
    """A name that an attacker points at 127.0.0.1 is not this machine's own."""
    _, port = served
    assert get(port, "/status", "evil.example")[0] == 403
    assert get(port, "/status", f"localhost:{port}")[0] == 200


def test_a_page_port_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SourceError, match=f"TCP port {port} at 127.0.0.1 cannot be opened"):
            PageServer(StandIn(), port)  # type: ignore[arg-type]
