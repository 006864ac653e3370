"""What is found of a damaged file, place by place: how many damaged places, where, and how many bytes."""

import io
import struct
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from flightlog import records, walk
from flightlog.logfile import LogReader
from flightlog.logwriter import LogWriter
from flightlog.walk import ChunkAt, Hole, Walk

CHUNKS = 5


def log(*, finish: bool = True) -> bytes:
    """A chunk for each of five flushes, incompressible enough to be told apart."""
    stream = io.BytesIO()
    writer = LogWriter(stream, metadata={"a": {"b": "c"}}, attachments={"x.yaml": b"y"}, compression="none")
    for i in range(CHUNKS):
        for k in range(3):
            content = bytes((i * 7 + k * 11 + j) % 251 for j in range(40 + i))
            writer.write("/mavlink/ins", 10 * i + k, records.encode_raw(10 * i + k, [(i, content)], "ins"))
        writer.flush()
    if finish:
        writer.finish()
    return stream.getvalue()


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where the chunks are, by the library's reader."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    return [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in summary.chunk_indexes]


def walked(data: bytes) -> list[walk.Found]:
    return list(Walk(io.BytesIO(data), len(data)))


def holes(data: bytes) -> list[Hole]:
    return [found for found in walked(data) if isinstance(found, Hole)]


def of_chunks(data: bytes) -> list[ChunkAt]:
    return [found for found in walked(data) if isinstance(found, ChunkAt)]


def zeroed(data: bytes, start: int, size: int) -> bytes:
    return data[:start] + bytes(size) + data[start + size :]


