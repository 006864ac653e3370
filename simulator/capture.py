"""What a laptop on the ground would have recorded: the packets as pcap, the telemetry as tlog."""

import struct
from collections.abc import Iterable
from typing import BinaryIO, Final

from flightlog.constants import NS_PER_S, NS_PER_US

_SENSOR_MAC: Final = bytes.fromhex("60768820126e")
_SENSOR_IP: Final = bytes((192, 168, 1, 201))
_BROADCAST_IP: Final = b"\xff\xff\xff\xff"
_MAGIC: Final = {"us": 0xA1B2C3D4, "ns": 0xA1B23C4D}
"""Magic numbers of the pcap format; all fields little endian (tcpdump.org, pcap-savefile)."""
_ETHERNET: Final = 1


def _checksum(header: bytes) -> int:
    """Internet checksum of an even number of bytes (RFC 1071)."""
    total: int = sum(struct.unpack(f">{len(header) // 2}H", header))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def udp_frame(payload: bytes, port: int) -> bytes:
    """Ethernet, IPv4 and UDP headers as an HDL-32E sends them, and the payload; no UDP checksum [measured]."""
    udp = struct.pack(">4H", port, port, 8 + len(payload), 0)
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp) + len(payload), 0, 0x4000, 255, 17, 0)
    head += _SENSOR_IP + _BROADCAST_IP
    head = head[:10] + struct.pack(">H", _checksum(head)) + head[12:]
    return b"\xff" * 6 + _SENSOR_MAC + b"\x08\x00" + head + udp + payload


class PcapWriter:
    """Writes a classic pcap file.

    Parameters
    ----------
    stream : BinaryIO
        Opened for writing; the caller's.
    resolution : str
        us or ns: unit of the stamps' fraction.
    """

    def __init__(self, stream: BinaryIO, resolution: str = "us") -> None:
        self._stream = stream
        self._unit_ns = NS_PER_US if resolution == "us" else 1
        stream.write(struct.pack("<IHHiIII", _MAGIC[resolution], 2, 4, 0, 0, 65535, _ETHERNET))

    def write(self, packets: Iterable[tuple[int, int, bytes]]) -> None:
        """Append packets of (time [ns], UDP port, payload)."""
        parts: list[bytes] = []
        for time_ns, port, payload in packets:
            frame = udp_frame(payload, port)
            seconds, rest_ns = divmod(time_ns, NS_PER_S)
            parts += (struct.pack("<4I", seconds, rest_ns // self._unit_ns, len(frame), len(frame)), frame)
        self._stream.write(b"".join(parts))


def tlog_record(time_ns: int, frame: bytes) -> bytes:
    """One record of a tlog: host time as big-endian microseconds, then the frame as received."""
    return struct.pack(">Q", time_ns // NS_PER_US) + frame
