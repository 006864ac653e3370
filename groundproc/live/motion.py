"""The motion grid of the odometry, growing at its end and forgetting its beginning."""

from collections import deque
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.motion import CUBIC_BELOW_HZ, ImuTrack, on_grid
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_ROWS: Final = 1200 * STEPS
"""Two minutes."""
KEPT_NS: Final = 60_000_000_000
"""Samples are kept for so long: what clocks and offsets are found from."""
_NOISE_SAMPLES: Final = 2000


class Samples:
    """The last minute of an inertial unit, in the sensor frame, on the lidar's clock.

    Parameters
    ----------
    name : str
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._parts: deque[tuple[Times, Array, Array]] = deque()
        self.last_ns: int | None = None

    def add(self, time_ns: Times, rate_rad_s: Array, force_m_s2: Array) -> None:
        """Take samples, shape (n,), (n, 3), (n, 3); those not later than all before them are left out."""
        highest = np.maximum.accumulate(time_ns)
        keep = np.ones(len(time_ns), np.bool_)
        keep[1:] = time_ns[1:] > highest[:-1]
        if self.last_ns is not None:
            keep &= time_ns > self.last_ns
        if not keep.any():
            return
        self._parts.append((time_ns[keep], rate_rad_s[keep], force_m_s2[keep]))
        self.last_ns = int(time_ns[keep][-1])
        while self._parts[0][0][-1] < self.last_ns - KEPT_NS:
            self._parts.popleft()

    def since(self, time_ns: int) -> tuple[Times, Array, Array]:
        """Samples from just before a time on: times, rates, forces."""
        parts = [part for part in self._parts if part[0][-1] >= time_ns - 200_000_000]
        if not parts:
            return np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3))
        return (
            np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]),
            np.concatenate([part[2] for part in parts]),
        )

    def all(self) -> tuple[Times, Array, Array]:
        """Everything kept."""
        return self.since(-(1 << 62))

    @property
    def span_ns(self) -> int:
        """Time between the first and the last sample kept [ns]."""
        return 0 if self.last_ns is None else int(self.last_ns - self._parts[0][0][0])

    def track(self) -> ImuTrack | None:
        """The newest samples with their white noise; None where there are too few to tell."""
        time, rate, force = self.all()
        if len(time) < 20:
            return None
        time, rate, force = time[-_NOISE_SAMPLES:], rate[-_NOISE_SAMPLES:], force[-_NOISE_SAMPLES:]
        felt = np.isfinite(force).all() and np.ptp(force) > 0.0
        return ImuTrack(self.name, time, rate, force, white_noise(rate), white_noise(force) if felt else float("nan"))


def white_noise(samples: Array) -> float:
    """White noise of a sample, from second differences: robust, all axes together; shape (n, 3)."""
    return robust.white_noise(samples)


class GrowingMotion:
    """A `MotionGrid` that grows: the motion of a flight that goes on.

    Parameters
    ----------
    start_ns : int
        Start of the grid, lidar time.
    rate_density, force_density : float
    source : str
    """

    def __init__(self, start_ns: int, rate_density: float, force_density: float, source: str) -> None:
        self.start_ns = start_ns
        self.rate_density, self.force_density, self.source = rate_density, force_density, source
        self._rate, self._force = np.zeros((_ROWS, 3)), np.zeros((_ROWS, 3))
        self._known = np.zeros(_ROWS, np.bool_)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def rate_rad_s(self) -> Array:
        """Mean rate of each step, shape (n, 3)."""
        return self._rate[: self._size]

    @property
    def force_m_s2(self) -> Array:
        """Mean specific force of each step, shape (n, 3)."""
        return self._force[: self._size]

    @property
    def known(self) -> Flags:
        """Whether samples said it, shape (n,)."""
        return self._known[: self._size]

    @property
    def end_ns(self) -> int:
        """Up to where it is there, lidar time."""
        return self.start_ns + self._size * STEP_NS

    @property
    def is_full(self) -> bool:
        """Whether the older half should be dropped."""
        return self._size > _ROWS - 200 * STEPS

    def extend(self, rate: Array, force: Array, known: Flags) -> None:
        """Append steps, shape (n, 3), (n, 3), (n,); no more than fit."""
        count = min(len(rate), _ROWS - self._size)
        part = slice(self._size, self._size + count)
        self._rate[part], self._force[part], self._known[part] = rate[:count], force[:count], known[:count]
        self._size += count

    def forget(self, slices: int) -> None:
        """Drop that many slices at the beginning: the grid starts later."""
        steps = slices * STEPS
        for table in (self._rate, self._force, self._known):
            table[: self._size - steps] = table[steps : self._size]
        self._size -= steps
        self.start_ns += slices * SLICE_NS


class MotionBuilder:
    """Puts samples on the grid as they come.

    Parameters
    ----------
    motion : GrowingMotion
    rates, forces : Samples
        Units to take them from; may be the same.
    spare : Samples or None
        What fills gaps of the first.
    """

    def __init__(self, motion: GrowingMotion, rates: Samples, forces: Samples, spare: Samples | None) -> None:
        self.motion, self._rates, self._forces, self._spare = motion, rates, forces, spare
        self.filled = 0
        """Steps that had to be filled."""

    def advance(self, must_ns: int) -> None:
        """Extend by all that is known by now; up to `must_ns` (lidar time) gaps are filled."""
        ends = [ready for ready in (_ready_ns(self._rates), _ready_ns(self._forces)) if ready is not None]
        known_ns = min(ends) if len(ends) == 2 else 0
        self._extend(known_ns, filling=False)
        self._extend(must_ns, filling=True)

    def _extend(self, to_ns: int, *, filling: bool) -> None:
        motion = self.motion
        steps = (to_ns - motion.end_ns) // STEP_NS
        if steps <= 0:
            return
        rate, seen = _gridded(self._rates, motion.end_ns, steps, 1)
        force, felt = _gridded(self._forces, motion.end_ns, steps, 2)
        known = seen & felt
        if not known.all():
            self._fill(rate, seen, force, felt)
            self.filled += int((~known).sum())
        motion.extend(rate, force, known if not filling else known & seen)

    def _fill(self, rate: Array, seen: Flags, force: Array, felt: Flags) -> None:
        """Steps without samples: from the other unit, less what it differs by; else as the last ones were."""
        motion = self.motion
        for values, there, history, column in (
            (rate, seen, motion.rate_rad_s[-400:], 1),
            (force, felt, motion.force_m_s2[-400:], 2),
        ):
            missing = ~there
            if not missing.any():
                continue
            level = history[-20:].mean(axis=0) if len(history) else np.zeros(3)
            if self._spare is not None and len(history):
                begin = motion.end_ns - len(history) * STEP_NS
                other, good = _gridded(self._spare, begin, len(history) + len(values), column)
                both = good[: len(history)]
                if both.sum() > 40:
                    off = (history[both] - other[: len(history)][both]).mean(axis=0)
                    now = missing & good[len(history) :]
                    values[now] = other[len(history) :][now] + off
                    missing &= ~now
            values[missing] = level


def _ready_ns(samples: Samples) -> int | None:
    """Up to where samples say the motion; a cubic through slow ones wants two beyond."""
    if samples.last_ns is None:
        return None
    time, _, _ = samples.since(samples.last_ns - 2_000_000_000)
    if len(time) < 4:
        return None
    slow = (len(time) - 1) / max((time[-1] - time[0]) * 1e-9, 1e-3) < CUBIC_BELOW_HZ
    return int(time[-3]) if slow else int(time[-1])


def _gridded(samples: Samples, start_ns: int, steps: int, column: int) -> tuple[Array, Flags]:
    time, rate, force = samples.since(start_ns - 1_000_000_000)
    values = rate if column == 1 else force
    if len(values) < 4 or not np.isfinite(values).all():
        return np.zeros((steps, 3)), np.zeros(steps, np.bool_)
    return on_grid(time, values, start_ns, steps)
