import io
import os
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from flightlog import records
from flightlog.errors import LogError
from flightlog.logfile import LogReader, Message
from flightlog.logwriter import LogWriter
from flightlog.records import FORMAT_VERSION, HostClock, LidarAccount

S = 10**9
Read = list[tuple[str, int, bytes]]
METADATA = {"swath.session": {"host": "test", "boot_id": "1"}}
ATTACHMENTS = {
    "config.yaml": b"lidar: {}\n", "mount.yaml": bytes(range(200)), "old.yml": b"", "lasers.bin": b"\x00",
}  # fmt: skip


def messages_of(count: int) -> Read:
    """Messages of every kind; incompressible, so that a byte of the file is a byte of a message."""
    random = np.random.default_rng(7)
    out: Read = []
    for i in range(count):
        time_ns = 1_700_000_000 * S + i * S // 10
        packets = np.zeros(1, records.SCAN_PACKET_DTYPE)
        packets["data"] = np.frombuffer(random.bytes(1206), packets["data"].dtype)
        out += [
            (records.LIDAR.topic, time_ns, records.encode_scan(time_ns, packets)),
            (records.LIDAR_ACCOUNT.topic, time_ns, records.encode_account(time_ns, LidarAccount(1, 1))),
            (records.POSITION.topic, time_ns, records.encode_raw(time_ns, [(time_ns, random.bytes(60))], "velodyne")),
            ("/mavlink/ins", time_ns, records.encode_raw(time_ns, [(time_ns, random.bytes(30))], "ins")),
            ("/dataflash/fc", time_ns, records.encode_raw(time_ns, [(time_ns, random.bytes(30))], "fc")),
            (records.HOST_CLOCK.topic, time_ns, records.encode_host_clock(HostClock(time_ns, 1, 2, 3))),
        ]
    return out


def written(messages: Read, *, flush_each: int = 6, finish: bool = True) -> bytes:
    stream = io.BytesIO()
    writer = LogWriter(stream, metadata=METADATA, attachments=ATTACHMENTS, library="swath-test")
    for i, (topic, time_ns, data) in enumerate(messages):
        writer.write(topic, time_ns, data)
        if i % flush_each == flush_each - 1:
            writer.flush()
    if finish:
        writer.finish()
    return stream.getvalue()


def read(path: Path) -> tuple[Read, LogReader]:
    with LogReader(path) as log:
        return [(topic, time_ns, bytes(data)) for topic, time_ns, data in log.messages()], log


def chunks_of(data: bytes) -> list[tuple[int, int]]:
    """Offset and size of the chunk records, found by walking the records as the specification has them."""
    found, offset = [], 8
    while offset < len(data) - 8:
        opcode, size = struct.unpack_from("<BQ", data, offset)
        if opcode == 6:
            found.append((offset, 9 + size))
        offset += 9 + size
    return found


@pytest.fixture(scope="module")
def messages() -> Read:
    return messages_of(5)


@pytest.fixture(scope="module")
def whole(messages: Read) -> bytes:
    return written(messages)


@pytest.fixture
def log_file(tmp_path: Path) -> Path:
    return tmp_path / "flight.mcap"


_MESSAGES = messages_of(4)
_MIXED = written(_MESSAGES)


# A whole log ----------------------------------------------------------------------------------------------------------


def test_what_is_written_reads_back_in_order(log_file: Path, messages: Read, whole: bytes) -> None:
    log_file.write_bytes(whole)
    ours, log = read(log_file)
    assert ours == messages
    assert not log.damage
    assert (log.start_ns, log.end_ns) == (messages[0][1], messages[-1][1])
    assert log.metadata["swath.session"] == METADATA["swath.session"]
    assert log.metadata["swath.log"] == {"format_version": str(FORMAT_VERSION)}
    assert log.attachments == ATTACHMENTS
    assert log.size == len(whole)


def test_only_the_topics_asked_for_are_given(log_file: Path, messages: Read, whole: bytes) -> None:
    log_file.write_bytes(whole)
    with LogReader(log_file) as log:
        for wanted, prefix in [(("/mavlink/",), "/mavlink/ins"), (("/host_clock",), "/host_clock")]:
            assert [tuple(m) for m in log.messages(wanted)] == [m for m in messages if m[0] == prefix]
        assert list(log.messages(())) == []
        assert list(log.messages(("/mavlink",))) == []


