"""The delay of the gyro that carries the motion, as an unknown of the adjustment: it re-times what the path does between two knots.

A gyro that is late by d against the returns makes a turn error of d times the rate. What of that is slower than the knots, the spline
corrects, and the gyro's own rows tell it (`gyro`). What is faster (gusts, vibration) no spline follows: a path by such a gyro is turned by

    d w(t), less what a spline through the knots follows of it,

and the lidar's rows tell it. Once a step has found more of the delay, the gyro is put on the grid anew, so that nothing is left of second
order: 5 ms are half a radian of a vibration of 16 Hz.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from flightlog import frames
from groundproc.estimation.observations.rows import Unknowns
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, near, on_grid
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

STEP_S: Final = STEP_NS * 1e-9


@dataclass(slots=True)
class Retiming:
    """How late the gyro that carries a path is against the returns.

    Attributes
    ----------
    name : str
        The global.
    sigma_s : float
        What was known of it before.
    track : ImuTrack
        Its samples.
    delay_s : ndarray, shape (1,)
        So far.
    """

    name: str
    sigma_s: float
    track: ImuTrack
    delay_s: Array = field(default_factory=lambda: np.zeros(1))

    def unknowns(self, unknowns: Unknowns) -> None:
        """The delay: it has the same name in the gyro's own rows."""
        unknowns.add(self.name, np.array([self.sigma_s]), self.delay_s, unit="s")

    def take(self, part: Mapping[str, Array]) -> None:
        """Put a solution in."""
        self.delay_s = self.delay_s + part[self.name]

    def turning(self, path: Path) -> Array:
        """What the path turns by, in the body, for a second less of delay: rates on its grid less what a spline follows, shape (n, 3).

        Taken evenly from before and behind a pose: a rate from one side goes along with the noise in the attitude there.
        """
        first, last = (
            np.maximum(np.arange(len(path.quat)) - 1, 0),
            np.minimum(np.arange(len(path.quat)) + 1, len(path.quat) - 1),
        )
        turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(path.quat[first]), path.quat[last]))
        return unfollowed(turn / ((last - first) * STEP_S)[:, None], path)

    def retimed(self, path: Path, part: Mapping[str, Array]) -> Path:
        """A path whose motion between two knots is that of the gyro, as late as a solution has it that is not yet taken; knots stay."""
        steps = path.intervals * STEPS
        some = near(self.track.time_ns, path.start_ns, steps)
        (before, known), (after, still) = (
            on_grid(
                self.track.time_ns[some] - round(float(late_s[0]) * 1e9),
                self.track.rate_rad_s[some],
                path.start_ns,
                steps,
            )
            for late_s in (self.delay_s, self.delay_s + part[self.name])
        )
        # over so short a time turns add up as vectors: the mean rate of what is shifted lies along the rate
        differs = np.where((known & still)[:, None], after - before, 0.0) * STEP_S
        turn = unfollowed(np.concatenate([np.zeros((1, 3)), np.cumsum(differs, axis=0)]), path)
        return replace(path, quat=frames.quat_multiply(path.quat, frames.quat_exp(turn)))


@dataclass(slots=True)
class RetimingColumn:
    """The lidar's rows by the delay.

    Attributes
    ----------
    value : ndarray of float32, shape (n,)
        Rows by a second of delay [m/s].
    """

    UNKNOWNS: ClassVar[int] = 1

    value: Singles

    def column(self, number: int) -> Array:
        """The rows by it, shape (n,)."""
        del number
        return self.value.astype(np.float64)

    def along(self, value: Array) -> Array:
        """The rows times the unknown, shape (1,): shape (n,)."""
        return np.asarray(self.value * value[0], np.float64)

    def gradient(self, projected: Array) -> Array:
        """Column times weighed values less their planes, shape (n,): shape (1,)."""
        return np.array([self.value @ projected])


def retiming_column(jacobian: Singles, turning: Array, time_ns: Ints, path: Path) -> RetimingColumn:
    """The column of rows, by their turns in the body, and the times of their clusters; `turning` is that of the path."""
    since = (time_ns - path.start_ns) / path.step_ns
    step = np.clip(since.astype(np.int64), 0, len(path.quat) - 2)
    share = (since - step)[:, None].astype(np.float32)
    fast = turning.astype(np.float32)
    at = (1.0 - share) * fast[step] + share * fast[step + 1]
    return RetimingColumn(np.einsum("ni,ni->n", jacobian[:, :3], at))


def unfollowed(course: Array, path: Path) -> Array:
    """What a cubic spline through the knots does not follow of a course on a path's grid, shape (n, 3): nothing is left at the knots."""
    grid = np.arange(len(path.quat))
    return np.asarray(course - CubicSpline(grid[::STEPS], course[::STEPS], axis=0)(grid))
