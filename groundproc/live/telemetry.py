"""The autopilot as heard live: the last minute of its frames, and tables of them on request."""

from collections import deque
from typing import Final

from flightlog import mavlink
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import LogError
from flightlog.mavlink import Frame, FrameParser
from flightlog.vehicles import Vehicles
from groundproc.flight import autopilot
from groundproc.flight.autopilot import REBOOT_MS, Boot

KEPT_NS: Final = 60 * NS_PER_S
_MOST: Final = 60_000
"""Frames kept: a minute at 1,000 a second."""
_ATTITUDE: Final = mavlink.message_id("ATTITUDE")
_STAMP_AT: Final = mavlink.field_offset("ATTITUDE", "time_boot_ms") or 0
_HEARTBEAT: Final = 0


class Telemetry:
    """Cuts frames and keeps those of the last minute.

    Attributes
    ----------
    reboots : int
        How often the autopilot was started again.
    """

    def __init__(self) -> None:
        self.parser = FrameParser()
        self.reboots = 0
        self.frames = 0
        self.last_ns = 0
        self._kept: deque[Frame] = deque()
        self._vehicles = Vehicles()
        self._heartbeats: dict[tuple[int, int], Frame] = {}
        self._stamp_ms: int | None = None

    def feed(self, time_ns: int, data: bytes) -> None:
        """Take bytes received at a time [ns of log time]."""
        for frame in self.parser.feed(time_ns, data):
            if frame.known and frame.message_id in autopilot.WANTED:
                self._keep(frame)

    def _keep(self, frame: Frame) -> None:
        self._vehicles.hear(frame)
        if frame.message_id == _HEARTBEAT:
            self._heartbeats[(frame.system, frame.component)] = frame
        if frame.message_id == _ATTITUDE and (frame.system, frame.component) == self._vehicles.autopilot:
            stamp_ms = int.from_bytes(frame.payload[_STAMP_AT : _STAMP_AT + 4], "little")
            if self._stamp_ms is not None and stamp_ms < self._stamp_ms - REBOOT_MS:
                self._kept.clear()
                self.reboots += 1
            self._stamp_ms = stamp_ms
        self.frames += 1
        self.last_ns = frame.time_ns
        self._kept.append(frame)
        while len(self._kept) > _MOST or self._kept[0].time_ns < frame.time_ns - KEPT_NS:
            self._kept.popleft()

    @property
    def is_there(self) -> bool:
        """Whether an autopilot has said that it is one."""
        return self._vehicles.autopilot is not None

    def latest(self, seconds: float) -> list[Frame]:
        """Frames of the last seconds, a heartbeat of each sender first."""
        begin_ns = self.last_ns - round(seconds * 1e3) * NS_PER_MS
        found: list[Frame] = []
        for frame in reversed(self._kept):
            if frame.time_ns < begin_ns:
                break
            found.append(frame)
        return [*self._heartbeats.values(), *reversed(found)]

    def boot(self, seconds: float) -> Boot | None:
        """The tables of the last seconds; None where there is no autopilot."""
        return newest_boot(self.latest(seconds))


def newest_boot(frames: list[Frame]) -> Boot | None:
    """Tables of the newest boot among frames; None where no autopilot is among them."""
    try:
        found = autopilot.boots(frames)
    except LogError:
        return None
    return found[-1] if found else None
