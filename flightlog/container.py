"""MCAP records as bytes (mcap.dev/spec): what a reader needs, and how to tell a whole record from a damaged one. Pure.

Only chunks and attachments have a checksum of their own. All other records are checked by their lengths: a record
whose parts do not add up to its size is damaged. One wrong bit in a length or an opcode therefore cannot make a
reader skip good chunks.
"""

import re
import struct
import zlib
from enum import IntEnum
from typing import Final, NamedTuple

import lz4.frame
import zstandard

MAGIC: Final = b"\x89MCAP0\r\n"
RECORD_HEAD: Final = struct.Struct("<BQ")
"""Opcode and size of what follows."""
LARGEST_CHUNK: Final = 64 * 2**20
"""Bytes, unpacked; a chunk that claims more is damaged. Ours have 1.5 MiB, those of other writers some MiB."""


class Opcode(IntEnum):
    """What a record is."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


SUMMARY_ONLY: Final = frozenset(
    (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET)
)
"""Records that stand only behind the end of the data."""


class RecordError(ValueError):
    """Bytes that are not the record they should be. Stays inside the reader, which counts it as damage."""


DAMAGE: Final = (RecordError, struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError)
"""All that reading damaged bytes can raise here (RuntimeError: lz4)."""


class ChunkHead(NamedTuple):
    """A chunk without its messages."""

    start_ns: int
    end_ns: int
    size: int
    """Bytes of the records in it, unpacked."""
    crc: int
    """Of the same, 0: none."""
    compression: str
    packed_start: int
    packed_size: int


_CHUNK_HEAD: Final = struct.Struct("<QQQI")
CHUNK_HEAD_BYTES: Final = _CHUNK_HEAD.size + 4 + 4 + 8
"""The longest head of a chunk: the names of the compressions have up to four letters."""


CHUNK_LOOKS_LIKE: Final = re.compile(rb"\x06(?=.{4}\0{4})", re.DOTALL)
"""Opcode and a size below 4 GiB: where to look closer in a damaged stretch."""
CHUNK_LOOKS_LIKE_BYTES: Final = 9


def chunk_head(head: bytes, size: int) -> ChunkHead:
    """Parse the first bytes of a chunk's content of `size` bytes; RecordError or struct.error where they do not fit together."""
    start_ns, end_ns, unpacked, crc = _CHUNK_HEAD.unpack_from(head)
    compression, offset = _string(head, _CHUNK_HEAD.size)
    (packed,) = struct.unpack_from("<Q", head, offset)
    if compression not in ("", "lz4", "zstd") or offset + 8 + packed != size or unpacked > LARGEST_CHUNK:
        raise RecordError("a chunk whose parts do not fit together")
    return ChunkHead(start_ns, end_ns, unpacked, crc, compression, offset + 8, packed)


def open_chunk(content: bytes) -> bytes:
    """Check and unpack the content of a chunk: the records in it. Raises one of DAMAGE."""
    head = chunk_head(content[:CHUNK_HEAD_BYTES], len(content))
    packed = memoryview(content)[head.packed_start :]
    if head.compression == "zstd":
        # zstandard gives a frame the memory that the frame states, without limit
        if zstandard.frame_content_size(packed) not in (-1, head.size):
            raise RecordError("a chunk with two different sizes")
        plain = zstandard.ZstdDecompressor().decompress(packed, max_output_size=head.size)
    elif head.compression == "lz4":
        plain = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=head.size + 1)
    else:
        plain = bytes(packed)
    if len(plain) != head.size or (head.crc and zlib.crc32(plain) != head.crc):
        raise RecordError("a wrong checksum")
    return plain


class Channel(NamedTuple):
    """What channel number in messages means which topic."""

    number: int
    topic: str


class Metadata(NamedTuple):
    """Named texts."""

    name: str
    values: dict[str, str]


class Attachment(NamedTuple):
    """A file inside the file."""

    name: str
    data: bytes


