"""What ties the path to the earth: positions and attitudes of the autopilot, or better ones, each with errors that last."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.adjustment.factors import Factor, RowBuilder, Unknowns, averaged, cross, eye, whitened
from groundproc.adjustment.scans import STEP_NS, STEPS
from groundproc.adjustment.spline import Path, basis

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

COMPASS_TERMS: Final = 5
"""Constant, sine and cosine of the heading, sine and cosine of twice the heading."""


@dataclass(slots=True)
class Positions:
    """Positions in the local frame.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC.
    position_m, sigma_m : ndarray, shape (n, 3)
    lever_m : ndarray, shape (3,)
        From the sensor to the point that they are of, sensor frame.
    tau_s : ndarray, shape (3,)
        How long their errors last.
    white_m : float
        The part of them that is new in each second.
    """

    time_ns: Ints
    position_m: Array
    sigma_m: Array
    lever_m: Array
    tau_s: Array
    white_m: float


@dataclass(slots=True)
class Attitudes:
    """Attitudes of the ins frame.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC.
    quat : ndarray, shape (n, 4)
        Local from ins.
    sigma_rad : ndarray, shape (3,)
        About east, north, up.
    tau_s : float
    """

    time_ns: Ints
    quat: Array
    sigma_rad: Array
    tau_s: float


@dataclass(slots=True)
class Tie:
    """Poses of the sensor at the first knots of a path, as the window before left them.

    Attributes
    ----------
    quat : ndarray, shape (n, 4)
    position_m : ndarray, shape (n, 3)
    """

    quat: Array
    position_m: Array


TIE_SIGMA_RAD: Final = np.deg2rad(0.03)
TIE_SIGMA_M: Final = 0.01
"""How far two windows may differ at a knot of their overlap."""


def tie_factor(given: Tie, path: Path, unknowns: Unknowns) -> Factor:
    """The path against the poses of a tie."""
    count = len(given.quat)
    quat, position = path.quat[: count * STEPS : STEPS], path.position_m[: count * STEPS : STEPS]
    residual = np.concatenate(
        [frames.quat_log(frames.quat_multiply(frames.quat_inverse(given.quat), quat)), position - given.position_m],
        axis=1,
    )
    builder, knot = RowBuilder(6 * count, unknowns), np.arange(count)
    builder.at_knots(6 * knot, knot, 0, eye(count))
    builder.at_knots(6 * knot + 3, knot, 3, eye(count))
    sigma = np.tile(np.repeat([TIE_SIGMA_RAD, TIE_SIGMA_M], 3), count)
    return Factor("tie", residual.ravel(), builder.matrix(), sigma)


def spots(time_ns: Ints, path: Path) -> tuple[Ints, Array, Ints, Array]:
    """Interval, spline weights, grid step, and share of it at times within a path."""
    g = (time_ns - path.start_ns) / STEP_NS
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
    return np.asarray((time_ns >= path.start_ns) & (time_ns <= path.start_ns + (len(path.quat) - 1) * STEP_NS))


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


def position_factor(given: Positions, path: Path, unknowns: Unknowns) -> Factor | None:
    """Positions in means of a second, their mean and their differences; None where the path covers fewer than two."""
    inside = within(given.time_ns, path)
    if inside.sum() < 2:
        return None
    time_ns = given.time_ns[inside]
    _, _, step, share = spots(time_ns, path)
    quat, position = poses(path, step, share)
    off = position + frames.mat_from_quat(quat) @ given.lever_m - given.position_m[inside]
    group, middle = seconds(time_ns)
    residual, sigma = means(off, group), means(given.sigma_m[inside], group)
    knot, weights, _, _ = spots(time_ns[middle], path)
    count = len(middle)
    builder, row = RowBuilder(3 * count, unknowns), 3 * np.arange(count)
    builder.at_times(row, knot, weights, 3, eye(count))
    builder.by(row, "world.turn", -cross(position[middle]))
    builder.by(row, "world.shift", eye(count))
    return averaged(
        "position",
        residual,
        builder.matrix(),
        time_ns[middle].astype(np.float64) * 1e-9,
        sigma,
        given.tau_s,
        given.white_m,
    )


def attitude_factor(
    given: Attitudes, path: Path, unknowns: Unknowns, mat_sensor_ins: Array, compass: Array, turn_name: str | None
) -> Factor | None:
    """Attitudes in means of a second, with the compass's error as a curve over heading.

    Parameters
    ----------
    mat_sensor_ins : ndarray, shape (3, 3)
        Boresight as estimated so far included.
    compass : ndarray, shape (5,)
        The curve so far [rad].
    turn_name : str, optional
        The global that corrects the boresight.
    """
    inside = within(given.time_ns, path)
    if inside.sum() < 2:
        return None
    time_ns = given.time_ns[inside]
    _, _, step, share = spots(time_ns, path)
    quat, _ = poses(path, step, share)
    mat = frames.mat_from_quat(quat)
    made = mat @ mat_sensor_ins
    off = frames.quat_log(frames.quat_from_mat(made @ np.swapaxes(frames.mat_from_quat(given.quat[inside]), 1, 2)))
    heading = frames.attitude_of(made)[0]
    terms = np.stack(
        [np.ones_like(heading), np.sin(heading), np.cos(heading), np.sin(2 * heading), np.cos(2 * heading)], axis=1
    )
    off[:, 2] -= terms @ compass
    group, middle = seconds(time_ns)
    count = len(middle)
    knot, weights, _, _ = spots(time_ns[middle], path)
    builder, row = RowBuilder(3 * count, unknowns), 3 * np.arange(count)
    builder.at_times(row, knot, weights, 0, mat[middle])
    builder.by(row, "world.turn", eye(count))
    curve = np.zeros((count, 3, COMPASS_TERMS))
    curve[:, 2] = -means(terms, group)
    builder.by(row, "compass", curve)
    if turn_name is not None:
        builder.by(row, turn_name, mat[middle])
    sigma = np.tile(given.sigma_rad, (count, 1))
    return whitened(
        "attitude",
        means(off, group),
        builder.matrix(),
        time_ns[middle].astype(np.float64) * 1e-9,
        sigma,
        np.full(3, given.tau_s),
        float(0.1 * given.sigma_rad[0]),
    )
