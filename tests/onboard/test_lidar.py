"""The lidar's ports with real sockets; what would be recorded is looked at in memory."""

import select
import socket
import time
from collections.abc import Callable

import numpy as np
import pytest
from lidar_stream import Stream, from_address, packet

from flightlog import hdl32e, records
from flightlog.records import LidarAccount
from onboard.config import FovConfig, LidarConfig
from onboard.lidar import LidarPort, PacketFields
from onboard.timesync import LogTime, read_clocks


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 90
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


class Session:
    """A port and what it handed over."""

    def __init__(
        self,
        fov: tuple[float, float] = (0, 0),
        room: Callable[[str], bool] = lambda topic: True,
        poll_ms: int = 20,
    ) -> None:
        self.messages: list[tuple[str, int, bytes]] = []
        self.room = room
        ports = []
        for _ in range(2):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.bind(("127.0.0.1", 0))
                ports.append(sock.getsockname()[1])
        self.data_address, self.position_address = (("127.0.0.1", port) for port in ports)
        config = LidarConfig(
            "127.0.0.1", ports[0], ports[1], poll_ms=poll_ms, receive_buffer_kb=2048, fov=FovConfig(fov[0], fov[1])
        )
        self.handed_over_ns: list[int] = []
        self.log_time = LogTime.start(read_clocks())
        self.port = LidarPort(
            config,
            self.log_time,
            self.put,
            handed_over=lambda: self.handed_over_ns.append(time.monotonic_ns()),
        )

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        del vital
        if self.room(topic):
            self.messages.append((topic, log_time_ns, data))
            return True
        return False

    def send(self, data: list[bytes], position: list[bytes] | None = None) -> None:
        self.port.start()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for i, payload in enumerate(data):
                sender.sendto(payload, self.data_address)
                if i % 100 == 99:
                    time.sleep(0.02)
            for payload in position or []:
                sender.sendto(payload, self.position_address)
        self.settle()
        self.port.stop()
        assert self.port.failure is None

    def settle(self) -> None:
        """Until nothing waits in the sockets any more."""
        sockets = [self.port._data_socket, self.port._position_socket]
        until(lambda: not select.select(sockets, [], [], 0)[0])

    def of(self, topic: str) -> list[tuple[int, bytes]]:
        return [(time_ns, data) for name, time_ns, data in self.messages if name == topic]

    def scans(self) -> np.ndarray:
        found = [records.decode_scan(data) for _, data in self.of(records.LIDAR.topic)]
        return np.concatenate([np.empty(0, records.SCAN_PACKET_DTYPE), *found])

    def account(self) -> LidarAccount:
        accounts = [records.decode_account(data) for _, data in self.of(records.LIDAR_ACCOUNT.topic)]
        names = ["received", "kept", "masked_packets", "masked_blocks", "rejected_length", "rejected_content"]
        names += ["kernel_drops", "queue_drops"]
        return LidarAccount(**{name: sum(getattr(account, name) for account in accounts) for name in names})


def test_every_packet_is_kept_bit_by_bit_with_its_account(
    monterey_data: list[bytes], monterey_position: list[bytes]
) -> None:
    session = Session()
    session.send(monterey_data[:1000], monterey_position[:100])
    assert session.scans()["data"].tobytes() == b"".join(monterey_data[:1000])
    assert session.account() == LidarAccount(received=1000, kept=1000)
    assert [t for t, _ in session.of(records.LIDAR.topic)] == [t for t, _ in session.of(records.LIDAR_ACCOUNT.topic)]
    chunks = [chunk for _, data in session.of(records.POSITION.topic) for _, chunk in records.decode_raw(data)]
    assert chunks == monterey_position[:100]
    times = records.receive_time_ns(session.scans())
    assert (np.diff(times) >= 0).all()
    assert session.log_time.anchor_ns < times[0]
    assert session.port.counts.nmea.startswith("$GPRMC,220632,A,")


