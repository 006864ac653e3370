"""The verdict on the status of everything aboard: what is wrong, by name. Pure: a status in, sentences out."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from flightlog.constants import NS_PER_S
from onboard.lidarstate import REMEDY, State
from onboard.status import LidarStatus, LinkStatus, RecorderStatus, Status

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
