"""A log played to real sockets: what arrives is what was recorded, when it was recorded."""

import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flightlog import records
from flightlog.errors import LogError, SourceError, UsageError
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from groundproc.cli import main
from groundproc.field.replay import Destination, Event, datagrams, parse_mavlink, parse_speed, replay

S = 1_000_000_000
START = 1_700_000_000 * S


def packet(number: int) -> bytes:
    """Bytes of a data packet's length that tell its number."""
    return number.to_bytes(4, "little") * 301 + b"\x37\x21"


def write(path: Path, packets: int = 200, interval_ns: int = 5_000_000, start_ns: int = START) -> Path:
    """A log of data packets, with a position packet and a piece of MAVLink after every 10th, topic by topic late as aboard."""
    with path.open("wb") as stream:
        log = LogWriter(stream, metadata={}, attachments={})
        times = start_ns + interval_ns * np.arange(packets)
        for first in range(0, packets, 20):
            part = np.zeros(min(20, packets - first), records.SCAN_PACKET_DTYPE)
            for i in range(len(part)):
                part["data"][i] = np.frombuffer(packet(first + i), part["data"].dtype)[0]
            stamps = times[first : first + len(part)]
            records.set_receive_time_ns(part, stamps)
            own = [(int(stamps[i]) + 1, b"P%d" % (first + i) + bytes(508)) for i in range(0, len(part), 10)]
            log.write(records.LIDAR.topic, int(stamps[-1]), records.encode_scan(int(stamps[-1]), part))
            log.write(records.POSITION.topic, own[-1][0], records.encode_raw(own[-1][0], own, "velodyne"))
            chunks = [(int(stamps[i]) + 2, b"\xfe%d" % (first + i)) for i in range(0, len(part), 10)]
            log.write("/mavlink/ins", chunks[-1][0], records.encode_raw(chunks[-1][0], chunks, "ins"))
        log.finish()
    return path


class Listener:
    """Three ports and what came, in the order of arrival."""

    def __init__(self) -> None:
        self.sockets = []
        for _ in range(3):
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            sock.bind(("127.0.0.1", 0))
            sock.settimeout(0.05)
            self.sockets.append(sock)
        self.ports = [sock.getsockname()[1] for sock in self.sockets]
        self.came: list[list[tuple[float, bytes]]] = [[], [], []]
        self._end = threading.Event()
        self._threads = [threading.Thread(target=self._listen, args=(i,)) for i in range(3)]
        for thread in self._threads:
            thread.start()

    def _listen(self, i: int) -> None:
        while True:
            try:
                payload = self.sockets[i].recv(65536)
                self.came[i].append((time.monotonic(), payload))
            except TimeoutError:
                if self._end.is_set():
                    return

    def to(self, *, mavlink: bool = True) -> Destination:
        return Destination("127.0.0.1", self.ports[0], self.ports[1], ("127.0.0.1", self.ports[2]) if mavlink else None)

    def close(self) -> None:
        self._end.set()
        for thread in self._threads:
            thread.join()
        for sock in self.sockets:
            sock.close()

    def payloads(self, i: int) -> list[bytes]:
        self.close()
        return [payload for _, payload in self.came[i]]


@pytest.fixture
def listener() -> Iterator[Listener]:
    made = Listener()
    yield made
    made.close()


def test_every_datagram_comes_once_in_order_and_unchanged(tmp_path: Path, listener: Listener) -> None:
    replayed = replay([write(tmp_path / "a.mcap")], listener.to(), speed=4.0)
    assert (replayed.data_packets, replayed.position_packets, replayed.mavlink_chunks) == (200, 20, 20)
    assert listener.payloads(0) == [packet(n) for n in range(200)]
    assert [p.rstrip(b"\0") for p in listener.payloads(1)] == [b"P%d" % n for n in range(0, 200, 10)]
    assert listener.payloads(2) == [b"\xfe%d" % n for n in range(0, 200, 10)]


def test_datagrams_of_all_topics_are_put_in_the_order_of_their_times(tmp_path: Path) -> None:
    with LogReader(write(tmp_path / "a.mcap")) as reader:
        times = [event.time_ns for event in datagrams(reader.messages())]
    assert times == sorted(times)
    assert len(times) == 240