def test_what_is_no_data_packet_never_reaches_the_log_and_is_counted_by_reason(
    monterey_data: list[bytes], monterey_position: list[bytes]
) -> None:
    good = monterey_data[:50]
    other_model = good[0][:1205] + b"\x22"
    other_mode = good[0][:1204] + b"\x55\x21"
    no_flag = b"\x00" + good[0][1:]
    bad = [b"", b"x", good[0][:1205], good[0] + b"\x00", bytes(1206), no_flag, other_model, other_model, other_mode]
    session = Session()
    session.send([*bad, *good, *bad], [b"short", monterey_position[0][:511], b"\x01" * 512, *monterey_position[:3]])
    assert session.scans()["data"].tobytes() == b"".join(good)
    assert session.account() == LidarAccount(received=68, kept=50, rejected_length=8, rejected_content=10)
    assert session.port.counts.rejected == {
        "data packet of a wrong length": 8,
        "data packet without block flags": 4,
        "data packet of another sensor: VLP-16": 4,
        "data packet of another sensor: unknown return mode or product 0x21": 2,
        "position packet of a wrong length": 2,
        "position packet with other content": 1,
    }
    assert session.port.counts.position_kept == 3


def test_the_field_of_view_is_applied_and_accounted(monterey_data: list[bytes]) -> None:
    session = Session(fov=(255, 105))
    session.send(monterey_data)
    account = session.account()
    assert account.received == len(monterey_data) == account.kept + account.masked_packets
    kept = session.scans()["data"]
    ranges = kept["blocks"]["returns"]["range"]
    azimuth = kept["blocks"]["azimuth"]
    behind = (azimuth > 10500) & (azimuth < 25500 - 20)
    assert not ranges[behind].any()
    assert 0 < behind.sum() <= account.masked_blocks
    # what lies inside is what was sent
    sent = np.frombuffer(b"".join(monterey_data), kept.dtype)
    inside_sent = sent["blocks"][(sent["blocks"]["azimuth"] <= 10500) | (sent["blocks"]["azimuth"] >= 25500)]
    inside_kept = kept["blocks"][(azimuth <= 10500) | (azimuth >= 25500)]
    assert inside_sent.tobytes() == inside_kept.tobytes()
    last = records.decode_account(session.of(records.LIDAR_ACCOUNT.topic)[-1][1])
    assert (last.fov_start_deg, last.fov_end_deg) == (255.0, 105.0)


def test_what_the_recorder_refuses_is_counted_in_the_account(monterey_data: list[bytes]) -> None:
    session = Session(room=lambda topic: topic != records.LIDAR.topic)
    session.send(monterey_data[:300])
    assert session.account() == LidarAccount(received=300, queue_drops=300)
    assert session.port.counts.queue_drops == 300


def test_a_recorded_vlp16_is_told_by_name_and_never_reaches_the_log(vlp16_data: list[bytes]) -> None:
    session = Session()
    session.send(vlp16_data)
    assert session.of(records.LIDAR.topic) == []
    assert session.account() == LidarAccount(received=len(vlp16_data), rejected_content=len(vlp16_data))
    assert session.port.counts.rejected == {"data packet of another sensor: VLP-16": len(vlp16_data)}
    assert session.port.counts.newest_ns == 0  # no sign of an HDL-32E


def test_an_hdl64e_is_told_by_name_and_never_reaches_the_log(monterey_data: list[bytes]) -> None:
    """Its packets are as long, have no product byte, and flag the blocks of its lower lasers with FF DD."""
    taller = []
    for payload in monterey_data[:40]:
        blocks = bytearray(payload)
        for block in range(1, 12, 2):
            blocks[100 * block : 100 * block + 2] = b"\xff\xdd"
        taller.append(bytes(blocks[:1204]) + b"\x48\x0a")  # status type and value in place of mode and product
    session = Session()
    session.send(taller)
    assert session.of(records.LIDAR.topic) == []
    assert session.port.counts.rejected == {"data packet of another sensor: HDL-64E": 40}
    assert session.port.counts.newest_ns == 0  # no sign of an HDL-32E


