import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flightlog import records
from flightlog.errors import LogError
from flightlog.hdl32e import DATA_DTYPE, POSITION_DTYPE
from flightlog.records import ClockSync, HostClock, LidarAccount, RecordType, SyncMethod, UtcSource

S = 10**9
Chunks = list[tuple[int, bytes]]


def mcap_ros2_decoder(row: RecordType) -> Callable[[bytes], Any]:
    schema = Schema(1, row.definition.encode(), "ros2msg", row.schema)
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    return decode


def rosbags_decoder(row: RecordType) -> Callable[[bytes], Any]:
    store = get_typestore(Stores.EMPTY)
    first, *rest = row.definition.split("=" * 80 + "\nMSG: ")
    types = get_types_from_msg(first, row.schema)
    for part in rest:
        name, text = part.split("\n", 1)
        types |= get_types_from_msg(text, name.replace("/", "/msg/"))
    store.register(types)
    return lambda data: store.deserialize_cdr(data, row.schema)


WITNESSES = [mcap_ros2_decoder, rosbags_decoder]
witness = pytest.mark.parametrize("decoder_of", WITNESSES, ids=["mcap_ros2", "rosbags"])

times = st.integers(-(2**31) * S, 2**31 * S - 1)
"""All that ROS 2 can say: whole seconds of 32 bits with a sign."""
frame_ids = st.text(st.characters(codec="ascii", exclude_characters="\x00"), max_size=20)
raw_chunks = st.lists(st.tuples(times, st.binary(max_size=40)), max_size=6)
counts = st.integers(0, 2**32 - 1)
accounts = st.builds(LidarAccount, *[counts] * 9, st.floats(0, 360, width=32), st.floats(0, 360, width=32))
int64 = st.integers(-(2**63), 2**63 - 1)
uint32 = st.integers(0, 2**32 - 1)
clock_syncs = st.builds(
    ClockSync, times, st.sampled_from(["ins", "fc", "lidar"]), int64, st.floats(-1e6, 1e6), int64, int64, uint32, uint32,
    st.sampled_from(SyncMethod), st.sampled_from(UtcSource),
)  # fmt: skip
host_clocks = st.builds(HostClock, times, int64, int64, int64, int64)


def stamp_ns(message: Any) -> int:
    stamp = message.stamp if hasattr(message, "stamp") else message.header.stamp
    return int(stamp.sec) * S + int(stamp.nanosec)


def packets_of(count: int, seed: int = 1) -> npt.NDArray[np.void]:
    random = np.random.default_rng(seed)
    packets = np.zeros(count, records.SCAN_PACKET_DTYPE)
    packets["data"] = np.frombuffer(random.bytes(1206 * count), DATA_DTYPE)
    records.set_receive_time_ns(packets, random.integers(0, 2**31 * S, count))
    return packets


# Round trips and witnesses --------------------------------------------------------------------------------------------


@witness
@pytest.mark.parametrize("count", [0, 1, 2, 181])
@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "velodyne"])
def test_a_scan_reads_the_same_everywhere(decoder_of: Any, count: int, frame_id: str) -> None:
    packets = packets_of(count)
    data = records.encode_scan(12 * S + 34, packets, frame_id)
    ours = records.decode_scan(data)
    assert ours.dtype == records.SCAN_PACKET_DTYPE
    for name in ("sec", "nanosec"):
        assert (ours[name] == packets[name]).all()
    assert ours["data"].tobytes() == packets["data"].tobytes()
    theirs = decoder_of(records.LIDAR)(data)
    assert (stamp_ns(theirs), theirs.header.frame_id) == (12 * S + 34, frame_id)
    assert len(theirs.packets) == count
    for i, packet in enumerate(theirs.packets):
        assert stamp_ns(packet) == records.receive_time_ns(packets)[i]
        assert bytes(packet.data) == packets["data"][i].tobytes()


