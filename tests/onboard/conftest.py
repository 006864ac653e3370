"""Recordings as bytes, read here with struct alone, and sockets of the loopback."""

import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recordings() -> Path:
    folder = os.environ.get("SWATH_RECORDINGS")
    if not folder:
        pytest.skip("SWATH_RECORDINGS is not set: no recordings to test with")
    return Path(folder)


def payloads(path: Path, port: int) -> list[bytes]:
    """UDP payloads to a port, in a little-endian Ethernet pcap."""
    raw, offset, found = path.read_bytes(), 24, []
    while offset < len(raw):
        size = struct.unpack_from("<I", raw, offset + 8)[0]
        frame = raw[offset + 16 : offset + 16 + size]
        if struct.unpack_from(">H", frame, 36)[0] == port:
            found.append(frame[42:])
        offset += 16 + size
    return found


@pytest.fixture(scope="session")
def monterey_data(recordings: Path) -> list[bytes]:
    return payloads(recordings / "lidar" / "hdl32e_monterey.pcap", 2368)


@pytest.fixture(scope="session")
def monterey_position(recordings: Path) -> list[bytes]:
    return payloads(recordings / "lidar" / "hdl32e_monterey.pcap", 8308)


@pytest.fixture(scope="session")
def vlp16_data(recordings: Path) -> list[bytes]:
    return payloads(recordings / "lidar" / "vlp16_gps.pcap", 2368)


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield sock


@pytest.fixture
def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
