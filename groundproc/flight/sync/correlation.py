"""The shift at which two gyros fit best: every shift tried, with the best rotation between them at each.

For each shift the 3 x 3 cross-correlation is formed; the sum of its singular values is what the best rotation would reach. The
samples of the slow gyro stay where they are, as impulses on the grid: interpolated, they would alias.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import fft

from flightlog.constants import NS_PER_S
from flightlog.errors import SyncError
from groundproc.flight.sync.tracks import GyroTrack, low_pass

Array = npt.NDArray[np.float64]

GRID_HZ: Final = 100.0
"""Rate of the correlation; the source's."""
HIGH_PASS_HZ: Final = 0.2
COARSE_HZ: Final = 10.0
"""Low-pass of the fast gyro in the correlation."""
LEAST_MOTION_RAD_S: Final = np.deg2rad(1.0)
"""RMS of the high-passed rate under which there is nothing to correlate."""
LEAST_PEAK: Final = 0.5
"""Normalised correlation under which a peak is chance."""
LEAST_ODDS: Final = 10.0
"""Log odds of the peak against the next one under which the choice between them is a guess."""
MOTION_HZ: Final = 1.0
"""Bandwidth of a multirotor's motion, for the number of independent values behind those odds."""
LEAST_OVERLAP_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Peak:
    """Where two gyros fit best.

    Attributes
    ----------
    offset_ns : int
        INS time minus lidar time.
    height, rival : float
        Normalised correlation there, and the highest more than 1 s away.
    log_odds : float
        Of the one against the other.
    mat_ins_lidar : ndarray, shape (3, 3)
        The rotation, or reflection, that fits best there.
    curve : tuple of two ndarrays
        Offsets [ns] and correlations of all shifts tried.
    """

    offset_ns: int
    height: float
    rival: float
    log_odds: float
    mat_ins_lidar: Array
    curve: tuple[Array, Array]


def correlate(
    lidar: GyroTrack, ins: GyroTrack, mat_ins_lidar: Array | None, expected_ns: int | None, search_s: float
) -> Peak:
    """Try every shift and take the best; see `groundproc.flight.sync.synchronise` for the arguments.

    Raises
    ------
    SyncError
        Too little motion or overlap, no peak to speak of, or another that is nearly as good.
    """
    peak = best_shift(lidar, ins, mat_ins_lidar, expected_ns, search_s)
    _refuse_doubt(peak, f"gyro correlation of {lidar.name} and {ins.name}")
    return peak


def best_shift(
    lidar: GyroTrack, ins: GyroTrack, mat_ins_lidar: Array | None, expected_ns: int | None, search_s: float
) -> Peak:
    """The best of all shifts, however well it fits; see `correlate`.

    Raises
    ------
    SyncError
        Too little motion or overlap.
    """
    offsets, cross, norm, common = _all_shifts(lidar, ins)
    usable = common >= min(LEAST_OVERLAP_S * ins.rate_hz, 0.9 * common.max())
    if expected_ns is not None:
        usable &= np.abs(offsets - expected_ns) <= search_s * NS_PER_S
    if not usable.any():
        where = "" if expected_ns is None else f" within {search_s:.0f} s of what the receive times say"
        raise SyncError(f"gyros of {lidar.name} and {ins.name}: no shift{where} overlaps by {LEAST_OVERLAP_S:.0f} s")
    offsets, cross, norm, common = offsets[usable], cross[usable], norm[usable], common[usable]
    score = np.linalg.svd(cross, compute_uv=False).sum(axis=1) / np.maximum(norm, 1e-3 * norm.max())
    best = int(np.argmax(score))
    away = np.abs(offsets - offsets[best]) > NS_PER_S
    rival = float(score[away].max()) if away.any() else 0.0
    independent = float(common[best]) * min(1.0, 2.0 * MOTION_HZ / ins.rate_hz)
    return Peak(
        int(offsets[best]),
        float(score[best]),
        rival,
        0.5 * independent * (_log_unexplained(rival) - _log_unexplained(float(score[best]))),
        _rotation(cross[best], mat_ins_lidar),
        (offsets.astype(np.float64), score),
    )


def _refuse_doubt(peak: Peak, what: str) -> None:
    if peak.height < LEAST_PEAK:
        raise SyncError(f"{what}: the best peak is {peak.height:.2f}, expected at least {LEAST_PEAK}")
    if peak.log_odds < LEAST_ODDS:
        raise SyncError(
            f"{what}: the peak of {peak.height:.2f} has a rival of {peak.rival:.2f} (log odds {peak.log_odds:.1f}, "
            f"expected at least {LEAST_ODDS:.0f}); the motion repeats itself"
        )


def _log_unexplained(correlation: float) -> float:
    """Logarithm of the share of the motion that a correlation leaves unexplained."""
    return float(np.log(1.0 - min(correlation, 1.0) ** 2 + 1e-9))


def _all_shifts(lidar: GyroTrack, ins: GyroTrack) -> tuple[npt.NDArray[np.int64], Array, Array, Array]:
    """For every shift: the offset [ns], the cross-correlation (3, 3), the norm it could reach, and the number of samples."""
    a, a_heard = _on_grid(lidar)
    b, b_heard = _samples_on_grid(ins)
    for track, grid, heard in ((lidar, a, a_heard), (ins, b, b_heard)):
        _check_motion(track, grid, heard)
    energy_a = _lagged((a**2).sum(axis=1, keepdims=True), b_heard[:, None])[:, 0, 0]
    energy_b = _lagged(a_heard[:, None], (b**2).sum(axis=1, keepdims=True))[:, 0, 0]
    common = np.rint(_lagged(a_heard[:, None], b_heard[:, None])[:, 0, 0])
    # lag k of the arrays: b[i + k] goes with a[i]
    lags = np.arange(-(len(a) - 1), len(b), dtype=np.int64)
    offsets = int(ins.time_ns[0] - lidar.time_ns[0]) + lags * round(NS_PER_S / GRID_HZ)
    return offsets, _lagged(a, b), np.sqrt(np.maximum(energy_a, 0.0) * np.maximum(energy_b, 0.0)), common


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
    # Gaussian filters: no delay, no ringing, and the ends held, so that huge offsets leave no steps there
    values = low_pass(values, COARSE_HZ, GRID_HZ)
    values = values - low_pass(values, HIGH_PASS_HZ, GRID_HZ)
    values[~heard] = 0.0
    return values, heard.astype(np.float64)


def _samples_on_grid(track: GyroTrack) -> tuple[Array, Array]:
    """High-passed samples of the slow gyro at the nearest points of the grid, shape (n, 3), and where they are, shape (n,)."""
    place = np.rint(_seconds(track) * GRID_HZ).astype(np.int64)
    count = np.bincount(place).astype(np.float64)
    centred = track.rate_rad_s - np.median(track.rate_rad_s, axis=0)
    values = np.stack([np.bincount(place, axis) for axis in centred.T], axis=1) / np.maximum(count, 1.0)[:, None]
    heard = (count > 0).astype(np.float64)
    slow = low_pass(values, HIGH_PASS_HZ, GRID_HZ) / np.maximum(low_pass(heard, HIGH_PASS_HZ, GRID_HZ), 1e-6)[:, None]
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
