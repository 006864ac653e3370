"""Packet captures: classic pcap and pcapng as a stream of packets, whole or cut off anywhere.

Sources: draft-ietf-opsawg-pcap (classic) and draft-ietf-opsawg-pcapng; link types of tcpdump.org.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, Final, NamedTuple

from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError
from groundproc.flight.importers.kinds import HEAD_BYTES, kind_of

_CLASSIC: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""Magic -> byte order and nanoseconds in a tick of the fraction."""

_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6
_ORDERS: Final = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_OPTION_RESOLUTION, _OPTION_OFFSET = 9, 14
_LARGEST: Final = 1 << 24
"""No packet and no block of a sane capture is larger [bytes]; more means damage."""


class Packet(NamedTuple):
    """One captured packet."""

    time_ns: int
    """Capture time, Unix [ns]."""
    link: int
    """Link type (LINKTYPE_ value): what the first bytes are."""
    data: bytes
    cut: bool
    """The capture kept only the beginning (snap length)."""


@dataclass(slots=True)
class CaptureCount:
    """What was found in a capture file, and what could not be used."""

    packets: int = 0
    untimed: int = 0
    """Simple packet blocks ahead of any packet with a time; left out."""
    borrowed_times: int = 0
    """Simple packet blocks that took the time of the packet before."""
    lost_bytes: int = 0
    """Bytes of the torn or damaged end."""
    damage: str = ""
    """What the end looks like, empty where the file is whole."""


@dataclass(slots=True)
class _Interface:
    link: int
    ticks_per_s: int = 1_000_000
    offset_s: int = 0


@dataclass(slots=True)
class _Section:
    order: str = "<"
    interfaces: list[_Interface] = field(default_factory=list)


def packets(stream: BinaryIO, count: CaptureCount, place: str) -> Iterator[Packet]:
    """Read a capture; what is whole before a torn end is given, the rest counted.

    Parameters
    ----------
    stream : BinaryIO
        Buffered, at its beginning; only read, never moved.
    count : CaptureCount
        Filled as packets are taken.
    place : str
        Name of the file, for errors.

    Raises
    ------
    CaptureError
        The first bytes are those of no capture.
    """
    magic = stream.read(4)
    if magic in _CLASSIC:
        yield from _classic(stream, magic, count)
    elif magic == struct.pack("<I", _SECTION):
        yield from _blocks(stream, count, place)
    elif not magic:
        raise CaptureError(f"{place}: is empty, expected a pcap or pcapng capture")
    else:
        kind = kind_of(magic + stream.read(HEAD_BYTES))
        if kind.what.startswith("nothing"):
            raise CaptureError(f"{place}: is no pcap or pcapng capture (it starts with the bytes {magic.hex(' ')})")
        raise CaptureError(f"{place}: is no pcap or pcapng capture but {kind.what}; {kind.remedy}")


def _torn(stream: BinaryIO, count: CaptureCount, start: bytes, what: str) -> None:
    """Count the rest of a file that cannot be followed any further."""
    count.damage = what
    count.lost_bytes += len(start)
    while rest := stream.read(1 << 20):
        count.lost_bytes += len(rest)


def _classic(stream: BinaryIO, magic: bytes, count: CaptureCount) -> Iterator[Packet]:
    order, tick_ns = _CLASSIC[magic]
    head = magic + stream.read(20)
    if len(head) < 24:
        _torn(stream, count, head, "ends within the file header")
        return
    link = struct.unpack(order + "I", head[20:])[0] & 0xFFFF
    record = struct.Struct(order + "IIII")
    while head := stream.read(record.size):
        if len(head) < record.size:
            _torn(stream, count, head, "ends within a packet header")
            return
        seconds, fraction, size, original = record.unpack(head)
        if size > _LARGEST or fraction * tick_ns >= NS_PER_S:
            _torn(stream, count, head, "has a damaged packet header")
            return
        data = stream.read(size)
        if len(data) < size:
            _torn(stream, count, head + data, "ends within a packet")
            return
        count.packets += 1
        yield Packet(seconds * NS_PER_S + fraction * tick_ns, link, data, size < original)


