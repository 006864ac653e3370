"""From a captured packet to its UDP datagram: link layers, VLAN tags, IPv4 and IPv6, datagrams in fragments.

Sources: link types of tcpdump.org; RFC 791, 8200 (IP, fragments), 4302 (length of an authentication header).
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from groundproc.flight.importers.fragments import Fragments, Key
from groundproc.flight.importers.pcap import Packet

_NULL, _ETHERNET, _RAW, _LOOP, _SLL, _IPV4, _IPV6, _SLL2 = 0, 1, 101, 108, 113, 228, 229, 276
_BARE: Final = (_RAW, _IPV4, _IPV6, 12, 14)
"""Links whose packets begin with the IP header; 12 and 14 are what some systems write for raw IP."""
_LINKS: Final = frozenset((_NULL, _ETHERNET, _LOOP, _SLL, _SLL2, *_BARE))
LINK_NAMES: Final = {
    6: "IEEE 802.5 (token ring)", 8: "SLIP", 9: "PPP", 10: "FDDI", 50: "PPP in HDLC framing", 51: "PPP over Ethernet",
    100: "LLC/SNAP over ATM", 104: "Cisco HDLC", 105: "IEEE 802.11", 107: "frame relay", 109: "IPsec (enc)", 117: "pflog",
    119: "IEEE 802.11 with a Prism header", 122: "IP over Fibre Channel", 127: "IEEE 802.11 with radiotap", 147: "user 0",
    149: "user 2 (pktap)", 163: "IEEE 802.11 with an AVS header", 166: "PPP with a direction", 187: "Bluetooth HCI",
    189: "USB", 195: "IEEE 802.15.4", 201: "Bluetooth HCI with a direction", 220: "USB (usbmon)", 227: "CAN (SocketCAN)",
    230: "IEEE 802.15.4 without checksum", 239: "netfilter log (nflog)", 249: "USB (USBPcap)", 253: "netlink",
    254: "Bluetooth monitor", 258: "pktap",
}  # fmt: skip
"""Of link layers that are not read."""
_IP_KINDS: Final = (0x0800, 0x86DD)
_VLAN: Final = (0x8100, 0x88A8, 0x9100, 0x9200)
_UDP: Final = 17
_SHORTEST_IPV4: Final = 20
_IPV6_HEAD: Final = 40
_EXTENSIONS: Final = (0, 43, 60)
_FRAGMENT: Final = 44
_AUTHENTICATION: Final = 51


class Datagram(NamedTuple):
    """One UDP datagram."""

    time_ns: int
    """When it was whole."""
    sender: bytes
    """IPv4 or IPv6 address."""
    port: int
    """Destination port."""
    payload: bytes
    source_port: int


@dataclass(slots=True)
class DatagramCount:
    """What became of the packets of a capture."""

    datagrams: int = 0
    reassembled: int = 0
    """Datagrams that came in fragments."""
    other: int = 0
    """No UDP over IP."""
    links: dict[int, int] = field(default_factory=dict)
    """Packets of link layers that are not read, by link type."""
    fragments: int = 0
    """Pieces of datagrams that never became whole."""
    cut: int = 0
    """Datagrams of which the capture kept only the beginning (snap length)."""
    snap_bytes: int = 0
    """Longest beginning that was kept of them."""


def datagrams(packets: Iterable[Packet], count: DatagramCount) -> Iterator[Datagram]:
    """Give the UDP datagrams of a capture, count the rest."""
    parts = Fragments()
    for packet in packets:
        data, start = packet.data, _ip_start(packet.link, packet.data)
        found = None
        if start is not None and start < len(data):
            version = data[start] >> 4
            if version == 4:
                found = _ipv4(packet, start, parts)
            elif version == 6:
                found = _ipv6(packet, start, parts)
        if isinstance(found, Datagram):
            count.datagrams += 1
            yield found
        elif found is not _WAITING:
            _left_out(packet, found is _CUT, count)
    count.fragments, count.reassembled = parts.left_out + parts.waiting, parts.whole


_WAITING: Final = "waiting"
"""A fragment whose datagram is not whole yet."""
_CUT: Final = "cut"
"""A datagram whose end was not captured."""
_Outcome = Datagram | str | None


def _left_out(packet: Packet, cut: bool, count: DatagramCount) -> None:
    if packet.link not in _LINKS:
        count.links[packet.link] = count.links.get(packet.link, 0) + 1
    elif cut or packet.cut:
        count.cut += 1
        count.snap_bytes = max(count.snap_bytes, len(packet.data))
    else:
        count.other += 1


def _ip_start(link: int, data: bytes) -> int | None:
    """Offset of the IP header, None for what is not IP."""
    if link == _ETHERNET:
        return _after_tags(data, 12, 14)
    if link in _BARE:
        return 0
    if link == _SLL:
        return _after_tags(data, 14, 16)
    if link == _SLL2:
        return _after_tags(data, 0, 20)
    if link in (_NULL, _LOOP):
        return 4
    return None


def _after_tags(data: bytes, kind_at: int, start: int) -> int | None:
    """What follows the ethertype at `kind_at` begins at `start`; skip VLAN tags there. None where it is not IP."""
    while start <= len(data):
        kind = data[kind_at] << 8 | data[kind_at + 1]
        if kind in _IP_KINDS:
            return start
        if kind not in _VLAN:
            return None
        kind_at, start = start + 2, start + 4
    return None


def _ipv4(packet: Packet, start: int, parts: Fragments) -> _Outcome:
    data = packet.data
    if len(data) < start + _SHORTEST_IPV4:
        return None
    head = (data[start] & 0x0F) * 4
    if data[start + 9] != _UDP or head < _SHORTEST_IPV4:
        return None
    flags = data[start + 6] << 8 | data[start + 7]
    sender = data[start + 12 : start + 16]
    if not flags & 0x3FFF:
        return _udp(packet.time_ns, sender, data, start + head)
    end = start + (data[start + 2] << 8 | data[start + 3])
    key = (data[start + 4 : start + 6], data[start + 12 : start + 20])
    return _piece(packet, sender, parts, key, (flags & 0x1FFF) * 8, bool(flags & 0x2000), (start + head, end))


def _ipv6(packet: Packet, start: int, parts: Fragments) -> _Outcome:
    data = packet.data
    if len(data) < start + _IPV6_HEAD:
        return None
    sender = data[start + 8 : start + 24]
    kind, at = data[start + 6], start + _IPV6_HEAD
    end = at + (data[start + 4] << 8 | data[start + 5])
    while kind != _UDP:
        if at + 8 > len(data):
            return None
        if kind == _FRAGMENT:
            place = data[at + 2] << 8 | data[at + 3]
            if place & 0xFFF9:
                if data[at] != _UDP:
                    return None
                key = (data[at + 4 : at + 8], data[start + 8 : start + 40])
                return _piece(packet, sender, parts, key, place & 0xFFF8, bool(place & 1), (at + 8, end))
            size = 8
        elif kind in _EXTENSIONS:
            size = (data[at + 1] + 1) * 8
        elif kind == _AUTHENTICATION:
            size = (data[at + 1] + 2) * 4
        else:
            return None
        kind, at = data[at], at + size
    return _udp(packet.time_ns, sender, data, at)


def _piece(
    packet: Packet, sender: bytes, parts: Fragments, key: Key, place: int, more: bool, stretch: tuple[int, int]
) -> _Outcome:
    """Take a fragment, whose bytes are a stretch of the packet; gives the datagram that it completes."""
    first, end = stretch
    if end > len(packet.data):
        return _CUT
    whole = parts.add(key, place, packet.data[first:end], more=more)
    return _WAITING if whole is None else _udp(packet.time_ns, sender, whole, 0)


def _udp(time_ns: int, sender: bytes, data: bytes, start: int) -> _Outcome:
    if len(data) < start + 8:
        return _CUT
    source, port, size = struct.unpack_from(">HHH", data, start)
    payload = data[start + 8 : start + size]
    if size < 8 or len(payload) < size - 8:
        return _CUT
    return Datagram(time_ns, sender, port, payload, source)
