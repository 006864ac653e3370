"""Offset, drift and rotation by least squares, to the slow gyro's samples as they were recorded."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.interpolate import CubicSpline, PPoly
from scipy.sparse.linalg import splu

from flightlog.constants import NS_PER_S
from flightlog.errors import SyncError
from flightlog.frames import mat_from_quat, quat_exp
from groundproc.flight.sync.correlation import Peak
from groundproc.flight.sync.result import Sync
from groundproc.flight.sync.tracks import GyroTrack, low_pass
from groundproc.machine.aside import aside
from groundproc.machine.system import let_go
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

FINE_HZ: Final = 400.0
"""Rate at which the fast gyro is smoothed for the fit."""
ROWS: Final = 1 << 14
"""Samples that are looked at together."""
PART: Final = 1 << 18
"""Values that a spline goes through, about, ten minutes; a longer one is made of several."""
BESIDE: Final = 64
"""Values on either side that belong to the next."""
BIAS_KNOT_S: Final = 30.0
"""Spacing of the linear spline that takes up both gyros' biases and their drift."""
DRIFT_PRIOR_PPM: Final = 60.0
"""Standard deviation of the drift between two crystals before the data speak; the lidar's alone is some 58 ppm."""
ROTATION_PRIOR_RAD: Final = 0.05
HUBER: Final = 1.5
"""Standard deviations beyond which a residual pulls no harder."""
BLOCK_S: Final = 2.0
"""Residuals further apart than this are taken to be independent in the stated sigma."""


def fit(lidar: GyroTrack, ins: GyroTrack, peak: Peak, cutoff_hz: float, mat_mount: Array | None) -> Sync:
    """Gauss-Newton on offset, drift and rotation, to the INS samples as they are; biases are projected out at every step.

    Model of a sample at time t: rotation @ rate(t - offset - drift (t - mid)) + bias(t), rate being the smoothed fast gyro.
    """
    smooth = _smooth_spline(lidar, cutoff_hz)
    time_s = (ins.time_ns - peak.offset_ns - lidar.time_ns[0]) * 1e-9
    inside = (time_s > 0.5) & (time_s < (lidar.time_ns[-1] - lidar.time_ns[0]) * 1e-9 - 0.5)
    time_s, rate = time_s[inside], ins.rate_rad_s[inside]
    if len(time_s) < 30:
        raise SyncError(f"gyros of {lidar.name} and {ins.name}: {len(time_s)} common samples, expected at least 30")
    mid_s = 0.5 * (time_s[0] + time_s[-1])
    unbias = _bias_projector(time_s)
    rotation, shift, turned_by = peak.mat_ins_lidar, np.zeros(2), np.zeros(3)  # shift: offset [s], drift
    # the prior on the rotation keeps an axis that hardly moved where the correlation, or the mount, put it
    prior = np.array([0.0, (DRIFT_PRIOR_PPM * 1e-6) ** -2, *[ROTATION_PRIOR_RAD**-2] * 3])
    for _ in range(20):
        at = time_s - shift[0] - shift[1] * (time_s - mid_s)
        turned, moved = smooth(at) @ rotation.T, smooth(at, 1) @ rotation.T
        residual = unbias(rate - turned)
        axes = np.eye(3)
        columns = [-moved, -moved * (time_s - mid_s)[:, None], *(np.cross(axis, turned) for axis in axes)]
        jacobian = np.stack([unbias(column) for column in columns], axis=2)
        weight, curvature = _weights(residual, moved)
        normal = np.einsum("nki,nk,nkj->ij", jacobian, weight, jacobian) + np.diag(prior)
        score = np.einsum("nki,nk,nk->i", jacobian, weight, residual)
        step = np.linalg.solve(normal, score - prior * np.array([0.0, shift[1], *turned_by]))
        shift = shift + step[:2]
        turned_by = turned_by + step[2:]
        rotation = mat_from_quat(quat_exp(step[2:])) @ rotation
        if abs(step[0]) < 1e-7 and np.abs(step[2:]).max() < 1e-6:
            break
    scores = np.einsum("nki,nk,nk->ni", jacobian, weight, residual)
    information = np.einsum("nki,nk,nkj->ij", jacobian, curvature, jacobian) + np.diag(prior)
    covariance = _covariance(time_s, scores, information)
    angle = None
    if mat_mount is not None:
        angle = float(np.degrees(np.arccos(np.clip((np.trace(rotation @ mat_mount.T) - 1.0) / 2.0, -1.0, 1.0))))
    reflected = np.linalg.det(rotation) < 0
    return Sync(
        method="gyro",
        offset_ns=peak.offset_ns + round(shift[0] * NS_PER_S),
        sigma_offset_ns=float(np.sqrt(covariance[0, 0] * NS_PER_S**2 + ins.stamp_step_ns**2 / 12.0)),
        reference_ns=int(lidar.time_ns[0]) + round((mid_s - shift[0]) * NS_PER_S),
        drift_ppm=float(shift[1] * 1e6),
        sigma_drift_ppm=float(np.sqrt(covariance[1, 1]) * 1e6),
        peak=peak.height,
        rival=peak.rival,
        residual_rad_s=float(np.sqrt((residual**2).mean())),
        samples=len(time_s),
        mat_ins_lidar=rotation,
        mount_angle_deg=angle,
        note="the gyros fit only with one axis of the opposite sign" if reflected else "",
        curve=peak.curve,
    )


