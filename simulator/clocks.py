"""What each clock shows at a true time."""

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S
from flightlog.errors import ConfigError
from simulator.config import ClockOptions


@dataclass(frozen=True, slots=True)
class Clock:
    """A clock that shows `start_ns` at true time 0 and goes `drift_ppm` too fast."""

    start_ns: int
    drift_ppm: float = 0.0

    def shows_ns(self, time_s: npt.NDArray[np.float64] | float) -> npt.NDArray[np.int64]:
        """Reading at true times [s since start]; shape as given [ns]."""
        elapsed_ns = np.asarray(time_s, np.float64) * (NS_PER_S * (1.0 + self.drift_ppm * 1e-6))
        return np.asarray(self.start_ns + np.rint(elapsed_ns).astype(np.int64))

    def time_s(self, elapsed_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """True time at which this clock has advanced by `elapsed_s` since the start [s]."""
        return np.asarray(elapsed_s / (1.0 + self.drift_ppm * 1e-6))


@dataclass(frozen=True, slots=True)
class Clocks:
    """The clocks of one simulation, each on the scale of `flightlog` that bears its name."""

    utc: Clock
    host: Clock
    lidar: Clock
    boot: Clock


def clocks(options: ClockOptions) -> Clocks:
    """The clocks of a configuration.

    Raises
    ------
    ConfigError
        A start that is no UTC time.
    """
    try:
        start = datetime.fromisoformat(options.start_utc)
    except ValueError:
        raise ConfigError(
            f"clocks: start_utc: {options.start_utc!r} found, expected a time like 2026-05-20T10:17:03Z"
        ) from None
    if start.tzinfo is None:
        start = start.replace(tzinfo=UTC)
    utc_ns = int(start.timestamp()) * NS_PER_S + start.microsecond * 1000
    free = Clock(round(options.lidar_on_s * NS_PER_S), options.lidar_drift_ppm)
    lidar = Clock(utc_ns % (3600 * NS_PER_S)) if options.lidar_gps else free
    return Clocks(
        utc=Clock(utc_ns),
        host=Clock(utc_ns + round(options.host_error_s * NS_PER_S), options.host_drift_ppm),
        lidar=lidar,
        boot=Clock(round(options.boot_s * NS_PER_S), options.boot_drift_ppm),
    )
