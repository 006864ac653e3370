"""Telemetry logs whose vehicles are given other ids and other times since boot, as nobody set them apart."""

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.generator.mavcrc import x25crc

from flightlog.mavlink import field_offset, message_name
from groundproc.flight.importers import tlog

_MICROSECONDS = ("RAW_IMU", "GPS_RAW_INT", "HIGHRES_IMU")


def records(data: bytes, system: int, as_system: int, later_ms: int) -> Iterator[tuple[int, bytes]]:
    """Receive time and frame of each record; those of one system under another id, and that much longer since boot [ms]."""
    for record in tlog.records(data, tlog.TlogCount()):
        raw = bytearray(record.data)
        assert raw[0] == 0xFE
        if raw[3] == system:
            raw[3] = as_system
            name = message_name(raw[5]) or ""
            for label, size, unit in (("time_boot_ms", 4, 1), ("time_usec", 8, 1000)):
                place = field_offset(name, label) if label == "time_boot_ms" or name in _MICROSECONDS else None
                if place is not None:
                    time = int.from_bytes(raw[6 + place : 6 + place + size], "little") + later_ms * unit
                    raw[6 + place : 6 + place + size] = time.to_bytes(size, "little")
            checksum = x25crc(bytes(raw[1:-2]) + bytes([dialect.mavlink_map[raw[5]].crc_extra]))
            raw[-2:] = checksum.crc.to_bytes(2, "little")
        yield record.time_ns, bytes(raw)


def shared_tlog(data: bytes, later_ms: int) -> bytes:
    """A telemetry log whose vehicle 2 has the id of vehicle 1."""
    return b"".join((time_ns // 1000).to_bytes(8, "big") + raw for time_ns, raw in records(data, 2, 1, later_ms))
