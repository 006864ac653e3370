"""Our writer judged by the mcap library, which shares no code with it, and by disks that fill up."""

import contextlib
import errno
import io
import random
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
