"""Log time: the wall clock at the start, continued by the monotonic clock, so that it never steps inside a log.

The kernel stamps packets with the wall clock, which may be set during recording (no clock on the board, then GPS or
NTP arrives). Each poll therefore notes the difference between wall clock and monotonic clock, and stamps are
converted to log time with it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_MS
from flightlog.records import HostClock

STEP_NS: Final = 5 * NS_PER_MS
"""A change of (wall clock - monotonic clock) from poll to poll beyond this is a step; less is slewing."""

_BRACKET_NS: Final = 50_000
"""How close two readings of the monotonic clock must be for what was read between them to count as the same instant."""


class Clocks(NamedTuple):
    """The host's clocks at one instant [ns]."""

    realtime_ns: int
    monotonic_ns: int

    @property
    def offset_ns(self) -> int:
        """Wall clock minus monotonic clock."""
        return self.realtime_ns - self.monotonic_ns


def read_clocks() -> Clocks:
    """Read both clocks at one instant, as nearly as a busy machine allows."""
    best: tuple[int, Clocks] | None = None
    for _ in range(5):
        before_ns = time.monotonic_ns()
        realtime_ns = time.time_ns()
        width_ns = time.monotonic_ns() - before_ns
        if best is None or width_ns < best[0]:
            best = width_ns, Clocks(realtime_ns, before_ns + width_ns // 2)
        if width_ns <= _BRACKET_NS:
            break
    assert best is not None
    return best[1]


@dataclass(frozen=True, slots=True)
class LogTime:
    """The log's time scale: what to add to the monotonic clock [ns]."""

    anchor_ns: int

    @classmethod
    def start(cls, now: Clocks) -> "LogTime":
        """Log time that agrees with the wall clock now."""
        return cls(now.offset_ns)

    def at(self, now: Clocks) -> int:
        """Log time of a reading of the clocks [ns]."""
        return now.monotonic_ns + self.anchor_ns


class KernelTime:
    """Puts the kernel's receive times of one socket on log time.

    Parameters
    ----------
    log_time : LogTime
    now : Clocks
        Read when the socket was opened.
    """

    def __init__(self, log_time: LogTime, now: Clocks) -> None:
        self._log_time = log_time
        self._before = self._earlier = now

    def convert(self, stamps_ns: npt.NDArray[np.int64], now: Clocks, *, emptied: bool = True) -> npt.NDArray[np.int64]:
        """Log times of packets that a poll found.

        Parameters
        ----------
        stamps_ns : ndarray of int64, shape (n,)
            The kernel's stamps on the wall clock, in order of arrival.
        now : Clocks
            Read after they were taken.
        emptied : bool
            Whether that emptied the socket; if not, what comes next may have arrived before these were taken.

        Returns
        -------
        ndarray of int64, shape (n,)
            [ns of log time], never later than now nor earlier than the poll before the last.
        """
        offset_ns = stepped_offset_ns(stamps_ns, self._before, now)
        monotonic_ns: npt.NDArray[np.int64] = np.maximum(stamps_ns - offset_ns, self._earlier.monotonic_ns)
        np.minimum(monotonic_ns, now.monotonic_ns, out=monotonic_ns)
        if emptied:
            self._earlier, self._before = self._before, now
        monotonic_ns += self._log_time.anchor_ns
        return monotonic_ns


def stepped_offset_ns(stamps_ns: npt.NDArray[np.int64], before: Clocks, now: Clocks) -> npt.NDArray[np.int64] | int:
    """How far the wall clock was from the monotonic one at each stamp [ns], shape (n,) or one for all.

    Where the clock was stepped between two polls, the step lies between two neighbours of the row (poll before, stamps, this poll);
    it is placed where removing it leaves the row smoothest.
    """
    step_ns = now.offset_ns - before.offset_ns
    if abs(step_ns) <= STEP_NS:
        return now.offset_ns
    row = np.concatenate([[before.realtime_ns], stamps_ns, [now.realtime_ns]])
    gaps_ns = np.diff(row)
    after = int(np.argmin(np.abs(gaps_ns - step_ns) - np.abs(gaps_ns)))
    return np.where(np.arange(len(stamps_ns)) < after, before.offset_ns, now.offset_ns)


class ClockWatch:
    """Makes the log's /host_clock records and notes steps of the wall clock.

    Parameters
    ----------
    log_time : LogTime
    read : callable
        Reads the clocks; a test may pass clocks of its own.
    boottime : callable
        Reads the boot clock [ns].
    """

    def __init__(
        self,
        log_time: LogTime,
        read: Callable[[], Clocks] = read_clocks,
        boottime: Callable[[], int] = lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME),
    ) -> None:
        self._log_time, self._read, self._boottime = log_time, read, boottime
        self._offset_ns: int | None = None
        self.steps = 0
        """How often the wall clock was stepped."""

    def record(self) -> HostClock:
        """Read the clocks."""
        now = self._read()
        step_ns = 0 if self._offset_ns is None else now.offset_ns - self._offset_ns
        self._offset_ns = now.offset_ns
        self.steps += abs(step_ns) > STEP_NS
        return HostClock(self._log_time.at(now), now.realtime_ns, now.monotonic_ns, self._boottime(), step_ns)
