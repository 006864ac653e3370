"""From a captured packet to its UDP datagram: link layers, VLAN tags, IPv4."""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from groundproc.flight.importers.pcap import Packet

_NULL, _ETHERNET, _RAW, _LOOP, _SLL, _IPV4, _SLL2 = 0, 1, 101, 108, 113, 228, 276
_RAW_TOO: Final = (12, 14)
"""What some systems write for raw IP."""
_ETHERTYPE_IPV4: Final = 0x0800
_VLAN: Final = (0x8100, 0x88A8, 0x9100)
_UDP: Final = 17
_SHORTEST_IPV4: Final = 20


class Datagram(NamedTuple):
    """One UDP datagram over IPv4."""

    time_ns: int
    sender: bytes
    """IPv4 address."""
    port: int
    """Destination port."""
    payload: bytes


@dataclass(slots=True)
class DatagramCount:
    """What became of the packets of a capture."""

    datagrams: int = 0
    other: int = 0
    """No UDP over IPv4, or of an unknown link layer."""
    fragments: int = 0
    """Pieces of a datagram that was too large for the link: no sensor of ours sends such."""
    cut: int = 0
    """Datagrams of which the capture kept only the beginning (snap length)."""


def datagrams(packets: Iterable[Packet], count: DatagramCount) -> Iterator[Datagram]:
    """Give the UDP datagrams of a capture, count the rest."""
    for packet in packets:
        start = _ip_start(packet.link, packet.data)
        if start is None:
            count.other += 1
            continue
        found = _datagram(packet, start, count)
        if found is not None:
            count.datagrams += 1
            yield found


def _ip_start(link: int, data: bytes) -> int | None:
    """Offset of the IPv4 header, None for what is not IPv4."""
    if link == _ETHERNET:
        return _after_ethertype(data, 12)
    if link in (_RAW, _IPV4, *_RAW_TOO):
        return 0
    if link == _SLL:
        return _after_ethertype(data, 14)
    if link == _SLL2:
        return 20 if data[:2] == b"\x08\x00" else None
    if link in (_NULL, _LOOP):
        return 4
    return None


def _after_ethertype(data: bytes, offset: int) -> int | None:
    """Skip VLAN tags; None where what follows is not IPv4."""
    while offset + 2 <= len(data):
        kind = data[offset] << 8 | data[offset + 1]
        if kind == _ETHERTYPE_IPV4:
            return offset + 2
        if kind not in _VLAN:
            return None
        offset += 4
    return None


def _datagram(packet: Packet, start: int, count: DatagramCount) -> Datagram | None:
    data = packet.data
    if len(data) < start + _SHORTEST_IPV4 or data[start] >> 4 != 4:
        count.other += 1
        return None
    head = (data[start] & 0x0F) * 4
    flags = data[start + 6] << 8 | data[start + 7]
    if data[start + 9] != _UDP or head < _SHORTEST_IPV4:
        count.other += 1
        return None
    if flags & 0x3FFF:  # more fragments, or an offset
        count.fragments += 1
        return None
    udp = start + head
    if len(data) < udp + 8:
        count.cut += 1
        return None
    port, size = struct.unpack_from(">HH", data, udp + 2)
    payload = data[udp + 8 : udp + size]
    if size < 8 or len(payload) < size - 8:
        count.cut += 1
        return None
    return Datagram(packet.time_ns, data[start + 12 : start + 16], port, payload)
