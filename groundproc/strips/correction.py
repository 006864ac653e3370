"""What is put right: splines of the trajectory in time, and constants of the mount and of the place."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.numerics.rotations import moved_by_turn, rotated
from groundproc.numerics.splines import basis, value_at

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Correction:
    """Points move by p -> s + shift + d(t) + exp(w(t)) (R l + exp(R b) (p - s)), with scanner s and attitude R as given.

    Attributes
    ----------
    start_ns : int
        UTC of the first knot.
    knots_s : float
    coefficients : ndarray, shape (intervals + 3, 6)
        Of uniform cubic B-splines: rotation vector w about map axes [rad], then shift d along them [m].
    boresight_rad, lever_m : ndarray, shape (3,)
        b and l, in the body: right, forward, up.
    shift_m : ndarray, shape (3,)
        Of the whole, along map axes.
    """

    start_ns: int
    knots_s: float
    coefficients: Array
    boresight_rad: Array
    lever_m: Array
    shift_m: Array

    @classmethod
    def none(cls, start_ns: int, end_ns: int, knots_s: float) -> "Correction":
        """No correction, over a stretch of time."""
        intervals = max(int(np.ceil((end_ns - start_ns) * 1e-9 / knots_s)), 1)
        zero = np.zeros(3)
        return cls(start_ns, knots_s, np.zeros((intervals + 3, 6)), zero, zero.copy(), zero.copy())

    @property
    def intervals(self) -> int:
        """Intervals between knots."""
        return len(self.coefficients) - 3

    @property
    def _arrays(self) -> "_Arrays":
        return _Arrays(
            self.start_ns, self.knots_s * 1e9, self.coefficients, self.boresight_rad, self.lever_m, self.shift_m
        )

    def changed(self, change: Array, named: dict[str, Array]) -> "Correction":
        """With a change of the coefficients, shape (intervals + 3, 6), and of the constants by name added."""
        constants = {name: getattr(self, name) + value for name, value in named.items()}
        return replace(self, coefficients=self.coefficients + change, **constants)

    def located(self, time_ns: Ints) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """Interval and spline weights of times, shape (n,) and (n, 4)."""
        knot, weights = np.empty(len(time_ns), np.int32), np.empty((len(time_ns), 4), np.float32)
        _locate(time_ns, self._arrays, knot, weights)
        return knot, weights

    def at(self, time_ns: Ints) -> Array:
        """The splines at times, shape (n, 6): w and d."""
        out = np.empty((len(time_ns), 6))
        _evaluate(time_ns, self._arrays, out)
        return out

    def moved(self, time_ns: Ints, arm_m: Array, quat: Array) -> tuple[Array, Array]:
        """By how much points move, and their new arms, shape (n, 3) each.

        Parameters
        ----------
        time_ns : ndarray of int64, shape (n,)
        arm_m : ndarray, shape (n, 3)
            From the scanner as given to the point, map axes.
        quat : ndarray, shape (n, 4)
            Map from body, as given.
        """
        move, arm = np.empty((len(time_ns), 3)), np.empty((len(time_ns), 3))
        _move(time_ns, arm_m, quat, self._arrays, move, arm)
        return move, arm

    def poses(self, time_ns: Ints, position_m: Array, quat: Array, lever_arm_m: Array) -> tuple[Array, Array]:
        """Corrected poses of the body, shape (n, 3) and (n, 4): it turns about the scanner, and its mount is not in it."""
        value = self.at(time_ns)
        arm = np.einsum("nij,j->ni", frames.mat_from_quat(quat), lever_arm_m)
        turn = frames.quat_exp(value[:, :3])
        turned = np.einsum("nij,nj->ni", frames.mat_from_quat(turn), arm)
        place = position_m + arm + value[:, 3:] + self.shift_m - turned
        return place, frames.quat_multiply(turn, quat)


class _Arrays(NamedTuple):
    """A `Correction` as kernels take it; the fields stand there, but for the spacing of the knots [ns]."""

    start_ns: int
    knot_ns: float
    coefficients: Array
    boresight_rad: Array
    lever_m: Array
    shift_m: Array


@njit(cache=True, nogil=True)
def _locate(time_ns: Ints, correction: _Arrays, knot: npt.NDArray[np.int32], weights: npt.NDArray[np.float32]) -> None:
    intervals = len(correction.coefficients) - 3
    for n in range(len(time_ns)):
        k, u = _interval(time_ns[n], correction.start_ns, correction.knot_ns, intervals)
        knot[n] = k
        weights[n, 0], weights[n, 1], weights[n, 2], weights[n, 3] = basis(u)


@njit(cache=True, nogil=True, inline="always")
def _interval(time_ns: int, start_ns: int, knot_ns: float, intervals: int) -> Any:
    """Interval between knots that a time is in, and where in it; beyond the ends, their ends."""
    u = (time_ns - start_ns) / knot_ns
    k = min(max(int(u), 0), intervals - 1)
    return k, min(max(u - k, 0.0), 1.0)


@njit(cache=True, nogil=True)
def _evaluate(time_ns: Ints, correction: _Arrays, out: Array) -> None:
    coefficients = correction.coefficients
    for n in range(len(time_ns)):
        k, u = _interval(time_ns[n], correction.start_ns, correction.knot_ns, len(coefficients) - 3)
        value_at(coefficients, k, u, out[n])


@njit(cache=True, nogil=True)
def _move(time_ns: Ints, arm: Array, quat: Array, correction: _Arrays, move: Array, turned: Array) -> None:
    coefficients, boresight, lever, shift = (
        correction.coefficients, correction.boresight_rad, correction.lever_m, correction.shift_m,
    )  # fmt: skip
    value, turn, offset, x = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(time_ns)):
        k, u = _interval(time_ns[n], correction.start_ns, correction.knot_ns, len(coefficients) - 3)
        value_at(coefficients, k, u, value)
        rotated(quat[n], boresight, turn)
        rotated(quat[n], lever, offset)
        for c in range(3):
            x[c] = arm[n, c]
        # what is added, rather than what results: a point that moves by nothing moves by exactly nothing
        moved_by_turn(turn, x, turned[n])
        for c in range(3):
            turned[n, c] += offset[c]
            x[c] += turned[n, c]
            move[n, c] = turned[n, c] + value[3 + c] + shift[c]
        moved_by_turn(value, x, turned[n])
        for c in range(3):
            move[n, c] += turned[n, c]
            turned[n, c] += x[c]
