import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from groundproc.flight.importers.tlog import TlogCount, is_plain_mavlink, is_tlog, records

START_US = 1_700_000_000_000_000


def frames(count: int) -> list[bytes]:
    """ATTITUDE frames by another library, MAVLink 1 and 2 in turn."""
    made = []
    for i in range(count):
        sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        message = dialect.MAVLink_attitude_message(100 * i, 0.1, 0.2, 0.3 + i, 0.0, 0.0, 0.0)
        made.append(bytes(message.pack(sender, force_mavlink1=bool(i % 2))))
    return made


def tlog(count: int, *, link: int = 0) -> list[bytes]:
    """Records of a telemetry log, 100 ms apart."""
    return [((START_US + 100_000 * i) & ~3 | link).to_bytes(8, "big") + frame for i, frame in enumerate(frames(count))]


def read(content: bytes) -> tuple[list[tuple[int, bytes]], TlogCount]:
    count = TlogCount()
    return [tuple(record) for record in records(content, count)], count


@pytest.mark.parametrize("link", [0, 1, 2, 3])
def test_the_link_number_in_the_stamp_is_no_time(link: int) -> None:
    found, count = read(b"".join(tlog(4, link=link)))
    assert found == [((START_US + 100_000 * i) * 1000, frame) for i, frame in enumerate(frames(4))]
    assert count == TlogCount(records=4, frames=4)


@pytest.mark.parametrize(
    "name",
    [
        # the longest; its frames are those that pymavlink finds in the quick suite too (flightlog/test_mavlink)
        pytest.param("copter_flight_2015", marks=pytest.mark.soak),
        "ardusub_2023",
        "arducopter313_sim",
    ],
)
def test_frames_and_bad_frames_are_those_that_pymavlink_finds(recordings: Path, name: str) -> None:
    path = recordings / "mavlink" / f"{name}.tlog"
    found, count = read(path.read_bytes())
    log = mavutil.mavlink_connection(str(path), robust_parsing=True)
    theirs, bad = [], 0
    while (message := log.recv_match()) is not None:
        bad += message.get_type() == "BAD_DATA"
        if message.get_type() != "BAD_DATA":
            theirs.append((round(message._timestamp * 1e6), bytes(message.get_msgbuf())))
    log.close()
    assert count.frames == len(theirs)
    assert count.bad_frames == bad + count.cut
    ours = {(time_ns // 1000, data) for time_ns, data in found}
    # their time is a float, and keeps the link number in the two lowest bits
    missing = [(us, data) for us, data in theirs if not {(us // 4 * 4 + d, data) for d in (-4, 0, 4)} & ours]
    assert missing == []


def test_the_copter_flight_has_1314_bad_frames_and_a_torn_one_at_its_end(recordings: Path) -> None:
    _, count = read((recordings / "mavlink/copter_flight_2015.tlog").read_bytes())
    assert (count.records, count.bad_frames, count.cut) == (76_792, 1314 + 1, True)
    assert count.bad_bytes == 1314 * 13 + 11


@given(st.lists(st.tuples(st.integers(0, 30), st.binary(min_size=1, max_size=60)), max_size=4))
def test_garbage_between_records_loses_no_record(garbage: list[tuple[int, bytes]]) -> None:
    parts = tlog(30)
    whole, _ = read(b"".join(parts))
    for place, noise in garbage:
        # a start byte in the noise may claim bytes behind it, and eight bytes with the right beginning are a stamp
        noise = noise.replace(b"\xfe", b"\x00").replace(b"\xfd", b"\x00").replace(b"\x00\x06", b"\x01\x06")
        parts.insert(place, noise)
    found, count = read(b"".join(parts))
    assert {data for _, data in whole} <= {data for _, data in found}
    assert count.frames == 30
    times = [time_ns for time_ns, _ in found]
    assert times == sorted(times)


def test_garbage_inside_records_loses_only_those(recordings: Path) -> None:
    content = (recordings / "mavlink/ardusub_2023.tlog").read_bytes()
    _, clean = read(content)
    chance = random.Random(1)
    parts, size = [], len(content)
    for i in range(20):
        parts += [content[size * i // 20 : size * (i + 1) // 20], chance.randbytes(chance.randrange(1, 400))]
    _, count = read(b"".join(parts))
    assert clean.frames - 20 <= count.frames <= clean.frames
    assert count.bad_bytes >= clean.bad_bytes + sum(map(len, parts[1::2]))


def test_a_log_cut_at_any_byte_keeps_what_is_whole() -> None:
    parts = tlog(4)
    content = b"".join(parts)
    ends = [sum(map(len, parts[: i + 1])) for i in range(4)]
    for size in range(len(content)):
        _, count = read(content[:size])
        assert count.frames == sum(end <= size for end in ends)
        assert count.bad_bytes == 0 or count.frames < 4
        if count.frames:
            assert count.cut == (size not in ends)


@settings(max_examples=200)
@given(st.binary(max_size=300))
def test_any_bytes_are_records_or_counted(content: bytes) -> None:
    found, count = read(content)
    assert sum(len(data) + 8 for _, data in found) + count.dropped_bytes == len(content)


def test_the_three_kinds_are_told_apart_by_content() -> None:
    stamped, plain = b"".join(tlog(5)), b"".join(frames(5))
    assert (is_tlog(stamped), is_plain_mavlink(stamped)) == (True, False)
    assert (is_tlog(plain), is_plain_mavlink(plain)) == (False, True)
    assert (is_tlog(b"# text\n" * 99), is_plain_mavlink(b"# text\n" * 99)) == (False, False)
