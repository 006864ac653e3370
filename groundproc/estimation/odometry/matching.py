"""The measurement of the odometry: distances of clusters from the planes of the map, and the correction of the state by them."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.odometry.state import STATES, StateArrays, apply
from groundproc.estimation.odometry.voxels import (
    COUNT,
    FLATNESS,
    LEVEL,
    LONGEST,
    MEAN,
    MOST_RETURNS,
    NORMAL,
    SPREAD,
    TILT,
    MapArrays,
    find,
)
from groundproc.numerics.facing import mean_normals
from groundproc.numerics.rotations import mat_of_quat, quat_difference
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
"""Cosine of what planes of the ground lean from its mean normal at most: 15 deg."""
FIRST_GROUND: Final = 0.707
"""The same, from the vertical, while there is no mean normal yet: a slope may be ground too."""
STANDING: Final = 0.5
"""Cosine from which on a plane stands, whatever it is known by."""
SURE_LEAN: Final = 3.0
"""A plane that leans from the ground by less than so many times what its width allows is none, for it may be ground."""
GROUND_MEMORY: Final = 0.99
"""What is kept of the sum of the ground's normals from slice to slice: the mean normal is that of some ten seconds."""
RELIEF: Final = 1.0
"""The ground's own normals may tell so many times what all else tells."""
FILLED_SIGMA_M: Final = 0.05
"""What leaves and blades differ from the voxel that they fill, one sigma of a cluster: they move, and are seen from elsewhere."""
FILLED_RETURNS: Final = 4
"""Returns of a cluster that count for its mean there, at most: those of one instant lie beside each other."""
TELLS_M: Final = 0.1
"""Sigma of a direction in one slice from which on nothing is taken of it. Over bare ground, a few planes that are none seem to hold the
path by some decimetres a slice, and brake it by a metre a second; trees at 30 m hold it to 1 cm."""
FACING_VOXELS: Final = 8.0
"""Edge of the cubes, in voxels, within which planes that face nearly one way are judged by their mean normal: sixty of one wall."""
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
    key, voxel : ndarray of int64, shape (n,)
        Of the voxel that each lies in, and its row whatever it is, -1 where there is none.
    """

    row: Ints
    residual_m: Array
    weight: Array
    key: Ints
    voxel: Ints


class _Clusters(NamedTuple):
    """Clusters of a slice.

    Attributes
    ----------
    body_m : ndarray, shape (n, 3)
        In the body at slice end.
    returns : ndarray of int32, shape (n,)
        Returns of each.
    """

    body_m: Array
    returns: npt.NDArray[np.int32]


class Normal(NamedTuple):
    """Normal equations of a pose's correction, by rotation in the body and by position.

    Attributes
    ----------
    information : ndarray, shape (6, 6)
    pull : ndarray, shape (6,)
        Weighted sum of the rows times their distances.
    """

    information: Array
    pull: Array


class Sums(NamedTuple):
    """Normal equations of a slice.

    Attributes
    ----------
    rest : Normal
        Of all that is not ground.
    level, ground : Normal
        Of the ground by its mean normal, and by the normals of its voxels.
    facing : Normal
        Of all that is not ground, planes by the mean normals of those that face the same way near by, less what is left of chance in
        these: what is judged by.
    """

    rest: Normal
    level: Normal
    ground: Normal
    facing: Normal


@njit(cache=True, nogil=True)
def observable(information: Array, least: float) -> Array:
    """Projection of a pose's correction, shape (6, 6), onto the directions that planes really observe.

    Nothing is taken of directions that get less than a share `least` of the information (after Zhang, Kaess, Singh
    2016). Rotations are measured by the motion at the mean distance.
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
        if values[i] > least * shift:
            for a in range(6):
                for b in range(6):
                    known[a, b] += vectors[a, i] * vectors[b, i]
    known[:3, 3:] /= arm
    known[3:, :3] *= arm
    return known


def _no_matches(count: int) -> _Matches:
    """Nothing is found yet: no voxel has the key -1."""
    key, voxel = np.full(count, -1, np.int64), np.empty(count, np.int64)
    return _Matches(np.empty(count, np.int64), np.empty(count), np.empty(count), key, voxel)