def test_progress_adds_up_to_the_size_of_the_file(log_file: Path, whole: bytes) -> None:
    log_file.write_bytes(whole)
    done: list[int] = []
    with LogReader(log_file) as log:
        list(log.messages(progress=done.append))
        assert sum(done) == log.size
    assert min(done) >= 0


def test_two_readings_at_once_do_not_disturb_each_other(log_file: Path, messages: Read, whole: bytes) -> None:
    log_file.write_bytes(whole)
    with LogReader(log_file) as log:
        pairs = list(zip(log.messages(), log.messages(), strict=True))
    assert [tuple(first) for first, _ in pairs] == messages
    assert all(first == second for first, second in pairs)


def test_progress_is_told_chunk_by_chunk_and_the_rest_at_the_end(log_file: Path, whole: bytes) -> None:
    log_file.write_bytes(whole)
    done: list[int] = []
    with LogReader(log_file) as log:
        for _ in log.messages(("/none",), done.append):
            pass
    ends = [0, *(offset + size for offset, size in chunks_of(whole)), len(whole)]
    assert done == np.diff(ends).tolist()


def test_the_span_of_a_log_is_that_of_its_messages_whatever_their_order(log_file: Path) -> None:
    stream = io.BytesIO()
    writer = LogWriter(stream, metadata={}, attachments={})
    for time_ns in (50, 30, 90, 10, 70):
        writer.write("/mavlink/ins", time_ns, records.encode_raw(time_ns, [], "ins"))
        writer.flush()
    assert writer.span_ns == (10, 90)
    assert writer.counts == {"/mavlink/ins": 5}
    writer.write("/mavlink/ins", 5, records.encode_raw(5, [], "ins"))
    assert writer.counts == {"/mavlink/ins": 5}, "what waits in the open chunk is not in the file"
    writer.finish()
    assert writer.counts == {"/mavlink/ins": 6}
    assert writer.lost == 0
    log_file.write_bytes(stream.getvalue())
    with LogReader(log_file) as log:
        assert (log.start_ns, log.end_ns) == (5, 90)


def test_which_number_means_which_topic_is_said_again_at_flushes_that_are_powers_of_two() -> None:
    stream = io.BytesIO()
    writer = LogWriter(stream, metadata={}, attachments={})
    writer.write("/mavlink/ins", 0, records.encode_raw(0, [], "ins"))
    said = []
    for number in range(1, 18):
        before = stream.getvalue().count(b"swath.topics")
        writer.flush()
        if stream.getvalue().count(b"swath.topics") > before:
            said.append(number)
    assert said == [1, 2, 4, 8, 16]


def test_a_log_of_many_damaged_places_names_the_first_twenty_and_counts_all(log_file: Path) -> None:
    data = bytearray(written(messages_of(5), flush_each=1))
    places = chunks_of(bytes(data))
    assert len(places) == 30
    for offset, size in places:
        data[offset + size - 3] ^= 1
    log_file.write_bytes(data)
    ours, log = read(log_file)
    assert ours == []
    assert (log.damage.count, log.damage.bad_chunks, len(log.damage.places)) == (30, 30, 20)
    assert log.damage.lost_bytes == sum(size for _, size in places)
    assert log.damage.places[19].startswith(f"byte {places[19][0]}: a damaged chunk")
    assert log.damage.reaches == sum(places[-1])


def test_a_topic_outside_the_table_is_refused() -> None:
    writer = LogWriter(io.BytesIO(), metadata={}, attachments={})
    with pytest.raises(LogError, match="topic '/imu' is not in the table of records"):
        writer.write("/imu", 0, b"")


def test_a_log_without_messages_is_a_log(log_file: Path) -> None:
    log_file.write_bytes(written([]))
    ours, log = read(log_file)
    assert ours == []
    assert not log.damage
    assert (log.start_ns, log.end_ns) == (0, 0)
    assert log.attachments == ATTACHMENTS


