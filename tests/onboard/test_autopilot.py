"""MAVLink links on real ptys and sockets, with what a real ArduCopter 3.1.3 sent; pymavlink judges what we send."""

import os
import pty
import select
import socket
import termios
import time
import tty
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from linktape import Tape, until
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import records
from flightlog.mavlink import FrameParser
from onboard.config import StreamsConfig
from onboard.linkcounts import LinkCounts, note_frames
from onboard.requester import Requester
from onboard.timesync import read_clocks

S = 1_000_000_000


def frame(message: dialect.MAVLink_message, component: int = 1, v1: bool = True) -> bytes:
    mavlink = dialect.MAVLink(None, srcSystem=1, srcComponent=component)
    return bytes(message.pack(mavlink, force_mavlink1=v1))


def heartbeat(component: int = 1, autopilot: int = 3, base_mode: int = 0, v1: bool = True) -> bytes:
    return frame(dialect.MAVLink_heartbeat_message(2, autopilot, base_mode, 0, 4, 3), component, v1)


ATTITUDE = frame(dialect.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 0))


@pytest.fixture(scope="module")
def arducopter(recordings: Path) -> list[bytes]:
    """The frames of the tlog, one by one: 8 bytes of time, then a MAVLink 1 frame."""
    raw, frames, offset = (recordings / "mavlink" / "arducopter313_sim.tlog").read_bytes(), [], 0
    while offset + 16 < len(raw):
        size = raw[offset + 9] + 8
        frames.append(raw[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return frames


class Pty:
    """An autopilot's serial port; the daemon opens `device`."""

    def __init__(self, device: Path) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave, termios.TCSANOW)
        device.unlink(missing_ok=True)
        device.symlink_to(os.ttyname(self.slave))
        self.device = device

    def read(self) -> bytes:
        data = b""
        while select.select([self.master], [], [], 0)[0]:
            data += os.read(self.master, 4096)
        return data

    def unplug(self) -> None:
        self.device.unlink(missing_ok=True)
        os.close(self.slave)
        os.close(self.master)


@pytest.fixture
def port(tmp_path: Path) -> Iterator[Pty]:
    opened = Pty(tmp_path / "swath-ins")
    yield opened
    opened.unplug()


def test_serial_bytes_are_kept_as_they_came(port: Pty, arducopter: list[bytes]) -> None:
    tape = Tape()
    link = tape.link(str(port.device))
    link.start()
    until(lambda: link.counts.connected)
    sent = b"noise \xfe\xfd" + b"".join(arducopter[:400])
    for start in range(0, len(sent), 500):  # frames straddle the reads
        os.write(port.master, sent[start : start + 500])
        time.sleep(0.01)
    until(lambda: link.counts.received_bytes == len(sent))
    link.stop()
    assert link.failure is None
    assert tape.bytes() == sent
    assert {topic for topic, _, _ in tape.messages} == {"/mavlink/ins"}
    times = [time_ns for _, _, data in tape.messages for time_ns, _ in records.decode_raw(data)]
    assert times == sorted(times)
    assert tape.log_time.at(read_clocks()) - times[0] < 10 * S
    assert link.counts.autopilot == (1, 1)
    assert link.counts.frames == 400
    assert link.counts.messages[dialect.MAVLINK_MSG_ID_ATTITUDE] > 50
    assert link.counts.bad_bytes == 8


def test_a_serial_autopilot_is_asked_for_its_streams_in_its_own_version(port: Pty) -> None:
    tape = Tape()
    link = tape.link(str(port.device))
    link.start()
    until(lambda: link.counts.connected)
    os.write(port.master, heartbeat())
    answer = b""
    end = time.monotonic() + 60
    while b"\xfe\x06" not in answer and time.monotonic() < end:
        answer += port.read()
        time.sleep(0.02)
    time.sleep(0.1)
    answer += port.read()
    link.stop()
    messages = dialect.MAVLink(None).parse_buffer(answer)
    kinds = [message.get_type() for message in messages]
    assert kinds == ["HEARTBEAT"] + ["REQUEST_DATA_STREAM"] * 6 + ["TIMESYNC"]
    assert {message.get_msgbuf()[0] for message in messages} == {0xFE}  # 3.1.3 is deaf to version 2
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in messages} == {(1, 191)}
    assert (messages[0].type, messages[0].autopilot, messages[0].system_status) == (18, 8, 4)
    assert {(m.req_stream_id, m.req_message_rate) for m in messages[1:7]} == {
        (1, 50), (2, 5), (6, 10), (10, 50), (11, 2), (12, 2),
    }  # fmt: skip
    assert {(m.target_system, m.target_component, m.start_stop) for m in messages[1:7]} == {(1, 1, 1)}


def test_an_unplugged_autopilot_is_taken_up_again_into_the_same_log(tmp_path: Path) -> None:
    tape, first = Tape(), Pty(tmp_path / "swath-ins")
    link = tape.link(str(first.device))
    link.start()
    until(lambda: link.counts.connected)
    os.write(first.master, heartbeat() + ATTITUDE)
    until(lambda: link.counts.received_bytes > 0)
    first.unplug()
    until(lambda: not link.counts.connected and link.counts.trouble != "")
    second = Pty(tmp_path / "swath-ins")
    until(lambda: link.counts.connected)
    os.write(second.master, ATTITUDE)
    until(lambda: link.counts.messages[dialect.MAVLINK_MSG_ID_ATTITUDE] == 2)
    link.stop()
    second.unplug()
    assert link.failure is None
    assert link.counts.opened == 2
    assert tape.bytes() == heartbeat() + ATTITUDE + ATTITUDE