@witness
@given(times, raw_chunks, frame_ids)
def test_a_batch_of_raw_bytes_reads_the_same_everywhere(
    decoder_of: Any, time_ns: int, chunks: Chunks, frame_id: str
) -> None:
    data = records.encode_raw(time_ns, chunks, frame_id)
    assert records.decode_raw(data) == chunks
    theirs = cached(decoder_of, records.MAVLINK)(data)
    assert (stamp_ns(theirs), theirs.header.frame_id) == (time_ns, frame_id)
    assert [(stamp_ns(chunk), bytes(chunk.data)) for chunk in theirs.chunks] == chunks


@witness
@given(times, accounts)
def test_an_account_reads_the_same_everywhere(decoder_of: Any, time_ns: int, account: LidarAccount) -> None:
    data = records.encode_account(time_ns, account)
    assert records.decode_account(data) == account
    theirs = cached(decoder_of, records.LIDAR_ACCOUNT)(data)
    assert stamp_ns(theirs) == time_ns
    assert LidarAccount(*(getattr(theirs, name) for name in LidarAccount.__dataclass_fields__)) == account


@witness
@given(host_clocks)
def test_host_clocks_read_the_same_everywhere(decoder_of: Any, clock: HostClock) -> None:
    data = records.encode_host_clock(clock)
    assert records.decode_host_clock(data) == clock
    theirs = cached(decoder_of, records.HOST_CLOCK)(data)
    values = (theirs.realtime_ns, theirs.monotonic_ns, theirs.boottime_ns, theirs.step_ns)
    assert HostClock(stamp_ns(theirs), *values) == clock


@witness
@given(clock_syncs)
def test_clock_syncs_read_the_same_everywhere(decoder_of: Any, sync: ClockSync) -> None:
    data = records.encode_clock_sync(sync)
    assert records.decode_clock_sync(data) == sync
    theirs = cached(decoder_of, records.CLOCK_SYNC)(data)
    names = list(ClockSync.__dataclass_fields__)[2:]
    assert ClockSync(stamp_ns(theirs), theirs.header.frame_id, *(getattr(theirs, name) for name in names)) == sync


shots = st.tuples(st.floats(width=32), st.floats(0, 255, width=32))
angles = st.floats(-7, 7, width=32)
increments = st.floats(0, 1, width=32)


@witness
@given(times, st.tuples(angles, angles, increments, increments), st.lists(shots, max_size=9))
def test_lines_read_the_same_everywhere(
    decoder_of: Any, time_ns: int, fields: tuple[float, ...], given_shots: list[tuple[float, float]]
) -> None:
    line = np.zeros((), records.line_dtype(len(given_shots)))
    line["time_ns"] = time_ns
    names = ("angle_min", "angle_increment", "time_increment", "scan_time")
    for name, value in zip(names, fields, strict=True):
        line[name] = value
    line["ranges"], line["intensities"] = np.array(given_shots, np.float32).reshape(-1, 2).T
    data = records.encode_line(line)
    ours = records.decode_line(data)
    assert ours.shape == (1,)
    assert ours.tobytes() == line.tobytes()
    theirs = cached(decoder_of, records.LINE_SCAN)(data)
    assert (stamp_ns(theirs), theirs.header.frame_id) == (time_ns, "line_scanner")
    assert tuple(getattr(theirs, name) for name in names) == fields
    assert np.array(theirs.ranges, np.float32).tobytes() == line["ranges"].tobytes()
    assert np.array(theirs.intensities, np.float32).tobytes() == line["intensities"].tobytes()
    last = fields[0] + fields[1] * (len(given_shots) - 1)
    assert theirs.angle_max == pytest.approx(last, abs=1e-5)
    returns = [reach for reach, _ in given_shots if 0.0 < reach < np.inf]
    assert (theirs.range_min, theirs.range_max) == ((min(returns), max(returns)) if returns else (0.0, 0.0))