def test_what_was_flushed_can_be_read_while_the_log_is_open(log_file: Path, messages: Read) -> None:
    with log_file.open("wb") as stream:
        writer = LogWriter(stream, metadata=METADATA, attachments={})
        writer.add_topic("/mavlink/ins")
        writer.flush()
        assert read(log_file)[0] == []
        for i, (topic, time_ns, data) in enumerate(messages):
            writer.write(topic, time_ns, data)
            if i == 9:
                writer.flush()
        ours, log = read(log_file)
        assert ours == messages[:10]
        assert log.damage.truncated


# Outside witnesses ----------------------------------------------------------------------------------------------------


def test_mcap_reads_the_log_by_its_index_and_finds_all_checksums_right(messages: Read, whole: bytes) -> None:
    reader = make_reader(io.BytesIO(whole), validate_crcs=True)
    header, summary = reader.get_header(), reader.get_summary()
    assert (header.profile, header.library) == ("ros2", "swath-test")
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages)
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (
        messages[0][1],
        messages[-1][1],
    )
    theirs = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
    assert sorted(theirs) == sorted(messages)
    assert {(attachment.name, attachment.data) for attachment in reader.iter_attachments()} == set(ATTACHMENTS.items())
    assert {entry.name: entry.metadata for entry in reader.iter_metadata()}["swath.session"] == METADATA[
        "swath.session"
    ]
    kinds = {attachment.name: attachment.media_type for attachment in reader.iter_attachments()}
    assert kinds == {
        "config.yaml": "application/yaml", "mount.yaml": "application/yaml", "old.yml": "application/yaml",
        "lasers.bin": "application/octet-stream",
    }  # fmt: skip
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert summary.schemas[channel.schema_id].encoding == "ros2msg"


def test_mcap_ros2_decodes_every_topic(messages: Read, whole: bytes) -> None:
    reader = make_reader(io.BytesIO(whole), decoder_factories=[DecoderFactory()])
    decoded = [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]
    assert {topic for topic, _ in decoded} == {topic for topic, _, _ in messages}
    first = next(message for topic, message in decoded if topic == records.LIDAR.topic)
    assert bytes(first.packets[0].data) == records.decode_scan(messages[0][2])["data"][0].tobytes()


def test_rosbags_opens_the_log_as_a_ros_2_bag(log_file: Path, messages: Read, whole: bytes) -> None:
    log_file.write_bytes(whole)
    with AnyReader([log_file], default_typestore=get_typestore(Stores.EMPTY)) as bag:
        assert bag.message_count == len(messages)
        assert {c.topic: c.msgtype for c in bag.connections} == {
            topic: row.schema for topic, _, _ in messages if (row := records.record_type(topic))
        }
        theirs = sorted((c.topic, time_ns, bytes(data)) for c, time_ns, data in bag.messages())
        assert theirs == sorted(messages)
        for connection, _, data in bag.messages():
            assert bag.deserialize(data, connection.msgtype) is not None


# Cut, overwritten, flipped --------------------------------------------------------------------------------------------


def test_a_log_cut_at_any_byte_gives_a_prefix_and_says_so(log_file: Path) -> None:
    messages = [message for message in messages_of(3) if message[0] in ("/mavlink/ins", "/host_clock")]
    whole = written(messages, flush_each=2)
    last_chunk_end = sum(chunks_of(whole)[-1])
    log_file.write_bytes(whole)
    least = len(messages)
    for size in range(len(whole) - 1, 7, -1):
        os.truncate(log_file, size)
        ours, log = read(log_file)
        assert log.damage.truncated
        assert len(ours) <= least
        least = len(ours)
        assert ours == messages[:least]
        assert least == len(messages) or size < last_chunk_end
    assert least == 0
    for size in range(8):
        os.truncate(log_file, size)
        with pytest.raises(LogError, match="is no MCAP file"):
            LogReader(log_file)


def test_a_chunk_that_is_complete_is_never_lost_to_a_cut(log_file: Path, messages: Read, whole: bytes) -> None:
    for i, (offset, size) in enumerate(chunks_of(whole)):
        log_file.write_bytes(whole[: offset + size])
        assert read(log_file)[0] == messages[: 6 * (i + 1)]


