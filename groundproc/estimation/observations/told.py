"""What the lidar's rows really observe of the path, interval by interval: judged as in the odometry (`matching`).

Normals of flat ground have errors, and thousands of them together would seem to fix the position along it. So the
ground counts by the mean normal of some twenty seconds. What its own normals tell beyond that, the relief, counts for
no more than everything else, direction by direction. A direction that nothing observes is left to inertial data and
fixes. The rows are changed accordingly.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from groundproc.estimation.odometry.matching import FACING_VOXELS, GROUND, INFLATION, RELIEF, TELLS_M, observable
from groundproc.estimation.odometry.tracker import SURE_HELD_M
from groundproc.machine.readahead import ahead
from groundproc.numerics.facing import mean_normals
from groundproc.numerics.parts import at_once
from groundproc.numerics.planeproducts import RowArrays
from groundproc.numerics.planerows import PlaneRows

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Knots = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

GROUND_SLICES: Final = 201
"""Slices whose ground makes one mean normal: were it each slice's own, its changes would seem to hold the place along the ground."""
SHAPE_SIGMA_RAD: Final = np.deg2rad(0.01)
"""What gyros of the lidar's class leave of the path's shape between two knots, 0.1 deg/sqrt(s) over a tenth of a second."""
TOLD: Final = 5.5
"""Trace of a projection below which a direction is missing: it has one for each of the six that are there."""
STEADY_SLICES: Final = 20.0
"""Over so many slices, one sigma, the direction that is missing is one: by each slice for itself it would waver by a degree, and each
change of it would seem to hold the way, for what slides along a wall must not go into it."""


class Poses(NamedTuple):
    """Clusters in the sensor frame, and its attitudes.

    Attributes
    ----------
    rotation : ndarray of float32, shape (n, 9)
        Local from sensor, row by row.
    xyz_m : ndarray of float32, shape (n, 3)
    """

    rotation: Singles
    xyz_m: Singles


def keep_told(
    rows: PlaneRows, poses: Callable[[slice], Poses], flat: int, voxel_m: float, place_m: Array, doubted: Mask | None = None
) -> None:  # fmt: skip
    """Leave in the rows of each interval what they really observe.

    This is judged on the axes of the map. On the axes of a body that tilts within the interval, the unobserved
    direction would change with the body, and each change of tilt would seem to tell a little of the heading. Where the
    heading is not observed at all, tilts count no more than the shape of the path between two knots is known. A gyro's
    bias about the vertical shows in the tilts by the small amount that a body leans, and an effect far below that
    noise would determine it wrongly.

    Parameters
    ----------
    rows : PlaneRows
    poses : callable
        Those of the clusters of some rows: all at once would be more than the rows.
    flat : int
        So many rows are of planes, those after them of what fills its voxel.
    voxel_m : float
    place_m : ndarray, shape (voxels, 3)
        Where each voxel is.
    doubted : ndarray of bool, shape (intervals,), optional
        Where, as the odometry has it, one direction of the way is not told for long. What seems to tell it there is believed only where it
        does so firmly (`SURE_HELD_M`), and the direction is that of the seconds around.
    """
    normals = np.zeros((rows.intervals, 3))
    _sum_ground(rows.knot[:flat], rows.jacobian, rows.weight, normals)
    normals = uniform_filter1d(normals, GROUND_SLICES, axis=0, mode="constant")
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    base, more, judged = np.zeros((3, rows.intervals, 6, 6))
    normal, unsure = _facing(rows, flat, place_m, voxel_m)

    def parts(piece: tuple[slice, slice]) -> tuple[RowArrays, Poses, tuple[Singles, Singles]]:
        few, seen = rows.some(piece), poses(piece[1])
        return few, seen, _parts(few, seen, normals, flat - piece[1].start)

    pieces = list(rows.pieces())
    # sums are taken in the order of the rows, whatever is made ahead
    for (of, _), (few, seen, (level, relief)) in zip(pieces, ahead(map(parts, pieces)), strict=True):
        _blocks(few.knot, level, few.weight, base)
        _blocks(few.knot[: len(relief)], relief, few.weight, more)
        _face(few, seen, len(relief), (normal[of], unsure[of]), level, judged)
        _blocks(few.knot, level, few.weight, judged)
    size = np.trace(judged[:, 3:, 3:], axis1=1, axis2=2)
    doubted = np.zeros(rows.intervals, np.bool_) if doubted is None else doubted
    least = INFLATION * np.where(doubted, SURE_HELD_M, TELLS_M) ** -2 / np.maximum(size, 1e-12)
    known = np.array([observable(*each) if each[0].any() else np.eye(6) for each in zip(judged, least, strict=True)])
    _steady(known, judged, doubted)
    affected = np.trace(known, axis1=1, axis2=2) < TOLD
    share = shares_of_relief(base, more)
    share[affected] = 0.0

    def take(at: int) -> None:
        few, seen, both = parts(pieces[at])
        _take(few, (known, share), both, seen.rotation)

    at_once(take, len(pieces))
    blind = affected & (known[:, 2, 2] < 0.5)
    if blind.any():
        weaker = np.ones(rows.intervals)
        weaker[blind] = 1.0 / (1.0 + SHAPE_SIGMA_RAD**2 * np.linalg.eigvalsh(base[blind, :3, :3])[:, 2])
        rows.weight *= weaker[rows.knot]
        rows.replane(voxel_m)


