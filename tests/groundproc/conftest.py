"""Recordings, and small captures made with struct alone, so that no writer of the project stands between file and test."""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from flightlog.mavlink import Frame


@pytest.fixture(scope="session")
def data_payload() -> Callable[..., bytes]:
    """A data packet of 1206 bytes by the manual: 12 blocks, a stamp, mode and product."""

    def make(
        stamp_us: int, azimuths: Sequence[int], *, mode: int = 0x37, product: int = 0x21, distance: int = 2500
    ) -> bytes:
        shot = struct.pack("<HB", distance, 40)
        blocks = b"".join(struct.pack("<HH", 0xEEFF, azimuth) + 32 * shot for azimuth in azimuths)
        return blocks + struct.pack("<IBB", stamp_us, mode, product)

    return make


@pytest.fixture(scope="session")
def turning(data_payload: Callable[..., bytes]) -> Callable[..., list[tuple[int, bytes]]]:
    """(device time [ns], payload) of a turning sensor that fires only inside its own field of view.

    Firings of 46.08 us; 12 fill a packet (6 in dual return mode, each of two blocks), whose stamp is that of the first.
    """

    def make(
        seconds: float,
        *,
        rpm: float = 600.0,
        start_us: int = 0,
        fov_deg: tuple[float, float] | None = None,
        dual: bool = False,
    ) -> list[tuple[int, bytes]]:
        count = int(seconds / 46.08e-6)
        azimuth = np.arange(count) * rpm * 6.0 * 46.08e-6 % 360.0
        fires = np.ones(count, bool)
        if fov_deg is not None:
            fires = (azimuth - fov_deg[0]) % 360.0 < (fov_deg[1] - fov_deg[0]) % 360.0
        firings = np.flatnonzero(fires)
        each = 6 if dual else 12
        found = []
        for first in range(0, len(firings) - each + 1, each):
            chosen = firings[first : first + each]
            values = np.repeat(np.rint(azimuth[chosen] * 100).astype(int) % 36000, 2 if dual else 1)
            time_us = start_us + chosen[0] * 46.08
            payload = data_payload(int(time_us) % 3_600_000_000, values.tolist(), mode=0x39 if dual else 0x37)
            found.append((int(time_us) * 1000, payload))
        return found

    return make


@pytest.fixture(scope="session")
def position_payload() -> Callable[..., bytes]:
    """A position packet of 512 bytes by the manual."""

    def make(stamp_us: int, nmea: bytes = b"", pps: int = 2) -> bytes:
        words = struct.pack("<12H", *(tag << 12 | 5 for tag in (0, 1, 2, 3) * 3))
        return (bytes(14) + words + bytes(160) + struct.pack("<IB", stamp_us, pps) + bytes(3) + nmea).ljust(
            512, b"\x00"
        )

    return make


@pytest.fixture(scope="session")
def ethernet() -> Callable[..., bytes]:
    """An Ethernet frame around a UDP payload."""

    def make(
        payload: bytes, port: int = 2368, *, sender: bytes = b"\xc0\xa8\x01\xc9", flags: int = 0, tags: bytes = b""
    ) -> bytes:
        udp = struct.pack(">4H", 443, port, 8 + len(payload), 0) + payload
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 1, flags, 64, 17, 0, sender, b"\xff" * 4)
        return b"\xff" * 6 + b"\x60\x76\x88\x20\x11\xa2" + tags + b"\x08\x00" + ip + udp

    return make


@pytest.fixture(scope="session")
def pcap() -> Callable[..., bytes]:
    """A classic pcap of (time [ns], frame)."""

    def make(frames: Sequence[tuple[int, bytes]], *, link: int = 1, order: str = "<", nano: bool = False) -> bytes:
        tick_ns = 1 if nano else 1000
        head = struct.pack(order + "IHHiIII", 0xA1B23C4D if nano else 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
        records = []
        for time_ns, frame in frames:
            seconds, rest_ns = divmod(time_ns, 10**9)
            records.append(struct.pack(order + "4I", seconds, rest_ns // tick_ns, len(frame), len(frame)) + frame)
        return head + b"".join(records)

    return make


@pytest.fixture(scope="session")
def tlog_frames(recordings: Path) -> Callable[[str], list["Frame"]]:
    """Frames of a recorded telemetry log: each of its records is a big-endian time in microseconds and bytes."""
    from flightlog.mavlink import FrameParser
    from groundproc.flight.importers import tlog

    def read(name: str) -> list["Frame"]:
        parser, found = FrameParser(), []
        for record in tlog.records((recordings / "mavlink" / f"{name}.tlog").read_bytes(), tlog.TlogCount()):
            found += parser.feed(record.time_ns, record.data)
        return found + parser.finish()

    return read


@pytest.fixture(scope="session")
def frames_of() -> Callable[..., list["Frame"]]:
    """Frames of pymavlink messages given with their receive times [ns]: frames_of([(time, message), ...], system=1, component=1)."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    from flightlog.mavlink import FrameParser

    def make(messages: Sequence[tuple[int, object]], system: int = 1, component: int = 1) -> list["Frame"]:
        sender = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        parser, found = FrameParser(), []
        for time_ns, message in messages:
            found += parser.feed(time_ns, bytes(message.pack(sender)))  # type: ignore[attr-defined]
        return found + parser.finish()

    return make