def test_a_zeroed_hole_costs_the_chunks_that_it_touches_and_no_more(
    log_file: Path, messages: Read, whole: bytes
) -> None:
    chunks = chunks_of(whole)
    for start in range(chunks[1][0] - 200, len(whole) - 300, 97):
        hole = range(start, start + 256)
        log_file.write_bytes(whole[: hole.start] + bytes(len(hole)) + whole[hole.stop :])
        ours, log = read(log_file)
        intact = [not (offset < hole.stop and hole.start < offset + size) for offset, size in chunks]
        assert ours == [message for i, message in enumerate(messages) if intact[i // 6]]
        if not all(intact):
            assert log.damage
            assert log.damage.places


def test_the_first_chunk_may_die_and_the_rest_is_still_told_apart(log_file: Path, messages: Read) -> None:
    for finish in (True, False):
        data = bytearray(written(messages, finish=finish))
        offset, size = chunks_of(bytes(data))[0]
        data[offset : offset + size] = bytes(size)
        log_file.write_bytes(data)
        ours, log = read(log_file)
        assert ours == messages[6:]
        assert log.damage
        assert log.damage.truncated is not finish


def test_the_start_of_a_log_may_die_and_the_rest_is_still_told_apart(log_file: Path, messages: Read) -> None:
    data = bytearray(written(messages, finish=False))
    second = chunks_of(bytes(data))[1][0]
    data[8:second] = bytes(second - 8)
    log_file.write_bytes(data)
    assert read(log_file)[0] == messages[6:]


def test_a_wrong_topic_in_the_summary_or_the_metadata_is_not_believed(log_file: Path, messages: Read) -> None:
    for finish in (True, False):
        data = bytearray(written(messages, finish=finish))
        offset, size = chunks_of(bytes(data))[0]
        place = data.find(b"/mavlink/ins", offset + size) if finish else data.find(b"/mavlink/ins")
        while place >= 0:  # in every copy but that of the first chunk, which is compressed
            data[place + 9] ^= 0x01
            place = data.find(b"/mavlink/ins", place)
        data[offset : offset + size] = bytes(size)
        log_file.write_bytes(data)
        ours, log = read(log_file)
        assert all(message in messages for message in ours)
        assert log.damage


def test_no_flipped_bit_goes_unnoticed_in_a_message_or_raises_but_a_log_error(log_file: Path) -> None:
    messages = messages_of(3)
    data = written(messages)
    chunks = chunks_of(data)
    random = np.random.default_rng(3)
    bits = set(random.integers(0, 8 * len(data), 3000).tolist())
    for offset, size in chunks:  # every bit of a chunk's own head, and of the record after it
        bits |= set(range(8 * offset, 8 * (offset + 49))) | set(range(8 * (offset + size), 8 * (offset + size + 15)))
    bits |= set(range(8 * 8, 8 * 400)) | set(range(8 * (len(data) - 40), 8 * len(data)))
    version = data.index(b"format_version") + len(b"format_version") + 4
    for bit in bits:
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        log_file.write_bytes(damaged)
        try:
            ours, log = read(log_file)
        except LogError:
            assert bit // 8 < 8 or bit // 8 == version
            continue
        lost = [message for message in messages if message not in ours]
        hit = [i for i, (offset, size) in enumerate(chunks) if offset <= bit // 8 < offset + size]
        assert all(message in messages for message in ours)
        assert lost in ([], *(messages[6 * i : 6 * i + 6] for i in hit))
        if lost:
            assert log.damage


def test_damage_is_counted_once_however_often_the_log_is_read(log_file: Path, whole: bytes) -> None:
    data = bytearray(whole)
    for offset, size in chunks_of(whole)[1:3]:
        data[offset + size - 10] ^= 0xFF
    log_file.write_bytes(data)
    with LogReader(log_file) as log:
        next(iter(log.messages()))
        for _ in range(2):
            list(log.messages())
            assert log.damage.bad_chunks == 2
            assert len(log.damage.places) == 2


def test_the_rest_of_a_damaged_log_stays_readable_to_the_last_metadata(log_file: Path, messages: Read) -> None:
    stream = io.BytesIO()
    writer = LogWriter(stream, metadata=METADATA, attachments=ATTACHMENTS)
    for topic, time_ns, data in messages:
        writer.write(topic, time_ns, data)
    writer.flush()
    writer.add_metadata("swath.end", {"reason": "SIGTERM"})
    writer.finish()
    log_file.write_bytes(stream.getvalue())
    assert read(log_file)[1].metadata["swath.end"] == {"reason": "SIGTERM"}


@given(st.data())
def test_any_mixture_of_damage_gives_whole_messages_and_no_error_but_a_log_error(draw: st.DataObject) -> None:
    data = bytearray(_MIXED)
    for _ in range(draw.draw(st.integers(1, 6))):
        place = draw.draw(st.integers(8, len(data) - 1))
        kind = draw.draw(st.sampled_from(["flip", "zero", "insert", "delete", "repeat"]))
        size = draw.draw(st.integers(1, 300))
        if kind == "flip":
            data[place] ^= size % 255 + 1
        elif kind == "zero":
            data[place : place + size] = bytes(len(data[place : place + size]))
        elif kind == "delete":
            del data[place : place + size]
        else:
            data[place:place] = draw.draw(st.binary(max_size=30)) if kind == "insert" else data[place : place + size]
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        try:
            ours, log = read(Path(file.name))
        except LogError:
            return
    assert all(message in _MESSAGES for message in ours)
    if len(ours) < len(_MESSAGES):
        assert log.damage


def test_random_bytes_behind_the_magic_are_a_damaged_log(log_file: Path) -> None:
    random = np.random.default_rng(5)
    for size in (1, 8, 9, 100, 5000):
        log_file.write_bytes(b"\x89MCAP0\r\n" + random.bytes(size))
        ours, log = read(log_file)
        assert ours == []
        assert log.damage.truncated
        assert log.damage.lost_bytes > 0


# Other files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is no MCAP file"),
        (b"hello, world\n", "is no MCAP file"),
        (b"\xd4\xc3\xb2\xa1" + bytes(100), "is no MCAP file"),
        (b"\x89MCAP1\r\n" + bytes(100), "is no MCAP file"),
    ],
)
def test_another_file_is_refused_in_one_sentence(log_file: Path, content: bytes, words: str) -> None:
    log_file.write_bytes(content)
    with pytest.raises(LogError, match=words) as caught:
        LogReader(log_file)
    assert str(caught.value).startswith(str(log_file))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.mcap: cannot be opened \(No such file or directory\)$"):
        LogReader(tmp_path / "none.mcap")
    with pytest.raises(LogError, match=r"cannot be opened \(Is a directory\)$"):
        LogReader(tmp_path)


def foreign(path: Path, compression: CompressionType, *, chunking: bool = True, crcs: bool = True) -> None:
    """A ROS 2 bag as others write it, with a topic that we know and one that we do not."""
    with path.open("wb") as stream:
        writer = Writer(
            stream, chunk_size=200, compression=compression, use_chunking=chunking, enable_crcs=crcs,
            index_types=IndexType.NONE, repeat_channels=False, repeat_schemas=False, use_statistics=False,
        )  # fmt: skip
        writer.start(profile="ros2", library="other")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        for topic in ("/chatter", "/velodyne_packets"):
            channel = writer.register_channel(topic, "cdr", schema)
            for i in range(20):
                writer.add_message(channel, i, b"\x00\x01\x00\x00" + bytes(20), i)
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("crcs", [True, False])
def test_a_bag_of_another_program_is_read_too(log_file: Path, compression: CompressionType, crcs: bool) -> None:
    foreign(log_file, compression, crcs=crcs)
    ours, log = read(log_file)
    assert not log.damage
    assert [topic for topic, _, _ in ours] == ["/chatter"] * 20 + ["/velodyne_packets"] * 20
    assert log.metadata == {}


def test_a_chunk_without_checksum_whose_records_do_not_add_up_is_damage(log_file: Path) -> None:
    foreign(log_file, CompressionType.NONE, crcs=False)
    data = bytearray(log_file.read_bytes())
    offset = chunks_of(bytes(data))[2][0] + 9 + 28 + 4 + 8  # the first record in an unpacked chunk
    opcode, size = struct.unpack_from("<BQ", data, offset)
    assert opcode == 5
    struct.pack_into("<Q", data, offset + 1, size + 10_000)
    log_file.write_bytes(data)
    ours, log = read(log_file)
    assert 0 < len(ours) < 40
    assert all(len(message[2]) == 24 for message in ours)
    assert log.damage.bad_chunks == 1


def test_a_bag_without_chunks_is_refused_and_not_taken_for_empty(log_file: Path) -> None:
    foreign(log_file, CompressionType.NONE, chunking=False)
    whole = log_file.read_bytes()
    for behind in (0, 30):  # whatever stands behind them
        log_file.write_bytes(whole[: len(whole) - 37] + b"\xff" * behind)
        with pytest.raises(LogError, match="messages outside of chunks"):
            LogReader(log_file)


def test_a_log_of_a_newer_format_is_refused(log_file: Path) -> None:
    with log_file.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "swath")
        writer.add_metadata("swath.log", {"format_version": str(FORMAT_VERSION + 1)})
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(
        LogError, match=f"is of log format {FORMAT_VERSION + 1}, this program reads up to {FORMAT_VERSION}"
    ):
        LogReader(log_file)


