"""Covariance of poses: the correlation of the errors of one pose.

The state is (east, north, up [m], roll, pitch, heading [rad]), in this order; its frame is the trajectory's local
frame. The roots of the diagonal are therefore the sigmas of the trajectory. A trajectory keeps its sigmas at every
knot, and the correlations, which change slowly, at coarser knots. In between, both are interpolated linearly, C(t) =
D(t) R(t) D(t). A mean of correlation matrices is a correlation matrix, so every result is positive semi-definite.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

STATES: Final = ("east_m", "north_m", "up_m", "roll_rad", "pitch_rad", "heading_rad")
"""Names of the state's components, in the order of rows and columns."""
SIZE: Final = len(STATES)


@dataclass(frozen=True, slots=True)
class Correlation:
    """Correlation matrices of poses at times of their own.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (m,)
        Strictly increasing, on the trajectory's scale.
    matrix : ndarray, shape (m, 6, 6)
        Ones on the diagonal; positive semi-definite.
    """

    time_ns: Times
    matrix: Array

    def at(self, time_ns: Times) -> Array:
        """Matrices at times, shape (n, 6, 6): between knots linear, beyond the first and the last that one."""
        if len(self.time_ns) == 1:
            return np.repeat(self.matrix, len(time_ns), axis=0)
        after = np.clip(np.searchsorted(self.time_ns, time_ns, side="right"), 1, len(self.time_ns) - 1)
        step = self.time_ns[after] - self.time_ns[after - 1]
        share = np.clip((time_ns - self.time_ns[after - 1]) / step, 0.0, 1.0)[:, None, None]
        return np.asarray((1.0 - share) * self.matrix[after - 1] + share * self.matrix[after])

    def between(self, first_ns: int, last_ns: int) -> "Correlation":
        """The same from one time to another, both of them knots."""
        inner = self.time_ns[(self.time_ns > first_ns) & (self.time_ns < last_ns)]
        time_ns = np.unique(np.concatenate([[first_ns], inner, [last_ns]]).astype(np.int64))
        return Correlation(time_ns, self.at(time_ns))


def scaled(matrix: Array, sigma_position_m: Array, sigma_attitude_rad: Array) -> Array:
    """Covariances of correlations, shape (n, 6, 6), and sigmas, shape (n, 3) each."""
    sigma = np.concatenate([sigma_position_m, sigma_attitude_rad], axis=1)
    return np.asarray(matrix * (sigma[:, :, None] * sigma[:, None, :]))


def uncorrelated(time_ns: Times) -> Correlation:
    """Nothing known but the sigmas, at times, shape (m,)."""
    return Correlation(time_ns, np.tile(np.eye(SIZE), (len(time_ns), 1, 1)))


def correlation_of(time_ns: Times, covariance: Array) -> Correlation:
    """What is left of covariances, shape (m, 6, 6), without the sigmas; a component without a finite sigma has none."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = np.isfinite(sigma) & (sigma > 0.0)
    both = known[:, :, None] & known[:, None, :]
    scale = np.where(known, sigma, 1.0)
    matrix = np.where(both, covariance / (scale[:, :, None] * scale[:, None, :]), 0.0)
    matrix[:, np.arange(SIZE), np.arange(SIZE)] = 1.0
    return Correlation(time_ns, matrix)


def chained(parts: Sequence[Correlation]) -> Correlation:
    """Correlations one after the other in time."""
    return Correlation(np.concatenate([p.time_ns for p in parts]), np.concatenate([p.matrix for p in parts]))


def mat_attitude_turn(heading_rad: Array, pitch_rad: Array) -> Array:
    """Changes of roll, pitch and heading by a small turn about east, north and up: matrices, shape (n, 3, 3).

    Parameters
    ----------
    heading_rad, pitch_rad : ndarray, shape (n,)
        The attitude that is turned; a pitch of 90 deg has no such matrix.
    """
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    tangent, secant = np.tan(pitch_rad), 1.0 / np.cos(pitch_rad)
    zero, one = np.zeros_like(sine), np.ones_like(sine)
    rows = (
        (sine * secant, cosine * secant, zero),
        (cosine, -sine, zero),
        (sine * tangent, cosine * tangent, -one),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
