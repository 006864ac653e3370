"""Time scales of outside files, for whole columns."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import GPS_EPOCH_UNIX_S, LEAP_UNIX_S
from flightlog.constants import NS_PER_S

Times = npt.NDArray[np.int64]

WEEK_S: Final = 604_800
WEEK_NS: Final = WEEK_S * NS_PER_S
ERA_NS: Final = 1024 * WEEK_NS
"""GPS weeks are sent modulo 1024: receivers with old firmware state dates that are whole eras early (IS-GPS-200, 20.3.3.3.1.1)."""
_APART_NS: Final = 6 * 3600 * NS_PER_S
"""Times of one flight or session have no longer silence between them."""
_FEW: Final = 0.01
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


def calendar_of_week(
    of_week_s: npt.NDArray[np.floating[Any]], *, week: int | None = None, near_ns: int | None = None
) -> Times:
    """GPS time written as a calendar [ns] of seconds of the GPS week, each for itself, shape (n,).

    Seconds that start again at the week's end and such that run on over it come out alike, in whatever order they are.

    Parameters
    ----------
    of_week_s : ndarray, shape (n,)
        Finite.
    week : int, optional
        GPS week, without rollover, in which the times begin: behind the longest stretch of the week that has none.
    near_ns : int, optional
        A time, written likewise: each is taken within half a week of it. One of the two is needed; this one goes first.
    """
    whole = np.floor(of_week_s)
    time_ns = whole.astype(np.int64) * NS_PER_S + np.rint((of_week_s - whole) * 1e9).astype(np.int64)
    if near_ns is None:
        assert week is not None
        first_s = week_start_s(of_week_s)
        near_ns = EPOCH_NS + week * WEEK_NS + first_s * NS_PER_S + (WEEK_NS // 2 - NS_PER_S)
    beyond_ns = near_ns - EPOCH_NS - time_ns + WEEK_NS // 2
    return np.asarray(EPOCH_NS + time_ns + beyond_ns // WEEK_NS * WEEK_NS)


def week_start_s(of_week_s: npt.NDArray[np.floating[Any]]) -> int:
    """The second of the week at which times that may go over its end begin: behind the longest stretch without any."""
    second = np.floor(np.asarray(of_week_s)).astype(np.int64)
    seen = np.unique(second % WEEK_S)
    if not len(seen):
        return 0
    silent = np.diff(seen, append=seen[0] + WEEK_S)
    start = int(seen[(int(np.argmax(silent)) + 1) % len(seen)])
    # a file may begin behind the week's end and run on
    return start + int(second[second % WEEK_S == start].min()) // WEEK_S * WEEK_S


def in_era(time_ns: Times, near_ns: int | None = None) -> tuple[Times, int]:
    """Times [ns], shape (n,), and how many of them were whole eras of GPS weeks early or late, mended each for itself.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
    near_ns : int, optional
        A time of the same flight. Without it the latest of the times that are eras apart is right: a receiver falls behind, never ahead.
    """
    if not len(time_ns):
        return time_ns, 0
    ahead_ns = (int(time_ns.max()) if near_ns is None else near_ns) - time_ns
    eras = np.rint(ahead_ns / ERA_NS).astype(np.int64)
    wrong = (eras != 0) & (np.abs(ahead_ns - eras * ERA_NS) < WEEK_NS)
    return np.asarray(time_ns + np.where(wrong, eras, 0) * ERA_NS), int(wrong.sum())


def stray(time_ns: Times) -> npt.NDArray[np.bool_]:
    """Times that cannot be of the same flight as the rest, shape (n,): a few, more than 6 hours from all others.

    A few is a hundredth of them, or a single one of three or more.
    """
    order = np.argsort(time_ns, kind="stable")
    group = np.concatenate([[0], np.cumsum(np.diff(time_ns[order]) > _APART_NS)]).astype(np.int64)[: len(order)]
    size = np.bincount(group) if len(group) else np.empty(0, np.int64)
    few = (size <= _FEW * len(order)) | ((size == 1) & (len(order) >= 3))
    found = np.zeros(len(order), np.bool_)
    if len(size) > 1:
        few[np.argmax(size)] = False
        found[order] = few[group]
    return found


def first_of_each(time_s: npt.NDArray[np.floating[Any]], interval_s: float) -> npt.NDArray[np.int64]:
    """Indices of the first of each interval among times in order [s], shape (n,)."""
    with np.errstate(invalid="ignore"):
        number = np.floor(np.asarray(time_s) / interval_s + 1e-6)  # a stamp on the edge belongs behind it
        return np.flatnonzero(np.concatenate([[True], np.diff(number) != 0]))