def _parts(rows: RowArrays, poses: Poses, normals: Array, flat: int) -> tuple[Singles, Singles]:
    """What `_level` makes of some rows, of which so many are of planes; the second is of these alone."""
    level = np.empty_like(rows.jacobian)
    relief = np.zeros_like(rows.jacobian[: max(flat, 0)])
    _level(rows.knot, rows.jacobian, poses, normals, level, relief)
    return level, relief


def _steady(known: Array, judged: Array, doubted: Mask) -> None:
    """Steady the projections `known` where it is doubted, by what the seconds around tell together.

    A slice that tells a direction which those around it do not tell together is believed no more than they are.
    """
    if not doubted.any():
        return
    near = gaussian_filter1d(doubted.astype(np.float64), STEADY_SLICES, mode="constant")
    around = np.where(doubted[:, None, None], judged, 0.0)
    around = gaussian_filter1d(around, STEADY_SLICES, axis=0, mode="constant")
    there = np.rint(np.trace(known, axis1=1, axis2=2))
    for k in np.flatnonzero(doubted & (near > 0.0)).tolist():
        mean = around[k] / near[k]
        turn, shift = np.trace(mean[:3, :3]), np.trace(mean[3:, 3:])
        if shift <= 0.0:
            continue
        # turns by what they move at the mean distance, as in `observable`
        scale = np.repeat([np.sqrt(shift / max(turn, 1e-12)), 1.0], 3)
        values, vectors = np.linalg.eigh(mean * scale * scale[:, None])
        if there[k] == 6 and values[0] > INFLATION * SURE_HELD_M**-2:
            continue
        missing = vectors[:, 0]
        # a shift along a wall turns nothing, and what noise adds of a turn would bend the path
        values, vectors = np.linalg.eigh(mean[3:, 3:])
        if values[0] <= INFLATION * SURE_HELD_M**-2:
            missing = np.concatenate([np.zeros(3), vectors[:, 0]])
        told = (np.eye(6) - np.outer(missing, missing)) * scale[:, None] / scale
        # what misses more than this direction misses it too
        known[k] = told if there[k] >= 5 else known[k] @ told


def _facing(rows: PlaneRows, flat: int, place_m: Array, voxel_m: float) -> tuple[Array, Array]:
    """Normals of the voxels as they face as a whole with those near by, shape (voxels, 3), and covariances; zero where none stands."""
    normal = np.asarray(rows.jacobian[rows.first[:-1], 3:], np.float64)
    stands = (rows.first[:-1] < flat) & (np.abs(normal[:, 2]) <= GROUND)
    tilt = 0.5 * INFLATION * (rows.inverse[:, 3] + rows.inverse[:, 5]) / voxel_m**2
    normal[~stands] = 0.0
    covariance = np.zeros((len(normal), 3, 3))
    normal[stands], covariance[stands] = mean_normals(
        place_m[stands], normal[stands], tilt[stands], FACING_VOXELS * voxel_m
    )
    return normal, covariance


@njit(cache=True, nogil=True)
def _face(
    rows: RowArrays, poses: Poses, flat: int, facing: tuple[Array, Array], out: Singles, judged: Array
) -> None:  # fmt: skip
    """Rows of planes that stand by rotation about the map's axes and by position, with the normals that they are judged by.

    What these are unsure of adds to the information by chance, and is taken off `judged`, shape (intervals, 6, 6).
    """
    rotation, xyz = poses.rotation, poses.xyz_m
    normals, covariances = facing
    by, some = np.zeros((3, 6)), np.empty(6)
    for c in range(3):
        by[c, 3 + c] = 1.0
    for v in range(len(rows.first) - 1):
        nx, ny, nz = normals[v]
        if nx == 0.0 and ny == 0.0 and nz == 0.0:
            continue
        for i in range(rows.first[v], min(rows.first[v + 1], flat)):
            m, k = rotation[i], rows.knot[i]
            x = m[0] * xyz[i, 0] + m[1] * xyz[i, 1] + m[2] * xyz[i, 2]
            y = m[3] * xyz[i, 0] + m[4] * xyz[i, 1] + m[5] * xyz[i, 2]
            z = m[6] * xyz[i, 0] + m[7] * xyz[i, 1] + m[8] * xyz[i, 2]
            by[0, 1], by[0, 2], by[1, 0], by[1, 2], by[2, 0], by[2, 1] = z, -y, -z, x, y, -x
            for c in range(6):
                out[i, c] = by[0, c] * nx + by[1, c] * ny + by[2, c] * nz
            for c in range(3):
                s = covariances[v, c]
                for a in range(6):
                    some[a] = s[0] * by[0, a] + s[1] * by[1, a] + s[2] * by[2, a]
                for a in range(6):
                    for b in range(6):
                        judged[k, a, b] -= rows.weight[i] * by[c, a] * some[b]


