from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import mavlink
from flightlog.mavlink import Frame, FrameParser
from flightlog.vehicles import Vehicles

TLOGS = ["arducopter313_sim.tlog", "ardusub_2023.tlog", "copter_flight_2015.tlog"]


class Witness(NamedTuple):
    """What pymavlink's own log reader finds: the stream without its stamps, and the messages it takes for good; and what we do."""

    stream: list[tuple[int, bytes]]
    messages: list[tuple[int, Any]]
    frames: list[Frame]
    """Those that our parser knows of the stream."""


@pytest.fixture(scope="module", params=TLOGS)
def witness(request: pytest.FixtureRequest, recordings: Path) -> Witness:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MAVLINK20", "1")
        from pymavlink import mavutil

        mavutil.set_dialect("ardupilotmega")  # by the environment as it is now, whoever imported it before
    log = mavutil.mavlogfile(str(recordings / "mavlink" / request.param))
    stream, messages = [], []
    while (message := log.recv_msg()) is not None:
        time_ns = round(message._timestamp * 1e6) * 1000
        if message.get_type() == "BAD_DATA":
            stream.append((time_ns, bytes(message.data)))
        else:
            stream.append((time_ns, bytes(message.get_msgbuf())))
            messages.append((time_ns, message))
    log.close()
    return Witness(stream, messages, known(stream))


def parsed(pieces: list[tuple[int, bytes]]) -> list[Frame]:
    parser = FrameParser()
    frames = [frame for time_ns, data in pieces for frame in parser.feed(time_ns, data)] + parser.finish()
    # every byte is accounted for: in a frame or bad
    assert sum(len(frame.data) for frame in frames) + parser.bad_bytes == sum(len(data) for _, data in pieces)
    assert parser.unknown == sum(not frame.known for frame in frames)
    return frames


def known(pieces: list[tuple[int, bytes]]) -> list[Frame]:
    return [frame for frame in parsed(pieces) if frame.known]


# Recordings -----------------------------------------------------------------------------------------------------------


def test_the_frames_of_a_recording_are_those_that_pymavlink_finds(witness: Witness) -> None:
    theirs = [(time_ns, bytes(message.get_msgbuf())) for time_ns, message in witness.messages]
    assert len(theirs) > 25_000
    assert [(frame.time_ns, frame.data) for frame in witness.frames] == theirs


