"""What goes wrong in flight: the INS reboots, packets get lost, the serial line picks up noise."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_MS, NS_PER_S
from simulator.clocks import Clock
from simulator.config import FaultOptions

_FIRST_STAMP_NS: Final = 2_500_000_000
"""What the boot clock shows when the first message after a reboot is built."""


@dataclass(frozen=True, slots=True)
class Reboot:
    """A reboot of the INS: silence from `start_s` to `end_s`, then another boot clock; never if start is 0."""

    start_s: float
    end_s: float

    @classmethod
    def of(cls, options: FaultOptions) -> "Reboot":
        """The reboot of a configuration."""
        return cls(options.reboot_at_s, options.reboot_at_s + options.reboot_silence_s)

    def silent(self, time_s: float) -> bool:
        """Whether nothing is sent at a true time."""
        return self.start_s > 0 and self.start_s <= time_s < self.end_s

    def after(self, time_s: float) -> bool:
        """Whether a true time lies after the reboot."""
        return self.start_s > 0 and time_s >= self.end_s

    def clock(self, time_s: float, first: Clock) -> Clock:
        """The boot clock in force at a true time."""
        if not self.after(time_s):
            return first
        elapsed_ns = round(self.end_s * NS_PER_S * (1.0 + first.drift_ppm * 1e-6))
        start_ns = _FIRST_STAMP_NS - elapsed_ns
        # the milliseconds go on as before, so that messages built on a whole one stay on it
        return Clock(start_ns + (first.start_ns - start_ns) % NS_PER_MS, first.drift_ppm)


@dataclass(frozen=True, slots=True)
class Outage:
    """A stretch of true time without GPS fix; never if start is 0."""

    start_s: float = 0.0
    end_s: float = 0.0

    @classmethod
    def of(cls, options: FaultOptions) -> "Outage":
        """The GPS outage of a configuration."""
        return cls(options.gnss_gap_at_s, options.gnss_gap_at_s + options.gnss_gap_s)

    def holds(self, time_s: float) -> bool:
        """Whether there is no fix at a true time."""
        return self.start_s > 0 and self.start_s <= time_s < self.end_s


@dataclass(frozen=True, slots=True)
class Glitch:
    """A stretch of true time in which positions are off, and perhaps velocities with them; never if start is 0."""

    start_s: float
    end_s: float
    rise_s: float
    off_m: tuple[float, float, float]
    moves: bool = False

    @classmethod
    def of(cls, options: FaultOptions) -> "Glitch":
        """The glitch of a configuration."""
        start_s = options.gnss_glitch_at_s
        return cls(
            start_s, start_s + options.gnss_glitch_s, options.gnss_glitch_rise_s, options.gnss_glitch_m,
            options.gnss_glitch_velocity,
        )  # fmt: skip

    def at(self, time_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """How far positions are off at true times, shape (n,): east, north, up, shape (n, 3) [m]."""
        if self.start_s <= 0:
            return np.zeros((len(time_s), 3))
        rise_s = max(self.rise_s, 1e-9)
        share = np.minimum((time_s - self.start_s) / rise_s, (self.end_s - time_s) / rise_s)
        return np.asarray(np.clip(share, 0.0, 1.0)[:, None] * np.array(self.off_m))

    def speed_at(self, time_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """How far velocities are off, shape (n, 3) [m/s]; those of a filter never by a jump of its positions."""
        if not self.moves or self.rise_s <= 0:
            return np.zeros((len(time_s), 3))
        step_s = 0.05
        return np.asarray((self.at(time_s + step_s) - self.at(time_s - step_s)) / (2.0 * step_s))


def arriving(sent_s: npt.NDArray[np.float64], options: FaultOptions, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Which lidar packets are not lost, shape (n,)."""
    kept = np.ones(len(sent_s), np.bool_)
    if options.lidar_gap_at_s > 0:
        kept &= (sent_s < options.lidar_gap_at_s) | (sent_s >= options.lidar_gap_at_s + options.lidar_gap_s)
    if options.lidar_loss > 0:
        kept &= rng.random(len(sent_s)) >= options.lidar_loss
    return kept


def garbage_before(rng: np.random.Generator, chance: float) -> bytes:
    """Line noise ahead of a frame: nothing, or with a chance 1 to 40 random bytes."""
    if chance <= 0 or rng.random() >= chance:
        return b""
    return bytes(rng.integers(0, 256, int(rng.integers(1, 41)), dtype=np.uint8))
