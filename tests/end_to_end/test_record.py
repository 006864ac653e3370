"""The real `swathd` as a process: real packets over the loopback and a pty, signals, and logs that others can read."""

import json
import os
import pty
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader as BagReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flightlog import records
from flightlog.logfile import LogReader

Timed = list[tuple[float, int, bytes]]
"""Seconds since the first packet, UDP port, payload."""

FULL_CIRCLE = {"start_deg": 0, "end_deg": 0}


@pytest.fixture(scope="module")
def recordings() -> Path:
    folder = os.environ.get("SWATH_RECORDINGS")
    if not folder:
        pytest.skip("SWATH_RECORDINGS is not set: no recordings to test with")
    return Path(folder)


@pytest.fixture(scope="module")
def monterey(recordings: Path) -> Timed:
    raw, offset, packets = (recordings / "lidar" / "hdl32e_monterey.pcap").read_bytes(), 24, []
    while offset < len(raw):
        seconds, micros, size = struct.unpack_from("<III", raw, offset)
        frame = raw[offset + 16 : offset + 16 + size]
        packets.append((seconds + micros * 1e-6, struct.unpack_from(">H", frame, 36)[0], frame[42:]))
        offset += 16 + size
    return [(then - packets[0][0], port, payload) for then, port, payload in packets]


@pytest.fixture(scope="module")
def tlog(recordings: Path) -> bytes:
    """The frames of ArduCopter 3.1.3 without the tlog's times."""
    raw, frames, offset = (recordings / "mavlink" / "arducopter313_sim.tlog").read_bytes(), [], 0
    while offset + 16 < len(raw):
        size = raw[offset + 9] + 8
        frames.append(raw[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return b"".join(frames)


def of(packets: Timed, port: int) -> list[bytes]:
    return [payload for _, to, payload in packets if to == port]


class Swathd:
    """A running daemon, told from a config of its own, heard as systemd would hear it."""

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.logs = folder / "logs"
        self.ports = {2368: free_port(), 8308: free_port()}
        lidar = {"address": "127.0.0.1", "data_port": self.ports[2368], "position_port": self.ports[8308]}
        tree = {"ins": {"device": None}, "recorder": {"directory": str(self.logs)}, **settings}
        tree["lidar"] = lidar | settings.get("lidar", {})
        self.config = folder / "swathd.yaml"
        self.config.write_text(json.dumps(tree))  # JSON is YAML
        self.systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.systemd.bind(str(folder / "notify"))
        self.systemd.settimeout(120)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "onboard.cli", "run", "--config", str(self.config)],
            env=os.environ | {"NOTIFY_SOCKET": str(folder / "notify")},
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_ready(self) -> None:
        while not self.systemd.recv(1000).startswith(b"READY=1"):
            pass

    def heard(self) -> list[str]:
        """What systemd was told since."""
        self.systemd.setblocking(False)
        lines = []
        try:
            while True:
                lines.append(self.systemd.recv(1000).decode())
        except BlockingIOError:
            return lines

    def stop(self, number: int = signal.SIGTERM) -> str:
        """Send a signal and wait; gives what was written to stderr."""
        self.process.send_signal(number)
        return self.process.communicate(timeout=120)[1]

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        self.systemd.close()

    def health(self, *more: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "onboard.cli", "health", "--config", str(self.config), *more]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)

    def status(self) -> dict[str, Any]:
        """What the status file says; nothing yet: zeros."""
        try:
            return dict(json.loads((self.logs / "status.json").read_text()))
        except FileNotFoundError:
            return {"uptime_s": 0.0, "links": {}, "lidar": {"received": 0, "kernel_drops": 0, "position_kept": 0}}

    def wait_for_packets(self, count: int) -> None:
        """Until so many data packets were looked at or counted as lost, and whatever else came with them was, too."""
        until(lambda: self.status()["lidar"]["received"] + self.status()["lidar"]["kernel_drops"] >= count)
        self.wait_s(1.5)

    def wait_s(self, seconds: float) -> None:
        """Until the daemon has gone on for so long."""
        before_s = self.status()["uptime_s"]
        until(lambda: self.status()["uptime_s"] >= before_s + seconds)

    @property
    def log(self) -> Path:
        (path,) = self.logs.glob("*.mcap")
        return path


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@contextmanager
def running(folder: Path, **settings: Any) -> Iterator[Swathd]:
    daemon = Swathd(folder, settings)
    try:
        daemon.wait_ready()
        yield daemon
    finally:
        daemon.kill()


