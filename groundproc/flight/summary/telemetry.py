"""A MAVLink link in figures: what came from whom at what rate, what was lost, and how often the autopilot started anew."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import numpy as np

from flightlog import clock
from flightlog.mavlink import Frame, message_id, payload_dtype
from flightlog.vehicles import Vehicles
from groundproc.flight import sound
from groundproc.flight.claims import can_be
from groundproc.flight.summary.numbering import Numbering
from groundproc.flight.summary.rates import rate_hz, rounded

_WRAP_MS: Final = 1 << 32
_REBOOT_MS: Final = 10_000
"""A boot time this much below the last one is a new boot; messages that overtake each other differ by less."""
FIX_3D: Final = 3
"""`fix_type` of GPS_RAW_INT from which on there is a position with its height."""
_SYSTEM_TIME: Final = message_id("SYSTEM_TIME")
_GPS_RAW_INT: Final = message_id("GPS_RAW_INT")
_JUDGED: Final = {message_id(name): name for name in sound.LARGEST}
_TOGETHER: Final = 500
"""Messages whose values are looked at in one go."""
_BOOT_TIMED: Final = tuple(message_id(name) for name in ("SYSTEM_TIME", "ATTITUDE", "GLOBAL_POSITION_INT"))


@dataclass(slots=True)
class _Kind:
    """Messages of one kind from one component."""

    name: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0


@dataclass(slots=True)
class _Boot:
    """One run of an autopilot, from power-on or from where the recording begins."""

    first_ns: int
    first_ms: int
    last_ns: int
    last_ms: int


@dataclass(slots=True)
class _Node:
    """One component of one system."""

    kinds: dict[int, _Kind] = field(default_factory=dict)
    numbers: Numbering = field(default_factory=Numbering)
    boots: list[_Boot] = field(default_factory=list)


@dataclass(slots=True)
class TelemetrySummary:
    """Sums over all frames of a link; `result` turns them into figures."""

    frames: int = 0
    nodes: dict[tuple[int, int], _Node] = field(default_factory=dict)
    vehicles: Vehicles = field(default_factory=Vehicles)
    first_utc_ns: int | None = None
    """The first UTC that the autopilot states and that can be."""
    first_utc_received_ns: int = 0
    impossible_utc: int = 0
    """SYSTEM_TIME messages with a date that cannot be; one without a fix has none."""
    fix_type: int | None = None
    satellites: int | None = None
    fixes: int = 0
    """Reports of the receiver since its first fix in three dimensions."""
    without_fix: int = 0
    """Those of them without one."""
    impossible: dict[str, int] = field(default_factory=dict)
    """Messages with values that cannot be, by name."""
    _waiting: dict[int, list[bytes]] = field(default_factory=dict)

    def add(self, frame: Frame) -> None:
        """Take the next frame; one outside the dialect counts nothing, its sender is not proven."""
        if not frame.known:
            return
        self.frames += 1
        node = self.nodes.setdefault((frame.system, frame.component), _Node())
        kind = node.kinds.setdefault(frame.message_id, _Kind(frame.name, 0, frame.time_ns))
        kind.count += 1
        kind.last_ns = frame.time_ns
        node.numbers.take(frame)
        self.vehicles.hear(frame)
        if frame.message_id == _GPS_RAW_INT:
            fix_type = _value(frame, "fix_type")
            self.fix_type = max(self.fix_type or 0, fix_type)
            if self.fix_type >= FIX_3D:
                self.fixes += 1
                self.without_fix += fix_type < FIX_3D
            self.satellites = max(self.satellites or 0, _value(frame, "satellites_visible"))
        if frame.message_id in _JUDGED:
            self._judge(frame)
        if frame.message_id in _BOOT_TIMED:
            _boot(node, frame.time_ns, _value(frame, "time_boot_ms"))
        if frame.message_id == _SYSTEM_TIME:
            self._system_time(frame.time_ns, _value(frame, "time_unix_usec") * 1000)

    def _system_time(self, received_ns: int, utc_ns: int) -> None:
        if can_be(utc_ns):
            if self.first_utc_ns is None:
                self.first_utc_ns, self.first_utc_received_ns = utc_ns, received_ns
        else:
            self.impossible_utc += utc_ns >= clock.PLAUSIBLE_UTC_NS[1]

    def _judge(self, frame: Frame) -> None:
        waiting = self._waiting.setdefault(frame.message_id, [])
        waiting.append(frame.payload)
        if len(waiting) >= _TOGETHER:
            self._judge_waiting()

    def _judge_waiting(self) -> None:
        """Count the messages with values that cannot be, among those not looked at yet."""
        for number, payloads in self._waiting.items():
            dtype, name = payload_dtype(number), _JUDGED[number]
            packed = b"".join(payload[: dtype.itemsize].ljust(dtype.itemsize, b"\x00") for payload in payloads)
            bad = int((~sound.possible(np.frombuffer(packed, dtype), name)).sum())
            if bad:
                self.impossible[name] = self.impossible.get(name, 0) + bad
        self._waiting.clear()

    def result(self, bad_bytes: int, unknown: int) -> dict[str, Any]:
        """The figures; see `swath info --json`."""
        self._judge_waiting()
        autopilots = {key: self.nodes[key] for key in self.vehicles.vehicles()}
        return {
            "frames": self.frames,
            "unknown_frames": unknown,
            "bad_bytes": bad_bytes,
            "lost_frames": sum(node.numbers.lost for node in autopilots.values()),
            "duplicate_frames": sum(node.numbers.duplicates for node in autopilots.values()),
            "late_frames": sum(node.numbers.late for node in autopilots.values()),
            "impossible": dict(sorted(self.impossible.items())),
            "autopilots": [_autopilot(key, node) for key, node in autopilots.items()],
            "reboots": sum(max(len(node.boots) - 1, 0) for node in autopilots.values()),
            "gps_fix_type": self.fix_type,
            "gps_satellites": self.satellites,
            "gps_after_first_fix": {"reports": self.fixes, "without": self.without_fix} if self.fixes else None,
            "first_system_time_utc": clock.utc_text(self.first_utc_ns) if self.first_utc_ns else None,
            "impossible_system_times": self.impossible_utc,
            "notes": [],
            "shared_ids": [],
            "messages": [
                _kind(key, kind)
                for key, node in sorted(self.nodes.items())
                for kind in sorted(node.kinds.values(), key=lambda kind: (-kind.count, kind.name))
            ],
        }


def _boot(node: _Node, time_ns: int, boot_ms: int) -> None:
    last = node.boots[-1] if node.boots else None
    if last is None or (last.last_ms - boot_ms > _REBOOT_MS and last.last_ms - boot_ms < _WRAP_MS - _REBOOT_MS):
        if last is not None:
            node.numbers.restarted(time_ns)
        node.boots.append(_Boot(time_ns, boot_ms, time_ns, boot_ms))
        return
    last.last_ns, last.last_ms = time_ns, boot_ms


def _autopilot(key: tuple[int, int], node: _Node) -> dict[str, Any]:
    return {
        "system": key[0],
        "component": key[1],
        "lost_frames": node.numbers.lost,
        "boots": [
            {
                "from_utc": clock.utc_text(boot.first_ns),
                "to_utc": clock.utc_text(boot.last_ns),
                "from_boot_s": boot.first_ms / 1000,
                "to_boot_s": boot.last_ms / 1000,
            }
            for boot in node.boots
        ],
    }


def _kind(key: tuple[int, int], kind: _Kind) -> dict[str, Any]:
    return {
        "system": key[0],
        "component": key[1],
        "name": kind.name,
        "count": kind.count,
        "rate_hz": rounded(rate_hz(kind.count, kind.last_ns - kind.first_ns), 3),
    }


@cache
def _place(number: int, name: str) -> tuple[int, int]:
    """Offset and size of an integer field in a message's payload."""
    fields = payload_dtype(number).fields
    assert fields is not None
    dtype, offset = fields[name][:2]
    return int(offset), int(dtype.itemsize)


def _value(frame: Frame, name: str) -> int:
    """An unsigned field of a message; version 2 cuts trailing zeros."""
    offset, size = _place(frame.message_id, name)
    return int.from_bytes(frame.payload[offset : offset + size], "little")
