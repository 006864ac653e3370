"""How the clocks of autopilot and lidar stand to log time. Pure: samples in, a line out.

An autopilot that speaks TIMESYNC is asked: its answer lies between our question and the arrival, and the shortest
round trips are the most accurate. Other autopilots only send their stamps. No stamp can be received before it was
made, so the best estimate is the upper envelope of (stamp - receive time). It still contains the delay that every
message has.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from flightlog.constants import HOUR_NS, NS_PER_MS, NS_PER_S
from flightlog.nmea import Rmc
from flightlog.records import SyncMethod, UtcSource

_JUMP_NS: Final = 500 * NS_PER_MS
"""A clock that is this far from where its line leads was started anew."""
_SKEW_SPAN_NS: Final = 30 * NS_PER_S
"""Over less than this no rate is told from noise."""
_SKEW_LIMIT: Final = 1e-3
"""No crystal is so far off."""
_ROUND_TRIPS: Final = 120
_WINDOW_NS: Final = 5 * NS_PER_S
_WINDOWS: Final = 120
_STAMP_NS: Final = NS_PER_MS // 2
"""Autopilots cut boot time to whole milliseconds."""
_RMC_LATE_NS: Final = 2 * NS_PER_S
"""The lidar passes a sentence on up to this long after the second that it names; usually 0.85 s."""


@dataclass(frozen=True, slots=True)
class ClockLine:
    """A clock as a line over log time."""

    at_ns: int
    """Log time at which `offset_ns` holds."""
    offset_ns: int
    """The clock minus log time."""
    skew_ppm: float
    uncertainty_ns: int
    samples: int
    method: SyncMethod

    def offset_at(self, log_ns: int) -> int:
        """The clock minus log time at a log time [ns]."""
        return self.offset_ns + round((log_ns - self.at_ns) * self.skew_ppm * 1e-6)


@dataclass(frozen=True, slots=True)
class _Trip:
    log_ns: int
    offset_ns: int
    rtt_ns: int


class RoundTrips:
    """TIMESYNC: questions answered."""

    def __init__(self) -> None:
        self._trips: deque[_Trip] = deque(maxlen=_ROUND_TRIPS)
        self.restarts = 0

    def add(self, sent_ns: int, received_ns: int, theirs_ns: int) -> None:
        """Note an answer: log times of question and answer, and the clock asked for in between [ns]."""
        middle_ns = (sent_ns + received_ns) // 2
        trip = _Trip(middle_ns, theirs_ns - middle_ns, received_ns - sent_ns)
        if self._trips:
            nearest = min(self._trips, key=lambda other: other.rtt_ns)
            if abs(trip.offset_ns - nearest.offset_ns) > _JUMP_NS + trip.rtt_ns + nearest.rtt_ns:
                self._trips.clear()
                self.restarts += 1
        self._trips.append(trip)

    def line(self, at_ns: int) -> ClockLine | None:
        """The clock at a log time, None before the first answer."""
        if not self._trips:
            return None
        rtt_ns = np.array([trip.rtt_ns for trip in self._trips])
        # answers that were delayed say little: the faster half has the information
        best = np.flatnonzero(rtt_ns <= np.median(rtt_ns))
        base = self._trips[int(np.argmin(rtt_ns))]
        time_s = np.array([self._trips[i].log_ns - base.log_ns for i in best]) / NS_PER_S
        offset_ns = np.array([self._trips[i].offset_ns - base.offset_ns for i in best], np.float64)
        skew = 0.0
        if len(best) >= 8 and np.ptp(time_s) * NS_PER_S >= _SKEW_SPAN_NS:
            # the error of an answer is up to half of its trip's excess over the shortest trip
            sigma_ns = (rtt_ns[best] - rtt_ns.min()) / 2 + 0.02 * rtt_ns.min() + 1000
            slope, level = _robust_line(time_s, offset_ns, sigma_ns)
            skew = float(np.clip(slope / NS_PER_S, -_SKEW_LIMIT, _SKEW_LIMIT))
        else:
            level = 0.0
        now_ns = base.offset_ns + round(level + skew * (at_ns - base.log_ns))
        return ClockLine(at_ns, now_ns, skew * 1e6, int(rtt_ns.min()) // 2, len(self._trips), SyncMethod.TIMESYNC)


def _robust_line(x: np.ndarray, y: np.ndarray, sigma: np.ndarray) -> tuple[float, float]:
    """Slope and level at x = 0 by weighted least squares; a second pass leaves out what is far off."""
    keep = np.ones(len(x), np.bool_)
    slope = level = 0.0
    for _ in range(3):
        slope, level = np.polyfit(x[keep], y[keep], 1, w=1 / sigma[keep])
        off = np.abs(y - slope * x - level) / sigma
        keep = off <= max(3.0, 3 * 1.4826 * float(np.median(off)))
        if keep.sum() < 4:
            break
    return float(slope), float(level)


class Envelope:
    """Stamps received one way: the line on top of (stamp - receive time).

    Parameters
    ----------
    period_ns : int, optional
        The clock wraps after so much.
    floor_ns : int
        What its stamps resolve; the uncertainty is never less.
    """

    def __init__(self, period_ns: int | None = None, floor_ns: int = _STAMP_NS) -> None:
        self._period_ns, self._floor_ns = period_ns, floor_ns
        self._tops: deque[tuple[int, int]] = deque(maxlen=_WINDOWS)
        """Log time and (stamp - log time) of the quickest message of each window [ns]."""
        self._window_ns = 0
        self._astray = 0
        self.samples = 0
        self.restarts = 0

    def add(self, log_ns: int, stamp_ns: int) -> None:
        """Note a stamp and the log time of its reception [ns]."""
        offset_ns = stamp_ns - log_ns
        if self._tops:
            last_ns = self._tops[-1][1]
            if self._period_ns is not None:
                offset_ns += round((last_ns - offset_ns) / self._period_ns) * self._period_ns
            # a late stamp was only delayed; an early one, or many late ones, mean that the clock was set
            if offset_ns - last_ns > _JUMP_NS or (offset_ns - last_ns < -_JUMP_NS and self._is_lost()):
                self._tops.clear()
                self.restarts += 1
                self.samples = 0
            elif offset_ns - last_ns < -_JUMP_NS:
                return
        self._astray = 0
        self.samples += 1
        if not self._tops or log_ns - self._window_ns >= _WINDOW_NS:
            self._window_ns = log_ns
            self._tops.append((log_ns, offset_ns))
        elif offset_ns > self._tops[-1][1]:
            self._tops[-1] = (log_ns, offset_ns)

    def _is_lost(self) -> bool:
        self._astray += 1
        return self._astray >= 5

    def line(self, at_ns: int) -> ClockLine | None:
        """The clock at a log time, None before the first stamp."""
        if not self._tops:
            return None
        begin_ns, base_ns = self._tops[0]
        points = [(log_ns - begin_ns, offset_ns - base_ns) for log_ns, offset_ns in self._tops]
        skew = 0.0
        if points[-1][0] >= _SKEW_SPAN_NS and len(points) >= 4:
            (x0, y0), (x1, y1) = _upper_edge(points)
            skew = min(max((y1 - y0) / (x1 - x0), -_SKEW_LIMIT), _SKEW_LIMIT)
        level = max(y - skew * x for x, y in points)
        below = sorted(level + skew * x - y for x, y in points)[len(points) // 2]
        offset_ns = base_ns + round(level + skew * (at_ns - begin_ns))
        uncertainty_ns = max(self._floor_ns, round(below))
        return ClockLine(at_ns, offset_ns, skew * 1e6, uncertainty_ns, self.samples, SyncMethod.ENVELOPE)


def _upper_edge(points: list[tuple[int, int]]) -> tuple[tuple[int, int], tuple[int, int]]:
    """The edge of the upper convex hull over the middle of the points; no line above them all is nearer to them."""
    hull: list[tuple[int, int]] = []
    for x, y in points:
        while len(hull) > 1 and (hull[-1][0] - hull[-2][0]) * (y - hull[-2][1]) >= (hull[-1][1] - hull[-2][1]) * (
            x - hull[-2][0]
        ):
            hull.pop()
        hull.append((x, y))
    middle = sum(x for x, _ in points) / len(points)
    right = next(i for i in range(1, len(hull)) if hull[i][0] >= middle or i == len(hull) - 1)
    return hull[right - 1], hull[right]


def utc_of_lidar(lidar_ns: int, rmc: Rmc | None) -> tuple[int, UtcSource]:
    """UTC minus the lidar's clock [ns], by the newest sentence that it passed on when its clock stood at `lidar_ns`.

    A lidar without a pulse counts from when it was switched on. One that follows GPS stands where the sentence says, which names a second
    that is just over; that tells the two apart better than the PPS byte, which firmware of 2012 leaves at 0.
    """
    if rmc is None:
        return 0, UtcSource.NONE
    hour_ns = round((rmc.utc_ns - lidar_ns) / HOUR_NS) * HOUR_NS
    if not 0 <= lidar_ns + hour_ns - rmc.utc_ns <= _RMC_LATE_NS:
        return 0, UtcSource.NONE
    return hour_ns, UtcSource.RMC_FIX if rmc.valid else UtcSource.RMC_NO_FIX
