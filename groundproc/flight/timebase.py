"""Clocks against each other without gyros: receive times against a device's clock, and what ties a clock to UTC."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import clock
from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US
from flightlog.errors import ClockError
from flightlog.nmea import Rmc
from groundproc.flight.autopilot import Boot
from groundproc.flight.claims import GPRMC, GPS_RAW, HOST, SYSTEM_TIME
from groundproc.flight.positions.scales import EPOCH_NS, in_era

LARGEST_DRIFT: Final = 300e-6
"""Drift of one crystal against another beyond which a fit has followed the jitter [s/s]."""
LEAST_DRIFT_SPAN_S: Final = 60.0
LEAST_TRAILING: Final = 0.95
"""Part of the GPS sentences that must agree with a disciplined clock."""
LEAST_RATE_SPAN_S: Final = 5.0
LEAST_RATE_MESSAGES: Final = 30
_LATEST_US: Final = 1 << 53
RECEIVER_LATE_NS: Final = 150.0 * NS_PER_MS
"""From a fix's epoch to its place in the log: 0.1 to 0.2 s with the receivers of such boards (AP_GPS, get_lag)."""


@dataclass(frozen=True, slots=True)
class HostLine:
    """Receive time as a line over a device's clock: host = device + offset + drift (device - reference).

    Attributes
    ----------
    reference_ns, offset_ns : int
    drift_ppm : float
    sigma_ns : float
        How late messages typically are beyond the line [ns]; the delay of the fastest message stays unknown, and is taken to be of
        the same size.
    rate : float
        Seconds of the device's clock in a second of receive time, where that is more than clocks and delays explain; else 1.
    """

    reference_ns: int
    offset_ns: int
    drift_ppm: float
    sigma_ns: float
    rate: float = 1.0

    def host_ns(self, device_ns: int) -> int:
        """Receive time of the fastest message [ns] at a device time [ns]."""
        return device_ns + self.offset_ns + round((device_ns - self.reference_ns) * self.drift_ppm * 1e-6)

    def device_ns(self, host_ns: int) -> int:
        """Device time [ns] of what is received at a time [ns] without delay."""
        since_ns = host_ns - self.offset_ns - self.reference_ns
        return self.reference_ns + round(since_ns / (1.0 + self.drift_ppm * 1e-6))


