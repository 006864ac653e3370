"""What is put right: splines of the trajectory in time, and constants of the mount and of the place."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.estimation.odometry.spline import basis

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

    def changed(self, change: Array, named: dict[str, Array]) -> "Correction":
        """With a change of the coefficients, shape (intervals + 3, 6), and of the constants by name added."""
        constants = {name: getattr(self, name) + value for name, value in named.items()}
        return replace(self, coefficients=self.coefficients + change, **constants)

    def located(self, time_ns: Ints) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """Interval and spline weights of times, shape (n,) and (n, 4)."""
        knot, weights = np.empty(len(time_ns), np.int32), np.empty((len(time_ns), 4), np.float32)
        _locate(time_ns, self.start_ns, self.knots_s * 1e9, self.intervals, knot, weights)
        return knot, weights

    def at(self, time_ns: Ints) -> Array:
        """The splines at times, shape (n, 6): w and d."""
        out = np.empty((len(time_ns), 6))
        _evaluate(time_ns, self.start_ns, self.knots_s * 1e9, self.coefficients, out)
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
        _move(
            time_ns, arm_m, quat, self.start_ns, self.knots_s * 1e9, self.coefficients, self.boresight_rad, self.lever_m,
            self.shift_m, move, arm,
        )  # fmt: skip
        return move, arm

    def poses(self, time_ns: Ints, position_m: Array, quat: Array, lever_arm_m: Array) -> tuple[Array, Array]:
        """Corrected poses of the body, shape (n, 3) and (n, 4): it turns about the scanner, and its mount is not in it."""
        value = self.at(time_ns)
        arm = np.einsum("nij,j->ni", frames.mat_from_quat(quat), lever_arm_m)
        turn = frames.quat_exp(value[:, :3])
        turned = np.einsum("nij,nj->ni", frames.mat_from_quat(turn), arm)
        place = position_m + arm + value[:, 3:] + self.shift_m - turned
        return place, frames.quat_multiply(turn, quat)


@njit(cache=True, nogil=True)
def _locate(time_ns: Any, start_ns: int, knot_ns: float, intervals: int, knot: Any, weights: Any) -> None:
    for n in range(len(time_ns)):
        u = (time_ns[n] - start_ns) / knot_ns
        k = min(max(int(u), 0), intervals - 1)
        knot[n] = k
        weights[n, 0], weights[n, 1], weights[n, 2], weights[n, 3] = basis(min(max(u - k, 0.0), 1.0))


@njit(cache=True, nogil=True, inline="always")
def _value(time_ns: int, start_ns: int, knot_ns: float, coefficients: Any, out: Any) -> None:
    u = (time_ns - start_ns) / knot_ns
    k = min(max(int(u), 0), len(coefficients) - 4)
    w0, w1, w2, w3 = basis(min(max(u - k, 0.0), 1.0))
    for c in range(6):
        out[c] = (
            w0 * coefficients[k, c]
            + w1 * coefficients[k + 1, c]
            + w2 * coefficients[k + 2, c]
            + w3 * coefficients[k + 3, c]
        )


@njit(cache=True, nogil=True)
def _evaluate(time_ns: Any, start_ns: int, knot_ns: float, coefficients: Any, out: Any) -> None:
    for n in range(len(time_ns)):
        _value(time_ns[n], start_ns, knot_ns, coefficients, out[n])


@njit(cache=True, nogil=True)
def _move(
    time_ns: Any, arm: Any, quat: Any, start_ns: int, knot_ns: float, coefficients: Any, boresight: Any, lever: Any, shift: Any,
    move: Any, turned: Any,
) -> None:  # fmt: skip
    value, turn, offset, x = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(time_ns)):
        _value(time_ns[n], start_ns, knot_ns, coefficients, value)
        _into_map(quat[n], boresight, turn)
        _into_map(quat[n], lever, offset)
        for c in range(3):
            x[c] = arm[n, c]
        # what is added, rather than what results: a point that moves by nothing moves by exactly nothing
        _turned(turn, x, turned[n])
        for c in range(3):
            turned[n, c] += offset[c]
            x[c] += turned[n, c]
            move[n, c] = turned[n, c] + value[3 + c] + shift[c]
        _turned(value, x, turned[n])
        for c in range(3):
            move[n, c] += turned[n, c]
            turned[n, c] += x[c]


@njit(cache=True, nogil=True, inline="always")
def _into_map(q: Any, v: Any, out: Any) -> None:
    """A vector of the body along map axes: v + 2 w (u x v) + 2 u x (u x v) with q = (w, u)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    a, b, c = y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]
    out[0] = v[0] + 2.0 * (w * a + y * c - z * b)
    out[1] = v[1] + 2.0 * (w * b + z * a - x * c)
    out[2] = v[2] + 2.0 * (w * c + x * b - y * a)


@njit(cache=True, nogil=True, inline="always")
def _turned(v: Any, x: Any, out: Any) -> None:
    """By how much a rotation vector moves a point: exp(v) x - x (Rodrigues)."""
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if square < 1e-6:
        sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = np.sqrt(square)
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    a, b, c = v[1] * x[2] - v[2] * x[1], v[2] * x[0] - v[0] * x[2], v[0] * x[1] - v[1] * x[0]
    out[0] = sine * a + cosine * (v[1] * c - v[2] * b)
    out[1] = sine * b + cosine * (v[2] * a - v[0] * c)
    out[2] = sine * c + cosine * (v[0] * b - v[1] * a)