def _nothing() -> Normal:
    return Normal(np.zeros((6, 6)), np.zeros(6))


@njit(cache=True, nogil=True, inline="always")
def _row(mat: Array, body: tuple[float, float, float], nx: float, ny: float, nz: float, out: Array) -> None:
    """How a distance along a normal changes with the pose of the slice's end: by rotation in the body, and by position."""
    bx, by, bz = body
    p = nx * mat[0, 0] + ny * mat[1, 0] + nz * mat[2, 0]
    q = nx * mat[0, 1] + ny * mat[1, 1] + nz * mat[2, 1]
    r = nx * mat[0, 2] + ny * mat[1, 2] + nz * mat[2, 2]
    out[0], out[1], out[2] = by * r - bz * q, bz * p - bx * r, bx * q - by * p
    out[3], out[4], out[5] = nx, ny, nz


@njit(cache=True, nogil=True, inline="always")
def _add(row: Array, weight: float, residual: float, normal: Normal) -> None:
    """Add a row to the lower half of the information and to the pull."""
    information, pull = normal.information, normal.pull
    for a in range(6):
        weighted = weight * row[a]
        pull[a] += weighted * residual
        for b in range(a + 1):
            information[a, b] += weighted * row[b]


@njit(cache=True, nogil=True)
def _match(
    planes: MapArrays, clusters: _Clusters, pose: tuple[Array, Array], gate_m: float, found: _Matches,
    ground: tuple[Array, float, Array],
) -> int:  # fmt: skip
    """Voxel of each cluster, -1 if it finds no plane and no filled voxel, with distance and weight of planes.

    `ground` holds three things: its mean normal so far, pointing up; the cosine of the largest lean from it that still
    belongs to the ground; and the sum that such normals are added to.
    """
    table, keys, voxels, voxel_m = planes
    up, cone, total = ground
    body, counts = clusters
    per_m, (mat, position) = 1.0 / voxel_m, pose
    row, residual, weight = found.row, found.residual_m, found.weight
    matched = 0
    # voxels are looked up in a loop of their own, whose cache misses run side by side; from round to round few clusters change theirs
    for n in range(len(body)):
        x, y, z = _at(mat, position, body, n)
        key = voxel_key(x, y, z, per_m)
        if key != found.key[n]:
            found.key[n], found.voxel[n] = key, find(table, keys, key)
    for n in range(len(body)):
        v = found.voxel[n]
        row[n] = v
        if v < 0:
            continue
        x, y, z = _at(mat, position, body, n)
        if voxels[v, SPREAD] > 0.0:
            matched += 1
            continue
        e = voxels[v, NORMAL] * x + voxels[v, NORMAL + 1] * y + voxels[v, NORMAL + 2] * z - voxels[v, LEVEL]
        if voxels[v, FLATNESS] < 0.0 or abs(e) > gate_m:
            row[n] = -1
            continue
        # a plane known from a few lines is uncertain away from them
        off = (x - voxels[v, MEAN]) ** 2 + (y - voxels[v, MEAN + 1]) ** 2 + (z - voxels[v, MEAN + 2]) ** 2
        lean = abs(voxels[v, NORMAL] * up[0] + voxels[v, NORMAL + 1] * up[1] + voxels[v, NORMAL + 2] * up[2])
        if STANDING < lean <= cone and _may_be_ground(voxels[v, COUNT], voxels[v, TILT], lean):
            row[n] = -1
            continue
        variance = (
            RANGE_SIGMA_M**2 / counts[n] + SURFACE_SIGMA_M**2 + 0.25 * voxels[v, FLATNESS] + voxels[v, TILT] * off
        )
        weight[n] = min(1.0, 2.0 * np.sqrt(variance) / max(abs(e), 1e-9)) / (INFLATION * variance)
        residual[n] = e
        matched += 1
        if lean > cone:
            side = voxels[v, NORMAL] * up[0] + voxels[v, NORMAL + 1] * up[1] + voxels[v, NORMAL + 2] * up[2]
            signed = weight[n] if side > 0.0 else -weight[n]
            for c in range(3):
                total[c] += signed * voxels[v, NORMAL + c]
    return matched


