"""What an autopilot told: its MAVLink messages as tables on its own clock, one set for each boot.

All times here are nanoseconds since boot. A reboot inside a file begins a new scale; nothing of one is ever laid over the other.
"""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames, mavlink
from flightlog.constants import NS_PER_MS, NS_PER_US
from flightlog.errors import LogError
from flightlog.mavlink import Frame
from flightlog.vehicles import Address, Sender, Vehicles
from groundproc.flight.sharing import parted
from groundproc.flight.sound import possible
from groundproc.flight.sync import GyroTrack
from groundproc.machine.aside import aside

Array = npt.NDArray[np.float64]

REBOOT_MS: Final = 5_000
"""A boot time that falls back by more than this is a reboot; less is messages out of order."""

HALF_MS_NS: Final = NS_PER_MS // 2
"""Autopilots cut their boot time to whole milliseconds: on average half of one is missing."""

LOST_MS: Final = 10_000
"""A boot time that lags the receive time by more than this from one message to the next is a reboot; links delay by seconds."""

_STAMP_OFFSETS: Final = {
    mavlink.message_id(name): offset
    for name in (
        "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "SCALED_PRESSURE", "SYSTEM_TIME",
        "SCALED_IMU2", "RC_CHANNELS_RAW", "SERVO_OUTPUT_RAW",
    )
    if (offset := mavlink.field_offset(name, "time_boot_ms")) is not None
}  # fmt: skip
"""Messages whose boot time marks the boots: id -> offset of time_boot_ms in the payload."""

_TABLES: Final = (
    "ATTITUDE", "ATTITUDE_QUATERNION", "AHRS2", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "HIGHRES_IMU", "GLOBAL_POSITION_INT",
    "GPS_RAW_INT", "SYSTEM_TIME", "HEARTBEAT", "SCALED_PRESSURE",
)  # fmt: skip

WANTED: Final = frozenset(_STAMP_OFFSETS) | frozenset(mavlink.message_id(name) for name in _TABLES)
"""Ids of all messages that are looked at here."""