def test_a_line_is_the_type_that_ros_scanner_drivers_publish() -> None:
    # sensor_msgs/msg/LaserScan: header, seven float32, then ranges and intensities, each with its count
    line = np.zeros((), records.line_dtype(2))
    line["time_ns"], line["angle_min"], line["angle_increment"] = 5 * S + 6, 0.25, 0.5
    line["time_increment"], line["scan_time"] = 0.125, 4.0
    line["ranges"], line["intensities"] = (1.5, 2.5), (7.0, 8.0)
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", 5, 6, 13) + b"line_scanner\x00" + bytes(3)
    body = struct.pack("<7f", 0.25, 0.75, 0.5, 0.125, 4.0, 1.5, 2.5) + struct.pack("<I2fI2f", 2, 1.5, 2.5, 2, 7.0, 8.0)
    assert records.encode_line(line) == head + body


def test_a_line_with_other_numbers_of_ranges_and_intensities_is_refused() -> None:
    line = np.zeros((), records.line_dtype(3))
    data = records.encode_line(line)
    for place, count in ((-16, 2), (-16, 4), (-32, 2)):
        damaged = bytearray(data)
        struct.pack_into("<I", damaged, len(damaged) + place, count)
        with pytest.raises(LogError, match=rf"^/line_scan: {len(data)} bytes, expected \d+ for \d shots$"):
            records.decode_line(bytes(damaged))
    # more behind it is padding, as others may leave it
    assert records.decode_line(data + bytes(3)).tobytes() == line.tobytes()


_CACHE: dict[tuple[Any, str], Callable[[bytes], Any]] = {}


def cached(decoder_of: Any, row: RecordType) -> Callable[[bytes], Any]:
    return _CACHE.setdefault((decoder_of, row.topic), decoder_of(row))


@witness
def test_every_row_of_the_table_is_a_definition_that_others_understand(decoder_of: Any) -> None:
    for row in records.TABLE:
        assert decoder_of(row) is not None


def test_a_scan_is_the_type_that_ros_drivers_publish() -> None:
    # velodyne_msgs/msg/VelodyneScan: Header header, VelodynePacket[] packets; VelodynePacket: time stamp, uint8[1206] data
    data = records.encode_scan(5 * S + 6, packets_of(2), "velodyne")
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", 5, 6, 9) + b"velodyne\x00" + bytes(3) + struct.pack("<I", 2)
    assert data.startswith(head)
    assert len(data) == len(head) + 8 + 1206 + 2 + 8 + 1206
    assert records.encode_scan(5 * S + 6, packets_of(2)) == data


def test_a_batch_of_raw_bytes_is_padded_between_its_chunks_and_not_behind_them() -> None:
    data = records.encode_raw(5 * S + 6, [(1, b"abcde"), (2 * S, b"f")], "ins")
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", 5, 6, 4) + b"ins\x00"
    assert (
        data
        == head
        + struct.pack("<I", 2)
        + struct.pack("<iII", 0, 1, 5)
        + b"abcde"
        + bytes(3)
        + struct.pack("<iII", 2, 0, 1)
        + b"f"
    )


# Bytes ----------------------------------------------------------------------------------------------------------------


def test_receive_times_go_in_and_out_of_packets_unchanged() -> None:
    time_ns = np.array([0, 1, S - 1, S, 2**31 * S - 1], np.int64)
    packets = np.zeros(5, records.SCAN_PACKET_DTYPE)
    records.set_receive_time_ns(packets, time_ns)
    assert (records.receive_time_ns(packets) == time_ns).all()
    assert (packets["nanosec"] < S).all()


def test_a_decoded_scan_is_a_copy_that_may_be_changed() -> None:
    data = records.encode_scan(0, packets_of(3))
    ours = records.decode_scan(data)
    ours["data"]["blocks"]["azimuth"] = 7
    assert records.decode_scan(data)["data"]["blocks"]["azimuth"].max() != 7


def test_a_memory_view_decodes_like_bytes() -> None:
    data = records.encode_scan(0, packets_of(3))
    view = memoryview(b"xyz" + data)[3:]
    assert records.decode_scan(view).tobytes() == records.decode_scan(data).tobytes()
    raw = records.encode_raw(0, [(1, b"abc")], "ins")
    assert records.decode_raw(memoryview(raw)) == [(1, b"abc")]


