"""A socket's own filter in the kernel: only datagrams of one length, sender or interface are queued.

A flood therefore takes no room in the buffer. Classic BPF (Linux socket filter, linux/filter.h) needs no privilege.
For a UDP socket a program sees the datagram from its UDP header on; the IP header is reached at SKF_NET_OFF.
"""

import ctypes
import ipaddress
import socket
import struct
from typing import Final

SO_ATTACH_FILTER: Final = 26
SO_DETACH_FILTER: Final = 27

_LOAD_LENGTH: Final = 0x80
_LOAD_WORD: Final = 0x20
_JUMP_IF_EQUAL: Final = 0x15
_RETURN: Final = 0x06
_UDP_HEADER_BYTES: Final = 8
_IP_SOURCE: Final = 0xFFF0_0000 + 12
"""SKF_NET_OFF and the offset of the source address in an IPv4 header (RFC 791)."""
_INTERFACE: Final = 0xFFFF_F000 + 8
"""SKF_AD_OFF + SKF_AD_IFINDEX: the index of the interface that it came in by."""
_ALL: Final = 0xFFFF_FFFF


def address_number(text: str) -> int:
    """An IPv4 address as a number; ValueError where it is none."""
    return int(ipaddress.IPv4Address(text))


def address_text(number: int) -> str:
    """The number of an IPv4 address as people write it."""
    return str(ipaddress.IPv4Address(number))


def program(payload_bytes: int | None = None, source: int | None = None, interface: int | None = None) -> bytes:
    """The filter's instructions: let pass what has this length, comes from this IPv4 address, came in by the interface of this index."""
    wanted = [
        (_LOAD_LENGTH, 0, None if payload_bytes is None else payload_bytes + _UDP_HEADER_BYTES),
        (_LOAD_WORD, _IP_SOURCE, source),
        (_LOAD_WORD, _INTERFACE, interface),
    ]
    checks = [(load, where, value) for load, where, value in wanted if value is not None]
    lines = []
    for left, (load, where, value) in zip(range(len(checks) - 1, -1, -1), checks, strict=True):
        lines += [(load, 0, 0, where), (_JUMP_IF_EQUAL, 0, 2 * left + 1, value)]
    lines += [(_RETURN, 0, 0, _ALL), (_RETURN, 0, 0, 0)]
    return b"".join(struct.pack("=HBBI", *line) for line in lines)


def attach(sock: socket.socket, code: bytes) -> None:
    """Let a socket queue only what a program lets pass; replaces the filter before."""
    buffer = ctypes.create_string_buffer(code, len(code))
    sock.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("@HP", len(code) // 8, ctypes.addressof(buffer)))


def detach(sock: socket.socket) -> None:
    """Let everything pass again; the socket must have a filter."""
    sock.setsockopt(socket.SOL_SOCKET, SO_DETACH_FILTER, 0)