def replay(packets: Timed, ports: dict[int, int], also: Callable[[float], None] = lambda _: None) -> list[int]:
    """Send as fast as the sensor did; `also` hears of the time now and then. Gives when each was sent [ns of the wall clock]."""
    sent_ns = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        begin = time.monotonic()
        for then, port, payload in packets:
            if (wait := then - (time.monotonic() - begin)) > 0.002:
                also(then)
                time.sleep(wait)
            sent_ns.append(time.time_ns())
            sender.sendto(payload, ("127.0.0.1", ports[port]))
    return sent_ns


class Stream(threading.Thread):
    """Numbered data packets at the sensor's rate, until told to stop; a packet's number is its stamp."""

    def __init__(self, template: bytes, port: int) -> None:
        super().__init__(daemon=True)
        self.sent = 0
        self.sent_ns: list[int] = []
        """When each was sent, on the wall clock."""
        self._template, self._address = template, ("127.0.0.1", port)
        self._end = threading.Event()

    def run(self) -> None:
        begin = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._end.is_set():
                for number in range(self.sent, int((time.monotonic() - begin) * 1808)):
                    packet = self._template[:1200] + struct.pack("<I", number) + self._template[1204:]
                    self.sent_ns.append(time.time_ns())
                    sender.sendto(packet, self._address)
                    self.sent += 1
                time.sleep(0.002)

    def wait_for(self, packets: int) -> None:
        """Until so many more were sent."""
        until(lambda then=self.sent + packets: self.sent >= then)

    def stop(self) -> None:
        self._end.set()
        self.join()


def scans(log: Path) -> np.ndarray:
    with LogReader(log) as reader:
        found = [records.decode_scan(message.data) for message in reader.messages((records.LIDAR.topic,))]
    return np.concatenate([np.empty(0, records.SCAN_PACKET_DTYPE), *found])


def chunks(log: Path, topic: str) -> list[tuple[int, bytes]]:
    with LogReader(log) as reader:
        return [chunk for message in reader.messages((topic,)) for chunk in records.decode_raw(message.data)]


def accounts(log: Path) -> list[records.LidarAccount]:
    with LogReader(log) as reader:
        topics = (records.LIDAR_ACCOUNT.topic,)
        return [records.decode_account(message.data) for message in reader.messages(topics)]


class Flight:
    """One recording that many tests look at."""

    def __init__(self, log: Path, config: Path, sent_ns: list[int], stderr: str, heard: list[str]) -> None:
        self.log, self.config, self.sent_ns = log, config, sent_ns
        self.stderr, self.heard = stderr, heard
        self.mavlink_sent = b""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory, monterey: Timed, tlog: bytes) -> Flight:
    """The recorded second and a half of the HDL-32E, with MAVLink of ArduCopter 3.1.3 over a pty."""
    folder = tmp_path_factory.mktemp("flight")
    master, slave = pty.openpty()
    tty.setraw(slave, termios.TCSANOW)
    mavlink = bytearray()

    def send_mavlink(seconds: float) -> None:
        part = tlog[len(mavlink) : round(seconds * 4000)]
        mavlink.extend(part[: os.write(master, part)] if part else b"")

    with running(folder, lidar={"fov": FULL_CIRCLE}, ins={"device": os.ttyname(slave)}) as daemon:
        until(lambda: daemon.status()["links"].get("ins", {}).get("connected", False))
        sent_ns = replay(monterey, daemon.ports, send_mavlink)
        daemon.wait_for_packets(len(of(monterey, 2368)))
        stderr = daemon.stop()
        assert daemon.process.returncode == 0, stderr
        found = Flight(daemon.log, daemon.config, sent_ns, stderr, daemon.heard())
        found.mavlink_sent = bytes(mavlink)
    os.close(master)
    os.close(slave)
    return found


