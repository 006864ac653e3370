"""Errors of the adjusted poses: sigmas of position and of roll, pitch and heading, and the correlation of the six."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from groundproc.estimation.adjustment.posterior import Spread
from groundproc.trajectory.covariance import SIZE

Array = npt.NDArray[np.float64]

LEAST_SIGMA: Final = 1e-12
"""A smaller error counts as none, and is correlated with no other [m, rad]."""


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of poses, shape (n, ...).

    Attributes
    ----------
    sigma_position_m : ndarray, shape (n, 3)
        East, north, up.
    sigma_attitude_rad : ndarray, shape (n, 3)
        Roll, pitch, heading.
    correlation : ndarray, shape (n, 6, 6)
        Of these six; positive semi-definite, with ones on the diagonal.
    """

    sigma_position_m: Array
    sigma_attitude_rad: Array
    correlation: Array


def pose_errors(
    spread: Spread,
    errors: Callable[[Array], Array],
    pitch_rad: Array,
    *,
    smooth: int,
    smooth_draws: int,
    extra: float = 0.0,
) -> PoseErrors:
    """Errors of poses along a path by a posterior's spread.

    Parameters
    ----------
    spread : Spread
    errors : callable
        From the unknowns to the errors of n poses, shape (n, 6): east, north, up [m], and small turns [rad] about the levelled
        aircraft's axes: forward, right, up.
    pitch_rad : ndarray, shape (n,)
        Of the poses, nose up.
    smooth : int
        Poses over which variances are averaged: single draws are rough.
    smooth_draws : int
        The same for the correlations of what is drawn: a dozen draws alone would make correlations of 0.3 out of nothing.
    extra : float
        Variance that is added to the attitude's about every axis [rad^2].
    """
    known, drawn = spread.moments(errors)
    rough = _diagonal(known) + np.maximum(_diagonal(drawn), 0.0)
    variance = uniform_filter1d(rough, smooth, axis=0, mode="nearest")
    # the angles change as the turns, but for what a pitch makes of them
    to_angles = _to_angles(pitch_rad)
    back = np.swapaxes(to_angles, 1, 2)
    known = uniform_filter1d(to_angles @ known @ back, smooth, axis=0, mode="nearest")
    drawn = to_angles @ drawn @ back
    size = np.sqrt(np.maximum(_diagonal(known) + np.maximum(_diagonal(drawn), 0.0), LEAST_SIGMA**2))
    both = size[:, :, None] * size[:, None, :]
    drawn = uniform_filter1d(drawn / both, smooth_draws, axis=0, mode="nearest")
    correlation = _normalised(known / both + semidefinite(drawn))
    added = np.repeat([0.0, extra], SIZE // 2)
    total = np.sqrt(variance + added)
    own = np.sqrt(variance)
    covariance = correlation * (own[:, :, None] * own[:, None, :]) + np.diag(added)
    return PoseErrors(total[:, :3], total[:, 3:], _normalised(covariance))


def semidefinite(matrix: Array) -> Array:
    """The nearest positive semi-definite matrices to symmetric ones, shape (n, k, k), by the Frobenius norm (Higham 1988)."""
    value, vector = np.linalg.eigh(matrix)
    return np.asarray((vector * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(vector, 1, 2))


def _to_angles(pitch_rad: Array) -> Array:
    """From position and levelled turns to position and roll, pitch, heading: matrices, shape (n, 6, 6)."""
    mat = np.tile(np.eye(SIZE), (len(pitch_rad), 1, 1))
    mat[:, 3, 3] = 1.0 / np.cos(pitch_rad)
    mat[:, 5, 3] = np.tan(pitch_rad)
    mat[:, 5, 5] = -1.0  # heading is clockwise
    return mat


def _diagonal(matrix: Array) -> Array:
    return np.diagonal(matrix, axis1=1, axis2=2)


def _normalised(covariance: Array) -> Array:
    """Correlations of covariances, shape (n, 6, 6); symmetric to the last bit."""
    sigma = np.sqrt(_diagonal(covariance))
    safe = np.where(sigma > LEAST_SIGMA, sigma, 1.0)
    matrix = covariance / (safe[:, :, None] * safe[:, None, :])
    matrix = 0.5 * (matrix + np.swapaxes(matrix, 1, 2))
    matrix[:, np.arange(SIZE), np.arange(SIZE)] = 1.0
    return np.asarray(matrix)
