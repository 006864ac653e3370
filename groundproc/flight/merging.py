"""The board's own logs together with what was heard of the same autopilot on a link.

Both have the same clock, that of the boot. Where both were recorded, the board's log is better in everything but one: it does not
tell when anything was received. What lies outside of it, such as the time before arming, is the link's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_MS, NS_PER_S
from groundproc.flight.autopilot import Boot, Vehicle
from groundproc.flight.timebase import boot_utc

Array = npt.NDArray[np.float64]

LEAST_COMMON_S: Final = 5.0
LEAST_COMMON_ROWS: Final = 10
SAME_RAD: Final = np.deg2rad(2.0)
"""Median difference of two records of one attitude: rounding, and interpolation between samples."""
SAME_UTC_NS: Final = 5 * NS_PER_S
_EDGE_NS: Final = 50 * NS_PER_MS

_CALLED: Final = {
    "HIGHRES_IMU": "inertial samples", "ATTITUDE": "attitudes", "GLOBAL_POSITION_INT": "positions", "GPS_RAW_INT": "GPS fixes",
    "SCALED_PRESSURE": "pressures", "SYSTEM_TIME": "UTC",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Merged:
    """All vehicles, of links and logs.

    Attributes
    ----------
    vehicles : list of Vehicle
        Those of the link in their order, then the logs that belong to none of them.
    notes : tuple of str
    """

    vehicles: list[Vehicle]
    notes: tuple[str, ...]


def merge(vehicles: Sequence[Vehicle], logs: Sequence[Boot]) -> Merged:
    """Give each log of a board to the boot of the link that it is of.

    Parameters
    ----------
    vehicles : sequence of Vehicle
        As heard on the link; may be empty.
    logs : sequence of Boot
        From `boardlog`.
    """
    made, notes = list(vehicles), []
    alone: list[Boot] = []
    for log in logs:
        place = _of_same_boot(made, log)
        if place is None:
            alone.append(log)
            notes.append(f"used of the board's own log: {_uses(log)}")
            continue
        number, which = place
        boots = list(made[number].boots)
        boots[which] = _joined(boots[which], log)
        made[number] = replace(made[number], boots=boots)
        notes.append(
            f"used of the board's own log: {_uses(boots[which])}; of the link: receive times, and what the log lacks"
        )
    _add_alone(made, alone)
    return Merged(made, tuple(notes))


def _add_alone(vehicles: list[Vehicle], logs: Sequence[Boot]) -> None:
    """Logs that no boot of a link goes with: boots of their own, of the one vehicle at other times or of another one."""
    if not logs:
        return
    one = len(vehicles) == 1
    if one and not any(_overlap(boot, log) for boot in vehicles[0].boots for log in logs):
        boots = sorted([*vehicles[0].boots, *logs], key=_first_heard)
        vehicles[0] = replace(vehicles[0], boots=[replace(boot, number=i) for i, boot in enumerate(boots)])
        return
    boots = sorted(logs, key=_first_heard)
    address = (boots[0].system, boots[0].component)
    vehicles.append(
        Vehicle((address,), [replace(boot, number=i) for i, boot in enumerate(boots)], source="the board's own log")
    )


def _first_heard(boot: Boot) -> int:
    _, host_ns = boot.host_pairs()
    return int(host_ns[0]) if len(host_ns) else 0


def _overlap(boot: Boot, other: Boot) -> bool:
    (_, a), (_, b) = boot.host_pairs(), other.host_pairs()
    return bool(len(a) and len(b) and min(a.max(), b.max()) > max(a.min(), b.min()))


def _of_same_boot(vehicles: Sequence[Vehicle], log: Boot) -> tuple[int, int] | None:
    for number, vehicle in enumerate(vehicles):
        for which, boot in enumerate(vehicle.boots):
            if is_same(boot, log):
                return number, which
    return None


def is_same(boot: Boot, log: Boot) -> bool:
    """Whether a log is of a boot: the same attitudes at the same times since boot, and the same UTC where both tell."""
    if "ATTITUDE" in boot.origins or not (boot.has("ATTITUDE") and log.has("ATTITUDE")):
        return False
    ties = boot_utc(boot), boot_utc(log)
    if ties[0] is not None and ties[1] is not None and abs(ties[0].offset_ns - ties[1].offset_ns) > SAME_UTC_NS:
        return False
    time_ns, log_ns = boot.stamps_ns["ATTITUDE"], log.stamps_ns["ATTITUDE"]
    inside = (time_ns >= log_ns[0]) & (time_ns <= log_ns[-1])
    if inside.sum() < LEAST_COMMON_ROWS or np.ptp(time_ns[inside]) < LEAST_COMMON_S * NS_PER_S:
        return False
    mine, theirs = _angles(boot), _angles(log)
    theirs = np.stack([np.interp(time_ns[inside], log_ns, np.unwrap(angle)) for angle in theirs.T], axis=1)
    between = frames.quat_multiply(frames.quat_inverse(_quat(mine[inside])), _quat(theirs))
    return bool(np.median(np.linalg.norm(frames.quat_log(between), axis=1)) < SAME_RAD)


def _angles(boot: Boot) -> Array:
    """Yaw, pitch and roll [rad], shape (n, 3)."""
    return np.stack([boot.tables["ATTITUDE"][f].astype(np.float64) for f in ("yaw", "pitch", "roll")], axis=1)


def _quat(angles: Array) -> Array:
    return np.asarray(frames.quat_from_mat(frames.mat_local_ins(*angles.T)))


def _joined(boot: Boot, log: Boot) -> Boot:
    """A boot of the link with the tables of its board's log in place of its own, and its own outside of these."""
    tables, stamps, origins = dict(boot.tables), dict(boot.stamps_ns), dict(log.origins)
    for name, table in log.tables.items():
        if name == "SYSTEM_TIME" and boot.has(name):
            del origins[name]  # the autopilot's own clock runs on between fixes
            continue
        tables[name], stamps[name] = table, log.stamps_ns[name]
        if boot.has(name, 1) and name in log.origins:
            tables[name], stamps[name] = _spliced(table, stamps[name], boot.tables[name], boot.stamps_ns[name])
    return replace(boot, tables=tables, stamps_ns=stamps, heard=boot.host_pairs(), origins=origins)


def _spliced(
    table: npt.NDArray[np.void],
    stamp_ns: npt.NDArray[np.int64],
    other: npt.NDArray[np.void],
    other_ns: npt.NDArray[np.int64],
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]:
    """A table with the rows of another before and behind its own."""
    names = table.dtype.names or ()
    if not set(names) <= set(other.dtype.names or ()):
        return table, stamp_ns
    outside = (other_ns < stamp_ns[0] - _EDGE_NS) | (other_ns > stamp_ns[-1] + _EDGE_NS)
    added = np.zeros(int(outside.sum()), table.dtype)
    for name in names:
        added[name] = other[name][outside]
    every_ns = np.concatenate([stamp_ns, other_ns[outside]])
    order = np.argsort(every_ns, kind="stable")
    return np.concatenate([table, added])[order], every_ns[order]


def _uses(boot: Boot) -> str:
    """What is taken from a board's log, for people."""
    parts = []
    for name, called in _CALLED.items():
        if name in boot.origins:
            stamp_ns = boot.stamps_ns[name]
            rate = f" at {NS_PER_S / np.median(np.diff(stamp_ns)):.0f} Hz" if len(stamp_ns) > 1 else ""
            parts.append(f"{called} ({boot.origins[name].removeprefix('dataflash ')}{rate})")
    return ", ".join(parts)