def test_a_batch_spans_about_a_tenth_of_a_second(monterey_data: list[bytes]) -> None:
    session = Session()
    session.port.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(500):
            sender.sendto(monterey_data[0], session.data_address)
            time.sleep(0.002)
    session.settle()
    session.port.stop()
    scans = [records.receive_time_ns(records.decode_scan(data)) for _, data in session.of(records.LIDAR.topic)]
    # by the times of the packets themselves, however long it took to send them
    assert 0.07e9 < (scans[-1][-1] - scans[0][0]) / len(scans) < 0.2e9
    assert np.median([times[-1] - times[0] for times in scans]) < 150e6


def test_a_batch_taken_as_it_is_holds_nothing_but_an_hdl32es_packets() -> None:
    slots = np.zeros(3, records.SCAN_PACKET_DTYPE)
    slots["data"]["blocks"]["flag"] = hdl32e.BLOCK_FLAG
    fields = PacketFields(slots)
    for mode in range(256):
        for product in (0, 0x20, 0x21, 0x22, 0xFF, mode):
            slots["data"]["return_mode"], slots["data"]["product"] = mode, product
            assert fields.good(3) == hdl32e.is_data(slots["data"]).all()
    slots["data"]["return_mode"], slots["data"]["product"] = hdl32e.ReturnMode.DUAL, hdl32e.PRODUCT_ID
    slots["data"]["return_mode"][2] = hdl32e.ReturnMode.LAST  # good too, but not alike: these are sorted one by one
    assert fields.good(2)
    assert not fields.good(3)
    slots["data"]["blocks"]["flag"][1, 7] = 0xDDFF
    assert fields.good(1)
    assert not fields.good(2)


def test_few_looks_at_the_socket_make_messages_of_a_tenth_of_a_second_each_with_its_account() -> None:
    session = Session(poll_ms=240)
    session.port.start()
    with from_address("127.0.0.1") as sender:
        stream = Stream(sender, session.data_address)
        time.sleep(3.0)
        stream.stop()
    session.settle()
    session.port.stop()
    scans = session.of(records.LIDAR.topic)
    assert [time_ns for time_ns, _ in scans] == [time_ns for time_ns, _ in session.of(records.LIDAR_ACCOUNT.topic)]
    assert session.account() == LidarAccount(received=stream.sent, kept=stream.sent)
    times = [records.receive_time_ns(records.decode_scan(data)) for _, data in scans]
    assert (np.diff(np.concatenate(times)) >= 0).all()
    assert 0.08e9 < np.median([span[-1] - span[0] for span in times]) < 0.16e9
    # looks become rare when the rate is known: 434 packets from one to the next, more often at the start
    assert len(session.handed_over_ns) < 2 * stream.sent / (0.24 * 1808)


def test_what_comes_after_silence_does_not_wait_for_the_next_look() -> None:
    session = Session(poll_ms=240)
    session.port._poll_s = 3600.0  # who waits for the next look waits for an hour
    session.port.start()
    with from_address("127.0.0.1") as sender:
        for number in range(5):
            known = len(session.messages)
            sender.sendto(packet(number), session.data_address)
            until(lambda known=known: len(session.messages) > known)
            time.sleep(0.3)  # silence
        session.port._stop_asked.set()
        sender.sendto(packet(5), session.data_address)
        session.port.join(90)
    assert session.port.failure is None
    assert len(session.scans()) == 6


@pytest.mark.parametrize("which", ["data_address", "position_address"])
def test_both_ports_are_free_again_after_a_failed_start(which: str) -> None:
    session = Session()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, pytest.raises(OSError, match="in use"):
        sock.bind(getattr(session, which))
    session.port.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(getattr(session, which))
