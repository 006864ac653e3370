"""Time offset between the lidar's clock and the autopilot's, from their gyros.

Source: FOI-R--4045--SE (2014): both gyros resampled to 100 Hz, high-passed, shifted to maximum correlation. Here all three axes are
used at once, with the rotation between them solved at every shift (the sum of the singular values of the 3 x 3 cross-correlation is
what the best rotation would reach), and the peak only starts a least-squares fit of offset, drift, rotation and biases to the samples
as they were recorded: no sample of a slow gyro is interpolated, so nothing is lost to its rate.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage, sparse
from scipy.interpolate import CubicSpline
from scipy.sparse.linalg import factorized

from flightlog.constants import NS_PER_S
from flightlog.errors import SyncError
from flightlog.frames import mat_from_quat, quat_exp

Array = npt.NDArray[np.float64]

GRID_HZ: Final = 100.0
"""Rate of the correlation; the source's."""
FINE_HZ: Final = 400.0
"""Rate at which the fast gyro is smoothed for the fit."""
HIGH_PASS_HZ: Final = 0.2
COARSE_HZ: Final = 10.0
"""Low-pass of the fast gyro in the correlation."""
CUTOFFS_HZ: Final = (3.0, 5.0, 8.0, 12.0, 20.0)
"""Low-pass of the fast gyro, tried in turn; the one that leaves the smallest residual is kept."""
LEAST_MOTION_RAD_S: Final = np.deg2rad(1.0)
"""RMS of the high-passed rate under which there is nothing to correlate."""
LEAST_PEAK: Final = 0.5
"""Normalised correlation under which a peak is chance."""
LEAST_ODDS: Final = 10.0
"""Log odds of the peak against the next one under which the choice between them is a guess."""
MOTION_HZ: Final = 1.0
"""Bandwidth of a multirotor's motion, for the number of independent values behind those odds."""
LEAST_OVERLAP_S: Final = 10.0
BIAS_KNOT_S: Final = 30.0
"""Spacing of the linear spline that takes up both gyros' biases and their drift."""
DRIFT_PRIOR_PPM: Final = 60.0
"""Standard deviation of the drift between two crystals before the data speak; the lidar's alone is some 58 ppm."""
ROTATION_PRIOR_RAD: Final = 0.05
BLOCK_S: Final = 2.0
"""Residuals further apart than this are taken to be independent in the stated sigma."""


@dataclass(frozen=True, slots=True)
class GyroTrack:
    """Samples of a gyro.

    Attributes
    ----------
    name : str
    time_ns : ndarray of int64, shape (n,)
        On the device's own clock, increasing.
    rate_rad_s : ndarray, shape (n, 3)
        In the device's own axes. Constant offsets, however large, do no harm.
    stamp_step_ns : int
        Resolution of the stamps. Whether they are cut or rounded to it is not known for sure, and goes into the sigma.
    """

    name: str
    time_ns: npt.NDArray[np.int64]
    rate_rad_s: Array
    stamp_step_ns: int = 1

    @property
    def rate_hz(self) -> float:
        """Median sample rate [Hz]."""
        return float(NS_PER_S / np.median(np.diff(self.time_ns))) if len(self.time_ns) > 1 else 0.0