def test_a_log_holds_every_packet_bit_by_bit(flight: Flight, monterey: Timed) -> None:
    assert scans(flight.log)["data"].tobytes() == b"".join(of(monterey, 2368))
    assert [payload for _, payload in chunks(flight.log, records.POSITION.topic)] == of(monterey, 8308)


def test_a_log_holds_every_mavlink_byte(flight: Flight) -> None:
    assert len(flight.mavlink_sent) > 4000
    assert b"".join(data for _, data in chunks(flight.log, "/mavlink/ins")) == flight.mavlink_sent


def test_receive_times_are_those_of_the_wall_clock_and_never_go_back(flight: Flight, monterey: Timed) -> None:
    times = records.receive_time_ns(scans(flight.log))
    assert (np.diff(times) >= 0).all()
    sent = np.array([sent_ns for sent_ns, (_, port, _) in zip(flight.sent_ns, monterey, strict=True) if port == 2368])
    # each was stamped between its own sending and the next; the wall clock may be slewed meanwhile, by 500 ppm at most
    assert (times > sent - 5e6).all()
    assert (times[:-1] < sent[1:] + 5e6).all()


def test_every_batch_has_its_account(flight: Flight, monterey: Timed) -> None:
    with LogReader(flight.log) as reader:
        times = {
            topic: [message.log_time_ns for message in reader.messages((topic,))]
            for topic in (records.LIDAR.topic, records.LIDAR_ACCOUNT.topic)
        }
    assert times[records.LIDAR.topic] == times[records.LIDAR_ACCOUNT.topic]
    assert len(times[records.LIDAR.topic]) > 1
    assert sum(account.received for account in accounts(flight.log)) == len(of(monterey, 2368))
    assert not any(account.kernel_drops or account.queue_drops for account in accounts(flight.log))


def test_a_log_alone_says_how_it_was_made(flight: Flight) -> None:
    with LogReader(flight.log) as reader:
        assert not reader.damage
        assert reader.path.name == "00001-000.mcap"
        session = reader.metadata["swath.session"]
        assert session["boot_id"] == Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        assert session["host"] == socket.gethostname()
        assert session["version"]
        assert (session["fov_start_deg"], session["fov_end_deg"]) == ("0", "0")
        assert b"data_port" in reader.attachments["config.yaml"]
        assert b"pitch_deg: -20.0" in reader.attachments["mount.yaml"]


def test_the_hosts_clocks_are_in_the_log_each_second(flight: Flight) -> None:
    with LogReader(flight.log) as reader:
        clocks = [records.decode_host_clock(message.data) for message in reader.messages((records.HOST_CLOCK.topic,))]
    assert len(clocks) >= 3
    assert all(abs(clock.realtime_ns - clock.log_ns) < 5e6 for clock in clocks)
    assert {clock.log_ns - clock.monotonic_ns for clock in clocks} == {clocks[0].log_ns - clocks[0].monotonic_ns}
    assert np.median(np.diff([clock.monotonic_ns for clock in clocks])) == pytest.approx(1e9, rel=0.5)


def test_mcap_ros2_reads_the_packets(flight: Flight, monterey: Timed) -> None:
    packets, stamps = [], []
    with flight.log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=[records.LIDAR.topic]):
            assert channel.message_encoding == "cdr"
            packets += [bytes(packet.data) for packet in message.packets]
            stamps += [packet.stamp.sec * 10**9 + packet.stamp.nanosec for packet in message.packets]
    assert packets == of(monterey, 2368)
    assert stamps == records.receive_time_ns(scans(flight.log)).tolist()