@njit(cache=True, nogil=True, inline="always")
def _at(mat: Array, position: Array, body: Array, n: int) -> Any:
    """Where a pose places a cluster."""
    bx, by, bz = body[n, 0], body[n, 1], body[n, 2]
    x = mat[0, 0] * bx + mat[0, 1] * by + mat[0, 2] * bz + position[0]
    y = mat[1, 0] * bx + mat[1, 1] * by + mat[1, 2] * bz + position[1]
    z = mat[2, 0] * bx + mat[2, 1] * by + mat[2, 2] * bz + position[2]
    return x, y, z


@njit(cache=True, nogil=True, inline="always")
def _may_be_ground(count: float, tilt: float, lean: float) -> bool:
    """Whether a plane leans from the ground, by its cosine, by no more than returns of one or two rings would: they share their errors."""
    of_one_ring = 0.25 * min(count, MOST_RETURNS) * tilt
    return bool(1.0 - lean * lean < SURE_LEAN**2 * of_one_ring)


@njit(cache=True, nogil=True, inline="always")
def _add_filled(
    voxel: tuple[Array, int], mat: Array, body: tuple[float, float, float], off: Array, count: int, voxel_m: float, sums: Sums,
    memory: tuple[Array, Array],
) -> None:  # fmt: skip
    """Add three rows, along the axes of what fills a voxel (one row of the map's), to the sums of all that is not ground.

    The mean of a few returns lies about that of the voxel by its scatter. The points cut off by the voxel's faces do
    not move with the path. Evenly filled from face to face, with a scatter of edge / sqrt(12), a voxel tells nothing.
    Working memory: (6,), (3, 3).
    """
    (voxels, v), (j, axis) = voxel, memory
    for c in range(3):
        axis[0, c], axis[2, c] = voxels[v, NORMAL + c], voxels[v, LONGEST + c]
    axis[1, 0] = axis[2, 1] * axis[0, 2] - axis[2, 2] * axis[0, 1]
    axis[1, 1] = axis[2, 2] * axis[0, 0] - axis[2, 0] * axis[0, 2]
    axis[1, 2] = axis[2, 0] * axis[0, 1] - axis[2, 1] * axis[0, 0]
    for i in range(3):
        spread = voxels[v, SPREAD + i]
        moves = max(1.0 - 12.0 * spread / voxel_m**2, 0.0)
        e = axis[i, 0] * off[0] + axis[i, 1] * off[1] + axis[i, 2] * off[2]
        variance = spread / min(count, FILLED_RETURNS) + FILLED_SIGMA_M**2
        weight = moves * min(1.0, 3.0 * np.sqrt(variance) / max(abs(e), 1e-9)) / (INFLATION * variance)
        _row(mat, body, axis[i, 0], axis[i, 1], axis[i, 2], j)
        _add(j, weight, e, sums.rest)
        _add(j, weight, e, sums.facing)


@njit(cache=True, nogil=True)
def _accumulate(
    planes: MapArrays, clusters: _Clusters, pose: tuple[Array, Array], found: _Matches, ground: Array, sums: Sums
) -> float:
    """Normal equations of all matches, those on the ground by its mean normal and by their own apart; gives the sum of squares."""
    voxels, body, returns = planes.voxels, clusters.body_m, clusters.returns
    mat, position = pose
    row, residual, weight = found.row, found.residual_m, found.weight
    j, off, axis, by, some = np.empty(6), np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty(6)
    mean, unsure = _facing(planes, row, ground)
    squares = 0.0
    for each in (sums.rest, sums.level, sums.ground, sums.facing):
        each.information[:, :], each.pull[:] = 0.0, 0.0
    for n in range(len(body)):
        if row[n] < 0:
            continue
        v, e, own = row[n], residual[n], (body[n, 0], body[n, 1], body[n, 2])
        if voxels[v, FLATNESS] < 0.0:
            for c in range(3):
                off[c] = (
                    mat[c, 0] * own[0] + mat[c, 1] * own[1] + mat[c, 2] * own[2] + position[c] - voxels[v, MEAN + c]
                )
            _add_filled((voxels, v), mat, own, off, returns[n], planes.voxel_m, sums, (j, axis))
            continue
        squares += e * e
        _row(mat, own, voxels[v, NORMAL], voxels[v, NORMAL + 1], voxels[v, NORMAL + 2], j)
        lean = voxels[v, NORMAL] * ground[0] + voxels[v, NORMAL + 1] * ground[1] + voxels[v, NORMAL + 2] * ground[2]
        if abs(lean) <= GROUND:
            _add(j, weight[n], e, sums.rest)
            _row(mat, own, mean[n, 0], mean[n, 1], mean[n, 2], j)
            _add(j, weight[n], e, sums.facing)
            _take_off(mat, own, (unsure, n), weight[n], sums.facing, (by, some))
            continue
        _add(j, weight[n], e, sums.ground)
        side = 1.0 if lean > 0.0 else -1.0
        _row(mat, own, side * ground[0], side * ground[1], side * ground[2], j)
        _add(j, weight[n], e, sums.level)
    for each in (sums.rest, sums.level, sums.ground, sums.facing):
        for a in range(6):
            for b in range(a):
                each.information[b, a] = each.information[a, b]
    return squares


