"""Single records: those that the mcap library writes are read, and any that does not add up is damage."""

import struct
import zlib

import lz4.frame
import mcap.records as theirs
import pytest
import zstandard
from mcap.data_stream import RecordBuilder

from flightlog import container
from flightlog.container import DAMAGE, MAGIC, RECORD_HEAD, Opcode, RecordError


def written(record: theirs.McapRecord) -> tuple[int, bytes]:
    """Opcode and content, by the library."""
    builder = RecordBuilder()
    record.write(builder)
    whole = builder.end()
    opcode, size = RECORD_HEAD.unpack_from(whole)
    assert len(whole) == RECORD_HEAD.size + size
    return opcode, whole[RECORD_HEAD.size :]


RECORDS: dict[str, tuple[theirs.McapRecord, object]] = {
    "header": (theirs.Header(profile="ros2", library="ü"), Opcode.HEADER),
    "schema": (theirs.Schema(id=3, data=b"uint8 x\n", encoding="ros2msg", name="a/msg/B"), Opcode.SCHEMA),
    "channel": (
        theirs.Channel(id=40_000, topic="/ä", message_encoding="cdr", metadata={"a": "b", "": "c"}, schema_id=3),
        container.Channel(40_000, "/ä"),
    ),
    "metadata": (
        theirs.Metadata(name="n", metadata={"ä": "ö", "k": ""}),
        container.Metadata("n", {"ä": "ö", "k": ""}),
    ),
    "attachment": (
        theirs.Attachment(create_time=1, log_time=2, name="x.yaml", media_type="text", data=b"content"),
        container.Attachment("x.yaml", b"content"),
    ),
    "data end": (theirs.DataEnd(data_section_crc=7), Opcode.DATA_END),
}


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_of_the_library_is_read(name: str) -> None:
    record, expected = RECORDS[name]
    assert container.parse(*written(record)) == expected


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_that_is_longer_or_shorter_than_its_parts_is_damage(name: str) -> None:
    opcode, content = written(RECORDS[name][0])
    for size in range(len(content)):
        with pytest.raises(DAMAGE):
            container.parse(opcode, content[:size])
    with pytest.raises(
        DAMAGE, match=rf"^a record of {len(content) + 1} bytes with {len(content)} bytes in it$|checksum"
    ):
        container.parse(opcode, content + b"\x00")


def test_an_attachment_is_checked_unless_it_has_no_checksum() -> None:
    opcode, content = written(RECORDS["attachment"][0])
    place = content.index(b"content")
    damaged = content[:place] + b"C" + content[place + 1 :]
    with pytest.raises(RecordError, match="a wrong checksum"):
        container.parse(opcode, damaged)
    assert container.parse(opcode, damaged[:-4] + bytes(4)) == container.Attachment("x.yaml", b"Content")


@pytest.mark.parametrize("opcode", [0, Opcode.FOOTER, Opcode.MESSAGE, Opcode.CHUNK, 0x10, 0xFF])
def test_what_stands_nowhere_by_itself_is_damage(opcode: int) -> None:
    with pytest.raises(RecordError, match=f"opcode {int(opcode)}"):
        container.parse(opcode, b"")


def test_a_text_that_says_it_is_longer_than_its_record_is_damage() -> None:
    for size in (4, 5, 2**32 - 1):
        with pytest.raises(RecordError, match="a text that runs out of its record"):
            container.parse(Opcode.METADATA, struct.pack("<I", size) + b"abc")


def test_a_map_ends_where_it_says() -> None:
    pair = struct.pack("<I1sI1s", 1, b"k", 1, b"v")
    name = struct.pack("<I", 0)
    assert container.parse(Opcode.METADATA, name + struct.pack("<I", 10) + pair) == ("", {"k": "v"})
    for size in (1, 9):
        with pytest.raises(RecordError, match="a map that runs out of its size"):
            container.parse(Opcode.METADATA, name + struct.pack("<I", size) + pair)


# Chunks ------------------------------------------------------------------------------------------------------------------

PLAIN = bytes(range(256)) * 40


