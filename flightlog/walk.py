"""Walks over the top level of an MCAP file, record by record, skips what is damaged, and finds the next good record."""

import zlib
from collections.abc import Iterator
from contextlib import suppress
from typing import BinaryIO, Final, NamedTuple

from flightlog import container
from flightlog.container import DAMAGE, MAGIC, RECORD_HEAD, Opcode

_WINDOW: Final = 1 << 20
_SEARCHED: Final = 4
"""Bytes that are unpacked in the search for good chunks, at most so many times those of the file: bytes that look like chunks
within chunks within chunks would cost the square of their number."""
_HEAD_BYTES: Final = RECORD_HEAD.size + container.CHUNK_HEAD_BYTES


class ChunkAt(NamedTuple):
    """A chunk, unopened."""

    offset: int
    size: int
    """Bytes of the record, its head included."""
    start_ns: int
    end_ns: int


class Hole(NamedTuple):
    """A stretch that no valid record fills."""

    offset: int
    size: int
    looks_loose: bool
    """It begins as a message outside of chunks would."""


Found = ChunkAt | Hole | container.Channel | container.Metadata | container.Attachment


class Walk:
    """Reads the top level of a file.

    Parameters
    ----------
    file : BinaryIO
        Starts with the magic bytes.
    size : int
        Of the file [bytes].

    Attributes
    ----------
    finished : bool
        A footer stands at its end.
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        footer = container.footer(self._read(max(0, size - container.FOOTER_BYTES), container.FOOTER_BYTES))
        self.finished = footer is not None
        self._end = size - container.FOOTER_BYTES if self.finished else size
        self._summary, self._summary_good = self._end, True
        if footer is not None and 0 < footer.summary_start < self._end:
            self._summary = footer.summary_start
            crc = self._crc(footer.summary_start, self._end + container.FOOTER_CHECKED_BYTES) if footer.crc else 0
            self._summary_good = crc == footer.crc
        self._in_summary = False
        self._search_left = _SEARCHED * size + _WINDOW

    def __iter__(self) -> Iterator[Found]:
        offset = len(MAGIC)
        while offset < self._end:
            record = self._record(offset)
            if record is None:
                following = self._step_over(offset)
                yield Hole(offset, following - offset, self._read(offset, 1)[0] == Opcode.MESSAGE)
                offset = following
                continue
            offset, found = record
            if isinstance(found, Opcode):
                self._in_summary = self._in_summary or found is Opcode.DATA_END
            elif self._summary_good or not self._in_summary:
                yield found
        if not self._summary_good:  # what it says of channels may be wrong, and where it starts too
            yield Hole(self._end, container.FOOTER_BYTES, False)

    def _read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _crc(self, start: int, end: int) -> int:
        crc = 0
        for offset in range(start, end, _WINDOW):
            crc = zlib.crc32(self._read(offset, min(_WINDOW, end - offset)), crc)
        return crc

    def _claimed_end(self, head: bytes, offset: int) -> int | None:
        """Where the record at `offset` says that it ends, None where that is beyond the end."""
        if len(head) < RECORD_HEAD.size:
            return None
        end = offset + RECORD_HEAD.size + int(RECORD_HEAD.unpack_from(head)[1])
        return end if end <= self._end else None

    def _record(self, offset: int) -> tuple[int, Found | Opcode] | None:
        """The record at `offset`, or its opcode where that says enough, and the place behind it; None for no valid record."""
        head = self._read(offset, _HEAD_BYTES)
        following = self._claimed_end(head, offset)
        if following is None:
            return None
        opcode, size = RECORD_HEAD.unpack_from(head)
        try:
            if opcode == Opcode.CHUNK:
                chunk = container.chunk_head(head[RECORD_HEAD.size :], size)
                return following, ChunkAt(offset, following - offset, chunk.start_ns, chunk.end_ns)
            if opcode == Opcode.MESSAGE_INDEX:
                container.check_message_index(head[RECORD_HEAD.size :], size)
                return following, Opcode.MESSAGE_INDEX
            if opcode in container.SUMMARY_ONLY:
                return (following, Opcode(opcode)) if self._in_summary else None
            return following, container.parse(opcode, self._read(offset + RECORD_HEAD.size, size))
        except DAMAGE:
            return None

    def _step_over(self, offset: int) -> int:
        """Where to continue after a damaged record: at its claimed end, the next good chunk, the summary, or the end."""
        claimed = self._claimed_end(self._read(offset, RECORD_HEAD.size), offset)
        if claimed is not None and claimed < self._end and self._record(claimed) is not None:
            return claimed
        following = self._next_chunk(offset + 1)
        if following == self._end and offset < self._summary < self._end:
            self._in_summary = True
            return self._summary
        return following

    def _next_chunk(self, offset: int) -> int:
        """Offset of the next chunk whose checksum holds, or the end."""
        while offset < self._end:
            window = self._read(offset, _WINDOW + container.CHUNK_LOOKS_LIKE_BYTES - 1)
            for found in container.CHUNK_LOOKS_LIKE.finditer(window):
                if self._is_good_chunk(offset + found.start()):
                    return offset + found.start()
            offset += _WINDOW
        return self._end

    def _is_good_chunk(self, offset: int) -> bool:
        record = self._record(offset)
        if record is None or not isinstance(record[1], ChunkAt) or record[1].size > self._search_left:
            return False
        self._search_left -= record[1].size
        with suppress(*DAMAGE):
            container.open_chunk(self._read(offset + RECORD_HEAD.size, record[1].size - RECORD_HEAD.size))
            return True
        return False