# pcapng ---------------------------------------------------------------------------------------------------------------


def _blocks(stream: BinaryIO, count: CaptureCount, place: str) -> Iterator[Packet]:
    """Walk the blocks; the type of the first, a section header, has been read."""
    section = _Section()
    kind_bytes, last_ns = struct.pack("<I", _SECTION), None
    while kind_bytes:
        block = _read_block(stream, kind_bytes, section, count)
        if block is None:
            return
        kind, body = block
        if kind == _INTERFACE and len(body) >= 8:
            section.interfaces.append(_interface(body, section.order))
        elif kind in (_ENHANCED, _SIMPLE):
            packet = _packet(kind, body, section, last_ns, count)
            if packet is not None:
                last_ns = packet.time_ns
                count.packets += 1
                yield packet
        kind_bytes = stream.read(4)
    if count.untimed and not count.packets:
        raise CaptureError(f"{place}: its packets carry no times (simple packet blocks only); capture with times")


def _read_block(
    stream: BinaryIO, kind_bytes: bytes, section: _Section, count: CaptureCount
) -> tuple[int, bytes] | None:
    """Type and body of the next block, None where the file is torn; a section header sets byte order and interfaces."""
    head = kind_bytes + stream.read(4)
    is_section = kind_bytes == struct.pack("<I", _SECTION)
    if is_section:
        head += stream.read(4)
        order = _ORDERS.get(head[8:12])
        if order is None:
            _torn(stream, count, head, "ends or is damaged within a section header")
            return None
        section.order, section.interfaces = order, []
    if len(head) < 8:
        _torn(stream, count, head, "ends within a block header")
        return None
    kind, size = struct.unpack(section.order + "II", head[:8])
    if size < len(head) + 4 or size % 4 or size > _LARGEST:
        _torn(stream, count, head, "has a damaged block header")
        return None
    rest = stream.read(size - len(head))
    if len(rest) < size - len(head):
        _torn(stream, count, head + rest, "ends within a block")
        return None
    if struct.unpack(section.order + "I", rest[-4:])[0] != size:
        _torn(stream, count, head + rest, "has a damaged block")
        return None
    return kind, rest[:-4]


def _interface(body: bytes, order: str) -> _Interface:
    interface = _Interface(struct.unpack_from(order + "H", body)[0])
    offset = 8
    while offset + 4 <= len(body):
        code, size = struct.unpack_from(order + "HH", body, offset)
        value = body[offset + 4 : offset + 4 + size]
        if code == _OPTION_RESOLUTION and len(value) == 1:
            base = 2 if value[0] & 0x80 else 10
            interface.ticks_per_s = base ** (value[0] & 0x7F)
        elif code == _OPTION_OFFSET and len(value) == 8:
            interface.offset_s = struct.unpack(order + "q", value)[0]
        elif code == 0:
            break
        offset += 4 + size + -size % 4
    return interface


def _packet(kind: int, body: bytes, section: _Section, last_ns: int | None, count: CaptureCount) -> Packet | None:
    if kind == _SIMPLE:
        if not section.interfaces or len(body) < 4:
            return None
        if last_ns is None:
            count.untimed += 1
            return None
        original = struct.unpack_from(section.order + "I", body)[0]
        count.borrowed_times += 1
        return Packet(last_ns, section.interfaces[0].link, body[4 : 4 + original], original > len(body) - 4)
    if len(body) < 20:
        return None
    number, high, low, size, original = struct.unpack_from(section.order + "IIIII", body)
    if number >= len(section.interfaces) or size > len(body) - 20:
        return None
    interface = section.interfaces[number]
    ticks = high << 32 | low
    time_ns = interface.offset_s * NS_PER_S + ticks * NS_PER_S // interface.ticks_per_s
    return Packet(time_ns, interface.link, body[20 : 20 + size], size < original)
