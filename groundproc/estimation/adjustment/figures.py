"""What pictures show of an adjustment: plain arrays by flat names, `Estimate.figures`, which are kept with the estimate."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.estimation.odometry.track import Track, boundaries_ns
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Figures = dict[str, npt.NDArray[Any]]


def odometry_figures(track: Track, motion: Motion, path: Path | None, trajectory: Trajectory) -> Figures:
    """What the lidar saw, slice by slice, and how far the final path lies from the odometry's.

    Parameters
    ----------
    track : Track
    motion : Motion
    path : Path or None
        Of the sensor after the batch; None without one.
    trajectory : Trajectory
        Of the ins frame, as it is written.

    Returns
    -------
    dict
        adjustment.begin_ns, shape (): where seconds of all arrays count from, UTC.
        adjustment.slice_s, matched, seen, residual_m, shape (n,).
        adjustment.sigma_s, shape (m,); sigma_position_m, sigma_attitude_rad, shape (m, 3).
        adjustment.moved_m, turned_rad, shape (n + 1, 3), or (0, 3) without a batch.
    """
    knots_ns = boundaries_ns(track, motion)
    begin_ns = int(knots_ns[0])
    place = trajectory.after(begin_ns - 1).before(int(knots_ns[-1]))
    moved, turned = np.zeros((0, 3)), np.zeros((0, 3))
    if path is not None:
        quat, position_m = path.quat[::STEPS], path.position_m[::STEPS]
        moved, turned = changed(track.quat[:], track.position_m[:], quat, position_m)
    return {
        "adjustment.begin_ns": np.array(begin_ns),
        "adjustment.slice_s": np.asarray((knots_ns[1:] - begin_ns) * 1e-9),
        "adjustment.matched": np.array(track.matched, np.float64),
        "adjustment.seen": np.array(track.seen, np.float64),
        "adjustment.residual_m": np.array(track.residual_m, np.float64),
        "adjustment.sigma_s": np.asarray((place.time_ns[::STEPS] - begin_ns) * 1e-9),
        "adjustment.sigma_position_m": place.sigma_position_m[::STEPS],
        "adjustment.sigma_attitude_rad": place.sigma_attitude_rad[::STEPS],
        "adjustment.moved_m": moved,
        "adjustment.turned_rad": turned,
    }


def stated_figures(
    begin_ns: int, path: Path, positions: Sequence[Positions], attitudes: Sequence[Attitudes], mat_ins_lidar: Array
) -> Figures:
    """How far what the autopilot states lies from the path.

    Parameters
    ----------
    begin_ns : int
        Where seconds count from.
    path : Path
        Of the sensor.
    positions, attitudes : sequence
    mat_ins_lidar : ndarray, shape (3, 3)
        As estimated.

    Returns
    -------
    dict
        adjustment.position_s, shape (k,); position_off_m, position_sigma_m, shape (k, 3).
        adjustment.heading_rad, heading_off_rad, shape (j,).
    """
    offs = [_position_off(each, path) for each in positions]
    headings = [_heading_off(each, path, mat_ins_lidar) for each in attitudes]
    return {
        "adjustment.position_s": (np.concatenate([t for t, _, _ in offs]) - begin_ns) * 1e-9,
        "adjustment.position_off_m": np.concatenate([off for _, off, _ in offs]),
        "adjustment.position_sigma_m": np.concatenate([sigma for _, _, sigma in offs]),
        "adjustment.heading_rad": np.concatenate([h for h, _ in headings]) if headings else np.zeros(0),
        "adjustment.heading_off_rad": np.concatenate([off for _, off in headings]) if headings else np.zeros(0),
    }


def outcome_figures(
    windows: int, restarts: int, is_worse: bool, last_round: Mapping[str, float], estimated: Mapping[str, Any]
) -> Figures:
    """How the adjustment ended, and what it estimated.

    Parameters
    ----------
    windows : int
        0: causal, there was no batch.
    restarts : int
        Of the odometry.
    is_worse : bool
        The trajectory is what the adjustment began from.
    last_round : mapping
        What the last window's last round says.
    estimated : mapping
        As in quality.json.

    Returns
    -------
    dict
        adjustment.windows, restarts, is_worse, shape ().
        adjustment.round_name (text), round_value, shape (r,): chi-square of the lidar, and residuals in sigma.
        adjustment.estimated_name (text), estimated_value, _sigma, _prior_sigma, _held, shape (p,): a row for each number.
        adjustment.curve_rad, shape (5,), or (0,) where no compass curve was estimated.
    """
    kept = {k: v for k, v in last_round.items() if k == "chi_square" or (k.endswith("_rms") and k != "prior_rms")}
    rows = [
        (name, *numbers)
        for name, entry in estimated.items()
        for numbers in zip(entry["value"], entry["sigma"], entry["prior_sigma"], entry["held"], strict=True)
    ]
    return {
        "adjustment.windows": np.array(windows),
        "adjustment.restarts": np.array(restarts),
        "adjustment.is_worse": np.array(is_worse),
        "adjustment.round_name": np.array(list(kept), np.str_),
        "adjustment.round_value": np.array(list(kept.values()), np.float64),
        "adjustment.estimated_name": np.array([row[0] for row in rows], np.str_),
        "adjustment.estimated_value": np.array([row[1] for row in rows], np.float64),
        "adjustment.estimated_sigma": np.array([row[2] for row in rows], np.float64),
        "adjustment.estimated_prior_sigma": np.array([row[3] for row in rows], np.float64),
        "adjustment.estimated_held": np.array([row[4] for row in rows], np.bool_),
        "adjustment.curve_rad": np.deg2rad(np.array(estimated.get("compass_deg", {}).get("value", []), np.float64)),
    }


def changed(quat: Array, position_m: Array, final_quat: Array, final_position_m: Array) -> tuple[Array, Array]:
    """Final poses less earlier ones that are turned and moved as a whole onto them: positions; rotations in the body."""
    count = min(len(quat), len(final_quat))
    quat, position_m = quat[:count], position_m[:count]
    final_quat, final_position_m = final_quat[:count], final_position_m[:count]
    total = (frames.mat_from_quat(final_quat) @ np.swapaxes(frames.mat_from_quat(quat), 1, 2)).sum(axis=0)
    u, _, vt = np.linalg.svd(total)
    mat = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    laid = position_m @ mat.T
    laid += (final_position_m - laid).mean(axis=0)
    turn = np.repeat(frames.quat_from_mat(mat[None]), count, axis=0)
    return final_position_m - laid, frames.quat_log(
        frames.quat_multiply(frames.quat_inverse(frames.quat_multiply(turn, quat)), final_quat)
    )


def _position_off(given: Positions, path: Path) -> tuple[Array, Array, Array]:
    """Times, stated positions less those of the path, and their sigmas."""
    inside, node = _nodes(given.time_ns, path)
    made = path.position_m[node] + frames.mat_from_quat(path.quat[node]) @ given.lever_m
    return given.time_ns[inside].astype(np.float64), given.position_m[inside] - made, given.sigma_m[inside]


def _heading_off(given: Attitudes, path: Path, mat_ins_lidar: Array) -> tuple[Array, Array]:
    """Headings of the path, and stated ones less them."""
    inside, node = _nodes(given.time_ns, path)
    made = frames.attitude_of(frames.mat_from_quat(path.quat[node]) @ mat_ins_lidar.T)[0]
    stated = frames.attitude_of(frames.mat_from_quat(given.quat[inside]))[0]
    return made % (2.0 * np.pi), (stated - made + np.pi) % (2.0 * np.pi) - np.pi


def _nodes(time_ns: npt.NDArray[np.int64], path: Path) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Which times lie on a path, and the nearest nodes of its grid to these."""
    inside = (time_ns >= path.start_ns) & (time_ns <= path.start_ns + (len(path.quat) - 1) * STEP_NS)
    return inside, np.rint((time_ns[inside] - path.start_ns) / STEP_NS).astype(np.int64)