@pytest.fixture(params=[1 << 20, 61], ids=["one window", "many windows"])
def window(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """How much is searched and summed at a time makes no difference."""
    monkeypatch.setattr(walk, "_WINDOW", request.param)
    return int(request.param)


def test_a_whole_file_has_no_hole_and_its_chunks_are_where_the_index_has_them(window: int) -> None:
    data = log()
    assert holes(data) == []
    assert [(found.offset, found.size) for found in of_chunks(data)] == chunks(data)
    assert [(found.start_ns, found.end_ns) for found in of_chunks(data)] == [
        (10 * i, 10 * i + 2) for i in range(CHUNKS)
    ]
    assert Walk(io.BytesIO(data), len(data)).finished
    cut = log(finish=False)
    assert not Walk(io.BytesIO(cut), len(cut)).finished
    assert holes(cut) == []


def test_a_hole_reaches_to_the_next_chunk_whose_checksum_holds(window: int) -> None:
    data = log()
    places = chunks(data)
    following = places[3][0]
    damaged = bytearray(zeroed(data, places[1][0], 9))  # the head of the second: nobody knows where it ends
    damaged[places[2][0] + places[2][1] - 5] ^= 1  # a bit in the third
    (hole,) = holes(bytes(damaged))
    assert (hole.offset, hole.size) == (places[1][0], following - places[1][0])
    assert not hole.looks_loose
    assert [found.offset for found in of_chunks(bytes(damaged))] == [places[k][0] for k in (0, 3, 4)]


def test_where_no_good_chunk_follows_the_summary_does(window: int) -> None:
    data = log()
    places = chunks(data)
    last = places[4][0]
    # the head of the last chunk and everything up to the end of the data
    end = data.index(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00", last) + 13
    (hole,) = holes(zeroed(data, last, end - last))
    assert (hole.offset, hole.size) == (last, end - last)
    # and the summary tells of the channel again
    with_channels = walked(zeroed(data, last, end - last))
    assert sum(type(found).__name__ == "Channel" for found in with_channels) == 1


def test_a_record_whose_content_is_damaged_costs_that_record_alone(window: int) -> None:
    data = log()
    place = data.index(b"\x0c", 8)  # metadata, before the first chunk
    damaged = bytearray(data)
    damaged[place + 9] ^= 0x40  # the length of its name
    (hole,) = holes(bytes(damaged))
    assert (hole.offset, hole.size) == (place, 9 + int.from_bytes(data[place + 1 : place + 9], "little"))
    assert len(of_chunks(bytes(damaged))) == CHUNKS
    kinds = [type(found).__name__ for found in walked(bytes(damaged))]
    assert (kinds[:3], kinds.count("Attachment")) == (["Hole", "Metadata", "Attachment"], 1)


def test_a_summary_that_does_not_add_up_is_not_believed_and_told_once(window: int) -> None:
    data = log()
    end = len(data) - 37  # of the summary: before the footer and the magic
    damaged = bytearray(data)
    damaged[data.rindex(b"/mavlink/ins")] ^= 1
    found = walked(bytes(damaged))
    assert [hole for hole in found if isinstance(hole, Hole)] == [Hole(end, 37, False)]
    assert not any(type(each).__name__ == "Channel" for each in found), "the channel of the summary may be a wrong one"


def test_a_summary_without_a_checksum_is_believed() -> None:
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, enable_crcs=False)
    writer.start("ros2", "other")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
    writer.add_message(writer.register_channel("/a", "cdr", schema), 1, bytes(8), 1)
    writer.finish()  # type: ignore[no-untyped-call]
    found = walked(stream.getvalue())
    assert not any(isinstance(each, Hole) for each in found)
    assert sum(type(each).__name__ == "Channel" for each in found) == 1


def test_a_damaged_record_at_the_head_of_a_summary_without_checksum_costs_what_follows_it_up_to_the_next() -> None:
    data = bytearray(log())
    start, _, _ = struct.unpack_from("<QQI", data, len(data) - 28)
    struct.pack_into("<I", data, len(data) - 12, 0)  # no checksum
    data[start] = 0xFE  # an opcode that there is not
    found = walked(bytes(data))
    assert [hole.offset for hole in found if isinstance(hole, Hole)] == [start]
    assert sum(type(each).__name__ == "Channel" for each in found) == 1
    data[start + 1 : start + 9] = b"\xff" * 8  # and nobody knows where it ends
    assert holes(bytes(data)) == [Hole(start, len(data) - 37 - start, False)]


def test_garbage_of_any_length_ends_where_the_next_chunk_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever in a window that is, and across the end of one."""
    monkeypatch.setattr(walk, "_WINDOW", 61)
    data = log()
    second = chunks(data)[1][0]
    for size in range(1, 130):
        assert holes(data[:second] + b"\xff" * size + data[second:])[0] == Hole(second, size, False)


def test_records_of_the_summary_within_the_data_are_damage() -> None:
    data = log()
    second = chunks(data)[1][0]
    statistics = data.rindex(b"\x0b" + (56).to_bytes(8, "little"))  # of one channel
    inserted = data[:second] + data[statistics : statistics + 65] + data[second:]
    assert holes(inserted)[0] == Hole(second, 65, False)
    assert len(of_chunks(inserted)) == CHUNKS


def test_a_message_outside_of_chunks_is_told_from_other_damage() -> None:
    data = log()
    second = chunks(data)[1][0]
    loose = b"\x05" + (22).to_bytes(8, "little") + bytes(22)
    assert holes(data[:second] + loose + data[second:])[0] == Hole(second, len(loose), True)


def test_the_reader_tells_each_place_once_and_where_the_last_one_ends(tmp_path: Path) -> None:
    data = log()
    places = chunks(data)
    damaged = bytearray(zeroed(data, places[1][0], 9))
    damaged[places[3][0] + places[3][1] - 5] ^= 1
    (tmp_path / "a.mcap").write_bytes(damaged)
    with LogReader(tmp_path / "a.mcap") as reader:
        assert len(list(reader.messages())) == 9
        damage = reader.damage
    hole = places[2][0] - places[1][0]
    assert (damage.truncated, damage.bad_chunks, damage.count) == (False, 1, 2)
    assert damage.lost_bytes == hole + places[3][1]
    assert damage.reaches == sum(places[3])
    assert damage.places == [
        f"byte {places[1][0]}: no valid record, {hole} bytes lost",
        f"byte {places[3][0]}: a damaged chunk (a wrong checksum), {places[3][1]} bytes lost",
    ]