def test_position_packets_come_as_an_array_and_other_lengths_are_left_out() -> None:
    one, two = bytes(range(256)) * 2, bytes(512)
    data = records.encode_raw(9, [(5, one), (6, b"short"), (7, two)], "velodyne")
    time_ns, packets = records.decode_position(data)
    assert time_ns.tolist() == [5, 7]
    assert packets.tobytes() == one + two
    assert packets["stamp_us"].tolist() == [int.from_bytes(one[198:202], "little"), 0]
    time_ns, packets = records.decode_position(records.encode_raw(9, [], "velodyne"))
    assert (time_ns.shape, packets.shape, packets.dtype) == ((0,), (0,), POSITION_DTYPE)


SAMPLES = {
    "scan": (records.encode_scan(1, packets_of(2)), records.decode_scan),
    "raw": (records.encode_raw(1, [(2, b"abc"), (3, b""), (4, b"defgh")], "ins"), records.decode_raw),
    "position": (records.encode_raw(1, [(2, bytes(512))], "velodyne"), records.decode_position),
    "account": (records.encode_account(1, LidarAccount(5, 4, 1)), records.decode_account),
    "clock sync": (
        records.encode_clock_sync(ClockSync(1, "ins", 2, 3.0, 4, 5, 6, 7, SyncMethod.TIMESYNC)),
        records.decode_clock_sync,
    ),
    "line": (records.encode_line(np.ones((), records.line_dtype(3))), records.decode_line),
    "host clock": (records.encode_host_clock(HostClock(1, 2, 3, 4, 5)), records.decode_host_clock),
}


@pytest.mark.parametrize("name", SAMPLES)
def test_a_record_that_was_cut_anywhere_is_a_log_error(name: str) -> None:
    data, decode = SAMPLES[name]
    for size in range(len(data)):
        with pytest.raises(LogError) as caught:
            decode(data[:size])
        # whose bytes they are, and a number to look for
        assert re.fullmatch(r"(RawBatch|/[a-z_]+): .*\d.*", str(caught.value))


@given(st.sampled_from(sorted(SAMPLES)), st.binary(max_size=80), st.booleans())
def test_any_bytes_are_a_record_or_a_log_error(name: str, data: bytes, sealed: bool) -> None:
    _, decode = SAMPLES[name]
    try:
        decode(b"\x00\x01\x00\x00" + data if sealed else data)
    except LogError:
        return


@given(st.sampled_from(sorted(SAMPLES)), st.data())
def test_a_flipped_bit_gives_a_record_or_a_log_error(name: str, draw: st.DataObject) -> None:
    data, decode = SAMPLES[name]
    bit = draw.draw(st.integers(0, 8 * min(len(data), 400) - 1))
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    try:
        decode(bytes(damaged))
    except LogError:
        return


def test_big_endian_records_are_refused_not_misread() -> None:
    with pytest.raises(LogError, match="encapsulation 00000000, expected little-endian CDR 00010000"):
        records.decode_raw(b"\x00\x00\x00\x00" + bytes(20))


# The table ------------------------------------------------------------------------------------------------------------


def test_a_topic_belongs_to_the_row_of_its_name_or_family() -> None:
    assert records.record_type("/velodyne_packets") is records.LIDAR
    assert records.record_type("/mavlink/ins") is records.MAVLINK
    assert records.record_type("/dataflash/fc") is records.DATAFLASH
    for foreign in ("/velodyne_packets/x", "/mavlink", "velodyne_packets", "", "/imu"):
        assert records.record_type(foreign) is None


def test_every_record_starts_with_a_header_and_says_what_it_is() -> None:
    for row in records.TABLE:
        assert row.definition.startswith("std_msgs/Header header\n")
        assert row.about.endswith(".")
        assert row.schema.split("/")[1] == "msg"


def test_one_schema_name_means_one_definition() -> None:
    assert len({(row.schema, row.definition) for row in records.TABLE}) == len({row.schema for row in records.TABLE})
