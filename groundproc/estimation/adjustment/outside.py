"""Positions and poses of another program as rows of the adjustment: centimetres, for as long as the other program is right.

Their errors last, as the autopilot's do. Each row gets the variance that independent errors would need for the mean of many to be as well
known (the spectrum of an autoregressive process at frequency zero), and no differences are taken: one wrong fix is one wrong row. The
shape from one second to the next, which the lidar knows better, is left to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from flightlog import frames
from groundproc.estimation.adjustment.anchors import means, poses, seconds, spots, within
from groundproc.estimation.adjustment.factors import Factor, RowBuilder, Unknowns, cross, eye
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.flight.positions.fixes import OutsideFixes
from groundproc.flight.positions.solution import Quality
from groundproc.flight.timebase import UtcTie
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

DELAY: Final = "outside.delay"
"""Name of the global: what the stamps of the positions are ahead of ours of the same moment [s]."""
TAU_S: Final = {Quality.FIX: 20.0}
LONGER_S: Final = 60.0
"""How long errors last: what multipath does to fixed ambiguities, and everything else (floats, code, blends with an IMU)."""
LEAST_SIGMA_M: Final = 0.005
LEAST_SIGMA_RAD: Final = np.deg2rad(0.02)
"""No sigma is believed below these: antennas have phase centres, and frames of other instruments their mounting."""
LEAST_DELAY_SIGMA_S: Final = 0.001
BY_BOOT_SIGMA_S: Final = 0.01
"""UTC that comes by way of the autopilot has the age of its gyros in it, which synchronisation cannot tell from an offset of clocks."""
OUTLIER: Final = 3.0
"""Times the usual distance from the path beyond which a position loses weight."""


@dataclass(frozen=True, slots=True)
class Outside:
    """Positions of a point of the airframe, and attitudes where there are any.

    Attributes
    ----------
    source : str
        File and format.
    time_ns : ndarray of int64, shape (n,)
        UTC.
    position_m : ndarray, shape (n, 3)
        Of the point, local.
    covariance_m2 : ndarray, shape (n, 3, 3)
    lever_m : ndarray, shape (3,)
        From the sensor to the point, sensor frame.
    tau_s : ndarray, shape (n,)
        How long the errors last.
    quat : ndarray, shape (n, 4), or None
        Local from ins.
    attitude_covariance_rad2 : ndarray, shape (n, 3, 3), or None
        Of a small rotation vector in the local frame; not a number where nobody states it.
    delay_sigma_s : float
        How well the UTC of the lidar's stamps is known.
    """

    source: str
    time_ns: Ints
    position_m: Array
    covariance_m2: Array
    lever_m: Array
    tau_s: Array
    quat: Array | None
    attitude_covariance_rad2: Array | None
    delay_sigma_s: float


def outside_track(fixes: OutsideFixes, mat_ins_lidar: Array, lidar_m: Array, utc: UtcTie) -> Outside:
    """Outside positions as the adjustment takes them.

    Parameters
    ----------
    fixes : OutsideFixes
    mat_ins_lidar, lidar_m : ndarray
        Nominal mount.
    utc : UtcTie
        What ties the lidar's clock to UTC.
    """
    tau_s = np.array([TAU_S.get(Quality(kind), LONGER_S) for kind in fixes.quality.tolist()])
    known = fixes.quat_local_ins_wxyz is not None and fixes.attitude_covariance_rad2 is not None
    return Outside(
        fixes.source,
        fixes.time_ns,
        fixes.position_m,
        fixes.covariance_m2,
        mat_ins_lidar.T @ (fixes.lever_arm_m - lidar_m),
        tau_s,
        fixes.quat_local_ins_wxyz if known else None,
        fixes.attitude_covariance_rad2 if known else None,
        float(np.hypot(utc.sigma_ns * 1e-9, LEAST_DELAY_SIGMA_S if utc.source == "gprmc" else BY_BOOT_SIGMA_S)),
    )


LONGEST_BLIND: Final = 10
"""Slices without a view after which the map may have gone astray."""
ROUGH_M: Final = 0.3
"""Positions that are no better do not move pieces."""
FEWEST_OF_PIECE: Final = 5
"""Positions by which a piece of the flight can be laid."""


def laid_by_pieces(path: Path, given: Sequence[Outside], view: npt.NDArray[np.bool_]) -> Path:
    """A path whose pieces between long blind stretches lie, each as a whole, where the positions have them.

    After a blind stretch the odometry goes on from where its inertial sensors had drifted to, beside its own map. A metre is too far for
    the planes of both pieces to meet, and soft enough for a wrong meeting to hold.

    Parameters
    ----------
    path : Path
    given : sequence of Outside
    view : ndarray of bool, shape (intervals,)
        Slices with clusters.
    """
    pieces = _pieces(view)
    if len(pieces) < 2 or not given:
        return path
    sigma_m = float(np.sqrt(np.median(np.concatenate([each.covariance_m2[:, 0, 0] for each in given]))))
    if sigma_m > ROUGH_M:
        return path
    time_ns = np.concatenate([each.time_ns for each in given])
    inside = within(time_ns, path)
    _, _, step, share = spots(time_ns[inside], path)
    quat, position = poses(path, step, share)
    lever = np.concatenate([np.tile(each.lever_m, (len(each.time_ns), 1)) for each in given])[inside]
    stated = np.concatenate([each.position_m for each in given])[inside]
    point = position + np.einsum("nij,nj->ni", frames.mat_from_quat(quat), lever)
    grid, turns, moves = [], [], []
    for first, last in pieces:
        mine = (step >= first * STEPS) & (step < last * STEPS)
        if mine.sum() < FEWEST_OF_PIECE:
            continue
        turn, about, shift = _level_fit(point[mine], stated[mine], sigma_m)
        nodes = np.arange(first * STEPS, last * STEPS + 1)
        off = path.position_m[nodes] - about
        moves.append(_level(off, turn) - off + shift)
        grid.append(nodes)
        turns.append(np.full(len(nodes), turn))
    if not grid:
        return path
    nodes, known = np.arange(len(path.quat)), np.concatenate(grid)
    move = np.stack([np.interp(nodes, known, axis) for axis in np.concatenate(moves).T], axis=1)
    about_up = np.zeros((len(nodes), 3))
    about_up[:, 2] = np.interp(nodes, known, np.concatenate(turns))
    quat = frames.quat_multiply(frames.quat_exp(about_up), path.quat)
    return Path(path.start_ns, quat, path.position_m + move, path.step_ns)


def _pieces(view: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last slice, the last excluded, of the stretches between long blind ones."""
    seen = np.flatnonzero(view)
    if not len(seen):
        return []
    breaks = np.flatnonzero(np.diff(seen) > LONGEST_BLIND)
    return [(int(seen[a]), int(seen[b]) + 1) for a, b in zip([0, *(breaks + 1)], [*breaks, len(seen) - 1], strict=True)]


