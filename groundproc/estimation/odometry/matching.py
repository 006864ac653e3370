"""The measurement of the odometry: distances of clusters from the planes of the map, and the correction of the state by them."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.odometry.state import STATES, StateArrays, apply
from groundproc.estimation.odometry.voxels import FLATNESS, LEVEL, MEAN, NORMAL, TILT, MapArrays, find
from groundproc.numerics.rotations import mat_of_quat, quat_difference, unit_vector
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

RANGE_SIGMA_M: Final = 0.02
"""Noise of a return of the HDL-32E (its data sheet)."""
SURFACE_SIGMA_M: Final = 0.015
"""What real surfaces differ from the plane of their voxel, one sigma of a cluster."""
INFLATION: Final = 4.0
"""Neighbouring clusters share their errors: so much is taken off their information."""
GROUND: Final = 0.966
"""Cosine of the steepest slope of what counts as ground: 15 deg."""
GROUND_MEMORY: Final = 0.99
"""What is kept of the sum of the ground's normals from slice to slice: the mean normal is that of some ten seconds."""
FLAT: Final = 1e-3
"""Share of the information below which a direction counts as not observed."""
ROUNDS: Final = 4


class _Matches(NamedTuple):
    """What clusters have found in the map.

    Attributes
    ----------
    row : ndarray of int64, shape (n,)
        Of the voxel, -1 where there is no plane.
    residual_m : ndarray, shape (n,)
        Distance from its plane.
    weight : ndarray, shape (n,)
        [1/m^2]
    """

    row: Ints
    residual_m: Array
    weight: Array


class _Normal(NamedTuple):
    """Normal equations of a pose's correction, by rotation in the body and by position.

    Attributes
    ----------
    information : ndarray, shape (6, 6)
    pull : ndarray, shape (6,)
        Weighted sum of the rows times their distances.
    """

    information: Array
    pull: Array


@njit(cache=True, nogil=True)
def observable(information: Array) -> Array:
    """Projection of a pose's correction, shape (6, 6), onto what planes really tell of it.

    Of directions that get less than `FLAT` of the information nothing is taken (after Zhang, Kaess, Singh 2016). Turns count by what
    they move at the mean distance.
    """
    turn = information[0, 0] + information[1, 1] + information[2, 2]
    shift = information[3, 3] + information[4, 4] + information[5, 5]
    arm = np.sqrt(max(turn, 1e-12) / max(shift, 1e-12))
    scaled = information.copy()
    scaled[:3, :] /= arm
    scaled[:, :3] /= arm
    values, vectors = np.linalg.eigh(scaled)
    known = np.zeros((6, 6))
    for i in range(6):
        if values[i] > FLAT * shift:
            for a in range(6):
                for b in range(6):
                    known[a, b] += vectors[a, i] * vectors[b, i]
    known[:3, 3:] /= arm
    known[3:, :3] *= arm
    return known


@njit(cache=True, nogil=True, inline="always")
def _row(mat: Array, body: Array, nx: float, ny: float, nz: float, out: Array) -> None:
    """How a distance along a normal changes with the pose of the slice's end: by rotation in the body, and by position."""
    p = nx * mat[0, 0] + ny * mat[1, 0] + nz * mat[2, 0]
    q = nx * mat[0, 1] + ny * mat[1, 1] + nz * mat[2, 1]
    r = nx * mat[0, 2] + ny * mat[1, 2] + nz * mat[2, 2]
    out[0], out[1], out[2] = body[1] * r - body[2] * q, body[2] * p - body[0] * r, body[0] * q - body[1] * p
    out[3], out[4], out[5] = nx, ny, nz


@njit(cache=True, nogil=True, inline="always")
def _add(row: Array, weight: float, residual: float, normal: _Normal) -> None:
    """Add a row to the lower half of the information and to the pull."""
    information, pull = normal.information, normal.pull
    for a in range(6):
        weighted = weight * row[a]
        pull[a] += weighted * residual
        for b in range(a + 1):
            information[a, b] += weighted * row[b]


@njit(cache=True, nogil=True)
def _match(
    planes: MapArrays, body: Array, counts: npt.NDArray[np.int32], pose: tuple[Array, Array], gate_m: float, found: _Matches,
    ground: Array,
) -> int:  # fmt: skip
    """Voxel of each cluster, -1 where it finds no plane, with distance and weight; the normals of ground, up, are added to `ground`."""
    table, keys, voxels, voxel_m = planes
    per_m, (mat, position) = 1.0 / voxel_m, pose
    row, residual, weight = found
    matched = 0
    for n in range(len(body)):
        bx, by, bz = body[n, 0], body[n, 1], body[n, 2]
        x = mat[0, 0] * bx + mat[0, 1] * by + mat[0, 2] * bz + position[0]
        y = mat[1, 0] * bx + mat[1, 1] * by + mat[1, 2] * bz + position[1]
        z = mat[2, 0] * bx + mat[2, 1] * by + mat[2, 2] * bz + position[2]
        row[n] = find(table, keys, voxel_key(x, y, z, per_m))
        if row[n] < 0:
            continue
        v = voxels[row[n]]
        e = v[NORMAL] * x + v[NORMAL + 1] * y + v[NORMAL + 2] * z - v[LEVEL]
        if v[FLATNESS] < 0.0 or abs(e) > gate_m:
            row[n] = -1
            continue
        # a plane known from a few lines is uncertain away from them
        off = (x - v[MEAN]) ** 2 + (y - v[MEAN + 1]) ** 2 + (z - v[MEAN + 2]) ** 2
        variance = RANGE_SIGMA_M**2 / counts[n] + SURFACE_SIGMA_M**2 + 0.25 * v[FLATNESS] + v[TILT] * off
        weight[n] = min(1.0, 2.0 * np.sqrt(variance) / max(abs(e), 1e-9)) / (INFLATION * variance)
        residual[n] = e
        matched += 1
        if abs(v[NORMAL + 2]) > GROUND:
            signed = weight[n] if v[NORMAL + 2] > 0.0 else -weight[n]
            for c in range(3):
                ground[c] += signed * v[NORMAL + c]
    return matched


