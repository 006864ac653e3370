"""Captures, read with struct alone, so that no reader of the project stands between file and test."""

import struct
from pathlib import Path

DATA_PORT, POSITION_PORT = 2368, 8308
"""Of a Velodyne."""


def read_udp(path: Path, port: int) -> list[tuple[int, bytes]]:
    """(time [ns], payload) of every UDP datagram to a port in a classic little-endian Ethernet pcap without IP options."""
    data = path.read_bytes()
    magic, link = struct.unpack_from("<I16xI", data)
    assert (magic, link) == (0xA1B2C3D4, 1)
    found, offset = [], 24
    while offset < len(data):
        seconds, microseconds, captured, _ = struct.unpack_from("<4I", data, offset)
        frame = data[offset + 16 : offset + 16 + captured]
        offset += 16 + captured
        assert (frame[12:15], frame[23]) == (b"\x08\x00\x45", 17)
        if struct.unpack_from(">H", frame, 36)[0] == port:
            length = struct.unpack_from(">H", frame, 38)[0]
            found.append((seconds * 10**9 + microseconds * 1000, frame[42 : 34 + length]))
    return found
