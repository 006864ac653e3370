"""Time scales of outside files, for whole columns."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import GPS_EPOCH_UNIX_S, LEAP_UNIX_S
from flightlog.constants import NS_PER_S

Times = npt.NDArray[np.int64]

WEEK_NS: Final = 604_800 * NS_PER_S
EPOCH_NS: Final = GPS_EPOCH_UNIX_S * NS_PER_S
"""Start of GPS week 0 in Unix time [ns]."""
# The n-th leap second takes effect at LEAP_UNIX_S[n] of UTC; GPS time, written as a calendar, then shows n more.
_STEPS_NS: Final = np.array([(at + count) * NS_PER_S for count, at in enumerate(LEAP_UNIX_S, 1)], np.int64)
_LEAPS_NS: Final = np.array(LEAP_UNIX_S, np.int64) * NS_PER_S


def utc_from_gps_calendar(time_ns: Times) -> Times:
    """Unix time [ns] of GPS time written as a calendar, that is counted from 1970 without leap seconds [ns], shape (n,)."""
    return np.asarray(time_ns - np.searchsorted(_STEPS_NS, time_ns, side="right") * NS_PER_S)


def gps_calendar_from_utc(utc_ns: Times) -> Times:
    """The inverse: Unix time plus the leap seconds so far [ns], shape (n,)."""
    return np.asarray(utc_ns + np.searchsorted(_LEAPS_NS, utc_ns, side="right") * NS_PER_S)


def first_of_each(time_s: npt.NDArray[np.floating[Any]], interval_s: float) -> npt.NDArray[np.int64]:
    """Indices of the first of each interval among times in order [s], shape (n,)."""
    with np.errstate(invalid="ignore"):
        number = np.floor(np.asarray(time_s) / interval_s + 1e-6)  # a stamp on the edge belongs behind it
        return np.flatnonzero(np.concatenate([[True], np.diff(number) != 0]))