def test_where_the_stream_was_cut_makes_no_difference(witness: Witness) -> None:
    bytes_of = [(time_ns, data[i : i + 1]) for time_ns, data in witness.stream[:3000] for i in range(len(data))]
    assert known(bytes_of) == known(witness.stream[:3000])
    some = witness.stream[: len(witness.stream) // 4]
    for size, pieces, whole in ((1000, some, known(some)), (4093, witness.stream, witness.frames)):
        joined = b"".join(data for _, data in pieces)
        cut = known([(0, joined[i : i + size]) for i in range(0, len(joined), size)])
        assert [frame.data for frame in cut] == [frame.data for frame in whole]


def test_every_field_of_every_message_is_what_pymavlink_reads(witness: Witness) -> None:
    frames = witness.frames
    kinds = {message.get_type() for _, message in witness.messages}
    assert {"ATTITUDE", "GLOBAL_POSITION_INT", "RAW_IMU", "GPS_RAW_INT", "SYSTEM_TIME", "STATUSTEXT"} <= kinds
    for kind in kinds:
        theirs = [(time_ns, message) for time_ns, message in witness.messages if message.get_type() == kind]
        ours = mavlink.table(frames, kind)
        assert ours["host_ns"].tolist() == [time_ns for time_ns, _ in theirs]
        if "system" not in theirs[0][1].get_fieldnames():
            assert ours["system"].tolist() == [message.get_srcSystem() for _, message in theirs]
        for field in theirs[0][1].get_fieldnames():
            column = ours[field]
            if column.dtype.kind == "S":
                texts = [getattr(message, f"_{field}_raw").rstrip(b"\x00") for _, message in theirs]
                assert column.tolist() == texts
            else:
                assert np.array_equal(column, [getattr(message, field) for _, message in theirs], equal_nan=True)


def test_a_frame_decodes_to_pymavlinks_message(witness: Witness) -> None:
    frames = witness.frames
    for frame, (_, theirs) in list(zip(frames, witness.messages, strict=True))[::50]:
        ours = mavlink.decode(frame)
        assert ours is not None
        assert repr(ours.to_dict()) == repr(theirs.to_dict())
        assert (frame.name, frame.message_id) == (theirs.get_type(), theirs.get_msgId())
        assert (frame.system, frame.component) == (theirs.get_srcSystem(), theirs.get_srcComponent())
        assert frame.sequence == theirs.get_seq()


def test_the_autopilot_is_told_from_ground_stations_and_companions(witness: Witness) -> None:
    senders = {
        (message.get_srcSystem(), message.get_srcComponent()): message.autopilot
        for _, message in witness.messages
        if message.get_type() == "HEARTBEAT"
    }
    assert any(autopilot == 8 for autopilot in senders.values()) or len(senders) == 1
    heard = Vehicles()
    for frame in witness.frames:
        heard.hear(frame)
    assert heard.vehicles() == [who for who, what in senders.items() if what != 8]


# Frames made by pymavlink ---------------------------------------------------------------------------------------------


def sender(*, signed: bool = False) -> dialect.MAVLink:
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    if signed:
        link.signing.secret_key = bytes(range(32))
        link.signing.sign_outgoing = True
    return link


ATTITUDE = dialect.MAVLink_attitude_message(1234, 0.125, -0.25, 3.0, 0.5, -0.0625, 2.0)
TEXT = dialect.MAVLink_statustext_message(4, b"EKF2 IMU0 is using GPS")
HEARTBEAT = dialect.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)
MESSAGES = [ATTITUDE, TEXT, HEARTBEAT]
CLEAN = b"".join(message.pack(sender(), force_mavlink1=one) for message in MESSAGES for one in (True, False))
UNKNOWN_2 = bytes((0xFD, 4, 0, 0, 7, 1, 1, 0xA0, 0x86, 0x01)) + b"\x01\x02\x03\x04\xaa\xbb"
"""MAVLink 2, id 100000, which no dialect has."""
FREE_ID = next(number for number in range(256) if number not in dialect.mavlink_map)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: str(message.get_type()))
@pytest.mark.parametrize(("one", "signed"), [(True, False), (False, False), (False, True)])
def test_versions_one_and_two_and_signed_frames_are_read(message: Any, one: bool, signed: bool) -> None:
    data = message.pack(sender(signed=signed), force_mavlink1=one)
    (frame,) = parsed([(5, data)])
    assert (frame.version, frame.known, frame.time_ns, frame.data) == (1 if one else 2, True, 5, data)
    ours = mavlink.decode(frame)
    assert ours is not None
    assert ours.to_dict() == message.to_dict()


@pytest.mark.parametrize("one", [True, False])
def test_a_frame_says_who_sent_it_and_the_table_too(one: bool) -> None:
    link = dialect.MAVLink(None, srcSystem=3, srcComponent=154)
    data = [ATTITUDE.pack(link, force_mavlink1=one), HEARTBEAT.pack(link, force_mavlink1=one)]
    frames = parsed([(7, b"".join(data)), (8, CLEAN)])
    assert [frame.sequence for frame in frames[:2]] == [message[2 if one else 4] for message in data]
    assert [(frame.system, frame.component) for frame in frames[:3]] == [(3, 154), (3, 154), (1, 1)]
    table = mavlink.table(frames, "ATTITUDE")
    assert table["system"].tolist() == [3, 1, 1]
    assert table["component"].tolist() == [154, 1, 1]
    assert table["host_ns"].tolist() == [7, 8, 8]


