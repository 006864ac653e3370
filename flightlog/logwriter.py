"""Writing a flight log: the topics of the table in `records`, in MCAP chunks, to an open file.

The container is MCAP (mcap.dev/spec); its bytes are in `mcapwriter`. A library's writer gives up on a full disk, and
the log from a bad day is the one that matters most.
"""

import json
import zlib
from collections.abc import Mapping
from typing import BinaryIO, Final

from flightlog.errors import LogError
from flightlog.mcapwriter import McapWriter
from flightlog.records import FORMAT_VERSION, record_type

TOPICS: Final = "swath.topics"
"""Name of the metadata that repeat which channel number is which topic."""
CHECK: Final = "crc32"
"""Key of their checksum."""
QOS: Final = (
    "- history: 1\n  depth: 10\n  reliability: 1\n  durability: 2\n"
    "  deadline: {sec: 9223372036, nsec: 854775807}\n  lifespan: {sec: 9223372036, nsec: 854775807}\n"
    "  liveliness: 1\n  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""What ROS 2 writes for a publisher with default settings; its bag player wants to find it."""


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
    compression : {"zstd", "lz4", "none"}
        Of the chunks.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, bytes],
        chunk_bytes: int = 1 << 20,
        library: str = "swath",
        compression: str = "zstd",
    ) -> None:
        self._stream = stream
        self._writer = McapWriter(stream, "ros2", library, chunk_bytes, compression)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._flushes = 0
        self.add_metadata("swath.log", {"format_version": str(FORMAT_VERSION)})
        for name, values in metadata.items():
            self.add_metadata(name, values)
        for name, content in attachments.items():
            self._writer.add_attachment(name, _media_type(name), content)

    @property
    def counts(self) -> dict[str, int]:
        """Messages that are in the file, by topic; what waits in the open chunk is not."""
        return {topic: self._writer.counts.get(number, 0) for topic, number in self._channels.items()}

    @property
    def lost(self) -> int:
        """Messages of chunks that the stream did not take."""
        return self._writer.lost

    @property
    def span_ns(self) -> tuple[int, int]:
        """Log time of the first and the last message in the file [ns]; zeros where there is none."""
        return self._writer.start_ns, self._writer.end_ns

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
            self._schemas[row.schema] = self._writer.add_schema(row.schema, "ros2msg", row.definition.encode())
        self._channels[topic] = self._writer.add_channel(
            topic, "cdr", self._schemas[row.schema], {"offered_qos_profiles": QOS}
        )

    def write(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Append one message; `data` is what an encode function of `records` made."""
        if topic not in self._channels:
            self.add_topic(topic)
        self._writer.add_message(self._channels[topic], log_time_ns, data)

    def flush(self) -> None:
        """Close the open chunk and hand everything to the stream, which is flushed too. Syncing to the disk is the caller's.

        What channel number means which topic stands in the first chunk and in the summary only. So that a log without summary
        survives the loss of that chunk, it is said again as metadata at the flushes number 1, 2, 4, 8 and so on.
        """
        self._flushes += 1
        if self._channels and self._flushes & (self._flushes - 1) == 0:
            topics = {str(number): topic for topic, number in self._channels.items()}
            self.add_metadata(TOPICS, topics | {CHECK: topics_check(topics)})
        self._writer.close_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write summary and footer. The stream stays open."""
        self._writer.finish()


def topics_check(topics: Mapping[str, str]) -> str:
    """Checksum of what channel number means which topic, in hexadecimal."""
    return f"{zlib.crc32(json.dumps(topics, sort_keys=True).encode()):08x}"


def _media_type(name: str) -> str:
    return "application/yaml" if name.endswith((".yaml", ".yml")) else "application/octet-stream"
