"""Normal equations of a block with its points eliminated: S = U - W V^-1 W^T, never written down but for S.

Points are worked one by one. A point's columns are those of the stations and cameras that see it; what it adds to S is a small dense
matrix. A point that its rows leave undetermined adds nothing.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.imagery import lenses
from groundproc.imagery.bundle.block import POSE
from groundproc.imagery.bundle.rows import System, row_of
from groundproc.imagery.rig import MOUNTING

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_POSE = POSE
_OF_CAMERA = lenses.FREE + len(MOUNTING)
_WEAKEST = 1e-13
"""A point whose normal matrix is this much flatter in one direction than in another is not determined."""


class Eliminated(NamedTuple):
    """What is kept of the points for going back.

    Attributes
    ----------
    inverse : ndarray, shape (p, 3, 3)
        V^-1; zero where a point is not determined.
    gradient : ndarray, shape (p, 3)
    determined : ndarray of bool, shape (p,)
    """

    inverse: Array
    gradient: Array
    determined: Mask


@njit(cache=True, nogil=True)
def _column_at(columns: Ints, count: int, column: int) -> int:
    """Place of a column among those of a point; `count` where it is new."""
    for k in range(count):
        if columns[k] == column:
            return k
    return count


@njit(cache=True, nogil=True)
def _new_column(columns: Ints, count: int, column: int, mixed: Array, camera_side: Array) -> int:
    """One more column of a point, empty; how many there are then."""
    columns[count] = column
    for k in range(3):
        mixed[count, k] = 0.0
    for k in range(count + 1):
        camera_side[count, k] = 0.0
        camera_side[k, count] = 0.0
    camera_side[count, -1] = 0.0
    return count + 1


@njit(cache=True, nogil=True)
def _add_row(
    value: Array, used: int, by_point: Array, residual: float, place: Ints, mixed: Array, own: Array, camera_side: Array
) -> None:
    """Add the products of one row: the first `used` of `value` in the columns at `place`, `by_point` (3,)."""
    for j in range(used):
        at, v = place[j], value[j]
        for k in range(3):
            mixed[at, k] += v * by_point[k]
        for k in range(used):
            camera_side[at, place[k]] += v * value[k]
        camera_side[at, -1] += v * residual
    for j in range(3):
        for k in range(3):
            own[j, k] += by_point[j] * by_point[k]
        own[j, 3] += by_point[j] * residual


@njit(cache=True, nogil=True)
def _known_of_point(
    system: System, p: int, point: Array, columns: Ints, count: int, mixed: Array, own: Array, camera_side: Array
) -> int:
    """Add what is known of a point without images; how many columns its rows have then."""
    value, place = np.zeros(_POSE), np.empty(_POSE, np.int64)
    normal, arm = np.empty(3), np.empty(3)
    for i in range(system.first_row[p], system.first_row[p + 1]):
        weight = system.row_root_weight[i]
        left = -system.row_target_m[i] * weight
        for k in range(3):
            normal[k] = weight * system.row_normal[i, k]
            left += normal[k] * point[k]
            arm[k] = point[k] - system.centre_m[k]
        used: Any = np.int64(0)
        if system.row_moves[i] and weight > 0.0:
            # the plane is shifted and turned with all of the cloud
            used = _POSE
            for k in range(3):
                a, b = (k + 1) % 3, (k + 2) % 3
                value[k] = normal[k]
                value[3 + k] = arm[a] * normal[b] - arm[b] * normal[a]
            for k in range(_POSE):
                left += value[k] * system.moved[k]
                place[k] = _column_at(columns, count, system.common_column[k])
                if place[k] == count:
                    count = _new_column(columns, count, system.common_column[k], mixed, camera_side)
        _add_row(value, used, normal, left, place, mixed, own, camera_side)
    return count


@njit(cache=True, nogil=True)
def _point_system(
    system: System, p: int, point: Array, columns: Ints, mixed: Array, own: Array, camera_side: Array
) -> int:
    """Sums of one point: own (3, 4) is V and its gradient, mixed (m, 3) is W, camera_side (m, m + 1) is U and its gradient; returns m.

    `columns` (m,) are the columns of the reduced system that the rows of this point have.
    """
    for j in range(3):
        for k in range(4):
            own[j, k] = 0.0
    count: Any = np.int64(0)  # of a constant's own type, what takes it would be compiled twice
    residual = np.zeros(2)
    by_pose, by_point, by_camera = np.zeros((2, _POSE)), np.zeros((2, 3)), np.zeros((2, _OF_CAMERA))
    place = np.empty(_POSE + _OF_CAMERA, np.int64)
    value = np.empty((2, _POSE + _OF_CAMERA))
    for i in range(system.first[p], system.first[p + 1]):
        if not row_of(system, i, point, residual, by_pose, by_point, by_camera):
            continue
        image = system.image[i]
        station, camera = system.station[image], system.camera[image]
        used: Any = np.int64(0)
        for j in range(_POSE + _OF_CAMERA):
            column = system.station_column[station, j] if j < _POSE else system.camera_column[camera, j - _POSE]
            if column < 0:
                continue
            at = _column_at(columns, count, column)
            if at == count:
                count = _new_column(columns, count, column, mixed, camera_side)
            place[used] = at
            for a in range(2):
                value[a, used] = by_pose[a, j] if j < _POSE else by_camera[a, j - _POSE]
            used += 1
        for a in range(2):
            _add_row(value[a], used, by_point[a], residual[a], place, mixed, own, camera_side)
    return int(_known_of_point(system, p, point, columns, count, mixed, own, camera_side))


@njit(cache=True, nogil=True)
def inverted(own: Array, damping: float, out: Array) -> bool:
    """Inverse of a symmetric matrix (3, 3) with its diagonal raised by a share; False where it is flat."""
    a, b, c = own[0, 0] * (1.0 + damping), own[1, 1] * (1.0 + damping), own[2, 2] * (1.0 + damping)
    d, e, f = own[0, 1], own[1, 2], own[0, 2]
    m00, m01, m02 = b * c - e * e, f * e - d * c, d * e - f * b
    determinant = a * m00 + d * m01 + f * m02
    scale = max(a, b, c)
    if not determinant > _WEAKEST * scale * scale * scale:
        for j in range(3):
            for k in range(3):
                out[j, k] = 0.0
        return False
    out[0, 0], out[0, 1], out[0, 2] = m00 / determinant, m01 / determinant, m02 / determinant
    out[1, 0], out[1, 1], out[1, 2] = out[0, 1], (a * c - f * f) / determinant, (d * f - a * e) / determinant
    out[2, 0], out[2, 1], out[2, 2] = out[0, 2], out[1, 2], (a * b - d * d) / determinant
    return True


def _widest(system: System, columns: int) -> int:
    """Columns that the rows of one point can have, of all there are."""
    most = int(np.diff(system.first).max(initial=0)) * _POSE
    most += int((system.camera_column >= 0).sum() + (system.common_column >= 0).sum())
    return min(most, columns)


def reduce(system: System, points: Array, damping: float, matrix: Array, gradient: Array, kept: Eliminated) -> None:
    """Add the rows of all points to the reduced normal matrix (n, n) and its gradient (n,); fill what is kept."""
    _reduce(system, points, damping, matrix, gradient, kept, _widest(system, len(gradient)))


def back(system: System, points: Array, kept: Eliminated, step: Array, out: Array) -> None:
    """Steps of the points, shape (p, 3), that belong to a step of the reduced system, shape (n,)."""
    _back(system, points, kept, step, out, _widest(system, len(step)))


def point_cofactors(system: System, points: Array, kept: Eliminated, cofactor: Array, out: Array) -> None:
    """Cofactors of the points, shape (p, 3, 3), from those of the reduced system, shape (n, n): V^-1 + V^-1 W^T Q W V^-1.

    Not a number where a point is not determined.
    """
    out[~kept.determined] = np.nan
    _point_cofactors(system, points, kept, cofactor, out, _widest(system, len(cofactor)))


@njit(cache=True, nogil=True)
def _carry(mixed: Array, inverse: Array, count: int, out: Array) -> None:
    """W V^-1 of one point, the first `count` rows."""
    for j in range(count):
        for k in range(3):
            out[j, k] = mixed[j, 0] * inverse[0, k] + mixed[j, 1] * inverse[1, k] + mixed[j, 2] * inverse[2, k]


@njit(cache=True, nogil=True)
def _reduce(
    system: System, points: Array, damping: float, matrix: Array, gradient: Array, kept: Eliminated, size: int
) -> None:
    columns, mixed = np.empty(size, np.int64), np.empty((size, 3))
    own, camera_side = np.empty((3, 4)), np.empty((size, size + 1))
    carried = np.empty((size, 3))
    for p in range(len(points)):
        count = _point_system(system, p, points[p], columns, mixed, own, camera_side)
        kept.determined[p] = inverted(own, damping, kept.inverse[p])
        for k in range(3):
            kept.gradient[p, k] = own[k, 3]
        if not kept.determined[p]:
            continue
        inverse = kept.inverse[p]
        _carry(mixed, inverse, count, carried)
        for j in range(count):
            row = columns[j]
            gradient[row] += camera_side[j, -1] - (
                carried[j, 0] * own[0, 3] + carried[j, 1] * own[1, 3] + carried[j, 2] * own[2, 3]
            )
            for k in range(count):
                matrix[row, columns[k]] += camera_side[j, k] - (
                    carried[j, 0] * mixed[k, 0] + carried[j, 1] * mixed[k, 1] + carried[j, 2] * mixed[k, 2]
                )


@njit(cache=True, nogil=True)
def _back(system: System, points: Array, kept: Eliminated, step: Array, out: Array, size: int) -> None:
    columns, mixed = np.empty(size, np.int64), np.empty((size, 3))
    own, camera_side = np.empty((3, 4)), np.empty((size, size + 1))
    right = np.empty(3)
    for p in range(len(points)):
        for k in range(3):
            out[p, k] = 0.0
        if not kept.determined[p]:
            continue
        count = _point_system(system, p, points[p], columns, mixed, own, camera_side)
        for k in range(3):
            right[k] = -kept.gradient[p, k]
            for j in range(count):
                right[k] -= mixed[j, k] * step[columns[j]]
        for k in range(3):
            for j in range(3):
                out[p, k] += kept.inverse[p, k, j] * right[j]


@njit(cache=True, nogil=True)
def _weigh(cofactor: Array, columns: Ints, count: int, carried: Array, out: Array) -> None:
    """Sum of the rows of one point, shape (count, 3), by one row of the cofactors."""
    for a in range(3):
        out[a] = 0.0
    for k in range(count):
        share = cofactor[columns[k]]
        for a in range(3):
            out[a] += share * carried[k, a]


@njit(cache=True, nogil=True)
def _point_cofactors(system: System, points: Array, kept: Eliminated, cofactor: Array, out: Array, size: int) -> None:
    columns, mixed = np.empty(size, np.int64), np.empty((size, 3))
    own, camera_side = np.empty((3, 4)), np.empty((size, size + 1))
    carried, moved = np.empty((size, 3)), np.empty(3)
    for p in range(len(points)):
        if not kept.determined[p]:
            continue
        count = _point_system(system, p, points[p], columns, mixed, own, camera_side)
        inverse = kept.inverse[p]
        for a in range(3):
            for b in range(3):
                out[p, a, b] = inverse[a, b]
        _carry(mixed, inverse, count, carried)
        for j in range(count):
            _weigh(cofactor[columns[j]], columns, count, carried, moved)
            for a in range(3):
                for b in range(3):
                    out[p, a, b] += carried[j, a] * moved[b]


def nothing_kept(points: int) -> Eliminated:
    """Empty arrays to be filled."""
    return Eliminated(np.zeros((points, 3, 3)), np.zeros((points, 3)), np.zeros(points, np.bool_))
