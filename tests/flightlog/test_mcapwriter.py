"""Our writer judged by the mcap library, which shares no code with it, and by disks that fill up."""

import contextlib
import errno
import io
import random
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Statistics

from flightlog.logfile import LogReader
from flightlog.mcapwriter import COMPRESSIONS, McapWriter

Sent = list[tuple[str, int, bytes]]


def messages(count: int = 60) -> Sent:
    dice = random.Random(1)
    sizes = (0, 30, 4095, 4096, 9000)  # on both sides of the size from which a message is not copied
    return [(f"/mavlink/{i % 3}", 10**18 + dice.randrange(10**6), dice.randbytes(sizes[i % 5])) for i in range(count)]


def write(stream: io.BytesIO, sent: Sent, compression: str = "none", chunk_bytes: int = 20_000) -> McapWriter:
    writer = McapWriter(stream, "ros2", "swath-test", chunk_bytes, compression)
    writer.add_metadata("a", {"key": "value", "ü": ""})
    writer.add_attachment("b.bin", "application/octet-stream", b"content")
    schema = writer.add_schema("s", "ros2msg", b"uint8 x\n")
    numbers: dict[str, int] = {}
    for topic, time_ns, data in sent:
        if topic not in numbers:
            numbers[topic] = writer.add_channel(topic, "cdr", schema, {"q": "1"})
        writer.add_message(numbers[topic], time_ns, data)
    return writer


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_the_library_finds_every_message_in_the_file_and_by_its_indexes(compression: str) -> None:
    sent, stream = messages(), io.BytesIO()
    write(stream, sent, compression).finish()
    reader = make_reader(io.BytesIO(stream.getvalue()), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    found = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
    assert sorted(found) == sorted(sent)
    one = [m.data for _, _, m in reader.iter_messages("/mavlink/1", log_time_order=False)]
    assert sorted(one) == sorted(data for topic, _, data in sent if topic == "/mavlink/1")
    assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("a", {"key": "value", "ü": ""})]
    assert [(a.name, a.data) for a in reader.iter_attachments()] == [("b.bin", b"content")]
    times = [time_ns for _, time_ns, _ in sent]
    assert summary.statistics == Statistics(
        attachment_count=1,
        channel_count=3,
        channel_message_counts={1: 20, 2: 20, 3: 20},
        chunk_count=len(summary.chunk_indexes),
        message_count=60,
        message_start_time=min(times),
        message_end_time=max(times),
        metadata_count=1,
        schema_count=1,
    )


def records_of(data: bytes) -> list[tuple[int, bytes, int]]:
    """Opcode, content and place of every record at the top level, by the specification."""
    found, at = [], 8
    while at < len(data) - 8:
        opcode, size = struct.unpack_from("<BQ", data, at)
        found.append((opcode, data[at + 9 : at + 9 + size], at))
        at += 9 + size
    return found


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_every_index_says_what_stands_where(compression: str) -> None:
    """Read by the library, compared with the bytes themselves: a reader may seek by any of them."""
    stream = io.BytesIO()
    write(stream, messages(), compression).finish()
    data = stream.getvalue()
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    records = records_of(data)
    places = {at: (opcode, content) for opcode, content, at in records}
    opcodes = [opcode for opcode, _, _ in records]
    assert opcodes[0] == 1
    assert len(summary.chunk_indexes) == opcodes.count(6) > 5
    for index in summary.chunk_indexes:
        opcode, content = places[index.chunk_start_offset]
        assert (opcode, len(content) + 9) == (6, index.chunk_length)
        start_ns, end_ns, size, crc, name_size = struct.unpack_from("<QQQII", content)
        assert (start_ns, end_ns, size) == (index.message_start_time, index.message_end_time, index.uncompressed_size)
        assert (
            content[32 : 32 + name_size].decode() == index.compression == ("" if compression == "none" else compression)
        )
        assert struct.unpack_from("<Q", content, 32 + name_size) == (index.compressed_size,)
        assert index.compressed_size == len(content) - 40 - name_size
        end = index.chunk_start_offset + index.chunk_length
        after = [at for at in places if end <= at < end + index.message_index_length]
        assert sorted(index.message_index_offsets.values()) == after
        assert sum(9 + len(places[at][1]) for at in after) == index.message_index_length
        for channel, at in index.message_index_offsets.items():
            assert (places[at][0], struct.unpack_from("<H", places[at][1])) == (7, (channel,))
        if compression == "none":
            assert zlib.crc32(content[40:]) == crc
            for at in after:  # each entry is the time of the message at its place in the chunk
                channel, size = struct.unpack_from("<HI", places[at][1])
                entries = struct.unpack_from(f"<{size // 8}Q", places[at][1], 6)
                for time_ns, offset in zip(entries[::2], entries[1::2], strict=True):
                    assert struct.unpack_from("<BxxxxxxxxHxxxxQQ", content, 40 + offset) == (
                        5,
                        channel,
                        time_ns,
                        time_ns,
                    )
    assert [(each.log_time, each.create_time) for each in summary.attachment_indexes] == [(0, 0)]
    (attached,), (named,) = summary.attachment_indexes, summary.metadata_indexes
    assert (places[attached.offset][0], len(places[attached.offset][1]) + 9) == (9, attached.length)
    assert (attached.name, attached.media_type, attached.data_size) == ("b.bin", "application/octet-stream", 7)
    assert (places[named.offset][0], len(places[named.offset][1]) + 9, named.name) == (12, named.length, "a")
    # the groups of the summary, and where each of them is
    footer = records[-1][1]
    summary_start, offsets_start, crc = struct.unpack("<QQI", footer)
    assert crc == zlib.crc32(data[summary_start : len(data) - 12])
    assert opcodes[-1 - opcodes.count(14) :] == [*[14] * 6, 2]
    for opcode, content, at in records:
        if opcode == 14:
            group, start, size = struct.unpack("<BQQ", content)
            inside = [place for place in places if start <= place < start + size]
            assert at >= offsets_start
            assert {places[place][0] for place in inside} == {group}
            assert sum(9 + len(places[place][1]) for place in inside) == size
    assert [opcode for opcode, _, at in records if at >= summary_start and opcode not in (8, 14, 2)] == [
        3,
        4,
        4,
        4,
        11,
        10,
        13,
    ]
    assert places[summary_start][0] == 3
    assert records[opcodes.index(15)][1] == bytes(4)
    assert records[opcodes.index(15)][2] + 13 == summary_start


