"""A flight log on disk, read: whole, or what a power cut left of it.

The container is MCAP (mcap.dev/spec); its bytes are in `container` and `walk`. A library's reader gives up at the
first damaged byte, and the log from a bad day is the one that matters most.
"""

import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

from flightlog import container
from flightlog.container import DAMAGE, MAGIC, RECORD_HEAD, Opcode
from flightlog.errors import LogError
from flightlog.logwriter import CHECK, TOPICS, topics_check
from flightlog.records import FORMAT_VERSION
from flightlog.walk import ChunkAt, Hole, Walk


class Message(NamedTuple):
    """One message of a log: topic, log time [ns], and the CDR bytes that `records` decodes."""

    topic: str
    log_time_ns: int
    data: memoryview


@dataclass(slots=True)
class Damage:
    """What could not be read of a log."""

    truncated: bool = False
    """The footer is missing: the writer was cut off."""
    bad_chunks: int = 0
    """Chunks whose checksum or content is wrong."""
    lost_bytes: int = 0
    """Bytes of the file in bad chunks, skipped stretches and the torn tail."""
    places: list[str] = field(default_factory=list)
    """One phrase for each place, the first twenty."""
    count: int = 0
    """Damaged places."""
    reaches: int = 0
    """Where in the file the last one ends [bytes]."""

    def note(self, offset: int, size: int, what: str) -> None:
        """Count one damaged place."""
        self.lost_bytes += size
        self.count += 1
        self.reaches = max(self.reaches, offset + size)
        if len(self.places) < 20:
            self.places.append(f"byte {offset}: {what}, {size} bytes lost")

    def __bool__(self) -> bool:
        return self.truncated or self.bad_chunks > 0 or self.lost_bytes > 0


