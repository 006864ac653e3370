"""The path of the sensor on the grid, and the spline that corrects it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.interpolate import CubicSpline

from flightlog import frames
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.numerics.rotations import quat_turned
from groundproc.numerics.splines import value_at

Array = npt.NDArray[np.float64]


class PathArrays(NamedTuple):
    """A `Path` as kernels take it; its fields stand there."""

    start_ns: int
    step_ns: int
    quat: Array
    position_m: Array


@dataclass(slots=True)
class Path:
    """Poses of the sensor on the grid.

    Attributes
    ----------
    start_ns : int
        UTC of the first pose.
    quat : ndarray, shape (n, 4)
        Local from sensor.
    position_m : ndarray, shape (n, 3)
    step_ns : int
        Between two poses; STEPS of them are an interval.
    """

    start_ns: int
    quat: Array
    position_m: Array
    step_ns: int = STEP_NS

    @property
    def intervals(self) -> int:
        """Slices it covers."""
        return (len(self.quat) - 1) // STEPS

    @property
    def arrays(self) -> PathArrays:
        """What the kernels take."""
        return PathArrays(self.start_ns, self.step_ns, self.quat, self.position_m)

    def corrected(self, coefficients: Array) -> "Path":
        """The path turned (in the body) and moved by a spline: coefficients of shape (intervals + 3, 6), rotation vector first."""
        quat, position = np.empty_like(self.quat), np.empty_like(self.position_m)
        _correct(self.quat, self.position_m, np.ascontiguousarray(coefficients), quat, position)
        return Path(self.start_ns, quat, position, self.step_ns)

    def turned(self, mat: Array, shift_m: Array) -> "Path":
        """The path as a rigid body: p -> mat p + shift."""
        turn = frames.quat_from_mat(mat[None])
        return Path(
            self.start_ns,
            frames.quat_multiply(np.repeat(turn, len(self.quat), 0), self.quat),
            self.position_m @ mat.T + shift_m,
            self.step_ns,
        )


@njit(cache=True, nogil=True)
def _correct(quat: Array, position: Array, coefficients: Array, out_quat: Array, out_position: Array) -> None:
    last = len(coefficients) - 4
    value = np.empty(6)
    for i in range(len(quat)):
        k = min(i // STEPS, last)
        value_at(coefficients, k, (i - k * STEPS) / STEPS, value)
        quat_turned(quat[i], value[0], value[1], value[2], out_quat[i])
        for c in range(3):
            out_position[i, c] = position[i, c] + value[3 + c]


def integrated(rate_rad_s: Array, start: Array) -> Array:
    """Attitudes that body rates, shape (n, 3), lead to, one grid step each, from a first one; shape (n + 1, 4)."""
    quat = np.empty((len(rate_rad_s) + 1, 4))
    quat[0] = start
    _integrate(rate_rad_s * (STEP_NS * 1e-9), quat)
    return quat


@njit(cache=True, nogil=True)
def _integrate(turn: Array, quat: Array) -> None:
    for i in range(len(turn)):
        quat_turned(quat[i], turn[i, 0], turn[i, 1], turn[i, 2], quat[i + 1])


def smooth_path(start_ns: int, rate_rad_s: Array, quat: Array, position_m: Array) -> Path:
    """A path through poses at slice boundaries with the motion between them as the gyros have it.

    Parameters
    ----------
    start_ns : int
    rate_rad_s : ndarray, shape (n STEPS, 3)
        Body rate of each grid step, less its bias.
    quat, position_m : ndarray, shape (n + 1, 4) and (n + 1, 3)
    """
    free = integrated(rate_rad_s, quat[0])
    at = np.arange(len(quat)) * STEPS
    off = frames.quat_log(frames.quat_multiply(frames.quat_inverse(free[at]), quat))
    grid = np.arange(len(free))
    turn = CubicSpline(at, off, axis=0)(grid)
    return Path(start_ns, frames.quat_multiply(free, frames.quat_exp(turn)), CubicSpline(at, position_m, axis=0)(grid))
