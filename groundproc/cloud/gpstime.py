"""Times of points in files: adjusted standard GPS time, or seconds of the GPS week; to UTC and back."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import clock
from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError
from groundproc.flight.positions.scales import (
    EPOCH_NS,
    WEEK_NS,
    WEEK_S,
    calendar_of_week,
    gps_calendar_from_utc,
    utc_from_gps_calendar,
    week_start_s,
)

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

_ADJUSTED_S: Final = 1_000_000_000
"""Adjusted standard GPS time is GPS time less this (LAS 1.4 R15, global encoding bit 0)."""


def gps_time_s(utc_ns: Times) -> Array:
    """Adjusted standard GPS time [s] of Unix times [ns], shape (n,)."""
    return np.asarray((utc_ns + gps_shift_ns(utc_ns)) * 1e-9)


def gps_shift_ns(utc_ns: Times) -> int:
    """What adjusted standard GPS time is ahead of Unix times, shape (n,), of one flight [ns]; 0 of none."""
    return clock.utc_to_gps_ns(int(utc_ns[0])) - int(utc_ns[0]) - _ADJUSTED_S * NS_PER_S if len(utc_ns) else 0


_FARTHEST_S: Final = 7e9
"""Beyond this, in the year 2233, nanoseconds are too many for 64 bits."""


@dataclass(frozen=True, slots=True)
class Clock:
    """How the stamps of a file become UTC.

    Attributes
    ----------
    week : int or None
        GPS week in which files begin that count seconds of the week.
    near_utc_ns : int or None
        A time of the flight, where the trajectory knows it: gives each point with seconds of the week its week, and goes before `week`.
    """

    week: int | None = None
    near_utc_ns: int | None = None

    def utc_ns(self, path: Path, week_time: bool, time_s: Array) -> Times:
        """Unix times of stamps, shape (n,), of the file at `path`; `week_time`: they are seconds of the GPS week.

        Raises
        ------
        CaptureError
            The stamps are no times, or the week is not known.
        """
        if not (np.abs(time_s) <= _FARTHEST_S).all() or not (time_s != 0.0).any():
            raise CaptureError(f"{path}: gps_time is {_example(time_s)}, expected the time of each point")
        if week_time:
            if self.week is None and self.near_utc_ns is None:
                raise CaptureError(f"{path}: its times are seconds of the GPS week; give the week with --week")
            near = None if self.near_utc_ns is None else int(gps_calendar_from_utc(np.array([self.near_utc_ns]))[0])
            return utc_from_gps_calendar(calendar_of_week(time_s, week=self.week, near_ns=near))
        whole = np.floor(time_s)
        nano = whole.astype(np.int64) * NS_PER_S + np.rint((time_s - whole) * 1e9).astype(np.int64)
        return utc_from_gps_calendar(nano + _ADJUSTED_S * NS_PER_S + EPOCH_NS)

    def begun(self, time_s: Array) -> "Clock":
        """The clock for the rest of a file whose first stamps are seconds of the week, shape (n,): near to where it begins."""
        if self.near_utc_ns is not None or self.week is None or not len(time_s) or not np.isfinite(time_s).all():
            return self
        near = np.array([EPOCH_NS + self.week * WEEK_NS + week_start_s(time_s) * NS_PER_S])
        return replace(self, near_utc_ns=int(utc_from_gps_calendar(near)[0]))


def is_week_time(time_s: Array) -> bool:
    """Whether stamps, shape (n,), can be seconds of the week: most of them; single ones may be wild."""
    with np.errstate(invalid="ignore"):
        return bool(np.mean((time_s >= 0.0) & (time_s < 2.0 * WEEK_S)) > 0.5)


def _example(time_s: Array) -> str:
    if not time_s.any():
        return "0 for all points"
    return f"{time_s[int(np.argmin(np.abs(time_s) <= _FARTHEST_S))]:g} for some points"
