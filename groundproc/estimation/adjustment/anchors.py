"""What ties the path to the earth: positions and attitudes of the autopilot, or better ones, each with errors that last."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.adjustment.factors import Factor, RowBuilder, Unknowns, cross, eye, whitened
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions
from groundproc.numerics.splines import basis

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

COMPASS_TERMS: Final = 5
"""Constant, sine and cosine of the heading, sine and cosine of twice the heading."""


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


def fixes_name(number: int) -> str:
    """The unknown that the mean error of the n-th source of positions is."""
    return f"world.fixes{number}"


def position_factors(given: Positions, path: Path, unknowns: Unknowns, number: int = 0) -> list[Factor]:
    """Positions in means of a second: their course, and their mean; none where the path covers fewer than two.

    The course alone, with an unknown mean error, bends and turns the path. Where the whole lies is left to the plain mean of the fixes,
    by 1 / sigma^2: the best weights of errors that last would lay two thirds of a minute's weight on its first and last fix, and are best
    by a tenth at most, if the errors last as long as stated and not otherwise.
    """
    inside = within(given.time_ns, path)
    if inside.sum() < 2:
        return []
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
    if fixes_name(number) in unknowns.names:
        builder.by(row, fixes_name(number), -eye(count))
    time_s = (time_ns[middle] - time_ns[0]) * 1e-9
    course = whitened("position", residual, builder.matrix(), time_s, sigma, given.tau_s, given.white_m)
    if fixes_name(number) not in unknowns.names:
        return [course]
    return [course, _mean_factor(residual, position[middle], (knot, weights), time_s, sigma, given, unknowns)]


SAMPLES: Final = 8
"""Moments of the flight by which the mean of the fixes is stated."""


def _mean_factor(
    residual: Array, position_m: Array, spline: tuple[Ints, Array], time_s: Array, sigma: Array, given: Positions,
    unknowns: Unknowns,
) -> Factor:  # fmt: skip
    """The mean of the residuals, shape (n, 3), as three rows.

    By every coefficient of the spline they would be dense. So they are stated by a few moments of the flight, with weights by which
    all that moves or turns the path as one moves their mean as it moves the mean of all. Bends are seen a little wrong; as the
    residual is that of the path as it is, that costs a step and not the result.
    """
    weights = sigma**-2.0 / (sigma**-2.0).sum(axis=0)
    builder, row = RowBuilder(3, unknowns), np.zeros(1, np.int64)
    centre = weights.T @ position_m
    some = np.unique(np.linspace(0, len(time_s) - 1, SAMPLES).round().astype(np.int64))
    shares = np.stack([_shares(position_m[some] - centre[axis]) for axis in range(3)], axis=1)
    for i, share in zip(some, shares, strict=True):
        builder.at_times(row, spline[0][i : i + 1], spline[1][i : i + 1], 3, np.diag(share)[None])
    builder.by(row, "world.turn", np.stack([-cross(centre)[axis, axis] for axis in range(3)])[None])
    builder.by(row, "world.shift", eye(1))
    deviation = mean_sigma(time_s, sigma, weights, given.tau_s, given.white_m)
    return Factor("position mean", (weights * residual).sum(axis=0), builder.matrix(), deviation)


def _shares(places: Array) -> Array:
    """Weights, sum 1, by which places, shape (n, 3), have their mean in the origin as nearly as may be; the most even ones."""
    even = np.full(len(places), 1.0 / len(places))
    asked = np.concatenate([np.ones((1, len(places))), places.T])
    return np.asarray(even + np.linalg.pinv(asked, 1e-6) @ (np.array([1.0, 0.0, 0.0, 0.0]) - asked @ even))


def mean_sigma(time_s: Array, sigma: Array, weights: Array, tau_s: Array, white: float) -> Array:
    """Sigma of a weighted mean of Gauss-Markov errors of `sigma`, shape (n, m), and white ones; in one pass over time."""
    part = weights * sigma
    variance = np.square(part).sum(axis=0) + white**2 * np.square(weights).sum(axis=0)
    keep = np.exp(-np.diff(time_s)[:, None] / tau_s)
    before = np.zeros_like(part[0])
    for i in range(1, len(part)):
        before = keep[i - 1] * (before + part[i - 1])
        variance += 2.0 * part[i] * before
    return np.asarray(np.sqrt(variance))


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