@dataclass(frozen=True, slots=True)
class Sync:
    """How to turn lidar time into autopilot time: t_ins = t_lidar + offset + drift (t_lidar - reference).

    Attributes
    ----------
    method : str
        "gyro", or "host" where only receive times were to be had.
    offset_ns, sigma_offset_ns : int, float
        At the reference.
    reference_ns : int
        Lidar time of the middle of what was used.
    drift_ppm, sigma_drift_ppm : float
    peak : float
        Normalised correlation at the peak, 0 to 1.
    rival : float
        Highest correlation more than 1 s from the peak.
    residual_rad_s : float
        RMS of the fit, all axes.
    samples : int
        INS samples used.
    mat_ins_lidar : ndarray, shape (3, 3), or None
        Rotation (or reflection, where a gyro axis has the opposite sign) between the gyros as solved.
    mount_angle_deg : float or None
        Angle between that rotation and the mount's.
    note : str
        What a reader must know: a reflection, a fallback and why.
    """

    method: str
    offset_ns: int
    sigma_offset_ns: float
    reference_ns: int
    drift_ppm: float = 0.0
    sigma_drift_ppm: float = 0.0
    peak: float = 0.0
    rival: float = 0.0
    residual_rad_s: float = 0.0
    samples: int = 0
    mat_ins_lidar: Array | None = None
    mount_angle_deg: float | None = None
    note: str = ""
    curve: tuple[Array, Array] | None = field(default=None, repr=False, compare=False)

    def ins_time_ns(self, lidar_time_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Autopilot time [ns] of lidar times, shape (n,)."""
        since = lidar_time_ns - self.reference_ns
        return np.asarray(lidar_time_ns + self.offset_ns + np.rint(since * (self.drift_ppm * 1e-6)).astype(np.int64))


@dataclass(frozen=True, slots=True)
class _Peak:
    offset_ns: int
    height: float
    rival: float
    log_odds: float
    mat_ins_lidar: Array
    curve: tuple[Array, Array]


def synchronise(
    lidar: GyroTrack,
    ins: GyroTrack,
    *,
    mat_ins_lidar: Array | None = None,
    expected_ns: int | None = None,
    search_s: float = 15.0,
) -> Sync:
    """Find the offset from lidar time to INS time.

    Parameters
    ----------
    lidar : GyroTrack
        The faster gyro, 50 Hz or more.
    ins : GyroTrack
        The slower one, 2 Hz or more.
    mat_ins_lidar : ndarray, shape (3, 3), optional
        Rotation of the mount; a start where the motion cannot tell, and what the solved one is compared with.
    expected_ns : int, optional
        Offset as receive times have it; only shifts within `search_s` of it are tried. Default: every shift with an overlap.

    Raises
    ------
    SyncError
        Too little overlap or motion, no clear peak, or several of nearly the same height.
    """
    peak = _correlate(lidar, ins, mat_ins_lidar, expected_ns, search_s)
    if peak.height < LEAST_PEAK:
        raise SyncError(
            f"gyro correlation of {lidar.name} and {ins.name}: the best peak is {peak.height:.2f}, expected at least {LEAST_PEAK}"
        )
    if peak.log_odds < LEAST_ODDS:
        raise SyncError(
            f"gyro correlation of {lidar.name} and {ins.name}: the peak of {peak.height:.2f} has a rival of {peak.rival:.2f} "
            f"(log odds {peak.log_odds:.1f}, expected at least {LEAST_ODDS:.0f}); the motion repeats itself"
        )
    fits = [_fit(lidar, ins, peak, cutoff, mat_ins_lidar) for cutoff in CUTOFFS_HZ if cutoff < 0.4 * lidar.rate_hz]
    if not fits:
        raise SyncError(f"gyro of {lidar.name}: {lidar.rate_hz:.1f} Hz, expected at least {CUTOFFS_HZ[0] / 0.4:.0f} Hz")
    return min(fits, key=lambda fit: fit.residual_rad_s)


# Correlation ----------------------------------------------------------------------------------------------------------


def _correlate(
    lidar: GyroTrack, ins: GyroTrack, mat_ins_lidar: Array | None, expected_ns: int | None, search_s: float
) -> _Peak:
    """Try every shift: the lidar's rates on the grid against the INS samples where they are, so that a slow gyro does not alias."""
    a, a_heard = _on_grid(lidar)
    b, b_heard = _samples_on_grid(ins)
    for track, grid, heard in ((lidar, a, a_heard), (ins, b, b_heard)):
        _check_motion(track, grid, heard)
    # lag k of the arrays: b[i + k] goes with a[i]
    cross = _lagged(a, b)
    energy_a = _lagged((a**2).sum(axis=1, keepdims=True), b_heard[:, None])[:, 0, 0]
    energy_b = _lagged(a_heard[:, None], (b**2).sum(axis=1, keepdims=True))[:, 0, 0]
    common = np.rint(_lagged(a_heard[:, None], b_heard[:, None])[:, 0, 0])
    lags = np.arange(-(len(a) - 1), len(b))
    offsets = int(ins.time_ns[0] - lidar.time_ns[0]) + lags * round(NS_PER_S / GRID_HZ)
    usable = common >= min(LEAST_OVERLAP_S * ins.rate_hz, 0.9 * b_heard.sum())
    if expected_ns is not None:
        usable &= np.abs(offsets - expected_ns) <= search_s * NS_PER_S
    if not usable.any():
        where = "" if expected_ns is None else f" within {search_s:.0f} s of what the receive times say"
        raise SyncError(f"gyros of {lidar.name} and {ins.name}: no shift{where} overlaps by {LEAST_OVERLAP_S:.0f} s")
    cross, offsets, common = cross[usable], offsets[usable], common[usable]
    norm = np.sqrt(np.maximum(energy_a[usable], 0.0) * np.maximum(energy_b[usable], 0.0))
    score = np.linalg.svd(cross, compute_uv=False).sum(axis=1) / np.maximum(norm, 1e-3 * norm.max())
    best = int(np.argmax(score))
    away = np.abs(offsets - offsets[best]) > NS_PER_S
    rival = float(score[away].max()) if away.any() else 0.0
    independent = common[best] * min(1.0, 2.0 * MOTION_HZ / ins.rate_hz)
    odds = 0.5 * independent * np.log((1 - min(rival, 1.0) ** 2 + 1e-9) / (1 - min(score[best], 1.0) ** 2 + 1e-9))
    return _Peak(
        int(offsets[best]),
        float(score[best]),
        rival,
        float(odds),
        _rotation(cross[best], mat_ins_lidar),
        (offsets.astype(np.float64), score),
    )


def _seconds(track: GyroTrack) -> Array:
    seconds = np.asarray((track.time_ns - track.time_ns[:1]) * 1e-9, np.float64)
    if len(seconds) < 8 or seconds[-1] < LEAST_OVERLAP_S:
        raise SyncError(
            f"gyro of {track.name}: {len(seconds)} samples in {seconds[-1] if len(seconds) else 0:.1f} s, "
            f"expected at least {LEAST_OVERLAP_S:.0f} s"
        )
    return seconds


def _on_grid(track: GyroTrack) -> tuple[Array, Array]:
    """Band-passed rates of the fast gyro on the grid, shape (n, 3), and where it was heard, shape (n,); silences are zero."""
    seconds = _seconds(track)
    grid = np.arange(0.0, seconds[-1], 1.0 / GRID_HZ)
    values = np.stack([np.interp(grid, seconds, axis) for axis in track.rate_rad_s.T], axis=1)
    before = np.clip(np.searchsorted(seconds, grid, side="right") - 1, 0, len(seconds) - 2)
    heard = seconds[before + 1] - seconds[before] <= max(1.0, 6.0 / max(track.rate_hz, 0.1))
    values[~heard] = np.median(track.rate_rad_s, axis=0)
    # Gaussian filters: no delay, no ringing, and a median first, so that huge offsets leave no steps at the ends
    values = _low_pass(values - np.median(values, axis=0), COARSE_HZ, GRID_HZ)
    values = values - _low_pass(values, HIGH_PASS_HZ, GRID_HZ)
    values[~heard] = 0.0
    return values, heard.astype(np.float64)


def _samples_on_grid(track: GyroTrack) -> tuple[Array, Array]:
    """High-passed samples of the slow gyro at the nearest points of the grid, shape (n, 3), and where they are, shape (n,)."""
    place = np.rint(_seconds(track) * GRID_HZ).astype(np.int64)
    count = np.bincount(place).astype(np.float64)
    centred = track.rate_rad_s - np.median(track.rate_rad_s, axis=0)
    values = np.stack([np.bincount(place, axis) for axis in centred.T], axis=1) / np.maximum(count, 1.0)[:, None]
    heard = (count > 0).astype(np.float64)
    slow = _low_pass(values, HIGH_PASS_HZ, GRID_HZ) / np.maximum(_low_pass(heard, HIGH_PASS_HZ, GRID_HZ), 1e-6)[:, None]
    return (values - slow) * heard[:, None], heard


def _check_motion(track: GyroTrack, grid: Array, heard: Array) -> None:
    """Refuse a gyro that did not move in any stretch of `LEAST_OVERLAP_S`."""
    block = np.arange(len(grid)) // int(LEAST_OVERLAP_S * GRID_HZ)
    power = np.bincount(block, (grid**2).sum(axis=1))
    present = np.bincount(block, heard)
    full = present >= 0.5 * present.max()
    rms = float(np.sqrt((power[full] / present[full]).max()))
    if rms < LEAST_MOTION_RAD_S:
        raise SyncError(
            f"gyro of {track.name}: {np.rad2deg(rms):.2f} deg/s rms above {HIGH_PASS_HZ} Hz, expected at least "
            f"{np.rad2deg(LEAST_MOTION_RAD_S):.1f}; there is no motion to correlate"
        )


def _lagged(a: Array, b: Array) -> Array:
    """Sums over i of b[i + k] a[i]^T for all lags k from 1 - len(a) to len(b) - 1, shape (lags, columns of b, columns of a)."""
    size = fft.next_fast_len(len(a) + len(b) - 1, real=True)
    order = np.concatenate([np.arange(size - len(a) + 1, size), np.arange(len(b))])
    spectrum = np.conj(fft.rfft(a, size, axis=0))[:, None, :] * fft.rfft(b, size, axis=0)[:, :, None]
    return np.asarray(fft.irfft(spectrum, size, axis=0)[order])


def _rotation(cross: Array, mat_ins_lidar: Array | None) -> Array:
    """The orthogonal matrix that fits a cross-correlation best; the mount's where the motion cannot tell.

    A reflection is kept if the data insist: then a gyro axis has the opposite sign.
    """
    left, singular, right = np.linalg.svd(cross)
    if singular[2] > 0.1 * singular[0]:
        return np.asarray(left @ right)
    if mat_ins_lidar is not None:
        return mat_ins_lidar
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _smooth_spline(track: GyroTrack, cutoff_hz: float) -> CubicSpline:
    seconds = (track.time_ns - track.time_ns[0]) * 1e-9
    grid = np.arange(0.0, seconds[-1] + 1.0 / FINE_HZ, 1.0 / FINE_HZ)
    values = np.stack([np.interp(grid, seconds, axis) for axis in track.rate_rad_s.T], axis=1)
    return CubicSpline(grid, _low_pass(values, cutoff_hz, FINE_HZ), axis=0)


def _low_pass(values: Array, cutoff_hz: float, rate_hz: float) -> Array:
    """Gaussian low-pass with half power at the cut-off, along the first axis."""
    sigma = rate_hz * np.sqrt(np.log(2.0) / 2.0) / (np.pi * cutoff_hz) / np.sqrt(2.0)
    return np.asarray(ndimage.gaussian_filter1d(values, sigma, axis=0, mode="nearest"))


# Least squares --------------------------------------------------------------------------------------------------------


def _fit(lidar: GyroTrack, ins: GyroTrack, peak: _Peak, cutoff_hz: float, mat_mount: Array | None) -> Sync:
    """Gauss-Newton on offset, drift and rotation, to the INS samples as they are; biases are projected out at every step.

    Model of a sample at time t: rotation @ rate(t - offset - drift (t - mid)) + bias(t), rate being the smoothed fast gyro.
    """
    smooth = _smooth_spline(lidar, cutoff_hz)
    slope = smooth.derivative()
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
        turned, moved = smooth(at) @ rotation.T, slope(at) @ rotation.T
        residual = unbias(rate - turned)
        axes = np.eye(3)
        columns = [-moved, -moved * (time_s - mid_s)[:, None], *(np.cross(axis, turned) for axis in axes)]
        jacobian = np.stack([unbias(column) for column in columns], axis=-1)
        weight = _weights(residual)
        normal = np.einsum("nki,nk,nkj->ij", jacobian, weight, jacobian) + np.diag(prior)
        score = np.einsum("nki,nk,nk->i", jacobian, weight, residual)
        step = np.linalg.solve(normal, score - prior * np.array([0.0, shift[1], *turned_by]))
        shift = shift + step[:2]
        turned_by = turned_by + step[2:]
        rotation = mat_from_quat(quat_exp(step[2:])) @ rotation
        if abs(step[0]) < 1e-7 and np.abs(step[2:]).max() < 1e-6:
            break
    covariance = _covariance(time_s, np.einsum("nki,nk,nk->ni", jacobian, weight, residual), normal)
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
    """A function that takes from each axis, shape (n, 3), its best linear spline with knots `BIAS_KNOT_S` apart."""
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
    solve = factorized(sparse.csc_matrix(basis.T @ basis + 1e-6 * sparse.identity(knots)))

    def unbias(values: Array) -> Array:
        fitted = np.stack([solve(basis.T @ axis) for axis in values.T], axis=1)
        return np.asarray(values - basis @ fitted)

    return unbias


def _weights(residual: Array) -> Array:
    """Huber weights over each axis' own variance, shape (n, 3)."""
    scale = np.maximum(1.4826 * np.median(np.abs(residual), axis=0), 1e-6)
    normed = np.abs(residual) / scale
    return np.asarray(np.where(normed > 1.5, 1.5 / np.maximum(normed, 1.5), 1.0) / scale**2)


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