def test_fields_are_where_the_protocol_puts_them() -> None:
    """In the order of their sizes, the largest first (mavlink.io, packet serialisation)."""
    fields = ("custom_mode", "type", "autopilot", "base_mode", "system_status", "mavlink_version")
    assert [mavlink.field_offset("HEARTBEAT", field) for field in fields] == [0, 4, 5, 6, 7, 8]
    assert mavlink.field_offset("SYSTEM_TIME", "time_boot_ms") == 8
    assert mavlink.field_offset("HEARTBEAT", "time_boot_ms") is None


def test_the_zeros_that_version_two_cuts_off_come_back() -> None:
    silent = dialect.MAVLink_attitude_message(1234, 0, 0, 0, 0, 0, 0)
    data = silent.pack(sender())
    assert len(data) < len(silent.pack(sender(), force_mavlink1=True))
    table = mavlink.table(parsed([(5, data)]), "ATTITUDE")
    assert (table["time_boot_ms"][0], table["yawspeed"][0]) == (1234, 0.0)


def test_a_frame_bears_the_time_of_its_last_byte() -> None:
    data = ATTITUDE.pack(sender())
    (frame,) = parsed([(1, data[:5]), (2, data[5:-1]), (3, data[-1:]), (4, b"")])
    assert frame.time_ns == 3


def test_a_false_start_delays_a_frame_but_does_not_change_its_time() -> None:
    data = ATTITUDE.pack(sender(), force_mavlink1=True)
    frames = parsed([(1, b"\xfe\xff\x00\x01\x01\x1e"), (2, data), (3, data), (4, bytes(300))])
    assert [frame.time_ns for frame in frames] == [2, 3]


def test_frames_behind_a_false_start_are_found_when_the_stream_ends() -> None:
    data = ATTITUDE.pack(sender(), force_mavlink1=True)
    assert [frame.time_ns for frame in parsed([(1, b"\xfe\xff\x00\x01\x01\x1e"), (2, data)])] == [2]


def test_a_frame_outside_the_dialect_is_kept_but_not_believed() -> None:
    frames = parsed([(1, UNKNOWN_2 + CLEAN)])
    assert [frame.known for frame in frames] == [False] + [True] * 6
    assert (frames[0].name, frames[0].data) == ("UNKNOWN_100000", UNKNOWN_2)
    assert mavlink.decode(frames[0]) is None
    alone = FrameParser()
    assert [frame.data for frame in alone.feed(1, UNKNOWN_2)] == [UNKNOWN_2], "it ends with what has arrived"
    assert len(mavlink.table(frames, "ATTITUDE")) == 2


def test_noise_that_looks_like_an_unknown_frame_hides_no_good_one() -> None:
    data = ATTITUDE.pack(sender(), force_mavlink1=True)
    claim = len(data) + 20
    noise = bytes((0xFE, claim - 8, 0, 1, 1, FREE_ID))
    for filler in range(30):  # the good frame inside, at the edge of and across the end of what the noise claims
        stream = noise + bytes(filler) + data + data
        assert [frame.data for frame in known([(0, stream)])] == [data, data]
        assert [frame.data for frame in known([(0, stream[i : i + 1]) for i in range(len(stream))])] == [data, data]
    # it ends where the good one does, and so does the stream
    assert [frame.data for frame in known([(0, bytes((0xFE, len(data) - 2, 0, 1, 1, FREE_ID)) + data)])] == [data]


def test_a_frame_with_an_unknown_incompatibility_flag_is_not_read() -> None:
    data = bytearray(ATTITUDE.pack(sender()))
    data[2] |= 0x02
    assert parsed([(0, bytes(data))]) == []


