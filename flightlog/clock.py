"""Time scales, as int nanoseconds: Unix and GPS time, counters that wrap, the hour of a top-of-hour stamp."""

from bisect import bisect_right
from datetime import UTC, datetime
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S, NS_PER_US

GPS_EPOCH_UNIX_S: Final = 315_964_800
"""1980-01-06 00:00:00 UTC in Unix seconds (IS-GPS-200)."""

# fmt: off
_LEAP_DATES: Final = (
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01", "1993-07-01",
    "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
)
# fmt: on
LEAP_UNIX_S: Final = tuple(int(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp()) for day in _LEAP_DATES)
"""Unix seconds at which GPS time gained one more second on UTC (IERS Bulletin C; none announced since 2017)."""

PLAUSIBLE_UTC_NS: Final = (946_684_800 * NS_PER_S, (1 << 31) * NS_PER_S)
"""2000 to 2038, to the end of the 32-bit seconds of a log's records: what lies outside is no date, but a counter or a fault."""
_U32: Final = 1 << 32
_CALENDAR_NS: Final = (-62_135_596_800 * NS_PER_S, 253_402_300_799 * NS_PER_S)
"""Years 1 to 9999."""
_HOUR_NS: Final = 3600 * NS_PER_S


def leap_seconds(utc_ns: int) -> int:
    """GPS minus UTC at a Unix time [s]."""
    return bisect_right(LEAP_UNIX_S, utc_ns // NS_PER_S)


def utc_to_gps_ns(utc_ns: int) -> int:
    """Nanoseconds since the GPS epoch of a Unix time [ns]."""
    return utc_ns - GPS_EPOCH_UNIX_S * NS_PER_S + leap_seconds(utc_ns) * NS_PER_S


def gps_to_utc_ns(gps_ns: int) -> int:
    """Unix time [ns] of nanoseconds since the GPS epoch."""
    unix_ns = gps_ns + GPS_EPOCH_UNIX_S * NS_PER_S
    return unix_ns - leap_seconds(unix_ns - leap_seconds(unix_ns) * NS_PER_S) * NS_PER_S


def gps_week_to_utc_ns(week: int, tow_ms: int) -> int:
    """Unix time [ns] of a GPS week and the milliseconds of the week."""
    return gps_to_utc_ns((week * 604_800_000 + tow_ms) * 1_000_000)


def utc_text(utc_ns: int) -> str:
    """ISO 8601 text of a Unix time, to the millisecond; beyond the year 9999, which has no such text, as seconds."""
    if not _CALENDAR_NS[0] <= utc_ns <= _CALENDAR_NS[1]:
        return f"{utc_ns / NS_PER_S:.3f} s after 1970"
    return datetime.fromtimestamp(utc_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def is_plausible(utc_ns: int) -> bool:
    """Whether a Unix time can be the date of a recording."""
    return PLAUSIBLE_UTC_NS[0] <= utc_ns < PLAUSIBLE_UTC_NS[1]


def unwrap_u32(values: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Unwrap a counter modulo 2^32, shape (n,); backward steps of less than half of it stay backward steps."""
    return unwrap(values, _U32)


def unwrap(values: npt.NDArray[np.integer], modulus: int) -> npt.NDArray[np.int64]:
    """Unwrap a counter: each step is taken to be the one nearest to zero.

    Parameters
    ----------
    values : ndarray of integers, shape (n,)
        Readings, in the order they were made.
    modulus : int
        The counter's range.

    Returns
    -------
    ndarray of int64, shape (n,)
        Starts at the first reading, unchanged.
    """
    plain = np.asarray(values).astype(np.int64)
    if plain.size == 0:
        return plain
    half = modulus // 2
    steps = (np.diff(plain) + half) % modulus - half
    return np.concatenate([plain[:1], plain[0] + np.cumsum(steps)])


def unwrap_top_of_hour_ns(
    stamps_us: npt.NDArray[np.integer], host_ns: npt.NDArray[np.int64], last_ns: int | None = None
) -> npt.NDArray[np.int64]:
    """Unwrap the lidar's microseconds past the hour to one continuous scale.

    Each step is taken modulo an hour and nearest to what the host clock says has passed, so that a silence of hours, a stamp that
    runs on past 3600 s before it resets, and packets that come a little out of order are all told apart.

    Parameters
    ----------
    stamps_us : ndarray of uint32, shape (n,)
        Stamps [us past the hour], in order of reception.
    host_ns : ndarray of int64, shape (n + 1,) or (n,)
        Receive times [ns]. With `last_ns`, the first is that of the packet before.
    last_ns : int, optional
        What this function gave for the packet before the first, to carry a stream on from batch to batch.

    Returns
    -------
    ndarray of int64, shape (n,)
        Lidar time [ns]; the first stamp as it is where `last_ns` is not given.
    """
    stamps_ns = np.asarray(stamps_us).astype(np.int64) * NS_PER_US
    if stamps_ns.size == 0:
        return stamps_ns
    before = stamps_ns[:1] if last_ns is None else np.array([last_ns], np.int64)
    host = host_ns if last_ns is not None else np.concatenate([host_ns[:1], host_ns])
    passed_ns = np.diff(host)
    raw = np.diff(np.concatenate([before, stamps_ns]))
    steps = raw + np.rint((passed_ns - raw) / _HOUR_NS).astype(np.int64) * _HOUR_NS
    return np.asarray(before[0] + np.cumsum(steps))


def nearest_hour_ns(stamp_ns: int, near_utc_ns: int) -> int:
    """What to add to a lidar time [ns past some hour] so that it lies within half an hour of a Unix time [ns]."""
    return round((near_utc_ns - stamp_ns) / _HOUR_NS) * _HOUR_NS