def shares_of_relief(base: Array, relief: Array) -> Array:
    """Matrices that take rows of the relief to what of them counts, shape (n, 6, 6).

    Parameters
    ----------
    base, relief : ndarray, shape (n, 6, 6)
        Information of all else, and of the relief; with the matrix M that is returned, M^T relief M is at most `RELIEF` times the former.
    """
    value, vector = np.linalg.eigh(base)
    half = np.sqrt(np.maximum(value, 1e-13 * value[:, -1:] + 1e-12))[:, None, :]
    narrow, wide = vector / half, vector * half
    share, axes = np.linalg.eigh(np.swapaxes(narrow, 1, 2) @ relief @ narrow)
    kept = np.sqrt(np.minimum(1.0, RELIEF / np.maximum(share, 1e-9)))[:, None, :]
    return np.asarray((narrow @ axes * kept) @ np.swapaxes(wide @ axes, 1, 2))


@njit(cache=True, nogil=True)
def _sum_ground(knot: Knots, jacobian: Singles, weight: Array, normals: Array) -> None:
    """Weighted sum of the ground's normals in each interval, up."""
    for i in range(len(knot)):
        if abs(jacobian[i, 5]) > GROUND:
            signed = weight[i] if jacobian[i, 5] > 0.0 else -weight[i]
            for c in range(3):
                normals[knot[i], c] += signed * jacobian[i, 3 + c]


@njit(cache=True, nogil=True)
def _level(knot: Knots, jacobian: Singles, poses: Poses, normals: Array, out: Singles, relief: Singles) -> None:
    """Rows by rotation about the map's axes and by position, those of ground with its mean normal; and what their own has beyond that."""
    rotation, xyz = poses.rotation, poses.xyz_m
    for i in range(len(jacobian)):
        m, j = rotation[i], jacobian[i]
        for r in range(3):
            out[i, r] = m[3 * r] * j[0] + m[3 * r + 1] * j[1] + m[3 * r + 2] * j[2]
            out[i, 3 + r] = j[3 + r]
        if i < len(relief) and abs(j[5]) > GROUND:
            relief[i] = out[i]
            side = 1.0 if j[5] > 0.0 else -1.0
            n = normals[knot[i]]
            nx, ny, nz = side * n[0], side * n[1], side * n[2]
            x = m[0] * xyz[i, 0] + m[1] * xyz[i, 1] + m[2] * xyz[i, 2]
            y = m[3] * xyz[i, 0] + m[4] * xyz[i, 1] + m[5] * xyz[i, 2]
            z = m[6] * xyz[i, 0] + m[7] * xyz[i, 1] + m[8] * xyz[i, 2]
            out[i, 0], out[i, 1], out[i, 2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            out[i, 3], out[i, 4], out[i, 5] = nx, ny, nz
            for c in range(6):
                relief[i, c] -= out[i, c]


@njit(cache=True, nogil=True)
def _take(rows: RowArrays, kept: tuple[Array, Array], parts: tuple[Singles, Singles], rotation: Singles) -> None:
    """Rows anew, of what is kept of both their parts, by rotation in the body again."""
    knot, jacobian = rows.knot, rows.jacobian
    (known, share), (level, relief) = kept, parts
    row = np.empty(6)
    for i in range(len(knot)):
        k = knot[i]
        row[:] = 0.0
        for a in range(6):
            for b in range(6):
                row[b] += level[i, a] * known[k, a, b]
                if i < len(relief):
                    row[b] += relief[i, a] * share[k, a, b]
        m = rotation[i]
        for c in range(3):
            jacobian[i, c] = m[c] * row[0] + m[3 + c] * row[1] + m[6 + c] * row[2]
            jacobian[i, 3 + c] = row[3 + c]


@njit(cache=True, nogil=True)
def _blocks(knot: Knots, jacobian: Any, weight: Array, out: Array) -> None:
    """Information of the rows of each interval."""
    for i in range(len(knot)):
        k = knot[i]
        for a in range(6):
            wa = weight[i] * jacobian[i, a]
            for b in range(6):
                out[k, a, b] += wa * jacobian[i, b]