class LogReader:
    """Reads a flight log, whole or cut off, in bounded memory.

    Opening skims the file: a seek and a few bytes for each chunk. `messages` then reads one chunk at a time.

    Attributes
    ----------
    path : Path
    metadata : dict of name to dict
        A name that occurs again replaces what came before.
    attachments : dict of name to bytes
    damage : Damage
        What was found wrong so far: truncation when opened, bad chunks as they are read.
    start_ns, end_ns : int
        Log time of the first and last message [ns]; 0 where there is none.

    Raises
    ------
    LogError
        No such file, no MCAP file, one with messages outside of chunks, or a log of a newer format.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.damage = Damage()
        self._chunks: list[ChunkAt] = []
        self._topics: dict[int, str] = {}
        self._bad: set[int] = set()
        self._opened: set[int] = set()
        self._counted: set[int] = set()
        self._unpacked = self._records = 0
        self._turn = threading.Lock()  # seek and read are one: messages may be read by several threads
        try:
            self._file = self.path.open("rb")
        except OSError as error:
            raise LogError(f"{self.path}: cannot be opened ({error.strerror})") from None
        try:
            self._skim()
            self._check_version()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def start_ns(self) -> int:
        """Log time of the first message [ns]."""
        return min((chunk.start_ns for chunk in self._chunks), default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last message [ns]."""
        return max((chunk.end_ns for chunk in self._chunks), default=0)

    @property
    def size(self) -> int:
        """Bytes in the file; the measure of `progress`."""
        return self._size

    def messages(
        self, topics: tuple[str, ...] | None = None, progress: Callable[[int], None] | None = None
    ) -> Iterator[Message]:
        """Yield the messages in the order of the file.

        Parameters
        ----------
        topics : tuple of str, optional
            Only these; an entry that ends in a slash takes the whole family. Default: all.
        progress : callable, optional
            Called with the number of file bytes done since the last call.
        """
        done = 0
        for chunk in self._chunks:
            content = self._read_chunk(chunk)
            if content is not None:
                yield from self._messages(chunk, content, topics)
            if progress is not None:
                progress(chunk.offset + chunk.size - done)
                done = chunk.offset + chunk.size
        if progress is not None:
            progress(self._size - done)

    # Opening ------------------------------------------------------------------------------------------------------

    def _skim(self) -> None:
        self._size = self.path.stat().st_size
        if self._read(0, len(MAGIC)) != MAGIC:
            raise LogError(f"{self.path}: is no MCAP file (its first bytes are not {MAGIC!r})")
        walk, loose = Walk(self._file, self._size), False
        for found in walk:
            if isinstance(found, Hole):
                self.damage.note(found.offset, found.size, "no valid record")
                loose |= found.looks_loose
            elif isinstance(found, ChunkAt):
                self._chunks.append(found)
            elif isinstance(found, container.Channel):
                self._topics[found.number] = found.topic
            elif isinstance(found, container.Attachment):
                self.attachments[found.name] = found.data
            else:
                self._keep_metadata(found)
        self.damage.truncated = not walk.finished
        if loose and not self._chunks and not self.metadata:
            raise LogError(f"{self.path}: holds messages outside of chunks, which no flight log does")

    def _keep_metadata(self, found: container.Metadata) -> None:
        self.metadata[found.name] = found.values
        if found.name == TOPICS:  # MCAP gives metadata no checksum, and a wrong topic is worse than none
            topics = {number: topic for number, topic in found.values.items() if number != CHECK}
            if found.values.get(CHECK) == topics_check(topics):
                self._topics |= {int(number): topic for number, topic in topics.items()}

    def _read(self, offset: int, size: int) -> bytes:
        with self._turn:
            self._file.seek(offset)
            return self._file.read(size)

    def _check_version(self) -> None:
        version = self.metadata.get("swath.log", {}).get("format_version", "")
        if version.isdecimal() and int(version) > FORMAT_VERSION:
            raise LogError(
                f"{self.path}: is of log format {version}, this program reads up to {FORMAT_VERSION}; update swath"
            )

    # Reading ------------------------------------------------------------------------------------------------------

    def _read_chunk(self, chunk: ChunkAt) -> bytes | None:
        try:
            content = container.open_chunk(self._read(chunk.offset + RECORD_HEAD.size, chunk.size - RECORD_HEAD.size))
            self._weigh(chunk, len(content))
        except DAMAGE as error:
            self._note_bad(chunk, error)
            return None
        return content

    def _weigh(self, chunk: ChunkAt, size: int) -> None:
        """Add up what the file unpacks to; RecordError beyond what any log of its size does."""
        first = chunk.offset not in self._opened
        if first:
            self._opened.add(chunk.offset)
            self._unpacked += size
        beyond = self._unpacked > _MOST_UNPACKED + _EXPANSION * self._size
        if chunk.offset in self._bad or (first and beyond):
            raise container.RecordError("the file unpacks to more than any log of its size")

    def _note_bad(self, chunk: ChunkAt, error: Exception) -> None:
        """Count a bad chunk, once however often it is read."""
        if chunk.offset not in self._bad:
            self._bad.add(chunk.offset)
            self.damage.bad_chunks += 1
            self.damage.note(chunk.offset, chunk.size, f"a damaged chunk ({error})")

    def _messages(self, chunk: ChunkAt, content: bytes, topics: tuple[str, ...] | None) -> Iterator[Message]:
        view = memoryview(content)
        offset, end = 0, len(content)
        counts = chunk.offset not in self._counted
        self._counted.add(chunk.offset)
        if not counts and chunk.offset in self._bad:
            return
        while offset < end:
            try:
                self._records += counts
                if counts and self._records > _MOST_RECORDS + self._size:
                    raise container.RecordError("the file holds more records than any log of its size")
                opcode, size = RECORD_HEAD.unpack_from(content, offset)
                offset += RECORD_HEAD.size
                if offset + size > end:
                    raise container.RecordError("a record that runs out of its chunk")
                if opcode == Opcode.CHANNEL:
                    number, topic = container.channel(content[offset : offset + size])
                    self._topics[number] = topic
                    message = None
                elif opcode == Opcode.MESSAGE:
                    message = self._message(view[offset : offset + size])
                elif opcode == Opcode.SCHEMA:
                    message = None
                else:
                    raise container.RecordError(f"a record of opcode {opcode} within a chunk")
            except DAMAGE as error:  # of a chunk without checksum
                self._note_bad(chunk, error)
                return
            if message is not None and _wanted(message.topic, topics):
                yield message
            offset += size

    def _message(self, content: memoryview) -> Message | None:
        """A message of a channel that we know, else None."""
        number, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(content)
        topic = self._topics.get(number)
        return None if topic is None else Message(topic, log_time_ns, content[_MESSAGE_HEAD.size :])


_EXPANSION: Final = 256
_MOST_UNPACKED: Final = 48 << 20
"""A log unpacks to this many times its size and so many bytes: packets of a lidar that stands still, without noise, to 34 times."""
_MOST_RECORDS: Final = 1 << 20
"""A log has at most so many records and one for each of its bytes; millions of empty ones cost the time of each, not their bytes."""
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")


def _wanted(topic: str, topics: tuple[str, ...] | None) -> bool:
    return topics is None or any(topic == name or (name.endswith("/") and topic.startswith(name)) for name in topics)
