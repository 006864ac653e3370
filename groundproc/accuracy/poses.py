"""Errors of poses against the true ones: position, rotation, heading over time, relative motion, stated sigmas.

The pose that makes the cloud is that of the lidar, which is the INS pose times the mount; it is what the figures are about. A method
that leaves an error in the mount and the opposite one in the attitude makes the same cloud, and gets the same figures.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from flightlog import frames
from flightlog.mount import Mount
from groundproc.accuracy.alignment import Rigid
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

GRID_NS: Final = 10_000_000
RPE_S: Final = 1.0
SETTLED_DEG: Final = 1.0
LEAST_SETTLED_S: Final = 2.0
"""A heading counts as settled when its error stays within `SETTLED_DEG` from then on to the end, for at least so long."""


@dataclass(frozen=True, slots=True)
class PoseSeries:
    """Poses of one body at common times.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
    position_m : ndarray, shape (n, 3)
    mat_local_body : ndarray, shape (n, 3, 3)
    """

    time_ns: Times
    position_m: Array
    mat_local_body: Array

    def moved(self, motion: Rigid) -> "PoseSeries":
        """The same after a rigid motion of the world."""
        return PoseSeries(self.time_ns, motion.points(self.position_m), motion.turned(self.mat_local_body))

    def times_mount(self, mount: Mount) -> "PoseSeries":
        """Poses of the lidar, of poses of the INS."""
        position = self.position_m + self.mat_local_body @ mount.lidar_position_m()
        return PoseSeries(self.time_ns, position, self.mat_local_body @ mount.mat_ins_lidar())


def common_poses(estimated: Trajectory, true: Trajectory) -> tuple[PoseSeries, PoseSeries, float]:
    """INS poses of both every 10 ms where both are covered, and the share of the true one's time that is."""
    first, last = int(true.time_ns[0]), int(true.time_ns[-1])
    grid = np.arange(-(-first // GRID_NS) * GRID_NS, last + 1, GRID_NS, dtype=np.int64)
    here, known = estimated.where_covered(grid)
    there, really = true.where_covered(grid)
    both = known & really
    series = [
        PoseSeries(grid[both], poses.position_m[both], frames.mat_from_quat(poses.quat_local_ins_wxyz[both]))
        for poses in (here, there)
    ]
    return series[0], series[1], float(both.sum() / max(int(really.sum()), 1))


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """Errors of poses after one rigid alignment.

    Attributes
    ----------
    ate_m, ate_max_m : float
        Absolute trajectory error: RMS and largest distance of positions.
    rotation_rms_deg : float
        RMS angle between attitudes.
    rotation_rms_free_deg : float
        The same after the constant rotation on the body's side is taken off.
    body_offset_deg : tuple of float
        That rotation, about the body's x, y and z: for the lidar an error of the boresight.
    rpe_m, rpe_deg : float
        RMS error of the motion over 1 s.
    """

    ate_m: float
    ate_max_m: float
    rotation_rms_deg: float
    rotation_rms_free_deg: float
    body_offset_deg: tuple[float, float, float]
    rpe_m: float
    rpe_deg: float


def pose_figures(estimated: PoseSeries, true: PoseSeries) -> PoseFigures:
    """Errors of aligned poses; those without two poses 1 s apart have no relative error (not a number)."""
    away_m = np.linalg.norm(estimated.position_m - true.position_m, axis=1)
    turn = np.swapaxes(true.mat_local_body, 1, 2) @ estimated.mat_local_body
    offset = _mean_rotation(turn)
    free = np.swapaxes(offset[None], 1, 2) @ turn
    x, y, z = np.rad2deg(_vectors(offset[None])[0]).tolist()
    rpe_m, rpe_deg = _relative(estimated, true)
    return PoseFigures(
        ate_m=_rms(away_m),
        ate_max_m=float(away_m.max()),
        rotation_rms_deg=float(np.rad2deg(_rms(np.linalg.norm(_vectors(turn), axis=1)))),
        rotation_rms_free_deg=float(np.rad2deg(_rms(np.linalg.norm(_vectors(free), axis=1)))),
        body_offset_deg=(x, y, z),
        rpe_m=rpe_m,
        rpe_deg=rpe_deg,
    )


def time_error_ms(estimated: PoseSeries, true: PoseSeries) -> float | None:
    """By how much the estimated attitude is ahead: at t it is that of t plus this [ms]; None where nothing turns.

    The part of the body rate's error that goes with the angular acceleration, by least squares. Rates do not know of a heading that is
    off; vibration, too fast for the grid, is smoothed away.
    """
    step = round(0.1e9 / GRID_NS)
    if len(true.time_ns) <= 2 * step:
        return None
    rate, true_rate = (
        uniform_filter1d(_rates(series), step, axis=0, mode="nearest")[step:-step] for series in (estimated, true)
    )
    growth = np.gradient(true_rate, GRID_NS * 1e-9, axis=0)
    power = float(np.square(growth).sum())
    return float(((rate - true_rate) * growth).sum()) / power * 1e3 if power > 1e-6 else None


def _rates(series: PoseSeries) -> Array:
    """Body rates [rad/s] between the poses before and after each inner one, shape (n - 2, 3)."""
    span_s = (series.time_ns[2:] - series.time_ns[:-2]) * 1e-9
    turn = np.swapaxes(series.mat_local_body[:-2], 1, 2) @ series.mat_local_body[2:]
    return _vectors(turn) / span_s[:, None]


def mount_errors(estimated: Mount, true: Mount) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Boresight error about the lidar's x, y and z [deg], and the lever arm's along the axes of the INS [m]."""
    turn = true.mat_ins_lidar().T @ estimated.mat_ins_lidar()
    lever = estimated.lidar_position_m() - true.lidar_position_m()
    return tuple(np.rad2deg(_vectors(turn[None])[0]).tolist()), tuple(lever.tolist())


def position_errors(estimated: PoseSeries, true: PoseSeries) -> Array:
    """Distances of positions [m], shape (n,)."""
    return np.asarray(np.linalg.norm(estimated.position_m - true.position_m, axis=1))


def rotation_errors_deg(estimated: PoseSeries, true: PoseSeries) -> Array:
    """Angles between attitudes [deg], shape (n,)."""
    turn = np.swapaxes(true.mat_local_body, 1, 2) @ estimated.mat_local_body
    return np.asarray(np.rad2deg(np.linalg.norm(_vectors(turn), axis=1)))


def heading_errors_deg(estimated: PoseSeries, true: PoseSeries) -> Array:
    """Estimated minus true heading of the INS [deg], -180 to 180, shape (n,)."""
    heading, *_ = frames.attitude_of(estimated.mat_local_body)
    truly, *_ = frames.attitude_of(true.mat_local_body)
    return wrapped_deg(np.rad2deg(heading - truly))


def wrapped_deg(angle_deg: Array) -> Array:
    """Angles brought to -180 to 180 deg."""
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)


def settled_offset_deg(error_deg: Array) -> float:
    """The constant part of a heading error: its median over the flight's second half, by when a method should have settled."""
    later = error_deg[len(error_deg) // 2 :]
    centre = float(np.rad2deg(np.angle(np.exp(1j * np.deg2rad(later)).mean())))
    return centre + float(np.median(wrapped_deg(later - centre)))


def settle_s(time_ns: Times, error_deg: Array) -> float | None:
    """Seconds from the first pose until an error stays within `SETTLED_DEG`; None where it never does.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
    error_deg : ndarray, shape (n,)
        Less whatever constant is to be left out.
    """
    outside = np.flatnonzero(np.abs(error_deg) > SETTLED_DEG)
    if not len(outside):
        return 0.0
    if outside[-1] + 1 == len(time_ns) or (time_ns[-1] - time_ns[outside[-1]]) * 1e-9 < LEAST_SETTLED_S:
        return None
    return float((time_ns[outside[-1] + 1] - time_ns[0]) * 1e-9)


@dataclass(frozen=True, slots=True)
class SigmaFigures:
    """Whether the sigmas that a trajectory states cover its errors.

    Attributes
    ----------
    position_within_2_sigma, attitude_within_2_sigma : float or None
        Share of the errors, all axes, within twice the sigma; 0.954 for a normal distribution. None where no sigma is stated.
    position_error_over_sigma, attitude_error_over_sigma : float or None
        Median of |error| / sigma; 0.674 for a normal distribution: far less says that the sigmas are too large.
    """

    position_within_2_sigma: float | None
    position_error_over_sigma: float | None
    attitude_within_2_sigma: float | None
    attitude_error_over_sigma: float | None


def sigma_figures(trajectory: Trajectory, estimated: PoseSeries, true: PoseSeries) -> SigmaFigures:
    """Compare errors of INS poses with the sigmas at the same times."""
    at = estimated.time_ns
    seconds, knots = (at - at[0]) * 1e-9, (trajectory.time_ns - at[0]) * 1e-9
    sigma_m, sigma_rad = (
        np.stack([np.interp(seconds, knots, axis) for axis in sigma.T], axis=1)
        for sigma in (trajectory.sigma_position_m, trajectory.sigma_attitude_rad)
    )
    heading, pitch, roll = frames.attitude_of(estimated.mat_local_body)
    true_heading, true_pitch, true_roll = frames.attitude_of(true.mat_local_body)
    angles = np.stack([roll - true_roll, pitch - true_pitch, heading - true_heading], axis=1)
    turned = np.deg2rad(wrapped_deg(np.rad2deg(angles)))
    position = _within(estimated.position_m - true.position_m, sigma_m)
    attitude = _within(turned, sigma_rad)
    return SigmaFigures(*position, *attitude)


def _within(error: Array, sigma: Array) -> tuple[float | None, float | None]:
    """Share within two sigma, and the median of |error| / sigma."""
    if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        return None, None
    ratio = np.abs(error) / sigma
    return float((ratio <= 2.0).mean()), float(np.median(ratio))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _vectors(mats: Array) -> Array:
    """Rotation vectors of matrices, shape (n, 3)."""
    return frames.quat_log(frames.quat_from_mat(mats))


def _mean_rotation(mats: Array) -> Array:
    """The rotation nearest to all of many (chordal mean), shape (3, 3)."""
    left, _, right = np.linalg.svd(mats.mean(axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _relative(estimated: PoseSeries, true: PoseSeries) -> tuple[float, float]:
    """RMS error of the motion over `RPE_S` [m], [deg]."""
    step = round(RPE_S * 1e9 / GRID_NS)
    first = np.arange(0, max(len(true.time_ns) - step, 0))
    first = first[true.time_ns[first + step] - true.time_ns[first] == step * GRID_NS]
    if not len(first):
        return float("nan"), float("nan")
    (move, turn), (true_move, true_turn) = (_motion(series, first, first + step) for series in (estimated, true))
    missed_m = np.linalg.norm(move - true_move, axis=1)
    missed = np.linalg.norm(_vectors(np.swapaxes(true_turn, 1, 2) @ turn), axis=1)
    return _rms(missed_m), float(np.rad2deg(_rms(missed)))


def _motion(series: PoseSeries, first: npt.NDArray[np.intp], last: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Motion between poses in the body of the first: shift, shape (n, 3), and rotation, shape (n, 3, 3)."""
    back = np.swapaxes(series.mat_local_body[first], 1, 2)
    shift = back @ (series.position_m[last] - series.position_m[first])[:, :, None]
    return shift[:, :, 0], back @ series.mat_local_body[last]
