"""What came over a MAVLink link since the start, and what its autopilot says of itself."""

import logging
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.mavlink import Frame, decode, field_offset
from flightlog.vehicles import Sender, Vehicles

_log = logging.getLogger(__name__)

_AUTOPILOT_AT: Final = field_offset("HEARTBEAT", "autopilot")


@dataclass(slots=True)
class LinkCounts:
    """What came over a link since the start."""

    connected: bool = False
    trouble: str = ""
    """Why it is not connected."""
    opened: int = 0
    received_bytes: int = 0
    queue_dropped_bytes: int = 0
    kernel_drops: int = 0
    frames: int = 0
    bad_bytes: int = 0
    unknown_frames: int = 0
    messages: Counter[int] = field(default_factory=Counter)
    """Verified frames of the autopilot, by message id."""
    vehicles: Vehicles = field(default_factory=Vehicles)
    """Who speaks here, and which of them is the autopilot."""
    achieved_hz: dict[str, float] = field(default_factory=dict)
    """Of each message asked for, over the last seconds looked at [Hz]."""
    asked_hz: dict[str, int] = field(default_factory=dict)
    requests: int = 0
    """How many streams were asked for, or asked for again."""
    kind: int = dialect.MAV_AUTOPILOT_GENERIC
    """MAV_AUTOPILOT of the autopilot, as its heartbeat says."""
    firmware: str = ""
    """Its version, such as 4.5.7; empty: it has not said."""
    signatures: dict[str, int] = field(default_factory=dict)
    """Frames by what their signatures say, where there is a key."""

    @property
    def autopilot(self) -> tuple[int, int] | None:
        """System and component of the autopilot."""
        return self.vehicles.autopilot

    @property
    def _sender(self) -> Sender:
        return _NOBODY if self.vehicles.autopilot is None else self.vehicles.senders[self.vehicles.autopilot]

    @property
    def version(self) -> int:
        """Of MAVLink, as the autopilot speaks it."""
        return self._sender.version

    @property
    def heartbeats(self) -> int:
        """Of the autopilot."""
        return self._sender.heartbeats

    @property
    def newest_ns(self) -> int:
        """Log time of the autopilot's newest verified frame [ns]; 0 before the first."""
        return self._sender.newest_ns

    def armed(self, log_ns: int) -> bool | None:
        """Whether the aircraft is armed, as far as somebody heard lately says; None where nobody does."""
        return self.vehicles.armed(log_ns)


_NOBODY: Final = Sender(0)


def note_frames(counts: LinkCounts, frames: list[Frame]) -> None:
    """Count frames; those of an id that cannot be verified are no sign of life."""
    for frame in frames:
        if not frame.known:
            continue
        counts.frames += 1
        if counts.vehicles.hear(frame):
            _tell_autopilot(counts)
        if (frame.system, frame.component) == counts.autopilot:
            counts.messages[frame.message_id] += 1
            _note_kind(counts, frame)


def _note_kind(counts: LinkCounts, frame: Frame) -> None:
    """What the autopilot says of itself."""
    if frame.message_id == dialect.MAVLINK_MSG_ID_HEARTBEAT and _AUTOPILOT_AT is not None:
        counts.kind = frame.payload.ljust(9, b"\x00")[_AUTOPILOT_AT]
    elif frame.message_id == dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION and (said := decode(frame)) is not None:
        major, minor, patch, _ = int(said.flight_sw_version).to_bytes(4, "big")
        counts.firmware = f"{major}.{minor}.{patch}"


def _tell_autopilot(counts: LinkCounts) -> None:
    """Say who the autopilot is, and who else might be."""
    first, *others = (f"{system}/{component}" for system, component in counts.vehicles.vehicles())
    if counts.autopilot is None:
        _log.warning("nobody on the link is an autopilot any more")
    elif others:
        _log.warning("autopilot %s heard, MAVLink %d; other vehicles: %s", first, counts.version, ", ".join(others))
    else:
        _log.info("autopilot %s heard, MAVLink %d", first, counts.version)
