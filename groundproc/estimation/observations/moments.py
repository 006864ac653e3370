"""Moments of a path: where stamps of observations lie on its grid and its spline, and means over seconds."""

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics.splines import basis

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def spots(time_ns: Ints, path: Path) -> tuple[Ints, Array, Ints, Array]:
    """Interval, spline weights, grid step, and share of it at times within a path."""
    g = (time_ns - path.start_ns) / path.step_ns
    step = np.clip(g.astype(np.int64), 0, len(path.quat) - 2)
    knot = np.clip(step // STEPS, 0, path.intervals - 1)
    weights = np.array([basis(float(u)) for u in g / STEPS - knot]).reshape(-1, 4)
    return knot, weights, step, g - step


def poses(path: Path, step: Ints, share: Array) -> tuple[Array, Array]:
    """Attitudes, shape (n, 4), and positions, shape (n, 3)."""
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(path.quat[step]), path.quat[step + 1]))
    quat = frames.quat_multiply(path.quat[step], frames.quat_exp(share[:, None] * turn))
    return quat, path.position_m[step] + share[:, None] * (path.position_m[step + 1] - path.position_m[step])


def within(time_ns: Ints, path: Path) -> npt.NDArray[np.bool_]:
    """Which times a path covers."""
    return np.asarray((time_ns >= path.start_ns) & (time_ns <= path.start_ns + (len(path.quat) - 1) * path.step_ns))


def seconds(time_ns: Ints) -> tuple[Ints, Ints]:
    """Groups of one second: number of each sample's group, counted without gaps, and the middle sample of each group."""
    _, group = np.unique(time_ns // NS_PER_S, return_inverse=True)
    first = np.searchsorted(group, np.arange(group.max() + 1))
    last = np.searchsorted(group, np.arange(group.max() + 1), side="right") - 1
    return group, (first + last) // 2


def means(values: Array, group: Ints) -> Array:
    """Mean of the rows of each group."""
    total = np.zeros((group.max() + 1, values.shape[1]))
    np.add.at(total, group, values)
    return np.asarray(total / np.bincount(group)[:, None])


def velocities(path: Path, step: Ints, lever_m: Array) -> Array:
    """Velocity of a point of the airframe [m/s], shape (n, 3), over a few grid steps, so that vibration is no part of it."""
    low, high = _around(path, step)
    ends = [path.position_m[at] + frames.mat_from_quat(path.quat[at]) @ lever_m for at in (low, high)]
    return np.asarray((ends[1] - ends[0]) / ((high - low) * path.step_ns * 1e-9)[:, None])


def rates(path: Path, step: Ints) -> Array:
    """Rates of turn about the local axes [rad/s], shape (n, 3), over as many grid steps."""
    low, high = _around(path, step)
    turn = frames.quat_log(frames.quat_multiply(path.quat[high], frames.quat_inverse(path.quat[low])))
    return np.asarray(turn / ((high - low) * path.step_ns * 1e-9)[:, None])


def _around(path: Path, step: Ints) -> tuple[Ints, Ints]:
    return np.maximum(step - 2, 0), np.minimum(step + 3, len(path.quat) - 1)
