"""The live downlink with real sockets: what arrives, what is left out, and that it loses only its own."""

import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import velodyne_decoder
from hypothesis import given, settings
from hypothesis import strategies as st

from flightlog import hdl32e, records
from flightlog.config import loads
from flightlog.errors import ConfigError
from onboard import relay
from onboard.config import DownlinkConfig
from onboard.relay import Relay, RelayCounts, Thinner

FRAME = 42


def packets(count: int, first: int = 0) -> npt.NDArray[np.void]:
    """Data packets of a head at 600 rpm, 181 to the turn; a packet's number is its stamp."""
    made = np.zeros(count, records.SCAN_PACKET_DTYPE)
    numbers = np.arange(first, first + count)
    firing = numbers[:, None] * 12 + np.arange(12)
    made["data"]["blocks"]["flag"] = hdl32e.BLOCK_FLAG
    made["data"]["blocks"]["azimuth"] = firing * 16.574 % 36000
    made["data"]["stamp_us"] = numbers
    made["data"]["return_mode"], made["data"]["product"] = 0x37, 0x21
    return made


def scan(count: int, first: int = 0) -> bytes:
    return records.encode_scan(1, packets(count, first))


def until(condition: Callable[[], bool], seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


class Ground:
    """Three ports on the ground and what came to them."""

    def __init__(self) -> None:
        self.sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
        self.came: list[list[bytes]] = [[], [], []]
        self._end = threading.Event()
        self._threads = []
        for i, sock in enumerate(self.sockets):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
            sock.bind(("127.0.0.1", 0))
            sock.settimeout(0.05)
            self._threads.append(threading.Thread(target=self._listen, args=(i,)))
            self._threads[-1].start()

    def _listen(self, i: int) -> None:
        while not self._end.is_set():
            try:
                self.came[i].append(self.sockets[i].recv(65536))
            except TimeoutError:
                continue

    def config(self, **more: int | str) -> DownlinkConfig:
        lidar, position, mavlink = (sock.getsockname()[1] for sock in self.sockets)
        return DownlinkConfig("127.0.0.1", lidar, position, mavlink, **more)  # type: ignore[arg-type]

    def close(self) -> None:
        self._end.set()
        for thread, sock in zip(self._threads, self.sockets, strict=True):
            thread.join()
            sock.close()


@pytest.fixture
def ground() -> Iterator[Ground]:
    made = Ground()
    yield made
    made.close()


def balanced(counts: RelayCounts) -> bool:
    """After the end nothing waits."""
    return counts.offered == counts.thinned + counts.sent + counts.unheard + counts.dropped


# Thinning -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("thin", [2, 3, 5, 7, 36])
def test_as_many_turns_make_a_whole_scan_and_every_turn_shows_its_share(thin: int) -> None:
    azimuth = packets(181 * thin)["data"]["blocks"]["azimuth"][:, 0]
    chosen = Thinner(thin).choose(azimuth)
    sectors = azimuth[chosen] // 1000
    assert set(sectors.tolist()) == set(range(36))
    # every sector is sent in one turn of so many: 181 packets are about 5 to each of 36 sectors
    assert (np.bincount(sectors, minlength=36) <= 7).all()
    assert abs(chosen.mean() - 1 / thin) < 0.02
    turn = np.arange(len(azimuth)) // 181
    assert (np.bincount(turn[chosen], minlength=thin) > 0).all()


@pytest.mark.parametrize("thin", [2, 4, 6])
def test_a_viewer_sees_one_scan_a_turn_however_thin_each_with_its_share(thin: int) -> None:
    """velodyne-decoder cuts the thinned stream as it cuts the whole one."""
    made = packets(181 * 12)["data"]
    made["blocks"]["returns"]["range"] = 2500  # 5 m
    chosen = Thinner(thin).choose(made["blocks"]["azimuth"][:, 0])
    decoder = velodyne_decoder.StreamDecoder(velodyne_decoder.Config(model=velodyne_decoder.Model.HDL32E))
    scans = []
    for packet in made[chosen]:
        if (scan := decoder.decode(1000.0 + packet["stamp_us"] * 553e-6, packet.tobytes(), True)) is not None:
            scans.append(len(scan[1]))
    assert 10 <= len(scans) <= 12
    whole = 181 * 12 * 32
    # sectors of 10 deg are cut between packets of 2 deg: one more or less of 36 / thin
    assert all(abs(points / whole - 1 / thin) < 1.2 / 36 for points in scans)


def test_thinning_by_one_keeps_everything() -> None:
    assert Thinner(1).choose(packets(500)["data"]["blocks"]["azimuth"][:, 0]).all()


@settings(deadline=None)
@given(st.lists(st.integers(0, 40), max_size=30), st.integers(2, 36))
def test_the_choice_does_not_depend_on_how_packets_are_batched(sizes: list[int], thin: int) -> None:
    azimuth = packets(sum(sizes))["data"]["blocks"]["azimuth"][:, 0]
    thinner, parts = Thinner(thin), np.split(azimuth, np.cumsum(sizes)[:-1]) if sizes else []
    choices = [thinner.choose(part) for part in parts]
    assert np.concatenate([np.empty(0, bool), *choices]).tolist() == Thinner(thin).choose(azimuth).tolist()


def test_turns_are_counted_in_a_restricted_field_of_view_and_through_jitter() -> None:
    inside = np.arange(3000, 12000, 200)  # 30 to 120 deg: no zero crossing
    thinner = Thinner(4)
    chosen = [thinner.choose((inside + jitter).astype(np.uint16)) for jitter in (0, 7, 3, 5)]
    assert np.sum(chosen, axis=0).tolist() == [1] * len(inside)  # each direction once in four turns
    still = Thinner(4).choose(np.array([5000, 4999, 5000, 4950] * 5, np.uint16))
    assert len(set(still.tolist())) <= 2  # a head that trembles does not turn


# Sending --------------------------------------------------------------------------------------------------------------


def test_everything_arrives_as_it_was_received(ground: Ground) -> None:
    link = Relay(ground.config())
    link.start()
    sent, first = [], 0
    for _ in range(10):
        link.offer(records.LIDAR.topic, scan(181, first))
        sent += [packet.tobytes() for packet in packets(181, first)["data"]]
        first += 181
        link.offer(records.POSITION.topic, records.encode_raw(1, [(1, b"p" * 512), (2, b"q" * 512)], "velodyne"))
        link.offer("/mavlink/ins", records.encode_raw(1, [(1, b"\xfe first"), (2, b"\xfe second")], "ins"))
        link.offer("/mavlink/fc", records.encode_raw(1, [(1, b"not asked for")], "fc"))
        link.offer(records.HOST_CLOCK.topic, b"of no interest")
        time.sleep(0.1)
    until(lambda: len(ground.came[0]) == 1810 and len(ground.came[1]) == len(ground.came[2]) == 20)
    link.stop()
    assert link.failure is None
    assert ground.came[0] == sent
    assert ground.came[1] == [b"p" * 512, b"q" * 512] * 10
    assert ground.came[2] == [b"\xfe first", b"\xfe second"] * 10
    assert link.counts == RelayCounts(offered=1850, sent=1850, sent_bytes=sum(len(d) for p in ground.came for d in p))


def test_a_thinned_downlink_sends_whole_packets_of_some_sectors(ground: Ground) -> None:
    link = Relay(ground.config(thin=4))
    link.start()
    for turn in range(8):
        link.offer(records.LIDAR.topic, scan(181, turn * 181))
    until(lambda: link.counts.offered == 1448 and link.counts.sent + link.counts.thinned == 1448)
    link.stop()
    until(lambda: len(ground.came[0]) == link.counts.sent)
    assert balanced(link.counts)
    assert 0.2 < link.counts.sent / 1448 < 0.3
    found = np.frombuffer(b"".join(ground.came[0]), hdl32e.DATA_DTYPE)
    assert found.tobytes() == packets(1448)["data"][found["stamp_us"]].tobytes()


class Paced:
    """Runs a link on a clock of the test's own, which moves only while the link pauses; something is offered every 0.1 s of it."""

    def __init__(self, link: Relay, monkeypatch: pytest.MonkeyPatch, offers: list[tuple[str, bytes]]) -> None:
        self.now_s, self.begin_s = 1000.0, 1000.0
        self._link, self._offers = link, list(reversed(offers))
        monkeypatch.setattr(relay, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        monkeypatch.setattr(link, "pause", self._pause)
        self._due_s = self.now_s
        self._offer()
        link.work()

    @property
    def took_s(self) -> float:
        return self.now_s - self.begin_s

    def _offer(self) -> None:
        if not self._offers:
            self._link._stop_asked.set()
            return
        self._link.offer(*self._offers.pop())
        self._due_s += 0.1

    def _pause(self, seconds: float) -> None:
        self.now_s += seconds
        if self.now_s >= self._due_s:
            self._offer()


def test_the_cap_holds_and_what_is_too_much_is_dropped_oldest_first(
    ground: Ground, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = Relay(ground.config(rate_kbit_s=2000))
    # 15 turns in 1.5 s are 18 Mbit/s
    paced = Paced(link, monkeypatch, [(records.LIDAR.topic, scan(181, turn * 181)) for turn in range(15)])
    until(lambda: len(ground.came[0]) == link.counts.sent)
    assert balanced(link.counts)
    assert link.counts.offered == 15 * 181
    on_the_wire = link.counts.sent_bytes + FRAME * link.counts.sent
    # it uses what it may, but for the first pause and a packet, and no more than what 50 ms of idleness left over
    assert 250_000 * (paced.took_s - 0.05) - 1248 <= on_the_wire <= 250_000 * paced.took_s + 1500 + 1248
    assert link.counts.dropped == 15 * 181 - link.counts.sent
    # what came is of all the time and not only of its beginning, in order, and half a second old at most
    numbers = np.frombuffer(b"".join(ground.came[0]), hdl32e.DATA_DTYPE)["stamp_us"]
    assert (np.diff(numbers.astype(np.int64)) > 0).all()
    assert numbers[-1] >= (15 - 6) * 181


def test_the_cap_counts_what_the_wire_carries_around_each_datagram(
    ground: Ground, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten bytes of MAVLink are 52 on an Ethernet: 64 kbit/s carry 154 of them a second, not 800."""
    link = Relay(ground.config(rate_kbit_s=64))
    message = "/mavlink/ins", records.encode_raw(1, [(1, bytes(10))] * 200, "ins")
    paced = Paced(link, monkeypatch, [message] * 10)
    assert (8000 * (paced.took_s - 0.05)) / 52 - 1 <= link.counts.sent <= (8000 * paced.took_s + 1500) / 52 + 1
    assert balanced(link.counts)


def test_who_offers_never_waits_and_memory_is_bounded_while_the_thread_hangs() -> None:
    link = Relay(DownlinkConfig("127.0.0.1"))  # not started: as if it hung
    data = scan(181)
    for _ in range(200):
        link.offer(records.LIDAR.topic, data)
    assert link._queued_bytes <= relay._QUEUE_BYTES
    assert sum(len(waiting.data) for waiting in link._queue) == link._queued_bytes
    link._stop_asked.set()
    link.start()
    link.stop()
    assert link.counts == RelayCounts(offered=200 * 181, dropped=200 * 181)


def test_a_ground_where_nobody_listens_is_counted_and_no_trouble() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    link = Relay(DownlinkConfig("127.0.0.1", lidar_port=port))
    link.start()
    for turn in range(5):
        link.offer(records.LIDAR.topic, scan(181, turn * 181))
    until(lambda: link.counts.offered == 905 and balanced(link.counts))
    link.stop()
    assert link.failure is None
    assert link.counts.unheard > 0
    assert link.counts.trouble == ""


PROGRAM = """
import subprocess, time
from flightlog import records
from onboard.config import DownlinkConfig
from onboard.relay import Relay

def until(condition):
    end = time.monotonic() + 90
    while not condition():
        assert time.monotonic() < end, link.counts
        time.sleep(0.01)

data = records.encode_raw(1, [(1, b"x")], "velodyne")
link = Relay(DownlinkConfig("127.0.0.1"))
link.start()
link.offer("/velodyne_position", data)
until(lambda: link.counts.dropped == 1)
assert link.counts.trouble == "there is no way to 127.0.0.1 (Network is unreachable)", link.counts
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
until(lambda: (link.offer("/velodyne_position", data), link.counts.sent > 0)[1])
until(lambda: link.counts.trouble == "")
link.stop()
assert link.failure is None
"""


@pytest.mark.root
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: makes a network namespace")
@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare(1)")
def test_a_network_that_is_not_there_is_waited_for() -> None:
    command = ["unshare", "--net", sys.executable, "-c", PROGRAM]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == 0, run.stderr
    assert "there is no way to 127.0.0.1" in run.stderr


def test_an_address_that_is_none_is_a_named_error() -> None:
    with pytest.raises(ConfigError, match="address 'laptop' found, expected one such as"):
        loads("address: laptop", DownlinkConfig, "x.yaml")
    assert loads("address: 10.0.0.255", DownlinkConfig, "x.yaml").ports() == {
        "/velodyne_packets": 2368, "/velodyne_position": 8308, "/mavlink/ins": 14550,
    }  # fmt: skip