def _level_fit(point: Array, stated: Array, sigma_m: float) -> tuple[float, Array, Array]:
    """Turn about the vertical [rad], the place that it is about, and shift, that lay points on those stated: tilt is gravity's."""
    about = point.mean(axis=0)
    a, b = point - about, stated - stated.mean(axis=0)
    turn = 0.0
    # a heading only where the points are far enough apart to have one, to a degree
    if np.linalg.norm(a[:, :2], axis=1).max() > 60.0 * sigma_m:
        turn = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum()))
    return turn, about, np.asarray(np.median(stated - about - _level(a, turn), axis=0))


def _level(off: Array, turn: float) -> Array:
    """Vectors, shape (n, 3), turned about the vertical."""
    sine, cosine = np.sin(turn), np.cos(turn)
    return np.asarray(off @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))


def outside_factors(
    given: Outside, path: Path, unknowns: Unknowns, delay_s: float, mat_sensor_ins: Array, turn_name: str | None
) -> list[Factor]:
    """Rows of positions and of attitudes in means of a second; none where the path covers fewer than two.

    Parameters
    ----------
    given : Outside
    path : Path
    unknowns : Unknowns
        With or without `DELAY`.
    delay_s : float
        As estimated so far.
    mat_sensor_ins : ndarray, shape (3, 3)
        Boresight as estimated so far included.
    turn_name : str, optional
        The global that corrects the boresight.
    """
    time_ns = given.time_ns - round(delay_s * 1e9)
    inside = within(time_ns, path)
    if inside.sum() < 2:
        return []
    found = [_positions(given, time_ns, inside, path, unknowns)]
    if given.quat is not None and given.attitude_covariance_rad2 is not None:
        stated = inside & np.isfinite(given.attitude_covariance_rad2).all(axis=(1, 2))
        if stated.sum() >= 2:
            found.append(
                _attitudes(
                    given.quat[stated],
                    given.attitude_covariance_rad2[stated],
                    given.tau_s[stated],
                    time_ns[stated],
                    path,
                    unknowns,
                    mat_sensor_ins,
                    turn_name,
                )
            )
    return found


