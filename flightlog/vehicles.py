"""Who is the autopilot, among all that speak on a MAVLink link: one rule for the recorder and for the ground.

Ground stations, gimbals and companions send heartbeats too, some of them with the fields of an autopilot. The first
criterion is therefore a message that only an autopilot sends, attitudes. The second is component number 1, which
autopilots have, and the third a heartbeat of a vehicle's type. Among equals, the one heard first wins. A vehicle that
falls silent gives way, because system ids may be changed in flight.
"""

from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.constants import NS_PER_S
from flightlog.mavlink import AUTOPILOT_INVALID, Frame, field_offset, message_id

Address = tuple[int, int]
"""System and component."""

SILENT_NS: Final = 3 * NS_PER_S
"""Who was not heard for so long is silent, and what he said of being armed holds no more."""
_NEVER_NS: Final = -(1 << 63)
MOST_SENDERS: Final = 64
"""Senders that are kept track of; a stranger who makes up addresses fills no memory."""

AUTOPILOT_COMPONENT: Final = dialect.MAV_COMP_ID_AUTOPILOT1
_HEARTBEAT: Final = message_id("HEARTBEAT")
_EVIDENCE: Final = frozenset(map(message_id, ("ATTITUDE", "ATTITUDE_QUATERNION", "RAW_IMU", "GLOBAL_POSITION_INT")))
"""Messages of the one that flies the vehicle."""
_NO_VEHICLES: Final = frozenset(
    getattr(dialect, f"MAV_TYPE_{name}")
    for name in (
        "GCS", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION", "FLARM", "SERVO", "ODID", "BATTERY", "PARACHUTE",
        "LOG", "OSD", "IMU", "GPS", "WINCH", "ANTENNA_TRACKER",
    )
    if hasattr(dialect, f"MAV_TYPE_{name}")
)  # fmt: skip
"""HEARTBEAT.type of what is no vehicle, whatever it says of its autopilot."""


def _place(name: str) -> int:
    offset = field_offset("HEARTBEAT", name)
    assert offset is not None
    return offset


_TYPE, _AUTOPILOT, _BASE_MODE = _place("type"), _place("autopilot"), _place("base_mode")
_HEARTBEAT_BYTES: Final = 9


@dataclass(slots=True)
class Sender:
    """One address on a link.

    Attributes
    ----------
    first_ns, newest_ns : int
        Receive times of its first and newest verified frame [ns].
    version : int
        Of MAVLink, as it speaks it.
    frames, heartbeats, evidence : int
        Verified frames; those that say it is a vehicle; those that only an autopilot sends.
    is_other : bool
        Whether a heartbeat said that it is no vehicle.
    armed : bool or None
        What its newest heartbeat said; None before the first.
    armed_ns : int
        When [ns].
    changes_ns : tuple of two int
        When it last said otherwise than before, and the time before that [ns].
    """

    first_ns: int
    newest_ns: int = 0
    version: int = 1
    frames: int = 0
    heartbeats: int = 0
    evidence: int = 0
    is_other: bool = False
    armed: bool | None = None
    armed_ns: int = 0
    changes_ns: tuple[int, int] = (_NEVER_NS, _NEVER_NS)

    @property
    def is_vehicle(self) -> bool:
        """Whether it may be an autopilot."""
        return not self.is_other and (self.heartbeats > 0 or self.evidence > 0)

    def may_be_armed(self, now_ns: int) -> bool:
        """Whether it says so, or says both in turn: two vehicles may share its id, and one of them is armed."""
        return bool(self.armed) or now_ns - self.changes_ns[1] <= SILENT_NS

    def hear(self, frame: Frame) -> None:
        """Take a verified frame of this sender."""
        self.frames += 1
        self.newest_ns = frame.time_ns
        if frame.message_id in _EVIDENCE:
            self.evidence += 1
        elif frame.message_id == _HEARTBEAT:
            beat = frame.payload.ljust(_HEARTBEAT_BYTES, b"\x00")
            self.is_other = beat[_AUTOPILOT] == AUTOPILOT_INVALID or beat[_TYPE] in _NO_VEHICLES
            if not self.is_other:
                self.heartbeats += 1
                self.version = frame.version
                armed = bool(beat[_BASE_MODE] & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
                if self.armed is not None and armed is not self.armed:
                    self.changes_ns = frame.time_ns, self.changes_ns[0]
                self.armed = armed
                self.armed_ns = frame.time_ns


@dataclass(slots=True)
class Vehicles:
    """All senders of a link, and which of them is the autopilot.

    Attributes
    ----------
    senders : dict of Address to Sender
        At most `MOST_SENDERS`, in order of their first frame.
    autopilot : Address or None
        As of the newest frame.
    overlooked : int
        Frames of senders beyond that number.
    """

    senders: dict[Address, Sender] = field(default_factory=dict)
    autopilot: Address | None = None
    overlooked: int = 0

    def hear(self, frame: Frame) -> bool:
        """Take a frame in order of reception; whether another sender is the autopilot now.

        Frames of an unknown id prove nothing and are passed over.
        """
        if not frame.known:
            return False
        address = (frame.system, frame.component)
        sender = self.senders.get(address)
        if sender is None:
            if len(self.senders) >= MOST_SENDERS:
                self.overlooked += 1
                return False
            sender = self.senders[address] = Sender(frame.time_ns)
        was_told = (sender.is_other, sender.heartbeats > 0, sender.evidence > 0)
        sender.hear(frame)
        present = self.senders.get(self.autopilot) if self.autopilot is not None else None
        settled = address == self.autopilot or (present is not None and frame.time_ns - present.newest_ns <= SILENT_NS)
        if settled and was_told == (sender.is_other, sender.heartbeats > 0, sender.evidence > 0):
            return False
        return self._elect(frame.time_ns)

    def _elect(self, now_ns: int) -> bool:
        before = self.autopilot
        heard = [
            a for a, sender in self.senders.items() if sender.is_vehicle and now_ns - sender.newest_ns <= SILENT_NS
        ]
        if heard:
            self.autopilot = max(heard, key=self._rank)  # of equals the first, which is the one heard first
        elif before is not None and self.senders[before].is_other:
            self.autopilot = None
        return self.autopilot != before

    def _rank(self, address: Address) -> tuple[bool, bool, bool]:
        sender = self.senders[address]
        return sender.evidence > 0, address[1] == AUTOPILOT_COMPONENT, sender.heartbeats > 0

    def vehicles(self) -> list[Address]:
        """All that may be autopilots, the one that is believed first."""
        found = [address for address, sender in self.senders.items() if sender.is_vehicle]
        return sorted(found, key=lambda address: address != self.autopilot)

    def armed(self, now_ns: int) -> bool | None:
        """Whether the aircraft is armed: any vehicle heard lately that says so is believed; None where that is not known.

        Only its own autopilot is believed when it says disarmed.
        """
        lately = {a: s for a, s in self.senders.items() if s.is_vehicle and now_ns - s.armed_ns <= SILENT_NS}
        if any(sender.may_be_armed(now_ns) for sender in lately.values()):
            return True
        own = lately.get(self.autopilot) if self.autopilot is not None else None
        return None if own is None else own.armed
