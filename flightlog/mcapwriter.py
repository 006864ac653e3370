"""Writes MCAP records (mcap.dev/spec) to a stream: chunks with their indexes, metadata, attachments, summary.

This is a writer of our own because a log aboard meets full disks. Here a record is written whole or not at all, the
summary lists only what is in the file, and what was lost is known. It also copies and compresses no more than it
must.
"""

import contextlib
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO, Final

import lz4.frame
import zstandard
from fastcrc import crc32

from flightlog.container import FOOTER_CHECKED_BYTES, MAGIC, RECORD_HEAD, Opcode

COMPRESSIONS: Final = ("none", "lz4", "zstd")
_LARGE: Final = 4096
"""From this size on the bytes of a message are not copied into the chunk but kept as they are [bytes]."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_FIXED: Final = _MESSAGE.size - RECORD_HEAD.size


def _string(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _string_map(values: Mapping[str, str]) -> bytes:
    body = b"".join(_string(key) + _string(value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body


def _number_map(values: Mapping[int, int]) -> bytes:
    body = b"".join(struct.pack("<HQ", key, value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body


def _record(opcode: Opcode, content: bytes) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content)) + content


@dataclass(slots=True)
class _Chunk:
    """A chunk that fills up."""

    pieces: list[bytes] = field(default_factory=list)
    small: bytearray = field(default_factory=bytearray)
    """What comes behind the pieces."""
    size: int = 0
    start_ns: int = 0
    end_ns: int = 0
    index: dict[int, list[int]] = field(default_factory=dict)
    """For each channel log time and offset of its messages, one after the other."""

    def add(self, content: bytes) -> None:
        """Append a record."""
        self.small += content
        self.size += len(content)

    def add_message(self, head: bytes, channel: int, time_ns: int, data: bytes) -> None:
        """Append a message record: its head and its bytes."""
        if not self.index:
            self.start_ns = self.end_ns = time_ns
        self.start_ns, self.end_ns = min(self.start_ns, time_ns), max(self.end_ns, time_ns)
        entries = self.index.get(channel)
        if entries is None:
            entries = self.index[channel] = []
        entries += (time_ns, self.size)
        self.small += head
        if len(data) < _LARGE:
            self.small += data
        else:
            self.pieces += (bytes(self.small), data)
            self.small = bytearray()
        self.size += len(head) + len(data)

    def content(self) -> list[bytes]:
        """All of it, in pieces."""
        return [*self.pieces, bytes(self.small)] if self.small else self.pieces


def _pack(pieces: list[bytes], compression: str) -> list[bytes]:
    if compression == "zstd":
        return [zstandard.ZstdCompressor().compress(b"".join(pieces))]
    if compression == "lz4":
        return [lz4.frame.compress(b"".join(pieces))]
    return pieces


class McapWriter:
    """Writes one MCAP file.

    Parameters
    ----------
    stream : BinaryIO
        Opened for writing, empty; `write` takes all it is given or raises OSError. Where it has a `write_pieces`, that is given the
        pieces of a record at once.
    profile, library : str
        See the header record.
    chunk_bytes : int
        Uncompressed size at which a chunk is closed.
    compression : str
        One of COMPRESSIONS.

    Attributes
    ----------
    counts : dict of channel number to int
        Messages that are in the file.
    lost : int
        Messages of chunks that the stream did not take.
    """

    def __init__(self, stream: BinaryIO, profile: str, library: str, chunk_bytes: int, compression: str) -> None:
        assert compression in COMPRESSIONS
        self._stream, self._chunk_bytes, self._compression = stream, chunk_bytes, compression
        self._write_pieces: Callable[[Sequence[bytes]], None] | None = getattr(stream, "write_pieces", None)
        self._offset = 0
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._sequence: dict[int, int] = {}
        self._chunk = _Chunk()
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._attachment_indexes: list[bytes] = []
        self.counts: dict[int, int] = {}
        self.lost = 0
        self.start_ns = self.end_ns = 0
        self._write([MAGIC, _record(Opcode.HEADER, _string(profile) + _string(library))])

    def _write(self, pieces: Sequence[bytes]) -> int:
        """Append whole records, or none of them; gives their place in the file."""
        begin = self._offset
        try:
            if self._write_pieces is not None:
                self._write_pieces(pieces)
            else:
                for piece in pieces:
                    self._stream.write(piece)
        except OSError:
            with contextlib.suppress(OSError, ValueError):
                self._stream.seek(begin)
                self._stream.truncate(begin)
            raise
        self._offset += sum(map(len, pieces))
        return begin

    def add_schema(self, name: str, encoding: str, definition: bytes) -> int:
        """Add a schema to the chunk; gives its number."""
        number = len(self._schemas) + 1
        content = struct.pack("<H", number) + _string(name) + _string(encoding)
        self._schemas.append(_record(Opcode.SCHEMA, content + struct.pack("<I", len(definition)) + definition))
        self._chunk.add(self._schemas[-1])
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel to the chunk; gives its number."""
        number = len(self._channels) + 1
        content = struct.pack("<HH", number, schema) + _string(topic) + _string(encoding) + _string_map(metadata)
        self._channels.append(_record(Opcode.CHANNEL, content))
        self._chunk.add(self._channels[-1])
        self._sequence[number] = 0
        return number

    def add_message(self, channel: int, time_ns: int, data: bytes) -> None:
        """Add a message to the chunk, and close that when it is full."""
        self._sequence[channel] += 1
        head = _MESSAGE.pack(
            Opcode.MESSAGE, _MESSAGE_FIXED + len(data), channel, self._sequence[channel], time_ns, time_ns
        )
        self._chunk.add_message(head, channel, time_ns, data)
        if self._chunk.size >= self._chunk_bytes:
            self.close_chunk()

    def close_chunk(self) -> None:
        """Write the chunk; OSError if the stream does not take it, in which case it is lost and counted."""
        chunk, self._chunk = self._chunk, _Chunk()
        if not chunk.size:
            return
        counts = {channel: len(entries) // 2 for channel, entries in chunk.index.items()}
        plain = chunk.content()
        crc = 0
        for piece in plain:
            crc = crc32.iso_hdlc(piece, crc)
        packed = _pack(plain, self._compression)
        packed_size = sum(map(len, packed))
        name = _string("" if self._compression == "none" else self._compression)
        head = struct.pack("<QQQI", chunk.start_ns, chunk.end_ns, chunk.size, crc) + name
        head += struct.pack("<Q", packed_size)
        size = RECORD_HEAD.size + len(head) + packed_size
        indexes, offsets = _message_indexes(chunk.index, self._offset + size)
        try:
            begin = self._write([RECORD_HEAD.pack(Opcode.CHUNK, size - RECORD_HEAD.size) + head, *packed, indexes])
        except OSError:
            self.lost += sum(counts.values())
            raise
        content = struct.pack("<QQQQ", chunk.start_ns, chunk.end_ns, begin, size) + _number_map(offsets)
        content += struct.pack("<Q", len(indexes)) + name + struct.pack("<QQ", packed_size, chunk.size)
        self._chunk_indexes.append(_record(Opcode.CHUNK_INDEX, content))
        self._count(chunk, counts)

    def _count(self, chunk: _Chunk, counts: Mapping[int, int]) -> None:
        if not counts:
            return
        first = not self.counts
        self.start_ns = chunk.start_ns if first else min(self.start_ns, chunk.start_ns)
        self.end_ns = chunk.end_ns if first else max(self.end_ns, chunk.end_ns)
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record now."""
        record = _record(Opcode.METADATA, _string(name) + _string_map(values))
        begin = self._write([record])
        content = struct.pack("<QQ", begin, len(record)) + _string(name)
        self._metadata_indexes.append(_record(Opcode.METADATA_INDEX, content))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment now."""
        names = _string(name) + _string(media_type)
        content = struct.pack("<QQ", 0, 0) + names + struct.pack("<Q", len(data)) + data
        record = _record(Opcode.ATTACHMENT, content + struct.pack("<I", zlib.crc32(content)))
        begin = self._write([record])
        index = struct.pack("<QQQQQ", begin, len(record), 0, 0, len(data)) + names
        self._attachment_indexes.append(_record(Opcode.ATTACHMENT_INDEX, index))

    def finish(self) -> None:
        """Close the chunk, write summary and footer."""
        try:
            self.close_chunk()
        finally:  # also where the disk is full: there may be room for what follows
            self._write(self._ending())

    def _ending(self) -> list[bytes]:
        end = _record(Opcode.DATA_END, struct.pack("<I", 0))
        start = offset = self._offset + len(end)
        groups = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        )
        summary, offsets = b"", b""
        for opcode, records in groups:
            group = b"".join(records)
            if group:
                offsets += _record(Opcode.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, offset, len(group)))
            summary += group
            offset += len(group)
        footer = RECORD_HEAD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", start, offset)
        assert len(footer) == FOOTER_CHECKED_BYTES
        summary += offsets + footer
        return [end, summary + struct.pack("<I", zlib.crc32(summary)) + MAGIC]

    def _statistics(self) -> bytes:
        content = struct.pack(
            "<QHIIIIQQ",
            sum(self.counts.values()),
            len(self._schemas),
            len(self._channels),
            len(self._attachment_indexes),
            len(self._metadata_indexes),
            len(self._chunk_indexes),
            self.start_ns,
            self.end_ns,
        )
        return _record(Opcode.STATISTICS, content + _number_map(self.counts))


def _message_indexes(index: Mapping[int, Sequence[int]], offset: int) -> tuple[bytes, dict[int, int]]:
    """The index records behind a chunk that ends at `offset`, and the place of each by channel."""
    out, offsets = bytearray(), {}
    for channel, entries in index.items():
        offsets[channel] = offset + len(out)
        body = struct.pack(f"<{len(entries)}Q", *entries)
        out += _record(Opcode.MESSAGE_INDEX, struct.pack("<HI", channel, len(body)) + body)
    return bytes(out), offsets