def chunk(compression: str, packed: bytes, size: int, crc: int) -> bytes:
    record = theirs.Chunk(
        compression=compression, data=packed, message_start_time=5, message_end_time=9, uncompressed_crc=crc, uncompressed_size=size,
    )  # fmt: skip
    return written(record)[1]


PACKED = {
    "": PLAIN,
    "lz4": bytes(lz4.frame.compress(PLAIN)),
    "zstd": zstandard.ZstdCompressor().compress(PLAIN),
}


@pytest.mark.parametrize("compression", PACKED)
def test_a_chunk_of_the_library_is_opened(compression: str) -> None:
    packed = PACKED[compression]
    content = chunk(compression, packed, len(PLAIN), zlib.crc32(PLAIN))
    head = container.chunk_head(content[: container.CHUNK_HEAD_BYTES], len(content))
    assert head == (5, 9, len(PLAIN), zlib.crc32(PLAIN), compression, len(content) - len(packed), len(packed))
    assert container.open_chunk(content) == PLAIN
    assert container.open_chunk(chunk(compression, packed, len(PLAIN), 0)) == PLAIN, "a checksum of 0 is none"


@pytest.mark.parametrize("compression", PACKED)
def test_a_chunk_with_another_checksum_or_size_is_damage(compression: str) -> None:
    packed = PACKED[compression]
    with pytest.raises(RecordError, match="a wrong checksum"):
        container.open_chunk(chunk(compression, packed, len(PLAIN), zlib.crc32(PLAIN) ^ 1))
    for wrong in (-1, 1):
        with pytest.raises(DAMAGE):
            container.open_chunk(chunk(compression, packed, len(PLAIN) + wrong, 0))
        content = chunk(compression, packed, len(PLAIN), 0)
        with pytest.raises(RecordError, match="a chunk whose parts do not fit together"):
            container.chunk_head(content[: container.CHUNK_HEAD_BYTES], len(content) + wrong)


def test_a_zstd_frame_that_states_no_size_is_opened_and_one_that_states_another_is_not() -> None:
    """A frame gets the memory that it states."""
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(PLAIN)
    assert container.open_chunk(chunk("zstd", packed, len(PLAIN), 0)) == PLAIN
    with pytest.raises(RecordError, match="a chunk with two different sizes"):
        container.open_chunk(chunk("zstd", PACKED["zstd"], len(PLAIN) + 1, 0))


def test_a_chunk_may_unpack_to_64_mib_and_not_to_a_byte_more() -> None:
    content = chunk("", b"", 64 << 20, 0)
    assert container.chunk_head(content, len(content)).size == 64 << 20
    for wrong in (chunk("", b"", (64 << 20) + 1, 0), chunk("gzip", b"", 0, 0)):
        with pytest.raises(RecordError, match="a chunk whose parts do not fit together"):
            container.chunk_head(wrong, len(wrong))


# Indexes and footer -------------------------------------------------------------------------------------------------------


def test_a_message_index_fills_its_record_with_whole_entries() -> None:
    opcode, content = written(theirs.MessageIndex(channel_id=1, records=[(5, 6), (7, 8)]))
    assert opcode == Opcode.MESSAGE_INDEX
    container.check_message_index(content[:6], len(content))
    container.check_message_index(content, len(content))
    for size in (len(content) - 1, len(content) + 1, len(content) + 16):
        with pytest.raises(RecordError, match="an index whose parts do not fit together"):
            container.check_message_index(content[:6], size)
    with pytest.raises(RecordError):
        container.check_message_index(struct.pack("<HI", 1, 8), 14)
    with pytest.raises(DAMAGE):
        container.check_message_index(content[:5], len(content))


def test_a_footer_is_38_bytes_at_the_very_end() -> None:
    opcode, content = written(theirs.Footer(summary_start=1000, summary_offset_start=2000, summary_crc=77))
    tail = RECORD_HEAD.pack(opcode, len(content)) + content + MAGIC
    assert container.footer(tail) == (1000, 77)
    assert container.footer(tail[1:]) is None
    assert container.footer(b"\x00" + tail) is None
    for place in (0, 1, len(tail) - 1, len(tail) - 8):
        damaged = bytearray(tail)
        damaged[place] ^= 1
        assert container.footer(bytes(damaged)) is None