def test_rosbags_reads_everything(flight: Flight, monterey: Timed, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    shutil.copy(flight.log, bag / flight.log.name)
    store = get_typestore(Stores.EMPTY)
    for row in records.TABLE:
        store.register(get_types_from_msg(row.definition, row.schema))
    packets: list[bytes] = []
    mavlink = b""
    with BagReader(bag / flight.log.name) as reader:
        for connection, _, raw in reader.messages():
            message: Any = store.deserialize_cdr(bytes(raw), connection.msgtype)
            if connection.topic == records.LIDAR.topic:
                packets += [packet.data.tobytes() for packet in message.packets]
            elif connection.topic == "/mavlink/ins":
                mavlink += b"".join(chunk.data.tobytes() for chunk in message.chunks)
    assert packets == of(monterey, 2368)
    assert mavlink == flight.mavlink_sent


def test_systemd_is_told_ready_watchdog_and_stopping(flight: Flight) -> None:
    assert "WATCHDOG=1" in flight.heard
    assert flight.heard[-1] == "STOPPING=1"
    assert any(line.startswith("STATUS=00001-000.mcap: lidar") for line in flight.heard)


def test_the_field_of_view_is_applied_on_the_way_into_the_log(tmp_path: Path, monterey: Timed) -> None:
    with running(tmp_path) as daemon:
        replay(monterey, daemon.ports)
        daemon.wait_for_packets(len(of(monterey, 2368)))
        daemon.stop(signal.SIGINT)
        assert daemon.process.returncode == 0
        kept = scans(daemon.log)["data"]
        total = accounts(daemon.log)
    sent = np.frombuffer(b"".join(of(monterey, 2368)), kept.dtype)
    # the mask by its meaning: a block may be blanked only if the next block, too, begins outside
    azimuth = sent["blocks"]["azimuth"].astype(int) % 36000
    ahead = (azimuth <= 10500) | (azimuth >= 25500)
    assert len(kept) == sum(account.kept for account in total)
    assert len(sent) - len(kept) == sum(account.masked_packets for account in total)
    stamps = {stamp: i for i, stamp in enumerate(sent["stamp_us"].tolist())}
    index = [stamps[stamp] for stamp in kept["stamp_us"].tolist()]
    assert not ahead[sorted(set(range(len(sent))) - set(index))].any()
    same = (kept["blocks"]["returns"]["range"] == sent[index]["blocks"]["returns"]["range"]).all(axis=2)
    assert same[ahead[index]].all()
    behind = (azimuth[index] > 10500) & (azimuth[index] < 25500 - 21)  # 0.195 deg from block to block at 706 rpm
    assert not kept["blocks"]["returns"]["range"][behind].any()
    restored = kept.copy()
    restored["blocks"]["returns"]["range"] = sent[index]["blocks"]["returns"]["range"]
    assert restored.tobytes() == sent[index].tobytes()
    assert len(chunks(daemon.log, records.POSITION.topic)) == len(of(monterey, 8308))


def test_a_kill_loses_at_most_a_second(tmp_path: Path, monterey: Timed) -> None:
    with running(tmp_path, lidar={"fov": FULL_CIRCLE}) as daemon:
        stream = Stream(of(monterey, 2368)[0], daemon.ports[2368])
        stream.start()
        stream.wait_for(4200)
        sent = stream.sent
        daemon.stop(signal.SIGKILL)
        stream.stop()
        numbers = scans(daemon.log)["data"]["stamp_us"].tolist()
        with LogReader(daemon.log) as reader:
            assert reader.damage.truncated
            assert reader.damage.bad_chunks == 0
    assert numbers == list(range(len(numbers)))
    assert sent - len(numbers) <= 1808


def test_what_came_while_the_daemon_was_frozen_is_recorded_with_its_true_times(tmp_path: Path, monterey: Timed) -> None:
    with running(tmp_path, lidar={"fov": FULL_CIRCLE}) as daemon:
        stream = Stream(of(monterey, 2368)[0], daemon.ports[2368])
        stream.start()
        stream.wait_for(900)
        daemon.process.send_signal(signal.SIGSTOP)
        stream.wait_for(1400)
        time.sleep(0.2)
        daemon.process.send_signal(signal.SIGCONT)
        stream.wait_for(900)
        stream.stop()
        daemon.wait_for_packets(stream.sent)
        daemon.stop()
        packets = scans(daemon.log)
        drops = sum(account.kernel_drops for account in accounts(daemon.log))
    assert len(packets) + drops == stream.sent
    with Path("/proc/sys/net/core/rmem_max").open() as file:
        if int(file.read()) >= 4 << 20:  # room for what comes in a stall of a second, and for a sender that catches up
            assert drops == 0
            sent_ns = np.array(stream.sent_ns)[packets["data"]["stamp_us"]]
            times = records.receive_time_ns(packets)
            assert (times > sent_ns - 5e6).all()
            assert (times[:-1] < sent_ns[1:] + 5e6).all()  # before the next was sent: the stamps are the kernel's


def test_what_a_small_buffer_drops_is_counted_exactly(tmp_path: Path, monterey: Timed) -> None:
    with running(tmp_path, lidar={"fov": FULL_CIRCLE, "receive_buffer_kb": 64}) as daemon:
        stream = Stream(of(monterey, 2368)[0], daemon.ports[2368])
        stream.start()
        stream.wait_for(500)
        daemon.process.send_signal(signal.SIGSTOP)
        stream.wait_for(1200)
        daemon.process.send_signal(signal.SIGCONT)
        stream.wait_for(500)
        stream.stop()
        daemon.wait_for_packets(stream.sent)
        daemon.stop()
        total = accounts(daemon.log)
    assert sum(account.kernel_drops for account in total) > 500
    assert sum(account.kernel_drops + account.received for account in total) == stream.sent


def test_a_disk_that_fails_ends_the_segment_with_a_sentence_and_recording_goes_on(
    tmp_path: Path, monterey: Timed
) -> None:
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    with running(tmp_path, lidar={"fov": FULL_CIRCLE}) as daemon:
        resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
        replay(monterey, daemon.ports)
        end = time.monotonic() + 60
        while len(list(daemon.logs.glob("*.mcap"))) < 2:
            assert time.monotonic() < end
            time.sleep(0.05)
        resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, unlimited)
        replay(monterey, daemon.ports)
        time.sleep(1.0)
        stderr = daemon.stop()
        assert daemon.process.returncode == 0
        assert "00001-000.mcap: cannot be written (File too large)" in stderr
        assert "Traceback" not in stderr
        first, *_, last = sorted(daemon.logs.glob("*.mcap"))
        with LogReader(first) as reader:
            assert any(message.topic == records.LIDAR.topic for message in reader.messages())
        with LogReader(last) as reader:
            assert not reader.damage
            kept = sum(len(records.decode_scan(m.data)) for m in reader.messages((records.LIDAR.topic,)))
        assert kept > 1000


