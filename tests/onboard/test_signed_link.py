"""A link with a key: strangers are recorded, counted, and never believed; and what autopilots of today are asked."""

import socket
from collections import Counter
from pathlib import Path

from linktape import Tape, until
from pymavlink.dialects.v20 import ardupilotmega as dialect
from recording import free_port

from flightlog.mavlink import FrameParser
from onboard import health
from onboard.config import StreamsConfig
from onboard.linkcounts import LinkCounts, note_frames
from onboard.requester import Requester, streams_asked
from onboard.status import LinkStatus
from onboard.voice import Voice

S = 10**9
KEY = bytes(range(1, 33))
NOW = 400_000_000_000
ARMED, DISARMED = 128, 0


def heartbeat(base_mode: int, key: bytes | None, stamp: int, autopilot: int = 3) -> bytes:
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    sender.signing.secret_key, sender.signing.sign_outgoing, sender.signing.timestamp = key, key is not None, stamp
    return bytes(dialect.MAVLink_heartbeat_message(2, autopilot, base_mode, 0, 4, 3).pack(sender))


def test_a_stranger_without_the_key_disarms_nobody(tmp_path: Path) -> None:
    (tmp_path / "key").write_text(KEY.hex())
    port, tape = free_port(), Tape()
    link = tape.link(f"udp:127.0.0.1:{port}", signing_key=str(tmp_path / "key"), request_streams=True)
    link.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        until(lambda: link.counts.connected)
        stranger = [heartbeat(DISARMED, None, 0), heartbeat(DISARMED, bytes(32), NOW + 5)]
        for data in stranger:
            sock.sendto(data, ("127.0.0.1", port))
        until(lambda: sum(link.counts.signatures.values()) == 2)
        assert link.counts.autopilot is None
        own = heartbeat(ARMED, KEY, NOW)
        sock.sendto(own, ("127.0.0.1", port))
        until(lambda: link.counts.autopilot == (1, 1))
        for data in (*stranger, own):  # the last one recorded by somebody, and sent again
            sock.sendto(data, ("127.0.0.1", port))
        until(lambda: sum(link.counts.signatures.values()) == 6)
        assert link.counts.armed(link.counts.newest_ns) is True
        assert link.counts.signatures == {"good": 1, "unsigned": 2, "wrong": 2, "old": 1}
        # what we say is signed, later than what was heard, and the reader with the key believes it
        sock.settimeout(60)
        judge = dialect.MAVLink(None)
        judge.signing.secret_key, judge.signing.timestamp = KEY, NOW
        heard = [judge.decode(bytearray(sock.recv(300))) for _ in range(4)]
        assert heard[0].get_type() == "HEARTBEAT"
        assert all(message.get_signed() for message in heard)
    link.stop()
    # every byte is in the log, believed or not
    assert tape.bytes() == b"".join((*stranger, own, *stranger, own))
    assert KEY.hex().encode() not in tape.bytes()


def test_health_says_what_was_not_believed() -> None:
    silent = LinkStatus(connected=True, signatures={"good": 0, "unsigned": 7, "wrong": 0, "old": 0})
    heard = LinkStatus(connected=True, age_s=0.1, signatures={"good": 9, "unsigned": 0, "wrong": 2, "old": 0})
    assert "signatures: 7 unsigned" in health._judge_link("ins", silent)[0][1]
    assert health._judge_link("ins", heard)[0][1].endswith("by their signatures: 2 wrong")
    assert health._judge_link("ins", LinkStatus(connected=True, age_s=0.1, signatures={"good": 9})) == []


def sent(requester: Requester, counts: LinkCounts, now_ns: int) -> list[dialect.MAVLink_message]:
    return dialect.MAVLink(None).parse_buffer(b"".join(requester.due(counts, now_ns))) or []


