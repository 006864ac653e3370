"""Every clock of a flight on one scale, UTC: which boot of the autopilot goes with which run of the lidar's clock, and how.

A leg is one boot together with one run of the lidar's clock between two jumps of it. Within a run lidar time has one line to UTC; each
boot is tied to the lidar by its own synchronisation. So the lidar, which is what must fit, never has a step within a run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.constants import NS_PER_MS
from flightlog.errors import ClockError
from flightlog.nmea import Rmc
from groundproc.flight.autopilot import Boot
from groundproc.flight.sync import GyroTrack, Sync
from groundproc.flight.timebase import HostLine, UtcTie

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LidarRun:
    """A stretch of the lidar's clock without a jump.

    Attributes
    ----------
    first_receive_ns, last_receive_ns : int
        Receive times [log].
    line : HostLine
        Receive time over lidar time.
    gyro : GyroTrack or None
        None where the lidar sent no position packets, or no readings in them.
    fixes : tuple of (int, Rmc)
        Lidar time [ns] at which each GPS sentence first appeared.
    force_m_s2 : ndarray, shape (n, 3), or None
        Specific force in the sensor frame at the gyro's samples.
    """

    first_receive_ns: int
    last_receive_ns: int
    line: HostLine
    gyro: GyroTrack | None
    fixes: tuple[tuple[int, Rmc], ...]
    force_m_s2: Array | None = None

    def less_delay(self, delay_ms: float) -> "LidarRun":
        """The same with readings of gyro and accelerometers stamped so much earlier: they are late against the returns."""
        if self.gyro is None or delay_ms == 0.0:
            return self
        return replace(self, gyro=replace(self.gyro, time_ns=self.gyro.time_ns - round(delay_ms * NS_PER_MS)))


@dataclass(frozen=True, slots=True)
class Line:
    """A clock as a line over another: y = x + offset + drift (x - reference), all ns."""

    offset_ns: int
    drift: float = 0.0
    reference_ns: int = 0

    def __call__(self, x_ns: Times) -> Times:
        """Times on the other clock, shape (n,)."""
        if self.drift == 0.0:
            return x_ns + self.offset_ns
        return np.asarray(x_ns + self.offset_ns + np.rint((x_ns - self.reference_ns) * self.drift).astype(np.int64))

    def inverse(self) -> "Line":
        """The line back."""
        return Line(-self.offset_ns, -self.drift / (1.0 + self.drift), self.reference_ns + self.offset_ns)


@dataclass(frozen=True, slots=True)
class ClockTie:
    """How the time of one run of the lidar's clock becomes UTC; with it a later run of the program places points at the same instants.

    Attributes
    ----------
    first_receive_ns, last_receive_ns : int
        Receive times of the run [log], by which it is known again.
    lines : tuple of Line
        One after the other: from lidar time to UTC.
    source : str
        What says which UTC it is: "gprmc", "system_time" or "host".
    """

    first_receive_ns: int
    last_receive_ns: int
    lines: tuple[Line, ...]
    source: str

    def utc_from_lidar(self, time_ns: Times) -> Times:
        """UTC [ns] of lidar times, shape (n,)."""
        for line in self.lines:
            time_ns = line(time_ns)
        return time_ns

    def overlap_ns(self, first_receive_ns: int, last_receive_ns: int) -> int:
        """How long this run and a stretch of receive time have in common; negative where they are apart."""
        return min(self.last_receive_ns, last_receive_ns) - max(self.first_receive_ns, first_receive_ns)


@dataclass(frozen=True, slots=True)
class Leg:
    """One boot with one run of the lidar's clock.

    Attributes
    ----------
    boot : Boot
    run : int
        Number of the lidar run.
    sync : Sync
    utc : UtcTie
        What says which UTC it is.
    lidar_line : tuple of Line
        One after the other: from lidar time to UTC.
    first_receive_ns, last_receive_ns : int
        Receive times of the lidar run [log].
    last_lidar_ns : int
        Lidar time at its end.
    """

    boot: Boot
    run: int
    sync: Sync
    utc: UtcTie
    lidar_line: tuple[Line, ...]
    first_receive_ns: int
    last_receive_ns: int
    last_lidar_ns: int

    def utc_from_lidar(self, time_ns: Times) -> Times:
        """UTC [ns] of lidar times, shape (n,)."""
        return self.tie.utc_from_lidar(time_ns)

    @property
    def tie(self) -> ClockTie:
        """The lidar's clock of this leg."""
        return ClockTie(self.first_receive_ns, self.last_receive_ns, self.lidar_line, self.utc.source)

    def utc_from_boot(self, time_ns: Times) -> Times:
        """UTC [ns] of boot times, shape (n,)."""
        return self.utc_from_lidar(line_of(self.sync).inverse()(time_ns))


def ties_of(timeline: Sequence[Leg]) -> tuple[ClockTie, ...]:
    """The lidar's clock of each run in a timeline; legs of one run share it."""
    runs = {leg.run: leg for leg in reversed(timeline)}
    return tuple(leg.tie for _, leg in sorted(runs.items()))


def tied(timeline: Sequence[Leg], ties: Sequence[ClockTie]) -> list[Leg]:
    """The legs with the lidar's clock as ties of an earlier run of the program have it.

    Raises
    ------
    ClockError
        No leg was recorded when any of the ties holds.
    """
    made, met = [], False
    for leg in timeline:
        receive_ns = leg.first_receive_ns, leg.last_receive_ns
        best = max(ties, key=lambda tie: tie.overlap_ns(*receive_ns), default=None)
        if best is not None and best.overlap_ns(*receive_ns) > 0:
            leg, met = replace(leg, lidar_line=best.lines), True
        made.append(leg)
    if not met:
        known = " and ".join(f"{utc_text(t.first_receive_ns)} to {utc_text(t.last_receive_ns)}" for t in ties)
        raise ClockError(
            f"clock ties: they hold from {known or 'never'}, and the log was recorded from {utc_text(timeline[0].first_receive_ns)}; is it "
            "of the same flight?"
        )
    return made


def line_of(found: Sync) -> Line:
    """The line that a synchronisation found."""
    return Line(found.offset_ns, found.drift_ppm * 1e-6, found.reference_ns)
