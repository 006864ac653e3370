"""The status of everything aboard: what the status file holds, and its text."""

import json
from dataclasses import dataclass, field
from typing import Any

from flightlog.errors import SwathError
from onboard.lidarstate import State


@dataclass(frozen=True, slots=True)
class LidarStatus:
    """The lidar's two ports; totals since the start, rates over the last second."""

    state: State = State.GOOD
    link: bool | None = None
    """Whether its network link is up; None: not known."""
    sensor: str = ""
    """Its address."""
    age_s: float | None = None
    """Since the newest good data packet; None: there was none."""
    packets_s: float = 0.0
    expected_packets_s: float = 0.0
    """At its return mode and field of view; 0: not known."""
    return_mode: str = ""
    rpm: float = 0.0
    fov_start_deg: float = 0.0
    fov_end_deg: float = 0.0
    position_packets_s: float = 0.0
    received: int = 0
    kept: int = 0
    not_armed: int = 0
    recording: bool = True
    """False: not armed, and only flights are to be recorded."""
    masked_packets: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    position_kept: int = 0
    position_drops: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    rejected_s: float = 0.0
    pps: int = 0
    nmea: str = ""


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """One MAVLink link."""

    connected: bool = False
    trouble: str = ""
    age_s: float | None = None
    """Since the newest verified frame of the autopilot; None: there was none."""
    frames_s: float = 0.0
    bytes_s: float = 0.0
    autopilot: str = ""
    version: int = 0
    heartbeats: int = 0
    armed: bool | None = None
    vehicles: list[str] = field(default_factory=list)
    """All on the link that may be autopilots, the one that is believed first."""
    bad_bytes: int = 0
    unknown_frames: int = 0
    dropped_bytes: int = 0
    kernel_drops: int = 0
    achieved_hz: dict[str, float] = field(default_factory=dict)
    asked_hz: dict[str, int] = field(default_factory=dict)
    """Of the messages asked for."""
    requests: int = 0
    firmware: str = ""
    """The autopilot's version; empty: it has not said."""
    signatures: dict[str, int] = field(default_factory=dict)
    """Frames by what their signatures say (good, unsigned, wrong, old); empty where no key is set."""


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """The log being written."""

    segment: str = ""
    messages: int = 0
    bytes_on_disk: int = 0
    backlog_bytes: int = 0
    refused: int = 0
    sync_age_s: float = 0.0
    slowest_sync_ms: float = 0.0
    free_bytes: int = 0
    minutes_left: float | None = None
    """Until the lidar is no longer recorded, at the rate of the last minute; None: not known yet."""
    segments: int = 0
    """Opened since the start."""
    space: str = "room"
    """`room`, `low`: the lidar is not recorded, or `full`: nothing is."""
    refused_for_space: int = 0
    """Messages."""
    lost_on_disk: int = 0
    """Messages."""
    trouble: str = ""
    """Why nothing is recorded, or where it is recorded instead."""
    abandoned: int = 0
    """Segments that were deleted or moved while they were written, or on a disk that failed."""
    leftovers: int = 0
    """Logs that a power cut or a crash had left open, found at the start."""
    leftovers_mended: int = 0
    leftovers_left: int = 0
    """Those that are no logs, or for which there was no space."""


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """How a device's clock stands to log time; see /clock_sync."""

    method: str
    skew_ppm: float
    uncertainty_ms: float
    samples: int
    restarts: int
    utc_source: str
    utc_minus_wall_s: float | None = None
    """What its UTC has more than the host's wall clock."""


@dataclass(frozen=True, slots=True)
class DownlinkStatus:
    """What goes to the ground live; totals since the start, rates over the last second."""

    address: str
    sent_s: float = 0.0
    kbit_s: float = 0.0
    sent: int = 0
    thinned: int = 0
    dropped: int = 0
    """Datagrams for which the link, or the cap on its rate, was too slow."""
    unheard: int = 0
    """Datagrams that the ground refused: no program has the port."""
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Status:
    """Everything; what the status file holds."""

    time_ns: int
    """Monotonic clock when it was made [ns]: a step of the wall clock must not make it look stale."""
    boot_id: str
    version: str
    pid: int
    uptime_s: float
    clock_steps: int
    lidar: LidarStatus
    links: dict[str, LinkStatus]
    recorder: RecorderStatus
    failures: list[str] = field(default_factory=list)
    downlink: DownlinkStatus | None = None
    clocks: dict[str, ClockStatus] = field(default_factory=dict)
    temperature_c: float | None = None
    """Of the board; None: it has no sensor."""


def to_json(status: Status) -> str:
    """The text of a status file."""
    return json.dumps(status, default=_fields) + "\n"  # in one line: the fast encoder knows no other way


def _fields(record: Any) -> dict[str, Any]:
    return {name: getattr(record, name) for name in record.__slots__}


def from_json(text: str, place: str) -> Status:
    """Read the text of a status file; SwathError where it is none, `place` names it."""
    try:
        tree: dict[str, Any] = json.loads(text)
        tree["lidar"] = LidarStatus(**tree["lidar"] | {"state": State(tree["lidar"]["state"])})
        tree["links"] = {name: LinkStatus(**link) for name, link in tree["links"].items()}
        tree["recorder"] = RecorderStatus(**tree["recorder"])
        tree["clocks"] = {name: ClockStatus(**clock) for name, clock in tree["clocks"].items()}
        tree["downlink"] = None if tree["downlink"] is None else DownlinkStatus(**tree["downlink"])
        return Status(**tree)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise SwathError(f"{place}: is no status file of this version of swathd") from None
