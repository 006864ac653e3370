"""Times of points in files: adjusted standard GPS time, or seconds of the GPS week; to UTC and back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import clock
from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError
from groundproc.flight.positions.scales import EPOCH_NS, WEEK_NS, utc_from_gps_calendar

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

_ADJUSTED_S: Final = 1_000_000_000
"""Adjusted standard GPS time is GPS time less this (LAS 1.4 R15, global encoding bit 0)."""


def gps_time_s(utc_ns: Times) -> Array:
    """Adjusted standard GPS time [s] of Unix times [ns], shape (n,)."""
    if not len(utc_ns):
        return np.empty(0)
    shift_ns = clock.utc_to_gps_ns(int(utc_ns[0])) - int(utc_ns[0]) - _ADJUSTED_S * NS_PER_S
    return np.asarray((utc_ns + shift_ns) * 1e-9)


_FARTHEST_S: Final = 7e9
"""Beyond this, in the year 2233, nanoseconds are too many for 64 bits."""


@dataclass(frozen=True, slots=True)
class Clock:
    """How the stamps of a file become UTC.

    Attributes
    ----------
    week : int or None
        GPS week of files that count seconds of the week.
    near_utc_ns : int or None
        A time of the flight, where the trajectory knows it: gives files with seconds of the week theirs.
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
        whole = np.floor(time_s)
        nano = whole.astype(np.int64) * NS_PER_S + np.rint((time_s - whole) * 1e9).astype(np.int64)
        if not week_time:
            return utc_from_gps_calendar(nano + _ADJUSTED_S * NS_PER_S + EPOCH_NS)
        if self.week is not None:
            week = self.week
        elif self.near_utc_ns is not None:
            # the leap seconds, 18 of 604800, do not matter here
            week = round((self.near_utc_ns - EPOCH_NS - int(nano[len(nano) // 2])) / WEEK_NS)
        else:
            raise CaptureError(f"{path}: its times are seconds of the GPS week; give the week with --week")
        return utc_from_gps_calendar(nano + week * WEEK_NS + EPOCH_NS)


def _example(time_s: Array) -> str:
    if not time_s.any():
        return "0 for all points"
    return f"{time_s[int(np.argmin(np.abs(time_s) <= _FARTHEST_S))]:g} for some points"
