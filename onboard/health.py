"""The status of everything aboard, and the verdict on it: what is wrong, by name. Pure: readings in, sentences out."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final

from flightlog.constants import NS_PER_S
from flightlog.errors import SwathError
from onboard.lidarstate import REMEDY, State

STALE_S: Final = 5.0
"""A status older than this says nothing about now."""
LINK_SILENT_S: Final = 3.0
"""An autopilot unheard for this long is silent; it sends a heartbeat each second."""
LOW_RATE: Final = 0.4
"""Share of the rate asked for below which a message is low. ArduCopter 3.1.3 gives half of 50 Hz and is content with it."""
STALLED_NS: Final = 5 * NS_PER_S
"""A worker without progress for this long hangs; a slow card may well hold the recorder for a second or two."""


SCHEMA: Final = 1
"""Of what `swathd health --json` prints (docs/health.schema.json): fields may come, and none goes or changes without another number."""


class Level(IntEnum):
    """Exit code of `swathd health`, as monitoring plug-ins have it."""

    GOOD = 0
    WARNING = 1
    CRITICAL = 2


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


def stalled(progress_ns: Mapping[str, int], now_ns: int, limit_ns: int = STALLED_NS) -> list[str]:
    """Which workers have not got on for too long.

    Parameters
    ----------
    progress_ns : mapping of name to int
        When each last did [ns of the monotonic clock].
    now_ns : int
        The monotonic clock.
    limit_ns : int
    """
    return [
        f"{name} has made no progress for {(now_ns - then_ns) / NS_PER_S:.1f} s"
        for name, then_ns in progress_ns.items()
        if now_ns - then_ns > limit_ns
    ]


@dataclass(frozen=True, slots=True)
class Verdict:
    """How bad it is, and why: one sentence for each finding."""

    level: Level
    findings: list[str]


def judge(status: Status, now_ns: int, boot_id: str) -> Verdict:
    """Judge a status; `now_ns` is the monotonic clock of the boot `boot_id`."""
    age_s = (now_ns - status.time_ns) / NS_PER_S
    if status.boot_id != boot_id:
        return Verdict(Level.CRITICAL, ["stale: the status is from before the last boot"])
    if age_s > STALE_S:
        return Verdict(Level.CRITICAL, [f"stale: the status is {age_s:.0f} s old; swathd does not run or hangs"])
    found = [(Level.CRITICAL, failure) for failure in status.failures]
    found += _judge_lidar(status.lidar)
    for name, link in status.links.items():
        found += _judge_link(name, link)
    found += _judge_recorder(status.recorder)
    if status.downlink is not None and status.downlink.trouble:
        found.append((Level.WARNING, f"downlink: {status.downlink.trouble}; recording goes on"))
    return Verdict(max((level for level, _ in found), default=Level.GOOD), [text for _, text in found])


def told(verdict: "Verdict", is_armed: bool | None, status: Mapping[str, Any] | None) -> dict[str, Any]:
    """What `swathd health --json` prints; `status` is the tree of a status file, None where there is none."""
    return {
        "schema": SCHEMA,
        "verdict": verdict.level.name,
        "findings": verdict.findings,
        "armed": is_armed,
        "status": status,
    }


def armed(status: Status, now_ns: int, boot_id: str) -> bool | None:
    """Whether the aircraft is armed, by any of its autopilots; None where that is not known now.

    Known is what an autopilot said that is still heard, in a status that is not stale.
    """
    if status.boot_id != boot_id or now_ns - status.time_ns > STALE_S * NS_PER_S:
        return None
    heard = [
        link.armed if link.connected and link.age_s is not None and link.age_s <= LINK_SILENT_S else None
        for link in status.links.values()
    ]
    if True in heard:
        return True
    return None if None in heard or not heard else False


def _judge_lidar(lidar: LidarStatus) -> list[tuple[Level, str]]:
    found = []
    if lidar.state == State.RATE_LOW:
        rates = f"{lidar.packets_s:.0f} packets/s, expected {lidar.expected_packets_s:.0f}"
        found.append((Level.WARNING, f"lidar: rate low, {rates}; {REMEDY[lidar.state]}"))
    elif lidar.state != State.GOOD:
        since = "" if lidar.age_s is None else f" for {lidar.age_s:.0f} s"
        found.append((Level.CRITICAL, f"lidar: {lidar.state}{since}; {REMEDY[lidar.state]}"))
    found += [(Level.WARNING, f"lidar: {count} x {reason}") for reason, count in lidar.rejected.items()]
    if lidar.kernel_drops:
        found.append((Level.WARNING, f"lidar: {lidar.kernel_drops} packets lost in the receive buffer"))
    if lidar.queue_drops:
        found.append((Level.WARNING, f"lidar: {lidar.queue_drops} packets lost because the disk was too slow or full"))
    return found


def _judge_link(name: str, link: LinkStatus) -> list[tuple[Level, str]]:
    if not link.connected:
        return [(Level.WARNING, f"link {name}: {link.trouble or 'not open yet'}")]
    refused = {word: count for word, count in link.signatures.items() if word != "good" and count}
    if link.age_s is None and refused:
        counts = ", ".join(f"{count} {word}" for word, count in refused.items())
        return [
            (
                Level.WARNING,
                f"link {name}: no autopilot with the key heard (signatures: {counts}); is signing set up on it, with this key?",
            )
        ]
    if link.age_s is None:
        return [(Level.WARNING, f"link {name}: open, but no autopilot heard")]
    if link.age_s > LINK_SILENT_S:
        return [(Level.WARNING, f"link {name}: autopilot silent for {link.age_s:.0f} s")]
    found = []
    if len(link.vehicles) > 1:
        others = ", ".join(link.vehicles[1:])
        found.append((Level.WARNING, f"link {name}: {link.autopilot} is taken for the autopilot; also heard: {others}"))
    found += [
        (
            Level.WARNING,
            f"link {name}: {message} at {hz:.1f} Hz of {link.asked_hz[message]} asked for; is its rate set elsewhere?",
        )
        for message, hz in link.achieved_hz.items()
        if hz < LOW_RATE * link.asked_hz.get(message, 0)
    ]
    if refused:
        counts = ", ".join(f"{count} {word}" for word, count in refused.items())
        found.append((Level.WARNING, f"link {name}: frames recorded and not believed, by their signatures: {counts}"))
    if link.dropped_bytes:
        found.append(
            (Level.WARNING, f"link {name}: {link.dropped_bytes} bytes lost because the disk was too slow or full")
        )
    return found


_SPACE: Final = {
    "low": "space is low, so the lidar is not recorded; pull the logs, or delete closed ones, which are read-only",
    "full": "the disk is full and nothing is recorded; pull the logs, or delete closed ones, which are read-only",
}


def _judge_recorder(recorder: RecorderStatus) -> list[tuple[Level, str]]:
    if recorder.trouble:
        return [(Level.CRITICAL, f"recorder: {recorder.trouble}")]
    if recorder.space in _SPACE:
        return [(Level.CRITICAL, f"recorder: {_SPACE[recorder.space]}")]
    if recorder.sync_age_s > STALLED_NS / NS_PER_S:
        return [(Level.CRITICAL, f"recorder: nothing reached the disk for {recorder.sync_age_s:.0f} s")]
    if recorder.lost_on_disk:
        return [(Level.WARNING, f"recorder: {recorder.lost_on_disk} messages lost on a full disk")]
    if recorder.abandoned:
        return [
            (
                Level.WARNING,
                f"recorder: {recorder.abandoned} segments were deleted, moved, or on a disk that failed; see the journal",
            )
        ]
    if recorder.leftovers_left:
        return [
            (Level.WARNING, f"recorder: {recorder.leftovers_left} earlier logs cut off and not mended; see the journal")
        ]
    return []


def summary(status: Status) -> str:
    """One line for `systemctl status`."""
    lidar, recorder = status.lidar, status.recorder
    links = ", ".join(f"{name} {link.frames_s:.0f}/s" for name, link in status.links.items())
    return (
        f"{recorder.segment}: lidar {lidar.packets_s:.0f}/s, position {lidar.position_packets_s:.0f}/s, "
        f"MAVLink {links or 'none'}, lost {lidar.kernel_drops + lidar.queue_drops}, "
        f"{recorder.bytes_on_disk / 1e6:.0f} MB"
    )


_PPS: Final = {0: "not told", 1: "synchronising", 2: "locked", 3: "error"}
"""Firmware of 2012 leaves it 0 even when locked."""


def report(status: Status, verdict: Verdict) -> list[str]:
    """The lines of `swathd health`."""
    lines = [f"{verdict.level.name}: {summary(status)}", *(f"  {finding}" for finding in verdict.findings)]
    lines += _report_lidar(status.lidar)
    for name, link in status.links.items():
        lines += _report_link(name, link)
    for name, clock in status.clocks.items():
        lines.append(_report_clock(name, clock))
    temperature = "" if status.temperature_c is None else f", {status.temperature_c:.0f} deg C"
    lines.append(f"host      up {status.uptime_s:.0f} s, wall clock set {status.clock_steps} times{temperature}")
    recorder = status.recorder
    left = "" if recorder.minutes_left is None else f", {recorder.minutes_left:.0f} min left"
    lines.append(
        f"recorder  {recorder.segment}, {recorder.bytes_on_disk / 1e6:.1f} MB, last sync "
        f"{recorder.sync_age_s:.1f} s ago, slowest {recorder.slowest_sync_ms:.0f} ms, "
        f"{recorder.free_bytes / 1e9:.1f} GB free{left}"
    )
    if (downlink := status.downlink) is not None:
        lines.append(
            f"downlink  {downlink.sent_s:.0f} datagrams/s, {downlink.kbit_s:.0f} kbit/s to {downlink.address}, "
            f"{downlink.dropped} dropped, {downlink.unheard} refused there"
        )
    return lines


def _report_lidar(lidar: LidarStatus) -> list[str]:
    expected = f" of {lidar.expected_packets_s:.0f}" if lidar.expected_packets_s else ""
    idle = "" if lidar.recording else ", not recorded: not armed"
    setting = (
        f", {lidar.rpm:.0f} rpm, {lidar.return_mode}, {lidar.fov_start_deg:.0f} to {lidar.fov_end_deg:.0f} deg"
        if lidar.return_mode
        else ""
    )
    return [
        f"lidar     {lidar.state}, {lidar.packets_s:.0f}{expected} packets/s{setting}{idle}",
        (
            f"          {lidar.kept} kept, {lidar.masked_packets} masked, dropped {lidar.kernel_drops} by the kernel and "
            f"{lidar.queue_drops} by the queue, {sum(lidar.rejected.values())} refused"
        ),
        (
            f"          position {lidar.position_packets_s:.0f} packets/s, PPS {_PPS.get(lidar.pps, lidar.pps)}, "
            f"GPS sentence {lidar.nmea or 'none'}"
        ),
    ]


def _report_link(name: str, link: LinkStatus) -> list[str]:
    firmware = f", firmware {link.firmware}" if link.firmware else ""
    heard = f"autopilot {link.autopilot}, MAVLink {link.version}{firmware}" if link.autopilot else "no autopilot"
    armed = {None: "unknown", True: "armed", False: "disarmed"}[link.armed]
    lines = [
        (
            f"{name:9} {link.frames_s:.0f} frames/s, {heard}, {armed}, {link.bad_bytes} bad bytes, "
            f"{link.unknown_frames} unknown frames"
        )
    ]
    if link.achieved_hz:
        rates = ", ".join(f"{message} {hz:.1f} of {link.asked_hz[message]}" for message, hz in link.achieved_hz.items())
        lines.append(f"          Hz: {rates}")
    return lines


def _report_clock(name: str, clock: ClockStatus) -> str:
    utc = ""
    if clock.utc_minus_wall_s is not None:
        utc = f", UTC of {clock.utc_source} is {clock.utc_minus_wall_s:+.3f} s from the wall clock"
    return (
        f"clock     {name} by {clock.method}, within {clock.uncertainty_ms:.1f} ms, {clock.skew_ppm:+.1f} ppm, "
        f"{clock.samples} samples, {clock.restarts} restarts{utc}"
    )