def test_a_device_that_is_not_there_is_one_sentence_and_no_failure(tmp_path: Path) -> None:
    link = Tape().link(str(tmp_path / "nothing"))
    link.start()
    until(lambda: link.counts.trouble != "")
    assert link.counts.trouble == f"serial device {tmp_path}/nothing cannot be opened: No such file or directory"
    before = link.progress_ns
    until(lambda: link.progress_ns > before)  # waiting is no hanging
    link.stop()
    assert link.failure is None


def test_datagrams_are_kept_whole_with_the_kernels_times(
    sender: socket.socket, free_port: int, arducopter: list[bytes]
) -> None:
    tape = Tape()
    link = tape.link(f"udp:127.0.0.1:{free_port}")
    link.start()
    until(lambda: link.counts.connected)
    datagrams = [*arducopter[:100], b"x" * 3000]
    for datagram in datagrams:
        sender.sendto(datagram, ("127.0.0.1", free_port))
    until(lambda: link.counts.received_bytes == sum(map(len, datagrams)))
    link.stop()
    chunks = [chunk for _, _, data in tape.messages for chunk in records.decode_raw(data)]
    assert [data for _, data in chunks] == datagrams
    times = [time_ns for time_ns, _ in chunks]
    assert times == sorted(times)
    assert len(set(times)) > 90
    assert sender.getsockname() is not None
    sender.setblocking(False)
    with pytest.raises(BlockingIOError):  # a shared UDP link is not asked unless told so
        sender.recv(100)


def test_a_udp_autopilot_is_asked_when_told_so(sender: socket.socket, free_port: int) -> None:
    link = Tape().link(f"udp:127.0.0.1:{free_port}", request_streams=True)
    link.start()
    until(lambda: link.counts.connected)
    sender.sendto(heartbeat(v1=False), ("127.0.0.1", free_port))
    sender.settimeout(60)
    assert [sender.recv(300)[0] for _ in range(7)] == [0xFD] * 7
    link.stop()


def test_a_taken_port_is_tried_again_until_it_is_free(free_port: int) -> None:
    link = Tape().link(f"udp:127.0.0.1:{free_port}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", free_port))
        link.start()
        until(lambda: "another program has it" in link.counts.trouble)
    until(lambda: link.counts.connected)
    link.stop()
    assert link.failure is None


def test_the_autopilot_is_who_sends_attitudes_not_who_is_heard_first() -> None:
    counts = LinkCounts()
    stream = heartbeat(component=154, autopilot=8, base_mode=128) + ATTITUDE + heartbeat(base_mode=128) + ATTITUDE
    stream += heartbeat(component=2, autopilot=4)
    note_frames(counts, FrameParser().feed(1, stream))
    assert counts.autopilot == (1, 1)
    assert counts.armed(1) is True
    assert counts.heartbeats == 1
    # known for the autopilot by its first attitude, before its heartbeat
    assert counts.messages == {dialect.MAVLINK_MSG_ID_HEARTBEAT: 1, dialect.MAVLINK_MSG_ID_ATTITUDE: 2}
    note_frames(counts, FrameParser().feed(2, heartbeat(component=154, autopilot=8, base_mode=128) + heartbeat()))
    assert counts.armed(2) is False


def test_frames_of_unknown_ids_are_no_sign_of_life() -> None:
    counts = LinkCounts()
    note_frames(counts, FrameParser().feed(1, heartbeat()))
    unknown = bytes([0xFD, 1, 0, 0, 0, 1, 1, 0xF0, 0xFF, 0x7F, 0, 0x12, 0x34])
    frames = FrameParser().feed(99, unknown)
    assert [f.known for f in frames] == [False]
    note_frames(counts, frames)
    assert (counts.newest_ns, counts.frames) == (1, 1)


def test_only_streams_that_come_too_slowly_are_asked_for_again() -> None:
    counts = LinkCounts()
    note_frames(counts, FrameParser().feed(1, heartbeat()))
    counts.messages.clear()
    requester = Requester(StreamsConfig(50, 0, 10, 50, 0, 2))

    def asked(now_ns: int) -> list[int]:
        messages = dialect.MAVLink(None).parse_buffer(b"".join(requester.due(counts, now_ns))) or []
        return [message.req_stream_id for message in messages if message.get_type() == "REQUEST_DATA_STREAM"]

    assert asked(100 * S) == [1, 6, 10, 12]
    assert requester.due(counts, 100 * S + S // 2) == []
    assert asked(101 * S) == []  # a heartbeat, nothing else
    # ArduCopter 3.1.3 gives 25 Hz for 50 and 8.3 for 10; a ground station has turned the attitude down to 4
    counts.messages.update(Counter({27: 250, 33: 83, 30: 40, 2: 19}))
    assert asked(110 * S) == [10]
    assert asked(119 * S) == []
    assert asked(120 * S) == [1, 6, 10, 12]  # silence


def test_nothing_is_sent_before_an_autopilot_is_heard() -> None:
    assert Requester(StreamsConfig()).due(LinkCounts(), 100 * S) == []