def _bias_projector(time_s: Array) -> Callable[[Array], Array]:
    """A function that takes from each column, shape (n, k), its best linear spline with knots `BIAS_KNOT_S` apart."""
    span = time_s[-1] - time_s[0]
    knots = max(2, round(span / BIAS_KNOT_S) + 1)
    place = (time_s - time_s[0]) / span * (knots - 1)
    left = np.minimum(place.astype(int), knots - 2)
    rows = np.arange(len(time_s))
    basis = sparse.csr_matrix(
        (
            np.concatenate([1.0 - (place - left), place - left]),
            (np.concatenate([rows, rows]), np.concatenate([left, left + 1])),
        ),
        shape=(len(time_s), knots),
    )
    # the small ridge is for knots in a silence, which no sample sees
    factors = splu(sparse.csc_matrix(basis.T @ basis + 1e-6 * sparse.identity(knots)))
    across = sparse.csr_matrix(basis.T)

    def unbias(values: Array) -> Array:
        return np.asarray(values - basis @ factors.solve(across @ values))

    return unbias


def _weights(residual: Array, moved: Array) -> tuple[Array, Array]:
    """Huber weights over each sample's own variance, and the curvature of the loss, both of shape (n, 3).

    A sample whose stamp is off is wrong by its slope times that: the variance is that of the axis plus the square of the stamp's
    jitter times the square of the slope, both learnt from the residuals. An outlier adds to the loss but not to its curvature.
    """
    axis = np.maximum(robust.sigma_of_columns(residual, 0.0), 1e-6) ** 2
    variance = np.broadcast_to(axis, residual.shape)
    for _ in range(3):
        square = np.minimum(residual**2, 25.0 * variance)
        level = _levels(square, np.square(moved), variance)
        level = np.maximum(level, [*(0.05 * axis), 0.0])
        variance = level[:3] + level[3] * moved**2
    normed = np.abs(residual) / np.sqrt(variance)
    inlier = normed <= HUBER
    return robust.huber(normed, HUBER) / variance, inlier / variance


def _levels(square: Array, slope: Array, variance: Array) -> Array:
    """Each axis's own level and one jitter for all that explain squares of residuals best, shape (4,); all given have shape (n, 3).

    Least squares by rows of some minutes at a time, each reduced to the triangle that it leaves (QR).
    """
    left = np.empty((0, 5))
    for begin in range(0, len(square), ROWS):
        some = slice(begin, begin + ROWS)
        rows = np.zeros((len(square[some]), 3, 5))
        rows[:, np.arange(3), np.arange(3)] = 1.0
        rows[:, :, 3], rows[:, :, 4] = slope[some], square[some]
        rows /= variance[some][:, :, None]
        triangle: Any = np.linalg.qr(np.concatenate([left, rows.reshape(-1, 5)]), mode="r")
        left = triangle
    level, *_ = np.linalg.lstsq(left[:, :4], left[:, 4], rcond=np.finfo(np.float64).eps * square.size)
    return np.asarray(level)


def _covariance(time_s: Array, scores: Array, normal: Array) -> Array:
    """Covariance of the five unknowns that holds for residuals correlated in time (sandwich over blocks of time).

    `scores` has shape (n, 5): what each sample, all its axes, adds to the right-hand side. The plain inverse, which takes every
    residual for independent, is the least that is stated.
    """
    block = ((time_s - time_s[0]) / BLOCK_S).astype(int)
    sums = np.stack([np.bincount(block, column) for column in scores.T], axis=1)
    used = np.bincount(block) > 0
    blocks = int(used.sum())
    plain = np.linalg.inv(normal)
    if blocks < 10:
        return np.asarray(plain * 4.0)  # too few blocks to learn the correlation from
    spread = sums[used].T @ sums[used] * (blocks / (blocks - 5.0))
    robust = plain @ spread @ plain
    factor = np.sqrt(np.maximum(np.diag(robust) / np.diag(plain), 1.0))
    return np.asarray(plain * np.outer(factor, factor))


def _smooth_spline(track: GyroTrack, cutoff_hz: float) -> "_Smooth":
    seconds = (track.time_ns - track.time_ns[0]) * 1e-9
    grid = np.arange(0.0, seconds[-1] + 1.0 / FINE_HZ, 1.0 / FINE_HZ)
    values = np.stack([np.interp(grid, seconds, axis) for axis in track.rate_rad_s.T], axis=1)
    return _Smooth(grid, low_pass(values, cutoff_hz, FINE_HZ))


class _Smooth:
    """A cubic spline of a rate, made and asked some minutes at a time: of an hour its coefficients are 140 MB.

    Parameters
    ----------
    grid_s : ndarray, shape (n,)
    values : ndarray, shape (n, 3)

    Attributes
    ----------
    ends_s : tuple of float
        The first and the last time.
    """

    def __init__(self, grid_s: Array, values: Array) -> None:
        self.ends_s = float(grid_s[0]), float(grid_s[-1])
        self._begins: list[float] = []
        self._parts: list[PPoly] = []
        for begin in range(0, len(grid_s), PART):
            # a spline forgets its ends by a factor of four with each value
            some = slice(max(begin - BESIDE, 0), begin + PART + BESIDE)
            spline = CubicSpline(grid_s[some], values[some], axis=0)
            coefficients, knots = aside(spline.c, spline.x)
            self._parts.append(PPoly.construct_fast(coefficients, knots))
            self._begins.append(grid_s[begin])

    def __call__(self, at_s: Array, derivative: int = 0) -> Array:
        """Values at times, or derivatives, shape (m, 3)."""
        out = np.empty((len(at_s), 3))
        part = np.maximum(np.searchsorted(self._begins, at_s, side="right") - 1, 0)
        for number, spline in enumerate(self._parts):
            mine = part == number
            out[mine] = spline(at_s[mine], derivative)
            let_go()
        return out
