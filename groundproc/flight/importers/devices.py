"""The clocks of the devices whose messages a recording holds, read from the messages' own bytes."""

from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np

from flightlog import hdl32e, mavlink, nmea, records
from flightlog.constants import HOUR_NS, NS_PER_MS, NS_PER_S, NS_PER_US
from groundproc.flight import claims
from groundproc.flight.importers.joining import Event


def _place(dtype: np.dtype[Any], name: str) -> slice:
    """Where a field lies in a packet."""
    assert dtype.fields is not None
    kind, offset = dtype.fields[name][:2]
    return slice(int(offset), int(offset) + int(kind.itemsize))


_DATA_STAMP: Final = _place(hdl32e.DATA_DTYPE, "stamp_us")
_POSITION_STAMP: Final = _place(hdl32e.POSITION_DTYPE, "stamp_us")
_SENTENCE: Final = _place(hdl32e.POSITION_DTYPE, "nmea")
_SYSTEM_TIME: Final = mavlink.message_id("SYSTEM_TIME")
_BOOT_WRAP_NS: Final = (1 << 32) * NS_PER_MS


class Reading(NamedTuple):
    """What a message says of the clock of the device that sent it."""

    device: tuple[str, bytes]
    """Whose clock."""
    time_ns: int | None
    """Its time when it sent the message, modulo `wrap_ns`; None where the message does not say."""
    wrap_ns: int
    kind: int
    """Messages of one kind are sent in the order of the device's times."""
    sequence: int | None
    """Number of the message modulo 256; None where the kind has none."""
    early_ns: int
    """Nothing is received before it was sent: a stamp that is earlier by more, by the clock of the device, is wrong."""
    slack_ns: int
    """Messages may come so much later than the fastest of them, and no clock was set."""


def reading(event: Event) -> Reading | None:
    """The clock that an event's bytes tell of; None for those of no device known."""
    if event.topic == records.LIDAR.topic:
        return _lidar(event, _DATA_STAMP, 0) if len(event.data) == hdl32e.DATA_BYTES else None
    if event.topic == records.POSITION.topic:
        return _lidar(event, _POSITION_STAMP, 1) if len(event.data) == hdl32e.POSITION_BYTES else None
    return _autopilot(event.data) if event.topic.startswith(records.MAVLINK.topic) else None


def _lidar(event: Event, place: slice, kind: int) -> Reading:
    stamp_us = int.from_bytes(event.data[place], "little")
    return Reading(
        ("lidar", event.sender), stamp_us * NS_PER_US % HOUR_NS, HOUR_NS, kind, None, 100 * NS_PER_MS, 150 * NS_PER_MS
    )


def _autopilot(data: bytes) -> Reading | None:
    frame = mavlink.frame_of(data)
    if frame is None or not frame.known:
        return None
    place = _boot_place(frame.message_id)
    # version 2 cuts trailing zeros
    stamp_ms = None if place is None else int.from_bytes(frame.payload[place : place + 4], "little")
    time_ns = None if stamp_ms is None else stamp_ms * NS_PER_MS
    device = ("autopilot", bytes((frame.system, frame.component)))
    # its messages have the time of what they tell, which differs from kind to kind
    early_ns, slack_ns = NS_PER_S // 2, 3 * NS_PER_S
    return Reading(device, time_ns, _BOOT_WRAP_NS, frame.message_id, frame.sequence, early_ns, slack_ns)


@cache
def _boot_place(number: int) -> int | None:
    """Where a message has its boot time; None where it has none or is of no kind known."""
    name = mavlink.message_name(number)
    return None if name is None else mavlink.field_offset(name, "time_boot_ms")


def stated_utc_ns(event: Event) -> int | None:
    """UTC that an event states: SYSTEM_TIME of an autopilot, or the sentence of a valid fix in a position packet; None for others."""
    if event.topic == records.POSITION.topic and len(event.data) == hdl32e.POSITION_BYTES:
        fix = nmea.parse_rmc(event.data[_SENTENCE])
        return _held(claims.GPRMC, fix.utc_ns) if fix is not None and fix.valid else None
    if event.topic.startswith(records.MAVLINK.topic):
        frame = mavlink.frame_of(event.data)
        if frame is not None and frame.message_id == _SYSTEM_TIME:
            return _held(claims.SYSTEM_TIME, int.from_bytes(frame.payload[:8], "little") * NS_PER_US)
    return None


def _held(name: str, utc_ns: int) -> int | None:
    """What a claim is worth alone: of the era that it can be of."""
    add_ns = claims.settled({name: utc_ns}).add_ns.get(name)
    return None if add_ns is None else utc_ns + add_ns