@njit(cache=True, nogil=True)
def _accumulate(
    voxels: Array, body: Array, mat: Array, found: _Matches, ground: Array, whole: _Normal, level: _Normal
) -> float:
    """Normal equations of all matches, and the same with the mean normal for all ground; gives the sum of squares."""
    row, residual, weight = found
    added, level_added = whole.information, level.information
    j = np.empty(6)
    squares = 0.0
    added[:, :], level_added[:, :] = 0.0, 0.0
    whole.pull[:], level.pull[:] = 0.0, 0.0
    for n in range(len(body)):
        if row[n] < 0:
            continue
        v, e = voxels[row[n]], residual[n]
        squares += e * e
        _row(mat, body[n], v[NORMAL], v[NORMAL + 1], v[NORMAL + 2], j)
        _add(j, weight[n], e, whole)
        if abs(v[NORMAL + 2]) > GROUND:
            side = 1.0 if v[NORMAL + 2] > 0.0 else -1.0
            _row(mat, body[n], side * ground[0], side * ground[1], side * ground[2], j)
        _add(j, weight[n], e, level)
    for a in range(6):
        for b in range(a):
            added[b, a], level_added[b, a] = added[a, b], level_added[a, b]
    return squares


@njit(cache=True, nogil=True)
def update(
    planes: MapArrays, body: Array, counts: npt.NDArray[np.int32], state: StateArrays, covariance: Array, ground: Array
) -> Any:
    """Correct a state by the planes that clusters lie on; gives how many do, their RMS distance, and the covariance."""
    quat, position = state.quat, state.position_m
    to_pose, mine = np.ascontiguousarray(covariance[:, :6]), np.ascontiguousarray(covariance[:6, :6])
    total = np.zeros(STATES)  # correction so far: the prior pulls back to where it began
    mat, turn = np.empty((3, 3)), np.empty(3)
    before = quat.copy()
    whole, level = _Normal(np.zeros((6, 6)), np.zeros(6)), _Normal(np.zeros((6, 6)), np.zeros(6))
    factor, inner = np.zeros((6, 6)), np.eye(6)
    found = _Matches(np.empty(len(body), np.int64), np.empty(len(body)), np.empty(len(body)))
    normals, up = ground.copy(), ground.copy()
    matched, squares = 0, 0.0
    for attempt in range(ROUNDS):
        mat_of_quat(quat, mat)
        gate = 0.5 if attempt == 0 else 0.25
        ground[:] = GROUND_MEMORY * normals
        matched = _match(planes, body, counts, (mat, position), gate, found, ground)
        up[:] = ground
        unit_vector(up)
        squares = _accumulate(planes.voxels, body, mat, found, up, whole, level)
        added, pull = whole
        if matched:
            # normals of flat ground have errors, and thousands of them would seem to hold a place along it: whether anything does is
            # judged with their mean for all of them, and where nothing does, that is also what counts. Not the vertical: the map
            # leans by what the start's tilt was off, and a turn about any other axis than the ground's own normal tilts it
            known = observable(level.information)
            if np.trace(known) < 5.5:
                pull = np.ascontiguousarray(known.T) @ level.pull
                added = np.ascontiguousarray(known.T) @ level.information @ np.ascontiguousarray(known)
        # (P^-1 + A)^-1 by Woodbury's formula: P itself may be too nearly singular to invert. With A = L L^T it stays a covariance
        values, vectors = np.linalg.eigh(added)
        root = np.sqrt(np.maximum(values, 1e-13 * values[5] + 1e-12))
        factor[:, :] = vectors * root
        inner[:, :] = np.linalg.inv(np.eye(6) + factor.T @ mine @ factor)
        change = to_pose @ (factor @ (inner @ (factor.T @ total[:6] - (vectors.T @ pull) / root))) - total
        total += change
        apply(change, state)
        # the attitude's correction as one rotation from the prediction
        quat_difference(before, quat, turn)
        total[:3] = turn
        moved = np.abs(change[:6])
        if moved[0] + moved[1] + moved[2] < 1e-5 and moved[3] + moved[4] + moved[5] < 3e-4:
            break
    gain = to_pose @ factor
    left = covariance - gain @ (inner @ gain.T)
    return matched, np.sqrt(squares / max(matched, 1)), 0.5 * (left + left.T)
