"""Recordings as bytes."""

from pathlib import Path

import pytest
from captures import DATA_PORT, POSITION_PORT, read_udp


@pytest.fixture(scope="session")
def monterey_data(recordings: Path) -> list[tuple[int, bytes]]:
    return read_udp(recordings / "lidar" / "hdl32e_monterey.pcap", DATA_PORT)


@pytest.fixture(scope="session")
def monterey_position(recordings: Path) -> list[tuple[int, bytes]]:
    return read_udp(recordings / "lidar" / "hdl32e_monterey.pcap", POSITION_PORT)


@pytest.fixture(scope="session")
def vlp16_data(recordings: Path) -> list[tuple[int, bytes]]:
    return read_udp(recordings / "lidar" / "vlp16_gps.pcap", DATA_PORT)


@pytest.fixture(scope="session")
def vlp16_position(recordings: Path) -> list[tuple[int, bytes]]:
    return read_udp(recordings / "lidar" / "vlp16_gps.pcap", POSITION_PORT)