@njit(cache=True, nogil=True)
def _facing(planes: MapArrays, row: Ints, ground: Array) -> tuple[Array, Array]:
    """Mean normals of the planes that each cluster's plane faces one way with, shape (n, 3), and their covariances, shape (n, 3, 3).

    Zero where a cluster is on the ground, or on no plane.
    """
    voxels, count = planes.voxels, 0
    at = np.empty(len(row), np.int64)
    place, normal = np.empty((len(row), 3)), np.empty((len(row), 3))
    for n in range(len(row)):
        v = row[n]
        if v < 0 or voxels[v, FLATNESS] < 0.0:
            continue
        if (
            abs(voxels[v, NORMAL] * ground[0] + voxels[v, NORMAL + 1] * ground[1] + voxels[v, NORMAL + 2] * ground[2])
            > GROUND
        ):
            continue
        at[count] = n
        for c in range(3):
            place[count, c], normal[count, c] = voxels[v, MEAN + c], voxels[v, NORMAL + c]
        count += 1
    # fewer than three planes are no wall: with their stated tilts taken off, a meadow's trunks and tufts would tell nothing
    found = mean_normals(place[:count], normal[:count], np.zeros(count), FACING_VOXELS * planes.voxel_m)
    mean, covariance = np.zeros((len(row), 3)), np.zeros((len(row), 3, 3))
    for i in range(count):
        for a in range(3):
            mean[at[i], a] = found[0][i, a]
            for b in range(3):
                covariance[at[i], a, b] = found[1][i, a, b]
    return mean, covariance


@njit(cache=True, nogil=True, inline="always")
def _take_off(
    mat: Array, body: tuple[float, float, float], covariances: tuple[Array, int], weight: float, normal: Normal,
    memory: tuple[Array, Array],
) -> None:  # fmt: skip
    """Take off the lower half of the information what an error of the normal adds to it by chance: weight J C J^T.

    C is one of some covariances, by its number; working memory (3, 6), (6,).
    """
    (covariance, n), (by, some) = covariances, memory
    bx, b_y, bz = body
    # by rotation in the body and by position, for normals along the three axes
    for c in range(3):
        p, q, r = mat[c, 0], mat[c, 1], mat[c, 2]
        by[c, 0], by[c, 1], by[c, 2] = b_y * r - bz * q, bz * p - bx * r, bx * q - b_y * p
        by[c, 3], by[c, 4], by[c, 5] = 0.0, 0.0, 0.0
        by[c, 3 + c] = 1.0
    for c in range(3):
        for a in range(6):
            some[a] = covariance[n, c, 0] * by[0, a] + covariance[n, c, 1] * by[1, a] + covariance[n, c, 2] * by[2, a]
        for a in range(6):
            for b in range(a + 1):
                normal.information[a, b] -= weight * by[c, a] * some[b]