def test_a_chunk_that_claims_to_unpack_to_gigabytes_is_damage_not_memory(log_file: Path) -> None:
    for compression, packed in (("zstd", _zstd_bomb()), ("lz4", _lz4_bomb())):
        stream = io.BytesIO()
        Writer(stream).start("ros2", "x")
        body = struct.pack("<QQQI", 0, 0, 100, 0) + struct.pack("<I", len(compression)) + compression.encode()
        body += struct.pack("<Q", len(packed)) + packed
        log_file.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body)
        ours, log = read(log_file)
        assert ours == []
        assert log.damage.bad_chunks == 1


def _zstd_bomb() -> bytes:
    # RFC 8878: magic, single segment with an 8-byte content size of 1 TiB, last block: 1 GiB of one byte
    return b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 40) + b"\x03\x00\x00\x00"


def _lz4_bomb() -> bytes:
    return bytes(lz4.frame.compress(bytes(1 << 26)))


# Memory ---------------------------------------------------------------------------------------------------------------

_MEASURE = """
import resource, sys
from flightlog.logfile import LogReader
def peak_mb(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
with LogReader(sys.argv[1]) as log:
    before = peak_mb()
    count = sum(len(message.data) for message in log.messages())
print(count, peak_mb() - before)
"""


def test_reading_takes_a_few_chunks_of_memory_however_long_the_log(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    path, size, count = tmp_path / "long.mcap", 220_000, 300
    with path.open("wb") as stream:
        writer = LogWriter(stream, metadata={}, attachments={})
        for i in range(count):
            writer.write("/mavlink/ins", i, records.encode_raw(i, [(i, random.bytes(size))], "ins"))
        writer.finish()
    assert path.stat().st_size > size * count
    done = subprocess.run([sys.executable, "-c", _MEASURE, str(path)], capture_output=True, text=True, check=True)
    total, growth_mb = done.stdout.split()
    assert int(total) > size * count
    # one chunk of 1 MiB packed and unpacked, twice over while the next is opened, and the decompressor's own window
    assert float(growth_mb) < 16


def test_the_chunks_of_a_log_are_checked_as_the_specification_says(whole: bytes) -> None:
    found = [
        record for record in StreamReader(io.BytesIO(whole), emit_chunks=True).records if isinstance(record, Chunk)
    ]
    assert len(found) == len(chunks_of(whole))
    assert all(chunk.uncompressed_crc for chunk in found)
    assert zlib.crc32(b"") == 0


def test_a_message_is_a_topic_a_time_and_bytes() -> None:
    assert Message("/a", 1, memoryview(b"x")) == ("/a", 1, memoryview(b"x"))
