"""What is put right: splines of the trajectory in time, and constants of the mount and of the place."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.adjustment.spline import basis

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Correction:
    """Points move by p -> s + shift + d(t) + R l + exp(w(t) + R b) (p - s), with scanner s and attitude R as given.

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
    value, b, l_ = np.empty(6), np.empty(3), np.empty(3)
    for n in range(len(time_ns)):
        _value(time_ns[n], start_ns, knot_ns, coefficients, value)
        w, x, y, z = quat[n, 0], quat[n, 1], quat[n, 2], quat[n, 3]
        for vector, out in ((boresight, b), (lever, l_)):
            # q v q*: v + 2 w (u x v) + 2 u x (u x v)
            cx = y * vector[2] - z * vector[1]
            cy = z * vector[0] - x * vector[2]
            cz = x * vector[1] - y * vector[0]
            out[0] = vector[0] + 2.0 * (w * cx + y * cz - z * cy)
            out[1] = vector[1] + 2.0 * (w * cy + z * cx - x * cz)
            out[2] = vector[2] + 2.0 * (w * cz + x * cy - y * cx)
        vx, vy, vz = value[0] + b[0], value[1] + b[1], value[2] + b[2]
        square = vx * vx + vy * vy + vz * vz
        if square < 1e-6:
            sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
        else:
            angle = np.sqrt(square)
            sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
        ax, ay, az = np.float64(arm[n, 0]), np.float64(arm[n, 1]), np.float64(arm[n, 2])
        cx, cy, cz = vy * az - vz * ay, vz * ax - vx * az, vx * ay - vy * ax
        dx = sine * cx + cosine * (vy * cz - vz * cy)
        dy = sine * cy + cosine * (vz * cx - vx * cz)
        dz = sine * cz + cosine * (vx * cy - vy * cx)
        turned[n, 0], turned[n, 1], turned[n, 2] = ax + dx, ay + dy, az + dz
        move[n, 0] = dx + value[3] + l_[0] + shift[0]
        move[n, 1] = dy + value[4] + l_[1] + shift[1]
        move[n, 2] = dz + value[5] + l_[2] + shift[2]