def test_messages_are_numbered_channel_by_channel() -> None:
    stream = io.BytesIO()
    write(stream, messages()).finish()
    numbers: dict[int, list[int]] = {}
    for _, channel, message in make_reader(io.BytesIO(stream.getvalue())).iter_messages(log_time_order=False):
        numbers.setdefault(channel.id, []).append(message.sequence)
        assert message.publish_time == message.log_time
    assert numbers == {channel: list(range(1, 21)) for channel in (1, 2, 3)}


def test_a_stream_may_take_all_pieces_of_a_record_at_once() -> None:
    class Whole(io.BytesIO):
        def write_pieces(self, pieces: Sequence[bytes]) -> None:
            super().write(b"".join(pieces))

        def write(self, data: object) -> int:  # type: ignore[override]
            raise AssertionError

    whole, plain = Whole(), io.BytesIO()
    write(whole, messages()).finish()
    write(plain, messages()).finish()
    assert whole.getvalue() == plain.getvalue()


def test_a_chunk_is_closed_when_it_is_full_and_an_empty_one_is_none() -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, "ros2", "swath-test", 1_000, "none")
    writer.close_chunk()
    channel = writer.add_channel("/a", "cdr", writer.add_schema("s", "ros2msg", b""), {})
    before = len(stream.getvalue())
    head = len(writer._chunk.content()[0])
    left = 1_000 - head - 31  # a message has 31 bytes about its own: record head 9, channel, sequence and times 22
    writer.add_message(channel, 1, bytes(left - 1))
    assert len(stream.getvalue()) == before, "one byte is missing"
    assert writer.counts == {}
    writer.add_message(channel, 2, b"")
    assert writer.counts == {channel: 2}
    assert len(stream.getvalue()) > before
    assert (writer.start_ns, writer.end_ns) == (1, 2)


class FullDisk(io.BytesIO):
    """Takes so many bytes and no more, half a write included; `room` may grow."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, data: object) -> int:  # type: ignore[override]
        raw = bytes(data)  # type: ignore[call-overload]
        left = self.room - self.tell()
        super().write(raw[: max(0, left)])
        if left < len(raw):
            raise OSError(errno.ENOSPC, "No space left on device")
        return len(raw)


def fill(writer: McapWriter, channel: int, sent: Sent) -> int:
    """Write until the disk is full; gives how many messages were handed over."""
    written = 0
    with contextlib.suppress(OSError):
        for _, time_ns, data in sent:
            written += 1
            writer.add_message(channel, time_ns, data)
        writer.close_chunk()
    return written


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_record_is_whole_in_the_file_or_not_at_all_wherever_the_disk_fills_up(
    compression: str, tmp_path: Path
) -> None:
    sent = messages()
    whole = io.BytesIO()
    write(whole, sent, compression).finish()
    for room in range(3000, len(whole.getvalue()) - 4000, 2903):
        disk = FullDisk(room)
        writer = McapWriter(disk, "ros2", "swath-test", 20_000, compression)
        channel = writer.add_channel("/mavlink/0", "cdr", writer.add_schema("s", "ros2msg", b""), {})
        written = fill(writer, channel, sent)
        assert disk.tell() <= room
        disk.room += 2000  # what was held in reserve
        writer.finish()
        log = tmp_path / "log.mcap"
        log.write_bytes(disk.getvalue())
        with LogReader(log) as reader:
            found = list(reader.messages())
            assert not reader.damage
        assert len(found) + writer.lost == written
        summary = make_reader(io.BytesIO(disk.getvalue()), validate_crcs=True).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(found) == sum(writer.counts.values())


def test_every_chunk_that_a_full_disk_did_not_take_is_counted() -> None:
    disk = FullDisk(1_000)
    writer = McapWriter(disk, "ros2", "swath-test", 20_000, "none")
    channel = writer.add_channel("/a", "cdr", writer.add_schema("s", "ros2msg", b""), {})
    for lost in (2, 4, 6):
        for _ in range(2):
            writer.add_message(channel, 1, bytes(2_000))
        with pytest.raises(OSError, match="No space left"):
            writer.close_chunk()
        assert writer.lost == lost
    disk.room += 10_000
    writer.add_message(channel, 1, bytes(2_000))
    writer.close_chunk()
    assert (writer.counts, writer.lost) == ({channel: 1}, 6)
