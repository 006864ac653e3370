"""A flight log on disk: LogWriter, and LogReader, which also reads what a power cut left.

The container is MCAP (mcap.dev/spec). Writing is the mcap library's; reading is ours because the library gives up at the first
damaged byte, and a log from a crash is the one that matters most.
"""

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, NamedTuple, Self

import lz4.frame
import zstandard
from mcap.writer import CompressionType, Writer

from flightlog.errors import LogError
from flightlog.records import FORMAT_VERSION, record_type

MAGIC: Final = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
_ATTACHMENT, _METADATA, _DATA_END = 0x09, 0x0C, 0x0F
_LAST_OPCODE: Final = 0x0F
_LARGEST_CHUNK: Final = 256 * 2**20

_QOS: Final = (
    "- history: 1\n  depth: 10\n  reliability: 1\n  durability: 2\n"
    "  deadline: {sec: 9223372036, nsec: 854775807}\n  lifespan: {sec: 9223372036, nsec: 854775807}\n"
    "  liveliness: 1\n  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""What ROS 2 writes for a publisher with default settings; its bag player wants to find it."""


class Message(NamedTuple):
    """One message of a log: topic, log time [ns], and the CDR bytes that `records` decodes."""

    topic: str
    log_time_ns: int
    data: memoryview


class LogWriter:
    """Writes a flight log to an open binary file.

    Parameters
    ----------
    stream : BinaryIO
        Opened for writing, empty. The caller owns it: syncing and closing are his.
    metadata : mapping of name to mapping of str to str
        Written at once, ahead of any message, so that they survive whatever happens later. `swath.log` with the format version is
        added.
    attachments : mapping of name to bytes
        Files that make the log stand alone: configuration, mount. Written at once too.
    chunk_bytes : int
        Uncompressed size at which a chunk is closed.
    library : str
        Name and version of the writing program.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, bytes],
        chunk_bytes: int = 1 << 20,
        library: str = "swath",
    ) -> None:
        self._writer = Writer(stream, chunk_size=chunk_bytes, compression=CompressionType.ZSTD, enable_data_crcs=False)
        self._writer.start(profile="ros2", library=library)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: dict[int, int] = {}
        self.add_metadata("swath.log", {"format_version": str(FORMAT_VERSION)})
        for name, values in metadata.items():
            self.add_metadata(name, values)
        for name, content in attachments.items():
            self._writer.add_attachment(0, 0, name, _media_type(name), content)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record now."""
        self._writer.add_metadata(name, dict(values))

    def add_topic(self, topic: str) -> None:
        """Announce a topic of the table in `records` ahead of its first message; LogError for any other."""
        if topic in self._channels:
            return
        row = record_type(topic)
        if row is None:
            raise LogError(f"topic {topic!r} is not in the table of records")
        if row.schema not in self._schemas:
            self._schemas[row.schema] = self._writer.register_schema(row.schema, "ros2msg", row.definition.encode())
        self._channels[topic] = self._writer.register_channel(
            topic, "cdr", self._schemas[row.schema], {"offered_qos_profiles": _QOS}
        )
        self._sequence[self._channels[topic]] = 0

    def write(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Append one message; `data` is what an encode function of `records` made."""
        if topic not in self._channels:
            self.add_topic(topic)
        channel = self._channels[topic]
        self._sequence[channel] += 1
        self._writer.add_message(channel, log_time_ns, data, log_time_ns, self._sequence[channel])

    def flush(self) -> None:
        """Close the open chunk and hand everything to the stream, which is flushed too. Syncing to the disk is the caller's."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self) -> None:
        """Write summary and footer. The stream stays open."""
        self._writer.finish()  # type: ignore[no-untyped-call]


def _media_type(name: str) -> str:
    return "application/yaml" if name.endswith((".yaml", ".yml")) else "application/octet-stream"


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

    def note(self, offset: int, size: int, what: str) -> None:
        """Count one damaged place."""
        self.lost_bytes += size
        if len(self.places) < 20:
            self.places.append(f"byte {offset}: {what}, {size} bytes lost")

    def __bool__(self) -> bool:
        return self.truncated or self.bad_chunks > 0 or self.lost_bytes > 0


class _Chunk(NamedTuple):
    offset: int
    size: int
    start_ns: int
    end_ns: int


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
        No such file, no MCAP file, or a log of a newer format.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.damage = Damage()
        self._chunks: list[_Chunk] = []
        self._topics: dict[int, str] = {}
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
        bad_before = self.damage.bad_chunks
        done = 0
        for chunk in self._chunks:
            content = self._read_chunk(chunk, count=bad_before == 0)
            if content is not None:
                yield from self._messages(content, topics)
            if progress is not None:
                progress(chunk.offset + chunk.size - done)
                done = chunk.offset + chunk.size

    # Skimming -----------------------------------------------------------------------------------------------------

    def _skim(self) -> None:
        self._size = self.path.stat().st_size
        if self._file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{self.path}: is no MCAP file (its first bytes are not {MAGIC!r})")
        offset, complete = len(MAGIC), False
        while offset < self._size:
            size = self._record_at(offset)
            if size is None:
                following = self._next_chunk(offset + 1)
                self.damage.note(offset, following - offset, "no valid record")
                offset = following
                continue
            opcode = self._opcode(offset)
            if opcode == _FOOTER:
                self._file.seek(-len(MAGIC), 2)
                complete = self._file.read(len(MAGIC)) == MAGIC
                break
            self._take(opcode, offset, size)
            offset += 9 + size
        self.damage.truncated = not complete

    def _opcode(self, offset: int) -> int:
        self._file.seek(offset)
        return self._file.read(1)[0]

    def _record_at(self, offset: int) -> int | None:
        """Size of the record's content, None where no record can start."""
        self._file.seek(offset)
        head = self._file.read(9)
        if len(head) < 9:
            return None
        opcode, size = struct.unpack("<BQ", head)
        if not _HEADER <= opcode <= _LAST_OPCODE or offset + 9 + size > self._size:
            return None
        return int(size)

    def _take(self, opcode: int, offset: int, size: int) -> None:
        """Keep what an opened log must know of a top-level record."""
        self._file.seek(offset + 9)
        if opcode == _CHUNK:
            start_ns, end_ns = struct.unpack("<QQ", self._file.read(16))
            self._chunks.append(_Chunk(offset, 9 + size, start_ns, end_ns))
        elif opcode == _CHANNEL:  # in the summary: saves a log whose first chunk is damaged
            content = self._file.read(size)
            self._topics[struct.unpack_from("<H", content)[0]] = _string(content, 4)[0]
        elif opcode == _METADATA:
            name, position = _string(content := self._file.read(size), 0)
            self.metadata[name] = _string_map(content, position)
        elif opcode == _ATTACHMENT:
            content = self._file.read(size)
            if zlib.crc32(content[:-4]) != struct.unpack("<I", content[-4:])[0]:
                self.damage.note(offset, size, "an attachment with a wrong checksum")
                return
            name, position = _string(content, 16)
            _, position = _string(content, position)
            (length,) = struct.unpack_from("<Q", content, position)
            self.attachments[name] = content[position + 8 : position + 8 + length]

    def _next_chunk(self, offset: int) -> int:
        """Offset of the next chunk whose checksum holds, or the end of the file."""
        step = 1 << 20
        while offset < self._size:
            self._file.seek(offset)
            window = self._file.read(step + 64)
            position = window.find(_CHUNK)
            while 0 <= position < step:
                if _could_be_chunk(window, position) and self._is_chunk(offset + position):
                    return offset + position
                position = window.find(_CHUNK, position + 1)
            offset += step
        return self._size

    def _is_chunk(self, offset: int) -> bool:
        size = self._record_at(offset)
        if size is None or size > _LARGEST_CHUNK:
            return False
        self._file.seek(offset + 9)
        with suppress(*_DAMAGE):
            _open_chunk(self._file.read(size))
            return True
        return False

    def _check_version(self) -> None:
        version = self.metadata.get("swath.log", {}).get("format_version", "")
        if version.isdigit() and int(version) > FORMAT_VERSION:
            raise LogError(
                f"{self.path}: is of log format {version}, this program reads up to {FORMAT_VERSION}; update swath"
            )

    # Reading ------------------------------------------------------------------------------------------------------

    def _read_chunk(self, chunk: _Chunk, *, count: bool) -> bytes | None:
        self._file.seek(chunk.offset + 9)
        try:
            return _open_chunk(self._file.read(chunk.size - 9))
        except _DAMAGE as error:
            if count:
                self.damage.bad_chunks += 1
                self.damage.note(chunk.offset, chunk.size, f"a damaged chunk ({error})")
            return None

    def _messages(self, content: bytes, topics: tuple[str, ...] | None) -> Iterator[Message]:
        view = memoryview(content)
        offset, end = 0, len(content)
        while offset + 9 <= end:
            opcode, size = struct.unpack_from("<BQ", content, offset)
            offset += 9
            if opcode == _MESSAGE:
                channel, _, log_time_ns, _ = struct.unpack_from("<HIQQ", content, offset)
                topic = self._topics.get(channel)
                if topic is not None and _wanted(topic, topics):
                    yield Message(topic, log_time_ns, view[offset + 22 : offset + size])
            elif opcode == _CHANNEL:
                channel = struct.unpack_from("<H", content, offset)[0]
                self._topics[channel] = _string(content, offset + 4)[0]
            offset += size


_DAMAGE: Final = (struct.error, LogError, zstandard.ZstdError, RuntimeError, UnicodeDecodeError)


def _wanted(topic: str, topics: tuple[str, ...] | None) -> bool:
    return topics is None or any(topic == name or (name.endswith("/") and topic.startswith(name)) for name in topics)


def _string(content: bytes, offset: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", content, offset)
    return content[offset + 4 : offset + 4 + size].decode(), offset + 4 + size


def _string_map(content: bytes, offset: int) -> dict[str, str]:
    (size,) = struct.unpack_from("<I", content, offset)
    end, offset, values = offset + 4 + size, offset + 4, {}
    while offset < end:
        key, offset = _string(content, offset)
        values[key], offset = _string(content, offset)
    return values


def _could_be_chunk(window: bytes, position: int) -> bool:
    """Cheap look at a chunk's head: size, order of times, name of the compression."""
    if position + 41 > len(window):
        return False
    _, size, start_ns, end_ns, _, _, name = struct.unpack_from("<BQQQQII", window, position)
    return 36 <= size <= _LARGEST_CHUNK and start_ns <= end_ns and name in (0, 3, 4)


def _open_chunk(content: bytes) -> bytes:
    """Check and decompress the content of a chunk record."""
    _, _, size, crc = struct.unpack_from("<QQQI", content, 0)
    name, offset = _string(content, 28)
    (length,) = struct.unpack_from("<Q", content, offset)
    packed = content[offset + 8 : offset + 8 + length]
    if size > _LARGEST_CHUNK:
        raise LogError(f"a chunk of {size} bytes")
    if name == "zstd":
        plain = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    elif name == "lz4":
        plain = lz4.frame.decompress(packed)
    elif name == "":
        plain = packed
    else:
        raise LogError(f"compression {name!r}")
    if len(plain) != size or (crc and zlib.crc32(plain) != crc):
        raise LogError("wrong checksum")
    return bytes(plain)
