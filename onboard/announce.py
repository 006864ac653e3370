"""What the pilot's ground station is told: a text when something changes, and a few numbers. Pure."""

from collections import deque
from collections.abc import Mapping
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.constants import NS_PER_S
from onboard.health import LINK_SILENT_S, STALLED_NS, Level
from onboard.lidarstate import State
from onboard.status import LidarStatus, RecorderStatus, Status

TEXT_BYTES: Final = 50
"""Of a STATUSTEXT."""
_WAITING: Final = 8
"""More news than this at once is no news: the oldest go."""
_SPACE: Final = {"low": "disk low, lidar stopped", "full": "disk full, nothing recorded"}
_SYNC_S: Final = STALLED_NS / NS_PER_S
_STEADY: Final = 2
"""A finding must be there, or gone, for so many seconds before it is told: what flickers is not a state."""
_SEVERITY: Final = {
    Level.GOOD: dialect.MAV_SEVERITY_INFO,
    Level.WARNING: dialect.MAV_SEVERITY_WARNING,
    Level.CRITICAL: dialect.MAV_SEVERITY_CRITICAL,
}


def text(severity: int, words: str) -> dialect.MAVLink_message:
    """A STATUSTEXT of one piece, cut where it is too long."""
    raw = f"swath: {words}".encode("ascii", "replace")[:TEXT_BYTES]
    return dialect.MAVLink_statustext_message(severity, raw)


class Announcer:
    """Turns the state of each second into texts, at most one a call: on changes only.

    What is good from the start is not announced, except for the lidar: a pilot waits for that.
    """

    def __init__(self) -> None:
        self._told: dict[str, tuple[int, str]] = {}
        """What the pilot knows: by subject, severity and words."""
        self._since: dict[str, tuple[tuple[int, str], int]] = {}
        self._waiting: deque[tuple[int, str]] = deque(maxlen=_WAITING)

    def next(self, states: Mapping[str, tuple[int, str]]) -> dialect.MAVLink_message | None:
        """Take in severity and words of each subject; gives the text to send in this second, if there is one."""
        for subject, state in states.items():
            before, count = self._since.get(subject, (state, 0))
            count = count + 1 if before == state else 1
            self._since[subject] = state, count
            if count < _STEADY or self._told.get(subject) == state:
                continue
            is_news = subject in self._told or subject == "lidar" or state[0] != dialect.MAV_SEVERITY_INFO
            self._told[subject] = state
            if is_news:
                self._waiting.append(state)
        return text(*self._waiting.popleft()) if self._waiting else None


def _doing(lidar: LidarStatus) -> str:
    if lidar.state != State.GOOD:
        return str(lidar.state)
    return "recording" if lidar.recording else "ready, not armed"


def _disk(recorder: RecorderStatus) -> tuple[int, str]:
    """Severity and words of the disk."""
    if recorder.trouble:
        return _SEVERITY[Level.CRITICAL], "disk trouble, see swathd health"
    if recorder.space != "room":
        return _SEVERITY[Level.CRITICAL], _SPACE[recorder.space]
    return _SEVERITY[Level.GOOD], "disk good"


def states(status: Status) -> dict[str, tuple[int, str]]:
    """What the pilot should know, by subject: severity and words without figures, so that they change with the state only."""
    lidar, recorder = status.lidar, status.recorder
    good, warning, critical = (_SEVERITY[level] for level in Level)
    told = {
        "lidar": ({State.GOOD: good, State.RATE_LOW: warning}.get(lidar.state, critical), f"lidar {_doing(lidar)}"),
        "lidar losses": (warning, "lidar packets lost")
        if lidar.kernel_drops + lidar.queue_drops
        else (good, "no losses"),
        "disk": _disk(recorder),
        "sync": (critical, "disk does not take the log")
        if recorder.sync_age_s > _SYNC_S
        else (good, "log reaches disk"),
        "failures": (critical, status.failures[0]) if status.failures else (good, "all workers run"),
    }
    for name, link in status.links.items():
        if not link.connected or link.age_s is None or link.age_s > LINK_SILENT_S:
            told[f"link {name}"] = warning, f"link {name} silent"
        else:
            told[f"link {name}"] = good, f"link {name} good"
    return told


def numbers(status: Status) -> list[dialect.MAVLink_message]:
    """Rates and losses as NAMED_VALUE_FLOAT; names have at most 10 characters."""
    lidar, up_ms = status.lidar, round(status.uptime_s * 1000) % (1 << 32)
    values = {
        "lidar_hz": lidar.packets_s,
        "lidar_lost": float(lidar.kernel_drops + lidar.queue_drops),
        "mav_lost_b": float(sum(link.dropped_bytes for link in status.links.values())),
        "disk_min": -1.0 if status.recorder.minutes_left is None else status.recorder.minutes_left,
    }
    return [dialect.MAVLink_named_value_float_message(up_ms, name.encode(), value) for name, value in values.items()]