def host_line(device_ns: npt.NDArray[np.int64], host_ns: npt.NDArray[np.int64]) -> HostLine:
    """Fit the lower envelope of receive times: delays only ever add.

    The line under all points that lies closest to them is an edge of their lower convex hull, the one over their mean (Moon, Skelly,
    Towsley 1999).

    Raises
    ------
    ClockError
        Fewer than two messages.
    """
    if len(device_ns) < 2:
        raise ClockError(f"{len(device_ns)} stamped messages, expected at least 2 to tie a clock to receive times")
    reference = int(device_ns[len(device_ns) // 2])
    base = int(np.min(host_ns - device_ns))
    x: npt.NDArray[np.float64] = ((device_ns - reference) * 1e-9).astype(np.float64)
    y: npt.NDArray[np.float64] = ((host_ns - device_ns - base) * 1e-9).astype(np.float64)
    slope, level = 0.0, float(y.min())
    if np.ptp(x) >= LEAST_DRIFT_SPAN_S:
        slope, level = _hull_edge(x, y)
        if abs(slope) > LARGEST_DRIFT:
            slope, level = 0.0, float(y.min())
    late = y - (level + slope * x)
    sigma_ns = float(max(np.median(late), 1e-5) * NS_PER_S)
    return HostLine(reference, base + round(level * NS_PER_S), slope * 1e6, sigma_ns, _strange_rate(x, y))


def _strange_rate(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> float:
    """Rate of a device's clock against receive times where it is beyond reason, else 1.

    `LARGEST_DRIFT` is reason. A device's crystal holds 100 ppm from -40 to 85 deg C (the usual grade; the HDL-32E in the recordings is 58
    ppm off), a computer's likewise, and NTP slews that by up to 500 ppm for a while. Delays add what they vary by over the span: the 95th
    percentile of the lateness beyond the line, at either end.
    """
    span = float(np.ptp(x))
    if span < LEAST_RATE_SPAN_S or len(x) < LEAST_RATE_MESSAGES:
        return 1.0
    slope, level = _hull_edge(x, y)
    vary = float(np.percentile(y - (level + slope * x), 95.0))
    if abs(slope) <= LARGEST_DRIFT + 500e-6 + 4.0 * vary / span or slope <= -1.0:
        return 1.0
    return 1.0 / (1.0 + slope)


def _hull_edge(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Slope and intercept of the edge of the lower convex hull over the mean of x."""
    order = np.argsort(x, kind="stable")
    hull: list[tuple[float, float]] = []
    for point in zip(x[order].tolist(), y[order].tolist(), strict=True):
        while len(hull) >= 2:
            (ax, ay), (bx, by) = hull[-2], hull[-1]
            if (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax) > 0:
                break
            hull.pop()
        hull.append(point)
    corners = np.array(hull)
    right = int(np.clip(np.searchsorted(corners[:, 0], x.mean()), 1, len(corners) - 1))
    (ax, ay), (bx, by) = corners[right - 1], corners[right]
    if bx <= ax:
        return 0.0, float(min(ay, by))
    slope = (by - ay) / (bx - ax)
    return float(slope), float(ay - slope * ax)


@dataclass(frozen=True, slots=True)
class UtcTie:
    """UTC as a clock's time plus an offset.

    Attributes
    ----------
    offset_ns : int
        UTC minus the clock's time.
    sigma_ns : float
    source : str
        "gprmc", "system_time", "gps_raw" or "host".
    mended, doubts : tuple of str
        What was found wrong with the source and mended, and what contradicts it.
    """

    offset_ns: int
    sigma_ns: float
    source: str
    mended: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def lidar_utc(fixes: Sequence[tuple[int, Rmc]]) -> UtcTie | None:
    """UTC from the lidar's own GPS: its stamp counts from the hour, and the sentence tells which.

    Taken only if the sentences of valid fixes trail the stamp by 0 to 2 s throughout, single wild ones apart, as they do when the clock
    is disciplined; a free-running counter is off by anything. The PPS byte is no help: firmware of 2012 leaves it 0 when locked.

    Parameters
    ----------
    fixes : sequence of (int, Rmc)
        Lidar time [ns past some hour, unwrapped] at which each sentence first appeared.
    """
    valid = [(time_ns, fix.utc_ns) for time_ns, fix in fixes if fix.valid]
    if not valid:
        return None
    time_ns, stated_ns = np.array(valid, np.int64).T
    stated_ns, _ = in_era(stated_ns)
    hour_ns = int(
        np.median([clock.nearest_hour_ns(*pair) for pair in zip(time_ns.tolist(), stated_ns.tolist(), strict=True)])
    )
    lag_ns = time_ns + hour_ns - stated_ns
    trails = (lag_ns >= -50 * NS_PER_MS) & (lag_ns <= 2 * NS_PER_S)
    if trails.mean() < LEAST_TRAILING:
        return None
    return UtcTie(hour_ns, 50.0 * NS_PER_US, GPRMC)


def boot_utc(boot: Boot) -> UtcTie | None:
    """UTC from SYSTEM_TIME: its Unix time is that of the last fix, so the largest difference to the boot clock is the truest.

    Where none was sent GPS_RAW_INT serves, if its time is Unix time, as older autopilots have it.
    """
    for source, message, field in (
        (SYSTEM_TIME, "SYSTEM_TIME", "time_unix_usec"),
        (GPS_RAW, "GPS_RAW_INT", "time_usec"),
    ):
        if not boot.has(message, 1):
            continue
        unix_us = np.minimum(
            boot.tables[message][field], _LATEST_US
        )  # as unsigned numbers they exceed what nanoseconds can
        unix_ns = unix_us.astype(np.int64) * NS_PER_US
        known = (unix_ns >= EPOCH_NS) & (unix_ns < clock.PLAUSIBLE_UTC_NS[1])
        if not known.any():
            continue
        offset_ns = unix_ns[known] - boot.stamps_ns[message][known]
        # the first fixes may come with a wrong second: keep what agrees with the majority
        near = offset_ns[np.abs(offset_ns - np.median(offset_ns)) < NS_PER_S]
        if not len(near):  # half of them are of another era
            near = offset_ns[offset_ns > offset_ns.max() - NS_PER_S]
        spread = float(np.median(near.max() - near)) if len(near) > 1 else 0.2 * NS_PER_S
        # a fix in the board's own log is as late as its receiver and the driver are; all are so by nearly the same
        least = RECEIVER_LATE_NS if message in boot.origins else float(NS_PER_MS)
        return UtcTie(int(near.max()), max(spread, least), source)
    return None


def host_utc(line: HostLine, device_ns: int) -> UtcTie:
    """UTC as the recording host's clock had it: right to what that clock was right."""
    return UtcTie(line.host_ns(device_ns) - device_ns, max(line.sigma_ns, 1.0 * NS_PER_S), HOST)