def test_no_flipped_bit_makes_a_wrong_frame_and_none_but_its_own_is_lost() -> None:
    originals = [frame.data for frame in parsed([(0, CLEAN)])]
    assert len(originals) == 6
    for bit in range(8 * len(CLEAN)):
        damaged = bytearray(CLEAN)
        damaged[bit // 8] ^= 1 << bit % 8
        found = [frame.data for frame in known([(0, bytes(damaged))])]
        assert len(found) == 5
        assert all(data in originals for data in found)


def test_a_megabyte_of_noise_gives_no_more_known_frames_than_the_checksum_lets_through() -> None:
    noise = np.random.default_rng(20261122).bytes(1 << 20)
    # one start byte of version 1 in 256, one checksum in 65536 right: 0.06 expected; more than 2 has a chance of 4e-5
    assert len(known([(0, noise)])) <= 2


pieces_of_stream = st.lists(
    st.sampled_from([message.pack(sender(), force_mavlink1=one) for message in MESSAGES for one in (True, False)])
    | st.just(TEXT.pack(sender(signed=True)))
    | st.just(UNKNOWN_2)
    | st.binary(max_size=20)
    | st.sampled_from(
        [b"\xfe", b"\xfd", b"\xfe\xff", b"\xfd\x20\x00", bytes((0xFE, 0x21, 0, 1, 1, FREE_ID)), b"\xfd\x40\x01"]
    ),
    max_size=12,
)


@given(pieces_of_stream, st.lists(st.integers(1, 60), min_size=1))
def test_however_a_stream_arrives_the_same_known_frames_come_out(parts: list[bytes], sizes: list[int]) -> None:
    stream = b"".join(parts)
    whole = known([(0, stream)])
    cut: list[tuple[int, bytes]] = []
    offset = 0
    while offset < len(stream):
        size = sizes[len(cut) % len(sizes)]
        cut.append((offset, stream[offset : offset + size]))
        offset += size
    frames = known(cut)
    assert [frame.data for frame in frames] == [frame.data for frame in whole]
    end = 0
    for frame in frames:  # each was received with the piece that ends it
        end = stream.index(frame.data, end) + len(frame.data)
        assert frame.time_ns < end <= frame.time_ns + len(dict(cut)[frame.time_ns])


@given(st.binary(max_size=600))
def test_any_bytes_are_frames_or_bad_bytes(data: bytes) -> None:
    parsed([(0, data)])


@pytest.mark.parametrize("number", sorted(dialect.mavlink_map))
def test_the_layout_of_every_message_is_that_of_the_dialect(number: int) -> None:
    kind = dialect.mavlink_map[number]
    dtype = mavlink.payload_dtype(number)
    assert dtype.itemsize == kind.unpacker.size
    assert dtype.names is not None
    assert set(dtype.names) == set(kind.fieldnames)
    assert mavlink.message_id(kind.msgname) == number
    payload = bytes((37 * i + 11) % 128 + 1 for i in range(dtype.itemsize))
    message = sender().decode(bytearray(_framed(number, payload, kind.crc_extra)))
    record = mavlink.table(parsed([(0, _framed(number, payload, kind.crc_extra))]), kind.msgname)[0]
    for field in kind.fieldnames:
        theirs, ours = getattr(message, f"_{field}_raw", getattr(message, field)), record[field]
        assert np.array_equal(ours, np.asarray(theirs, ours.dtype)), field


def _framed(number: int, payload: bytes, crc_extra: int) -> bytes:
    body = bytes((len(payload), 0, 0, 0, 1, 1)) + number.to_bytes(3, "little") + payload
    crc = 0xFFFF  # CRC-16/MCRF4XX bit by bit, as the protocol's guide defines it
    for byte in body + bytes((crc_extra,)):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return b"\xfd" + body + crc.to_bytes(2, "little")


def test_no_frames_give_an_empty_table() -> None:
    table = mavlink.table([], "ATTITUDE")
    assert table.shape == (0,)
    assert table["roll"].dtype == np.float32
