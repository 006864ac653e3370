"""Vehicles that share one MAVLink address, separated by the numbers of their messages.

Two vehicles that nobody gave ids of their own look like one sender by their address. But each counts its own messages,
and its own time since boot. If one counter cannot explain a stream and two can, there are two senders. They are two
vehicles if their clocks, attitudes or places contradict each other, and otherwise one that was heard over two links.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import mavlink
from flightlog.constants import NS_PER_MS
from flightlog.mavlink import Frame

_NEAR: Final = 16
"""Numbers that a message may be ahead of its sender's last one; more lost on end are rare."""
_ONE: Final = 0.9
"""Share of near messages from which on one counter explains a link: where half are lost, more than 99 of 100 are near."""
_ALL: Final = 0.9
"""Share of near messages with several counters, below which the link is in disorder and tells nothing."""
_SENDERS: Final = 4
_LEAST: Final = 0.1
"""Share of the messages that a sender has at least."""
_FEWEST: Final = 64
_LATE_MS: Final = 2500.0
"""Links delay by less."""
_CLOCKS_MS: Final = 1000.0
"""Boot clocks of one vehicle agree within what its links delay."""
_TOGETHER_MS: Final = 200
_TURNED_DEG: Final = 5.0
"""Within 0.2 s a vehicle turns by less, in the median of a flight."""
_APART_M: Final = 20.0
_STAMPED: Final = {name: mavlink.message_id(name) for name in ("ATTITUDE", "GLOBAL_POSITION_INT")}
_PLACES: Final = {
    mavlink.message_id(name): place
    for name in (*_STAMPED, "SCALED_PRESSURE", "SYSTEM_TIME")
    if (place := mavlink.field_offset(name, "time_boot_ms")) is not None
}
"""Where messages have their time since boot."""


def parted(frames: Sequence[Frame]) -> list[list[Frame]]:
    """The frames of one address by vehicle, the one heard first ahead.

    Parameters
    ----------
    frames : sequence of Frame
        In order of reception.
    """
    whole = [list(frames)]
    numbers = np.fromiter((frame.sequence for frame in frames), np.int64, len(frames))
    if len(numbers) < _FEWEST or (np.mod(np.diff(numbers) - 1, 256) < _NEAR).mean() >= _ONE:
        return whole
    owner, near = _owners(numbers.tolist())
    owner = _by_clock(frames, owner)
    parts = [[frames[i] for i in np.flatnonzero(owner == each).tolist()] for each in np.unique(owner).tolist()]
    parts = [part for part in parts if len(part) >= _LEAST * len(frames)]
    if near < _ALL or len(parts) < 2 or not all(_differ(parts[0], other) for other in parts[1:]):
        return whole
    return parts


def _owners(numbers: Sequence[int]) -> tuple[npt.NDArray[np.int64], float]:
    """Which counter each message goes on from, and the share of those near to one; at most `_SENDERS` are followed."""
    last: list[int] = []
    owner = np.empty(len(numbers), np.int64)
    near = 0
    for i, number in enumerate(numbers):
        ahead = [(number - each - 1) % 256 for each in last]
        best = min(range(len(last)), key=ahead.__getitem__, default=-1)
        if best >= 0 and ahead[best] < _NEAR:
            near += 1
        elif len(last) < _SENDERS:
            best = len(last)
            last.append(number)
        owner[i], last[best] = best, number
    return owner, near / len(numbers)


def _by_clock(frames: Sequence[Frame], owner: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Owners again, where a message's time since boot is another sender's: counters that meet are mistaken for each other."""
    rows, delay_ms = [], []
    for i, frame in enumerate(frames):
        place = _PLACES.get(frame.message_id)
        if place is not None:
            rows.append(i)
            boot_ms = int.from_bytes(frame.payload[place : place + 4], "little")
            delay_ms.append(frame.time_ns / NS_PER_MS - boot_ms)
    row, delay = np.array(rows, np.int64), np.array(delay_ms)
    senders = [each for each in np.unique(owner[row]).tolist() if (owner[row] == each).mean() >= _LEAST]
    usual = np.array([np.median(delay[owner[row] == each]) for each in senders])
    if len(usual) < 2 or np.diff(np.sort(usual)).min() <= 2.0 * _LATE_MS:
        return owner
    mended = owner.copy()
    mended[row] = np.array(senders)[np.abs(delay[:, None] - usual).argmin(axis=1)]
    return mended


def _differ(first: Sequence[Frame], second: Sequence[Frame]) -> bool:
    """Whether two senders are two vehicles: their clocks, attitudes or places contradict."""
    tables = {name: (_table(first, name), _table(second, name)) for name in _STAMPED}
    for a, b in tables.values():
        if len(a) and len(b) and abs(_delay_ms(a) - _delay_ms(b)) > _CLOCKS_MS:
            return True
    attitude, place = tables["ATTITUDE"], tables["GLOBAL_POSITION_INT"]
    return _turned_deg(*attitude) > _TURNED_DEG or _apart_m(*place) > _APART_M


def _table(frames: Sequence[Frame], name: str) -> npt.NDArray[np.void]:
    return mavlink.table([frame for frame in frames if frame.message_id == _STAMPED[name]], name)


def _delay_ms(table: npt.NDArray[np.void]) -> float:
    """Receive time less boot time, of the fastest message [ms]."""
    return float((table["host_ns"] / NS_PER_MS - table["time_boot_ms"]).min())


def _pairs(a: npt.NDArray[np.void], b: npt.NDArray[np.void]) -> tuple[npt.NDArray[np.void], npt.NDArray[np.void]]:
    """Rows of both at nearly the same boot time."""
    if not len(a) or not len(b):
        return a[:0], b[:0]
    b = b[np.argsort(b["time_boot_ms"], kind="stable")]
    times, wanted = b["time_boot_ms"].astype(np.int64), a["time_boot_ms"].astype(np.int64)
    found = np.clip(np.searchsorted(times, wanted), 0, len(b) - 1)
    near = np.abs(times[found] - wanted) <= _TOGETHER_MS
    return a[near], b[found[near]]


def _turned_deg(a: npt.NDArray[np.void], b: npt.NDArray[np.void]) -> float:
    """Median of the largest difference between their angles at the same time [deg]."""
    a, b = _pairs(a, b)
    if not len(a):
        return 0.0
    off = np.stack([a[name].astype(np.float64) - b[name].astype(np.float64) for name in ("roll", "pitch", "yaw")])
    off = off[:, np.isfinite(off).all(axis=0)]
    return float(np.degrees(np.median(np.abs(np.angle(np.exp(1j * off))).max(axis=0)))) if off.size else 0.0


def _apart_m(a: npt.NDArray[np.void], b: npt.NDArray[np.void]) -> float:
    """Median of the distance in plan at the same time [m]."""
    a, b = _pairs(a, b)
    if not len(a):
        return 0.0
    north, east = (a[name].astype(np.float64) - b[name].astype(np.float64) for name in ("lat", "lon"))
    scale = np.cos(np.radians(a["lat"].astype(np.float64) * 1e-7))
    return float(np.median(np.hypot(north, east * scale)) * 1e-7 * 111_320.0)