def weakest(information: Array) -> tuple[float, float]:
    """How well the direction of a pose that is told least is told, and the next, one sigma [m].

    Turns count by what they move at the mean distance.
    """
    turn = information[0, 0] + information[1, 1] + information[2, 2]
    shift = information[3, 3] + information[4, 4] + information[5, 5]
    arm = np.sqrt(max(turn, 1e-12) / max(shift, 1e-12))
    scaled = information.copy()
    scaled[:3, :] /= arm
    scaled[:, :3] /= arm
    values = np.linalg.eigvalsh(scaled)
    return 1.0 / float(np.sqrt(max(values[0], 1e-6))), 1.0 / float(np.sqrt(max(values[1], 1e-6)))


@njit(cache=True, nogil=True)
def told(sums: Sums) -> Normal:
    """What a slice tells of the pose: all by mean normals, of the ground's relief at most `RELIEF` times as much.

    Normals of flat ground have errors. Thousands of them would seem to fix the position along it, and would brake the
    path where nothing else holds it. So the ground counts by its mean normal. The vertical would not do: the map leans
    by the error of the first tilt, and a rotation about any axis but the ground's own normal tilts it. Where walls and
    trees hold the path as well, the relief's own normals are right enough to help.
    """
    base, pull = sums.rest.information + sums.level.information, sums.rest.pull + sums.level.pull
    judged = sums.facing.information + sums.level.information
    known = observable(judged, TELLS_M**-2 / max(judged[3, 3] + judged[4, 4] + judged[5, 5], 1e-12))
    if np.trace(known) < 5.5:
        across = np.ascontiguousarray(known.T)
        return Normal(across @ base @ np.ascontiguousarray(known), across @ pull)
    values, vectors = np.linalg.eigh(base)
    half = np.sqrt(np.maximum(values, 1e-13 * values[5] + 1e-12))
    narrow, wide = np.ascontiguousarray(vectors / half), np.ascontiguousarray(vectors * half)
    more = np.ascontiguousarray(narrow.T) @ (sums.ground.information - sums.level.information) @ narrow
    share, axes = np.linalg.eigh(0.5 * (more + more.T))
    kept = np.minimum(np.maximum(share, 0.0), RELIEF)
    out = wide @ np.ascontiguousarray(axes)
    asked = np.ascontiguousarray(axes.T) @ (np.ascontiguousarray(narrow.T) @ (sums.ground.pull - sums.level.pull))
    for i in range(6):
        asked[i] = asked[i] * kept[i] / share[i] if share[i] > 1e-9 else 0.0
    return Normal(base + (out * kept) @ np.ascontiguousarray(out.T), pull + out @ asked)


def update(
    planes: MapArrays, body: Array, counts: npt.NDArray[np.int32], state: StateArrays, covariance: Array, ground: Array
) -> Any:
    """Correct a state by the planes and leaves that clusters lie on.

    No kernel itself: with all that it calls it took as long to compile as the rest of this file.
    Gives how many do, their RMS distance from planes, sigmas of the two directions that they tell least of [m], and the covariance.
    """
    quat, position = state.quat, state.position_m
    to_pose, mine = np.ascontiguousarray(covariance[:, :6]), np.ascontiguousarray(covariance[:6, :6])
    total = np.zeros(STATES)  # correction so far: the prior pulls back to where it began
    mat, turn = np.empty((3, 3)), np.empty(3)
    before = quat.copy()
    sums = Sums(_nothing(), _nothing(), _nothing(), _nothing())
    factor, inner = np.zeros((6, 6)), np.eye(6)
    clusters = _Clusters(body, counts)
    found = _no_matches(len(body))
    normals, up, axis, cone = ground.copy(), ground.copy(), ground.copy(), GROUND
    if not axis.any():
        axis[2], cone = 1.0, FIRST_GROUND
    axis /= np.linalg.norm(axis)
    matched, squares = 0, 0.0
    for attempt in range(ROUNDS):
        mat_of_quat(quat, mat)
        gate = 0.5 if attempt == 0 else 0.25
        ground[:] = GROUND_MEMORY * normals
        matched = _match(planes, clusters, (mat, position), gate, found, (axis, cone, ground))
        up[:] = ground / max(float(np.linalg.norm(ground)), 1e-300)
        squares = _accumulate(planes, clusters, (mat, position), found, up, sums)
        added, pull = told(sums)
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
    unheld = weakest(sums.facing.information + sums.level.information)
    return matched, float(np.sqrt(squares / max(matched, 1))), unheld, 0.5 * (left + left.T)