def parse(opcode: int, content: bytes) -> Channel | Metadata | Attachment | Opcode:
    """Check a record that is read whole; only the opcode of one that has nothing for us. Raises one of DAMAGE."""
    if opcode == Opcode.CHANNEL:
        return channel(content)
    if opcode == Opcode.METADATA:
        return _metadata(content)
    if opcode == Opcode.ATTACHMENT:
        return _attachment(content)
    if opcode == Opcode.HEADER:
        _check_end(content, _string(content, _string(content, 0)[1])[1])
    elif opcode == Opcode.SCHEMA:
        _, offset = _string(content, 2)
        _, offset = _string(content, offset)
        _check_end(content, offset + 4 + int(struct.unpack_from("<I", content, offset)[0]))
    elif opcode == Opcode.DATA_END:
        _check_end(content, 4)
    else:
        raise RecordError(f"opcode {opcode}")
    return Opcode(opcode)


def channel(content: bytes) -> Channel:
    """Parse a channel record. Raises one of DAMAGE."""
    number, _ = struct.unpack_from("<HH", content)
    topic, offset = _string(content, 4)
    _, offset = _string(content, offset)
    _, offset = _string_map(content, offset)
    _check_end(content, offset)
    return Channel(number, topic)


def _metadata(content: bytes) -> Metadata:
    name, offset = _string(content, 0)
    values, offset = _string_map(content, offset)
    _check_end(content, offset)
    return Metadata(name, values)


def _attachment(content: bytes) -> Attachment:
    (crc,) = struct.unpack_from("<I", content, max(0, len(content) - 4))
    if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
        raise RecordError("a wrong checksum")
    name, offset = _string(content, 16)
    _, offset = _string(content, offset)
    (size,) = struct.unpack_from("<Q", content, offset)
    offset += 8
    _check_end(content, offset + size + 4)
    return Attachment(name, content[offset : offset + size])


def check_message_index(head: bytes, size: int) -> None:
    """The first 6 bytes of a message index state the entries that fill its `size`. Raises one of DAMAGE."""
    entries = int(struct.unpack_from("<I", head, 2)[0])
    if 6 + entries != size or entries % 16:
        raise RecordError("an index whose parts do not fit together")


FOOTER_BYTES: Final = RECORD_HEAD.size + 20 + len(MAGIC)
"""Footer and magic at the very end of a finished file."""
FOOTER_CHECKED_BYTES: Final = RECORD_HEAD.size + 16
"""As much of the footer as its checksum covers."""


class Footer(NamedTuple):
    """The last record of a finished file."""

    summary_start: int
    """0: there is no summary."""
    crc: int
    """Of the summary and of the footer before this field, 0: none."""


def footer(tail: bytes) -> Footer | None:
    """Parse the last FOOTER_BYTES of a file; None where they are no footer."""
    if len(tail) != FOOTER_BYTES or RECORD_HEAD.unpack_from(tail) != (Opcode.FOOTER, 20) or not tail.endswith(MAGIC):
        return None
    summary_start, _, crc = struct.unpack_from("<QQI", tail, RECORD_HEAD.size)
    return Footer(summary_start, crc)


def _check_end(content: bytes, offset: int) -> None:
    if offset != len(content):
        raise RecordError(f"a record of {len(content)} bytes with {offset} bytes in it")


def _string(content: bytes, offset: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", content, offset)
    end = offset + 4 + size
    if end > len(content):
        raise RecordError("a text that runs out of its record")
    return content[offset + 4 : end].decode(), end


def _string_map(content: bytes, offset: int) -> tuple[dict[str, str], int]:
    (size,) = struct.unpack_from("<I", content, offset)
    offset += 4
    end, values = offset + size, {}
    while offset < end:
        key, offset = _string(content, offset)
        values[key], offset = _string(content, offset)
    if offset != end:
        raise RecordError("a map that runs out of its size")
    return values, end