def test_a_terminal_that_closes_ends_no_recording(tmp_path: Path) -> None:
    with running(tmp_path) as daemon:
        daemon.process.send_signal(signal.SIGHUP)
        time.sleep(0.5)
        assert daemon.process.poll() is None
        daemon.stop()
        assert daemon.process.returncode == 0
        with LogReader(daemon.log) as reader:
            assert not reader.damage


def test_recording_goes_on_without_any_autopilot_or_lidar(tmp_path: Path) -> None:
    with running(tmp_path, ins={"device": str(tmp_path / "no-such-device")}) as daemon:
        daemon.wait_s(1.2)
        health = daemon.health()
        assert health.returncode == 2
        assert "lidar: no " in health.stdout  # no packets, or no link
        assert f"link ins: serial device {tmp_path}/no-such-device cannot be opened" in health.stdout
        stderr = daemon.stop()
        assert daemon.process.returncode == 0
        assert stderr.count("no-such-device") == 1  # said once, not at each attempt
        with LogReader(daemon.log) as reader:
            assert {message.topic for message in reader.messages()} == {records.HOST_CLOCK.topic}
            assert not reader.damage


def test_health_is_good_while_packets_come(tmp_path: Path, monterey: Timed) -> None:
    with running(tmp_path) as daemon:
        stream = Stream(of(monterey, 2368)[0], daemon.ports[2368])
        stream.start()
        until(lambda: daemon.status()["lidar"]["received"] > 1808)
        until(lambda: daemon.health().returncode == 0)
        text, tree = daemon.health(), daemon.health("--json")
        stream.stop()
        daemon.stop()
    assert text.returncode == 0, text.stdout
    assert text.stdout.startswith("GOOD: 00001-000.mcap: lidar 1")
    parsed = json.loads(tree.stdout)
    assert (parsed["verdict"], parsed["findings"]) == ("GOOD", [])
    assert parsed["status"]["lidar"]["packets_s"] > 0