def test_autopilots_of_today_are_asked_message_by_message_and_for_their_version() -> None:
    counts = LinkCounts()
    note_frames(counts, FrameParser().feed(1, heartbeat(0, None, 0)))
    requester = Requester(StreamsConfig(50, 5, 10, 50, 0, 2))
    first = sent(requester, counts, 100 * S)
    commands = [m for m in first if m.get_type() == "COMMAND_LONG"]
    assert [m.get_type() for m in first] == ["HEARTBEAT"] + ["COMMAND_LONG"] * 7
    assert (commands[0].command, commands[0].param1) == (dialect.MAV_CMD_REQUEST_MESSAGE, 148)
    assert {m.target_system for m in commands} == {1}
    intervals = {int(m.param1): m.param2 for m in commands if m.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    # microseconds: RAW_IMU, GPS_RAW_INT with SYS_STATUS, GLOBAL_POSITION_INT, ATTITUDE, SYSTEM_TIME
    assert intervals == {27: 20_000, 24: 200_000, 1: 200_000, 33: 100_000, 30: 20_000, 2: 500_000}
    # where that brings nothing, as the old ones want it; then anew
    counts.messages.update(Counter({27: 500, 24: 50, 33: 100, 2: 20}))
    second = [m for m in sent(requester, counts, 110 * S) if m.get_type() != "COMMAND_LONG"]
    assert [(m.get_type(), getattr(m, "req_stream_id", None)) for m in second] == [
        ("HEARTBEAT", None),
        ("REQUEST_DATA_STREAM", 10),
    ]
    counts.messages.update(Counter({27: 500, 24: 50, 33: 100, 2: 20}))
    third = [m for m in sent(requester, counts, 120 * S) if m.get_type() == "COMMAND_LONG"]
    assert [m.command for m in third if m.command != dialect.MAV_CMD_REQUEST_MESSAGE] == [
        dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    ]


def test_the_firmwares_version_is_asked_for_until_it_is_known() -> None:
    counts = LinkCounts()
    note_frames(counts, FrameParser().feed(1, heartbeat(0, None, 0)))
    requester = Requester(StreamsConfig(0, 0, 0, 0, 0, 0))
    assert len(sent(requester, counts, 100 * S)) == 2
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    none = b"\0" * 8
    said = 4 << 24 | 5 << 16 | 7 << 8 | 255
    version = dialect.MAVLink_autopilot_version_message(0, said, 0, 0, 0, none, none, none, 0, 0, 0)
    note_frames(counts, FrameParser().feed(2, bytes(version.pack(sender))))
    assert counts.firmware == "4.5.7"
    assert len(sent(requester, counts, 102 * S)) == 1


def test_px4_is_asked_for_the_imu_that_it_has() -> None:
    counts = LinkCounts()
    note_frames(counts, FrameParser().feed(1, heartbeat(0, None, 0, autopilot=12)))
    assert counts.kind == dialect.MAV_AUTOPILOT_PX4
    requester = Requester(StreamsConfig(50, 0, 0, 0, 0, 0))
    commands = [m for m in sent(requester, counts, 100 * S) if m.get_type() == "COMMAND_LONG"]
    assert [int(m.param1) for m in commands] == [148, 105]
    counts.messages.update({105: 500})
    assert [m.get_type() for m in sent(requester, counts, 110 * S)].count("REQUEST_DATA_STREAM") == 0
    assert counts.achieved_hz == {"HIGHRES_IMU": 50.0}
    assert streams_asked(StreamsConfig(50, 0, 0, 0, 0, 0), dialect.MAV_AUTOPILOT_PX4) == [("HIGHRES_IMU", 105, 50)]


def test_a_voice_without_a_key_signs_nothing_and_version_1_never() -> None:
    message = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    assert Voice().frame(message, 1, 2)[2] == 0
    signed = Voice(KEY)
    signed.sign_from(NOW)
    assert signed.frame(message, 1, 2)[2] == 1
    assert signed.frame(message, 1, 1)[0] == 0xFE
    before = signed.frame(message, 1, 2)
    signed.sign_from(5)  # a clock that fell back does not repeat a time
    after = signed.frame(message, 1, 2)
    assert int.from_bytes(before[-12:-6], "little") < int.from_bytes(after[-12:-6], "little")


def test_what_was_not_signed_does_not_reach_the_ground_either(tmp_path: Path) -> None:
    from flightlog import records
    from flightlog.logfile import LogReader
    from flightlog.logwriter import LogWriter
    from groundproc.flight.load import mavlink_frames

    data = heartbeat(DISARMED, None, 0) + heartbeat(ARMED, KEY, NOW)
    for links, count in (("", 2), ("fc", 2), ("ins,fc", 1)):
        with (tmp_path / "log.mcap").open("wb") as stream:
            writer = LogWriter(stream, metadata={"swath.session": {"signed_links": links}}, attachments={})
            writer.write("/mavlink/ins", S, records.encode_raw(S, [(S, data)], "ins"))
            writer.finish()
        with LogReader(tmp_path / "log.mcap") as log:
            found = list(mavlink_frames([log], "ins"))
        assert len(found) == count
        assert found[-1].payload[6] == ARMED
