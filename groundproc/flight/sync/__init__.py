"""Time offset between the lidar's clock and the autopilot's, from their gyros.

Source: FOI-R--4045--SE (2014): both gyros resampled to 100 Hz, high-passed, shifted to maximum correlation. Here all three axes are
used at once, with the rotation between them solved at every shift (the sum of the singular values of the 3 x 3 cross-correlation is
what the best rotation would reach), and the peak only starts a least-squares fit of offset, drift, rotation and biases to the samples
as they were recorded: no sample of a slow gyro is interpolated, so nothing is lost to its rate.
"""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import SyncError
from groundproc.flight.sync.correlation import LEAST_PEAK, Peak, best_shift, correlate
from groundproc.flight.sync.fit import fit
from groundproc.flight.sync.result import Sync
from groundproc.flight.sync.tracks import GyroTrack

__all__ = ["LEAST_PEAK", "GyroTrack", "Peak", "Sync", "best_shift", "synchronise"]

Array = npt.NDArray[np.float64]

CUTOFFS_HZ: Final = (3.0, 5.0, 8.0, 12.0, 20.0)
"""Low-pass of the fast gyro, tried in turn; the one that leaves the smallest residual is kept."""


def synchronise(
    lidar: GyroTrack,
    ins: GyroTrack,
    *,
    mat_ins_lidar: Array | None = None,
    expected_ns: int | None = None,
    search_s: float = 15.0,
    expected_drift_ppm: float = 0.0,
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
    expected_drift_ppm : float
        Drift as receive times have it, which the search starts from: over an hour, 70 ppm smear the correlation over a quarter of a
        second.

    Raises
    ------
    SyncError
        Too little overlap or motion, no clear peak, or several of nearly the same height.
    """
    drift, middle_ns = expected_drift_ppm * 1e-6, int(ins.time_ns[len(ins.time_ns) // 2]) if len(ins.time_ns) else 0
    ins = _slowed(ins, drift, middle_ns)
    peak = correlate(lidar, ins, mat_ins_lidar, expected_ns, search_s)
    fits = [fit(lidar, ins, peak, cutoff, mat_ins_lidar) for cutoff in CUTOFFS_HZ if cutoff < 0.4 * lidar.rate_hz]
    if not fits:
        raise SyncError(f"gyro of {lidar.name}: {lidar.rate_hz:.1f} Hz, expected at least {CUTOFFS_HZ[0] / 0.4:.0f} Hz")
    return _quickened(min(fits, key=lambda fit: fit.residual_rad_s), drift, middle_ns)


def _slowed(track: GyroTrack, drift: float, about_ns: int) -> GyroTrack:
    """A track on a clock that does not drift: t = slowed + drift (slowed - about)."""
    if drift == 0.0:
        return track
    since_ns = track.time_ns - about_ns
    return replace(track, time_ns=track.time_ns - np.rint(since_ns * (drift / (1.0 + drift))).astype(np.int64))


def _quickened(found: Sync, drift: float, about_ns: int) -> Sync:
    """What was found with a slowed track, for the track as it was."""
    slowed_ns = found.reference_ns + found.offset_ns
    return replace(
        found,
        offset_ns=found.offset_ns + round(drift * (slowed_ns - about_ns)),
        drift_ppm=((1.0 + found.drift_ppm * 1e-6) * (1.0 + drift) - 1.0) * 1e6,
    )