def _positions(given: Outside, time_ns: Ints, inside: npt.NDArray[np.bool_], path: Path, unknowns: Unknowns) -> Factor:
    time_ns = time_ns[inside]
    _, _, step, share = spots(time_ns, path)
    quat, position = poses(path, step, share)
    mat = frames.mat_from_quat(quat)
    point = position + mat @ given.lever_m
    group, middle = seconds(time_ns)
    residual = means(point - given.position_m[inside], group)
    covariance = _means_of(given.covariance_m2[inside], group) + LEAST_SIGMA_M**2 * np.eye(3)
    knot, weights, _, _ = spots(time_ns[middle], path)
    count = len(middle)
    builder, row = RowBuilder(3 * count, unknowns), 3 * np.arange(count)
    arm = np.tile(cross(given.lever_m[None]), (count, 1, 1))
    builder.at_times(row, knot, weights, 3, eye(count))
    builder.at_times(row, knot, weights, 0, -mat[middle] @ arm)
    builder.by(row, "world.turn", -cross(means(point, group)))
    builder.by(row, "world.shift", eye(count))
    if DELAY in unknowns.names:
        velocity = _velocity(path, step, given.lever_m)
        builder.by(row, DELAY, -means(velocity, group)[:, :, None])
    inflation = _lasting(time_ns[middle], means(given.tau_s[inside, None], group)[:, 0])
    return _weighed("outside position", residual, builder.matrix(), covariance, inflation)


def _velocity(path: Path, step: Ints, lever_m: Array) -> Array:
    """Velocity of a point of the airframe [m/s], shape (n, 3), over a few grid steps, so that vibration is no part of it."""
    low, high = np.maximum(step - 2, 0), np.minimum(step + 3, len(path.quat) - 1)
    ends = [path.position_m[at] + frames.mat_from_quat(path.quat[at]) @ lever_m for at in (low, high)]
    return np.asarray((ends[1] - ends[0]) / ((high - low) * STEP_NS * 1e-9)[:, None])


def _attitudes(
    stated: Array,
    covariance: Array,
    tau_s: Array,
    time_ns: Ints,
    path: Path,
    unknowns: Unknowns,
    mat_sensor_ins: Array,
    turn_name: str | None,
) -> Factor:
    _, _, step, share = spots(time_ns, path)
    mat = frames.mat_from_quat(poses(path, step, share)[0])
    off = frames.quat_log(frames.quat_from_mat(mat @ mat_sensor_ins @ np.swapaxes(frames.mat_from_quat(stated), 1, 2)))
    group, middle = seconds(time_ns)
    knot, weights, _, _ = spots(time_ns[middle], path)
    count = len(middle)
    builder, row = RowBuilder(3 * count, unknowns), 3 * np.arange(count)
    builder.at_times(row, knot, weights, 0, mat[middle])
    builder.by(row, "world.turn", eye(count))
    if turn_name is not None:
        builder.by(row, turn_name, means(mat.reshape(-1, 9), group).reshape(-1, 3, 3))
    spread = _means_of(covariance, group) + LEAST_SIGMA_RAD**2 * np.eye(3)
    inflation = _lasting(time_ns[middle], means(tau_s[:, None], group)[:, 0])
    return _weighed("outside attitude", means(off, group), builder.matrix(), spread, inflation)


def _means_of(covariance: Array, group: Ints) -> Array:
    """Mean covariance of each group: errors that last are the same ones throughout a second."""
    return means(covariance.reshape(-1, 9), group).reshape(-1, 3, 3)


def _lasting(time_ns: Ints, tau_s: Array) -> Array:
    """What variances are multiplied by, shape (n,): (1 + k) / (1 - k) with k = exp(-dt / tau)."""
    spacing_s = float(np.median(np.diff(time_ns))) * 1e-9 if len(time_ns) > 1 else np.inf
    keep = np.exp(-spacing_s / tau_s)
    return np.asarray((1.0 + keep) / (1.0 - keep))


def _weighed(name: str, residual: Array, matrix: sparse.csr_matrix, covariance: Array, inflation: Array) -> Factor:
    """Rows made independent and of unit noise, those far from where the others lie with less weight.

    What is usual is told by the rows themselves, about their median: before the path is where it belongs all are off alike, and a
    file whose sigmas are too small all over does not make all of them wrong. The loss goes on linearly (Huber), because where the
    lidar was blind it is the path that is far off, and must be pulled back.
    """
    spread = np.linalg.cholesky(covariance)
    centred = residual - np.median(residual, axis=0)
    distance = np.linalg.norm(np.linalg.solve(spread, centred[:, :, None])[:, :, 0], axis=1)
    # 1.54: the median of the distance of three unit normals
    usual = OUTLIER * max(1.0, float(np.median(distance)) / 1.54)
    share = robust.huber(distance, usual)
    white = np.linalg.inv(spread) * np.sqrt(share / inflation)[:, None, None]
    blocks = sparse.block_diag(white, format="csr")
    return Factor(name, blocks @ residual.ravel(), (blocks @ matrix).tocsr(), np.ones(residual.size))