@dataclass(frozen=True, slots=True)
class Boot:
    """What came from one boot of an autopilot.

    Attributes
    ----------
    number : int
        0 for the first in the log.
    system, component : int
        MAVLink address.
    tables : dict of str to structured ndarray
        Message name to its table (`mavlink.table`), in order of reception, without repeats.
    stamps_ns : dict of str to ndarray of int64
        Time since boot of each row [ns]; rows without a stamp of their own have that of the stamped message before.
    heard : tuple of two ndarrays of int64, shape (n,), or None
        Boot times and receive times [ns] where the tables do not tell them: of the board's own log.
    heard_by : str
        What receive times are: "link", or "gps" where UTC of the GPS module stands in their place.
    origins : dict of str to str
        Where tables come from that are not of the link: those of the board's own log.
    left_out : dict of str to int
        Messages with values that cannot be, by name; see `sound`.
    """

    number: int
    system: int
    component: int
    tables: dict[str, npt.NDArray[np.void]]
    stamps_ns: dict[str, npt.NDArray[np.int64]]
    heard: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None = None
    heard_by: str = "link"
    origins: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)

    def has(self, name: str, least: int = 2) -> bool:
        """Whether there are at least so many messages of a kind."""
        return name in self.tables and len(self.tables[name]) >= least

    def span_ns(self) -> tuple[int, int]:
        """First and last boot time [ns]."""
        spans = [(s.min(), s.max()) for s in self.stamps_ns.values() if len(s)]
        return (int(min(a for a, _ in spans)), int(max(b for _, b in spans))) if spans else (0, 0)

    def host_pairs(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Boot time and receive time [ns] of all messages that carry their own boot time."""
        if self.heard is not None:
            return self.heard
        names = [
            n for n in ("ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "SYSTEM_TIME") if n in self.tables
        ]
        if not names:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        boot = np.concatenate([self.stamps_ns[n] for n in names])
        host = np.concatenate([self.tables[n]["host_ns"] for n in names])
        order = np.argsort(boot, kind="stable")
        return boot[order], host[order]

    def gyros(self) -> list[GyroTrack]:
        """All gyro series there are, in the ins frame."""
        tracks = []
        for name, fields, unit in (
            ("ATTITUDE", ("rollspeed", "pitchspeed", "yawspeed"), 1.0),
            ("ATTITUDE_QUATERNION", ("rollspeed", "pitchspeed", "yawspeed"), 1.0),
            ("RAW_IMU", ("xgyro", "ygyro", "zgyro"), 1e-3),
            ("SCALED_IMU", ("xgyro", "ygyro", "zgyro"), 1e-3),
            ("HIGHRES_IMU", ("xgyro", "ygyro", "zgyro"), 1.0),
        ):
            if self.has(name, 30) and not self._borrows_gyro(name):
                frd = np.stack([self.tables[name][f].astype(np.float64) for f in fields], axis=1) * unit
                if np.ptp(frd, axis=0).max() > 0.0:
                    whole_ms = (self.stamps_ns[name] % NS_PER_MS == HALF_MS_NS).all()
                    step_ns = NS_PER_MS if whole_ms else NS_PER_US
                    tracks.append(GyroTrack(name, self.stamps_ns[name], frames.ins_from_frd(frd), step_ns))
        return tracks

    def _borrows_gyro(self, name: str) -> bool:
        """Whether the rates of a message are only those of another at other times: ATT has none of its own."""
        return name == "ATTITUDE" and name in self.origins and "HIGHRES_IMU" in self.tables


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One autopilot of those on a link.

    Attributes
    ----------
    addresses : tuple of (int, int)
        System and component, in the order in which it used them: an id may be changed in flight.
    boots : list of Boot
    source : str
        Where it was heard, if not on the link.
    shared_by : int
        Its number among the vehicles that share these addresses; 0 where they are its own.
    """

    addresses: tuple[Address, ...]
    boots: list[Boot]
    source: str = ""
    shared_by: int = 0

    @property
    def name(self) -> str:
        """Its addresses, such as 1/1."""
        addresses = ", then ".join(f"{system}/{component}" for system, component in self.addresses)
        if self.shared_by:
            addresses += f" (sender {self.shared_by} of that id)"
        return f"{addresses} of {self.source}" if self.source else addresses


def vehicles(all_frames: Sequence[Frame]) -> list[Vehicle]:
    """Sort a link's frames into vehicles and their boots, first the one that `flightlog.vehicles` elects for most of the time.

    An address that was never heard together with another, and only after it, is the same vehicle under a new id, until the gyros
    contradict (`vehicle.choose`).

    Parameters
    ----------
    all_frames : sequence of Frame
        In order of reception.

    Raises
    ------
    LogError
        No autopilot was heard.
    """
    heard, elected = Vehicles(), Counter[Address]()
    for frame in all_frames:
        heard.hear(frame)
        if heard.autopilot is not None:
            elected[heard.autopilot] += 1
    chains = _chains({address: sender for address, sender in heard.senders.items() if sender.is_vehicle})
    if not chains:
        raise LogError("MAVLink: no heartbeat of an autopilot and no attitudes in the log, expected one a second")
    chains.sort(key=lambda chain: -sum(elected[address] for address in chain))
    return [vehicle for chain in chains for vehicle in _of(all_frames, chain)]


def _of(all_frames: Sequence[Frame], addresses: Sequence[Address]) -> list[Vehicle]:
    """The vehicle with these addresses; several where one address is shared."""
    parts = parted([f for f in all_frames if f.known and (f.system, f.component) in addresses])
    if len(parts) == 1:
        return [Vehicle(tuple(addresses), _boots(parts[0]))]
    return [Vehicle(tuple(addresses), _boots(part), shared_by=i + 1) for i, part in enumerate(parts)]


def boots(all_frames: Sequence[Frame]) -> list[Boot]:
    """The boots of the elected vehicle; see `vehicles`."""
    return vehicles(all_frames)[0].boots


def _chains(senders: Mapping[Address, Sender]) -> list[list[Address]]:
    """Addresses that follow each other in time, without ever being heard together."""
    chains: list[list[Address]] = []
    for address in sorted(senders, key=lambda each: senders[each].first_ns):
        before = [chain for chain in chains if senders[chain[-1]].newest_ns < senders[address].first_ns]
        if before:
            max(before, key=lambda chain: senders[chain[-1]].newest_ns).append(address)
        else:
            chains.append([address])
    return chains


def _boots(mine: Sequence[Frame]) -> list[Boot]:
    clock_ms = _running_clock_ms(mine)
    starts = [0, *_reboots(mine, clock_ms), len(mine)]
    return [
        _boot(number, (mine[a].system, mine[a].component), mine[a:b], clock_ms[a:b])
        for number, (a, b) in enumerate(itertools.pairwise(starts))
        if b > a
    ]


def _reboots(mine: Sequence[Frame], clock_ms: npt.NDArray[np.int64]) -> list[int]:
    """Frames at which another boot begins: its clock falls back, or has run for much less than the time that passed.

    The second is what a reboot looks like that is heard of again only when its clock is past the old one.
    """
    own = np.array([i for i, frame in enumerate(mine) if frame.message_id in _STAMP_OFFSETS], np.int64)
    if len(own) < 2:
        return []
    passed_ms = np.diff(np.array([mine[i].time_ns for i in own.tolist()], np.int64)) // NS_PER_MS
    counted_ms = np.diff(clock_ms[own])
    reboot = (counted_ms < -REBOOT_MS) | (passed_ms - counted_ms > LOST_MS)
    return [int(i) for i in own[1:][reboot]]


def _running_clock_ms(mine: Sequence[Frame]) -> npt.NDArray[np.int64]:
    """Boot time of the last stamped message at each frame [ms], shape (n,)."""
    clock = np.empty(len(mine), np.int64)
    current, unset = 0, 0
    seen = False
    for i, frame in enumerate(mine):
        offset = _STAMP_OFFSETS.get(frame.message_id)
        if offset is not None:
            current = int.from_bytes(frame.payload[offset : offset + 4], "little")
            if not seen:
                clock[unset:i] = current
                seen = True
        clock[i] = current
    return clock


def _boot(number: int, address: tuple[int, int], mine: Sequence[Frame], clock_ms: npt.NDArray[np.int64]) -> Boot:
    ids = np.fromiter((f.message_id for f in mine), np.int64, len(mine))
    tables, stamps = {}, {}
    left_out: dict[str, int] = {}
    for name in _TABLES:
        rows = np.flatnonzero(ids == mavlink.message_id(name))
        if len(rows) == 0:
            continue
        table = mavlink.table([mine[i] for i in rows.tolist()], name)
        good = possible(table, name)
        if not good.all():
            left_out[name] = int((~good).sum())
            table, rows = table[good], rows[good]
        stamp_ns = _stamps_ns(table, clock_ms[rows])
        keep = increasing(stamp_ns)
        tables[name], stamps[name] = aside(table[keep], stamp_ns[keep])
    return Boot(number, *address, tables, stamps, left_out=left_out)


def _stamps_ns(table: npt.NDArray[np.void], clock_ms: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Boot time of each row [ns]: its own stamp where it has one and it agrees with the clock, else the clock's."""
    assert table.dtype.names is not None
    if "time_boot_ms" in table.dtype.names:
        return np.asarray(table["time_boot_ms"].astype(np.int64) * NS_PER_MS + HALF_MS_NS)
    if "time_usec" in table.dtype.names:
        clock_us = clock_ms * 1000 + HALF_MS_NS // NS_PER_US
        usec = table["time_usec"].astype(np.int64)
        # ArduPilot of the 3.1 era sends a 32-bit count that wraps every 71.6 min
        wrapped = usec < 1 << 32
        usec = np.where(wrapped, usec + np.rint((clock_us - usec) / 2.0**32).astype(np.int64) * (1 << 32), usec)
        # unlike boot time, Unix time is nowhere near the clock; 30 s leave room for a slow link
        own = np.abs(usec - clock_us) < 30_000_000
        return np.asarray(np.where(own, usec, clock_us) * NS_PER_US)
    return clock_ms * NS_PER_MS + HALF_MS_NS


def increasing(stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Rows later than all before them: repeats and late-comers are left out."""
    highest = np.maximum.accumulate(stamp_ns)
    keep = np.ones(len(stamp_ns), np.bool_)
    keep[1:] = stamp_ns[1:] > highest[:-1]
    return keep