def test_a_restart_in_the_same_boot_is_the_next_segment(tmp_path: Path) -> None:
    for attempt in range(2):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with running(folder, recorder={"directory": str(tmp_path / "logs")}) as daemon:
            daemon.stop()
    assert sorted(path.name for path in (tmp_path / "logs").glob("*.mcap")) == ["00001-000.mcap", "00001-001.mcap"]


def failure(folder: Path, settings: dict[str, Any] | str, *, exit_code: int) -> str:
    """The one sentence that a start that cannot be ends with."""
    config = folder / "swathd.yaml"
    if isinstance(settings, str):
        config.write_text(settings)
    else:
        ports = {"address": "127.0.0.1", "data_port": free_port(), "position_port": free_port()}
        lidar = ports | settings.get("lidar", {})
        logs = {"directory": str(folder / "logs")}
        config.write_text(json.dumps({"recorder": logs, **settings, "lidar": lidar}))
    command = [sys.executable, "-m", "onboard.cli", "run", "--config", str(config)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == exit_code
    assert "Traceback" not in run.stderr
    sentence = run.stderr.splitlines()[-1]
    assert sentence.startswith("swathd: ")
    assert not list((folder / "logs").glob("*.mcap"))
    return sentence


def test_a_port_in_use_is_one_sentence(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        for key in ("data_port", "position_port"):
            sentence = failure(tmp_path, {"lidar": {key: port}}, exit_code=1)
            assert sentence == f"swathd: UDP port {port} at 127.0.0.1 cannot be opened: another program has it"


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    sentence = failure(tmp_path, {"recorder": {"directory": str(tmp_path / "file" / "logs")}}, exit_code=1)
    assert sentence == f"swathd: {tmp_path}/file/logs: logs cannot be written there (Not a directory)"


def test_an_unknown_key_is_one_sentence(tmp_path: Path) -> None:
    sentence = failure(tmp_path, "lidra: {}\n", exit_code=2)
    assert sentence.startswith(f"swathd: {tmp_path}/swathd.yaml: unknown key 'lidra'; known are lidar, ins, fc")


def test_a_mount_file_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    sentence = failure(tmp_path, {"mount": "mount.yaml"}, exit_code=2)
    assert sentence == f"swathd: {tmp_path}/mount.yaml: cannot be read (No such file or directory)"


def test_the_sample_configuration_is_one_the_daemon_takes(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "onboard.cli", "config"]
    sample = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout
    (tmp_path / "sample.yaml").write_text(sample)
    health = [sys.executable, "-m", "onboard.cli", "health", "--config", str(tmp_path / "sample.yaml")]
    run = subprocess.run(health, capture_output=True, text=True, check=False, timeout=300)
    assert "unknown key" not in run.stderr


@pytest.mark.parametrize("content", [None, "{", "\x00"])
def test_health_without_a_status_is_critical(tmp_path: Path, content: str | None) -> None:
    (tmp_path / "c.yaml").write_text(f"status_file: {tmp_path}/s.json\n")
    if content is not None:
        (tmp_path / "s.json").write_text(content)
    health = [sys.executable, "-m", "onboard.cli", "health", "--config", str(tmp_path / "c.yaml")]
    run = subprocess.run(health, capture_output=True, text=True, check=False, timeout=300)
    assert (run.returncode, run.stderr) == (2, "")
    assert run.stdout.startswith(f"CRITICAL: {tmp_path}/s.json: ")
    assert len(run.stdout.splitlines()) == 1