@pytest.mark.parametrize(("interval_ms", "speed"), [(5, 1.0), (100, 20.0)])
@pytest.mark.parametrize("oversleep_s", [0.0, 0.03])
def test_datagrams_are_sent_at_their_times_and_never_before(
    tmp_path: Path,
    listener: Listener,
    monkeypatch: pytest.MonkeyPatch,
    interval_ms: int,
    speed: float,
    oversleep_s: float,
) -> None:
    """On a clock of the test's own, which only sleeping moves: nothing is early by more than a slice of 2 ms, lateness is told."""
    now_s, late_s = 1000.0, defaultdict[str, list[float]](list)

    def sleep(seconds: float) -> None:
        nonlocal now_s
        assert seconds > 0
        now_s += seconds + oversleep_s

    def note(event: Event) -> None:
        late_s[event.topic].append(now_s - 1000.0 - (event.time_ns - START) * 1e-9 / speed)

    module = sys.modules[replay.__module__]
    send = module._send
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s, sleep=sleep))
    monkeypatch.setattr(module, "_send", lambda sock, event, *words: (note(event), send(sock, event, *words)))
    path = write(tmp_path / "a.mcap", packets=201, interval_ns=interval_ms * 1_000_000)
    replayed = replay([path], listener.to(mavlink=False), speed)
    assert len(late_s[records.LIDAR.topic]) == 201
    assert min(late_s[records.LIDAR.topic]) > -0.002
    assert max(late_s[records.LIDAR.topic]) == pytest.approx(oversleep_s, abs=0.002)
    assert replayed.worst_late_s == pytest.approx(max(map(max, late_s.values())), abs=1e-6)
    assert listener.payloads(2) == []  # nobody asked for the autopilot


def test_max_does_not_wait(tmp_path: Path, listener: Listener) -> None:
    path = write(tmp_path / "a.mcap", packets=200, interval_ns=S // 2)  # 100 s
    replayed = replay([path], listener.to(), speed=None)
    assert replayed.data_packets == 200
    assert replayed.worst_late_s == 0.0


def test_logs_are_played_in_the_order_of_their_times_without_the_pause_between(
    tmp_path: Path, listener: Listener
) -> None:
    second = write(tmp_path / "1.mcap", packets=40, interval_ns=S // 10, start_ns=START + 3600 * S)
    first = write(tmp_path / "2.mcap", packets=60, interval_ns=S // 10)
    replayed = replay([second, first], listener.to(), speed=20.0)
    assert replayed.pauses_cut == 1
    assert listener.payloads(0) == [packet(n) for n in [*range(60), *range(40)]]


def test_a_cut_log_is_played_as_far_as_it_goes(tmp_path: Path, listener: Listener) -> None:
    path = write(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:-100])
    replayed = replay([path], listener.to(), speed=None)
    assert replayed.data_packets == 200  # the summary is gone, the chunk is not


def test_what_cannot_be_played_is_one_sentence(tmp_path: Path, listener: Listener) -> None:
    empty = write(tmp_path / "empty.mcap", packets=0)
    with pytest.raises(LogError, match="nothing in there to play"):
        replay([empty], listener.to())
    with pytest.raises(SourceError, match="no such address"):
        replay([empty], Destination("256.1.1.1"))
    with pytest.raises(LogError, match="cannot be opened"):
        replay([tmp_path / "nothing.mcap"], listener.to())


def test_words_of_the_command_line() -> None:
    assert parse_speed("max") is None
    assert parse_speed("2.5") == 2.5
    assert parse_mavlink("udp:10.0.0.1:14550") == ("10.0.0.1", 14550)
    for text in ("0", "-1", "fast", "nan"):
        with pytest.raises(UsageError, match="expected max, or a number"):
            parse_speed(text)
    for text in ("10.0.0.1:14550", "udp:14550", "udp:x:0", "tcp:x:1"):
        with pytest.raises(UsageError, match="expected udp:ADDRESS:PORT"):
            parse_mavlink(text)


def test_the_command_plays_and_says_what_it_sent(
    tmp_path: Path, listener: Listener, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.mcap")
    words = ["--lidar-port", str(listener.ports[0]), "--position-port", str(listener.ports[1])]
    assert main(["replay", str(path), *words, "--mavlink", f"udp:127.0.0.1:{listener.ports[2]}", "--speed", "max"]) == 0
    assert "200 data packets, 20 position packets, 20 pieces of MAVLink sent" in capsys.readouterr().out
    assert main(["replay", str(path), "--speed", "backwards"]) == 2


def test_a_loop_goes_on_until_interrupted(tmp_path: Path, listener: Listener) -> None:
    path = write(tmp_path / "a.mcap", packets=20)
    program = "import sys; from groundproc.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["--lidar-port", str(listener.ports[0]), "--position-port", str(listener.ports[1])]
    command = [sys.executable, "-c", program, "replay", str(path), "--loop", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 120
    while len(listener.came[0]) < 100:
        assert time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(2)
    assert process.wait(120) == 130
    assert [payload for _, payload in listener.came[0][:60]] == [packet(n) for n in range(20)] * 3
