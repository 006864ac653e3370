"""Rows of poses that were observed and of values of cameras that were known before: dense, for they have no points."""

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import POSE, Block, PosePriors
from groundproc.imagery.bundle.unknowns import Unknowns
from groundproc.imagery.rig import MOUNTING, RigCamera
from groundproc.imagery.rotations import cross_matrix

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

PRIOR_UNIT = {"boresight": ("boresight_deg", np.pi / 180.0), "lever": ("lever_arm_m", 1.0)}


def pose_residuals(block: Block, priors: PosePriors) -> Array:
    """Station minus observed pose: place [m] and turn in the local frame [rad], shape (k, 6)."""
    stations, at = block.stations, priors.station
    mat = stations.mat_local_ins[at]
    place = stations.place_m[at] + np.einsum("kij,kj->ki", mat, priors.arm_m) - priors.place_m
    place += priors.common.shift_m(priors.place_m)
    turn = frames.quat_log(frames.quat_from_mat(mat @ np.swapaxes(priors.mat_local_ins, 1, 2)))
    turn += priors.common.moved[3:]
    return np.concatenate([place, turn], axis=1)


def whitening(covariance: Array) -> Array:
    """Matrices that make errors independent and of unit size, shape (k, 6, 6); rows of what nothing is known of are zero."""
    out = np.zeros_like(covariance)
    for number, one in enumerate(covariance):
        known = np.flatnonzero(np.isfinite(np.diag(one)))
        if len(known):
            lower = np.linalg.cholesky(one[np.ix_(known, known)])
            out[number][np.ix_(known, known)] = np.linalg.inv(lower)
    return out


def bare_rows(block: Block, unknowns: Unknowns) -> tuple[Array, Array, Ints]:
    """Residuals of observed poses [m, rad], shape (k, 6), derivatives, shape (k, 6, 14), and columns, shape (k, 14), -1 for none.

    The seventh column is the shift of the camera's clock: later images were taken elsewhere. Then follows what is common to all poses.
    """
    priors = block.priors
    by = np.zeros((len(priors), POSE, 2 * POSE + 2))
    arm = np.einsum("kij,kj->ki", block.stations.mat_local_ins[priors.station], priors.arm_m)
    by[:, :3, :3], by[:, :3, 3:6], by[:, 3:, 3:6] = np.eye(3), -cross_matrix(arm), np.eye(3)
    by[:, :3, 6], by[:, 3:, 6], by[:, 3:, 7] = -priors.velocity_m_s, -priors.turning_rad_s, -priors.turning_rad_s
    by[:, :3, 8:11], by[:, 3:, 11:] = np.eye(3), np.eye(3)
    by[:, :3, 11:] = -cross_matrix(priors.place_m - priors.common.centre_m)
    lead = block.stations.lead[priors.station]
    shift = unknowns.camera[lead, lenses.FREE + MOUNTING.index("timeshift")]
    common = np.tile(unknowns.common, (len(priors), 1))
    columns = np.concatenate([unknowns.station[priors.station], shift[:, None], common], axis=1)
    return pose_residuals(block, priors), by, columns


def pose_rows(block: Block, unknowns: Unknowns) -> tuple[Array, Array, Ints]:
    """Rows of observed poses with independent errors of unit size: residuals, derivatives, columns.

    Where errors last, a row is what is new against the pose before (a Markov process), whose columns follow.
    """
    priors = block.priors
    residual, by, columns = bare_rows(block, unknowns)
    white = whitening(priors.covariance) * np.sqrt(priors.weight)[:, None, None]
    residual, by = np.einsum("kij,kj->ki", white, residual), white @ by
    if priors.before is None or priors.keep is None:
        return residual, by, columns
    return what_is_new(priors.before, priors.keep, residual, by, columns)


def what_is_new(before: Ints, keep: Array, residual: Array, by: Array, columns: Ints) -> tuple[Array, Array, Ints]:
    """Rows of unit errors that are correlated with those before made independent."""
    last = np.maximum(before, 0)
    kept = np.repeat(keep, 3, axis=1) * (before >= 0)[:, None]
    scale = 1.0 / np.sqrt(1.0 - kept**2)
    new = scale * (residual - kept * residual[last])
    both = np.concatenate([scale[:, :, None] * by, -(scale * kept)[:, :, None] * by[last]], axis=2)
    return new, both, np.concatenate([columns, np.where((before >= 0)[:, None], columns[last], -1)], axis=1)


def common_rows(block: Block, unknowns: Unknowns) -> tuple[Array, Array, Ints]:
    """Rows of what is known of the trajectory as a whole, of unit size: residuals (1, 7), derivatives (1, 7, 7), columns (1, 7)."""
    given = block.priors.common
    by = np.zeros((1 + POSE, 1 + POSE))
    if given.late_sigma_s > 0.0:
        by[0, 0] = 1.0 / given.late_sigma_s
    if given.covariance is not None:
        by[1:, 1:] = np.linalg.inv(np.linalg.cholesky(given.covariance))
    residual = by @ np.append(given.late_s, given.moved)
    return residual[None], by[None], unknowns.common[None]


def known_rows(block: Block, known: tuple[RigCamera, ...], unknowns: Unknowns) -> tuple[Array, Array, Ints]:
    """Weighted residuals, shape (k,), weights, shape (k,), and columns of values of cameras that were known before.

    Parameters
    ----------
    block : Block
    known : tuple of RigCamera
        As they were before.
    unknowns : Unknowns
    """
    residual, weight, columns = [], [], []
    for number, (now, before) in enumerate(zip(block.rig.cameras, known, strict=True)):
        for name, sigma, off in _known(now, before):
            place = now.camera.place_of(name) if name in now.camera.names else lenses.FREE + MOUNTING.index(name)
            column = unknowns.camera[number, place]
            if column < 0 or column in columns:
                continue
            residual.append(off / sigma)
            weight.append(1.0 / sigma)
            columns.append(int(column))
    return np.array(residual), np.array(weight), np.array(columns, np.int64)


def _known(now: RigCamera, before: RigCamera) -> list[tuple[str, float, float]]:
    """Name, prior sigma and departure of each value with a prior."""
    found = []
    values, old = now.camera.values(), before.camera.values()
    found += [(name, before.sigma[name], values[name] - old[name]) for name in values if name in before.sigma]
    turn = frames.quat_log(frames.quat_from_mat(now.mat_cam_ins @ before.mat_cam_ins.T))
    lever = now.lever_arm_m - before.lever_arm_m
    for what, off in (("boresight", turn), ("lever", lever)):
        key, unit = PRIOR_UNIT[what]
        if before.sigma.get(key):
            found += [(f"{what}_{axis}", before.sigma[key] * unit, off[i]) for i, axis in enumerate("xyz")]
    times = (
        ("timeshift", now.timeshift_s - before.timeshift_s),
        ("line_delay", now.line_delay_s - before.line_delay_s),
    )
    found += [(name, before.sigma[f"{name}_s"], off) for name, off in times if before.sigma.get(f"{name}_s")]
    return found


def add_dense(matrix: Array, gradient: Array, residual: Array, by: Array, columns: Ints) -> None:
    """Add rows, (k, m), (k, m, c) with columns (k, c), to the normal matrix and the gradient."""
    held = columns < 0
    by = np.where(held[:, None, :], 0.0, by)
    columns = np.where(held, 0, columns)
    square = np.einsum("kmi,kmj->kij", by, by)
    np.add.at(matrix, (columns[:, :, None], columns[:, None, :]), square)
    np.add.at(gradient, columns, np.einsum("kmi,km->ki", by, residual))
