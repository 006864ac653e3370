"""MAVLink in captured datagrams: each stream cut into its frames, because the streams of several senders are mixed."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from flightlog.mavlink import Frame, FrameParser
from groundproc.flight.importers.joining import Event
from groundproc.flight.importers.udp import Datagram

_STX_1: Final = 0xFE
_MOST_STREAMS: Final = 64
"""More senders than that are no link but a scan of ports; they share a parser."""
_OTHERS: Final = (b"", 0, 0)


@dataclass(slots=True)
class MavlinkStreams:
    """Frames of all streams, in the order in which they became whole.

    Attributes
    ----------
    topic : str
        Of their events.
    frames : int
        With a right checksum.
    """

    topic: str
    frames: int = 0
    _parsers: dict[tuple[bytes, int, int], FrameParser] = field(default_factory=dict)
    _last_ns: int = 0

    @property
    def bad_bytes(self) -> int:
        """Bytes that belong to no frame."""
        return sum(parser.bad_bytes for parser in self._parsers.values())

    def feed(self, datagram: Datagram) -> Iterator[Event]:
        """Take a datagram, and give the frames that it completes."""
        key = (datagram.sender, datagram.source_port, datagram.port)
        if key not in self._parsers and len(self._parsers) >= _MOST_STREAMS:
            key = _OTHERS
        parser = self._parsers.setdefault(key, FrameParser())
        self._last_ns = datagram.time_ns
        for frame in parser.feed(datagram.time_ns, datagram.payload):
            yield self._event(frame, datagram.sender)

    def finish(self) -> Iterator[Event]:
        """Give the frames held back; no more datagrams will come."""
        for (sender, _, _), parser in self._parsers.items():
            for frame in parser.finish():
                yield self._event(frame._replace(time_ns=self._last_ns), sender)

    def _event(self, frame: Frame, sender: bytes) -> Event:
        self.frames += frame.known
        return Event(frame.time_ns, self.topic, frame.data, sender)


def frame_bytes(message: Any) -> bytes:
    """The frame that a message of MAVROS was made of (mavros_msgs/Mavlink)."""
    payload = b"".join(int(word).to_bytes(8, "little") for word in message.payload64)[: message.len]
    if message.magic == _STX_1:
        head = bytes((message.magic, message.len, message.seq, message.sysid, message.compid, message.msgid & 0xFF))
    else:
        flags = (message.incompat_flags, message.compat_flags)
        head = bytes((message.magic, message.len, *flags, message.seq, message.sysid, message.compid))
        head += int(message.msgid).to_bytes(3, "little")
    return head + payload + int(message.checksum).to_bytes(2, "little") + bytes(message.signature)
