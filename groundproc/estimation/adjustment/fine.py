"""The motion between the knots: rotations every 5 ms from all that the lidar sees, constrained by the carrying gyro.

Between two knots of the batch, a tenth of a second apart, the path has the gyro's motion with the gyro's noise. That
noise is white, plus vibration faster than the sampling, which aliases. The batch uses a part of the lidar's clusters
and cannot follow it. Here the flight is streamed once more, some seconds at a time, once the path is right. All
clusters of these seconds make a map of planes, placed by the path. The distance of each cluster from its plane then
tells of the rotation at its moment. With the gyro's noise this is a chain of unknowns, each tied to the next: one
banded system.

The slow part of the path is the batch's and stays. Errors are taken to be those of a gyro that something brings back
within a tenth of a second (an Ornstein-Uhlenbeck process). Where the lidar sees nothing, the path stays as it is.
Positions are not changed.
"""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.linalg import solveh_banded

from flightlog import frames
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.odometry import Odometry
from groundproc.estimation.odometry.slices import Clusterer, Slice
from groundproc.estimation.odometry.spline import Path, PathArrays
from groundproc.estimation.odometry.voxels import COUNT, FLATNESS, LEVEL, MEAN, NORMAL, TILT, MapArrays, PlaneMap, find
from groundproc.machine.readahead import ahead
from groundproc.numerics.parts import at_once
from groundproc.numerics.rotations import mat_of_quat
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

CHUNK: Final = 200
"""Slices that make a map of their own: twenty seconds see a surface many times, and have some hundred megabytes."""
RANGE_SIGMA_M: Final = 0.02
"""Noise of a return (data sheet)."""
ROUGH_SIGMA_M: Final = 0.003
"""What a plane of many returns is off at least, one sigma."""
CLEAN_SIGMA_M: Final = 0.015
"""Returns scatter by this about a plane that is one; what is beyond it is common to a cluster."""
FEWEST: Final = 60.0
"""Returns of a plane: one of few would follow those that it is to judge."""
GATE_M: Final = 0.15
HUBER: Final = 2.0
"""Sigmas beyond which a cluster loses weight."""
SURE_RAD: Final = np.deg2rad(0.002)
"""How closely a part of the flight goes on where the one before ended."""
BACK_S: Final = 0.1
"""Within so long the path's knots bring errors back."""
_KEPT: Final = np.dtype([("time_ns", "<i8"), ("xyz", "<f4", (3,)), ("count", "<i4")])
"""Of a slice's clusters: numpy's choice of fields keeps the room of the others."""


def refined(path: Path, pieces: Iterable[Slice], grid_ns: int, density: float, voxel_m: float) -> Path:
    """The path with its turns between the knots.

    Parameters
    ----------
    path : Path
        Right but for these.
    pieces : iterable of Slice
        Of the flight, in order of time.
    grid_ns : int
        From where slices are numbered [UTC].
    density : float
        Noise of the gyro that carries the motion [rad/sqrt(s)].
    voxel_m : float
        Edge of the voxels whose planes make the map.
    """
    turns = np.zeros((len(path.quat), 3))
    clusters: list[npt.NDArray[np.void]] = []
    planes, first, last = PlaneMap(voxel_m), 0, 0
    with contextlib.closing(ahead(_clustered(path, pieces, grid_ns, Clusterer(voxel_m)))) as made:
        for at, found, world in made:
            if at < first:
                continue
            if clusters and at - first >= CHUNK * STEPS:
                _turn(path, slice(first, last), turns, clusters, planes, density)
                clusters, planes = [], PlaneMap(voxel_m)
            if not clusters:
                first = at
            last = at + STEPS + 1
            planes.insert(world, found, Odometry.MOST, judged=False)
            clusters.append(found[list(_KEPT.names or ())].astype(_KEPT))
    if clusters:
        _turn(path, slice(first, last), turns, clusters, planes, density)
    return replace(path, quat=frames.quat_multiply(path.quat, frames.quat_exp(turns)))


def _clustered(
    path: Path, pieces: Iterable[Slice], grid_ns: int, cluster: Clusterer
) -> Iterator[tuple[int, npt.NDArray[np.void], Array]]:
    """Clusters of the slices that the path covers, in order, where it places them, and the grid step at which each slice begins.

    They do not depend on the map, and so are made while it takes those before.
    """
    for piece in pieces:
        at = int((grid_ns + piece.number * SLICE_NS - path.start_ns) // STEP_NS)
        if at < 0 or at + STEPS >= len(path.quat) or not len(piece.xyz_m):
            continue
        start_ns, here = path.start_ns + at * STEP_NS, slice(at, at + STEPS + 1)
        yield at, *cluster(piece, start_ns, path.quat[here], path.position_m[here])


def _turn(
    path: Path, here: slice, turns: Array, clusters: list[npt.NDArray[np.void]], planes: PlaneMap, density: float
) -> None:
    """Find the turns of a part of the grid; its first goes on from what the part before found there, if that was next to it."""
    part = Path(path.start_ns + here.start * STEP_NS, path.quat[here], path.position_m[here])
    planes.judge()
    diagonal, beside = gyro_information(part.quat, density)
    pull = np.zeros((len(part.quat), 3))
    if turns[here.start].any():
        diagonal[0] += np.eye(3) / SURE_RAD**2
        pull[0] -= turns[here.start] / SURE_RAD**2

    def add(some: Sequence[npt.NDArray[np.void]]) -> None:
        for each in some:
            _add(each["time_ns"], each["xyz"], each["count"], part.arrays, planes.arrays, (diagonal, beside, pull))

    parts = apart(clusters)
    at_once(lambda number: add(parts[number]), 2)
    add(parts[2])
    turns[here] = solved(diagonal, beside, -pull)


def apart(clusters: Sequence[npt.NDArray[np.void]]) -> list[Sequence[npt.NDArray[np.void]]]:
    """Slices in three: two parts that share no pose of the grid and may be added at once, and what lies between them.

    Where slices are not in the order of time, all lie between.
    """
    middle = len(clusters) // 2
    parts: list[Sequence[npt.NDArray[np.void]]] = [
        clusters[:middle],
        clusters[middle + 1 :],
        clusters[middle : middle + 1],
    ]
    times = [np.concatenate([each["time_ns"] for each in some]) if some else np.empty(0, np.int64) for some in parts]
    first, last, between = times
    if not (len(first) and len(last) and len(between)):
        return [[], [], clusters]
    # a cluster touches the poses before and after it; a slice lies between the parts, and is more than two steps of the grid
    if last.min() - first.max() < 3 * STEP_NS:
        return [[], [], clusters]
    return parts


def gyro_information(quat: Array, density: float) -> tuple[Array, Array]:
    """What a gyro's noise says of errors of attitudes in the body: blocks on the diagonal, (n, 3, 3), and beside it, (n - 1, 3, 3)."""
    step_s = STEP_NS * 1e-9
    keep, variance = np.exp(-step_s / BACK_S), 0.5 * density**2 * BACK_S
    tie = 1.0 / (variance * (1.0 - keep**2))
    diagonal = np.zeros((len(quat), 3, 3))
    diagonal[0] = np.eye(3) / variance
    diagonal[1:] += tie * np.eye(3)
    diagonal[:-1] += tie * keep**2 * np.eye(3)
    turn = frames.mat_from_quat(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:]))
    return diagonal, -tie * keep * turn


def solved(diagonal: Array, beside: Array, right: Array) -> Array:
    """Solution of a symmetric block-tridiagonal system, shape (n, 3)."""
    band = np.zeros((6, 3 * len(diagonal)))
    for row in range(3):
        for column in range(3):
            if column >= row:
                band[5 + row - column, column::3] = diagonal[:, row, column]
            band[2 + row - column, 3 + column :: 3] = beside[:, row, column]
    return np.asarray(solveh_banded(band, right.ravel())).reshape(-1, 3)


@njit(cache=True, nogil=True)
def _add(
    time_ns: Ints, xyz: npt.NDArray[np.float32], returns: npt.NDArray[np.int32], path: PathArrays, planes: MapArrays,
    system: tuple[Array, Array, Array],
) -> None:  # fmt: skip
    """Add what clusters say of the turns at the grid's poses before and after them."""
    table, keys, voxels, voxel_m = planes
    diagonal, beside, pull = system
    before, after, mat, place, j = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for n in range(len(time_ns)):
        g = (time_ns[n] - path.start_ns) / path.step_ns
        i = int(g)
        if g < 0.0 or i >= len(path.quat) - 1:
            continue
        share = g - i
        mat_of_quat(path.quat[i], before)
        mat_of_quat(path.quat[i + 1], after)
        for r in range(3):
            place[r] = path.position_m[i, r] + share * (path.position_m[i + 1, r] - path.position_m[i, r])
            for c in range(3):
                mat[r, c] = before[r, c] + share * (after[r, c] - before[r, c])
                place[r] += mat[r, c] * xyz[n, c]
        row = find(table, keys, voxel_key(place[0], place[1], place[2], 1.0 / voxel_m))
        if row < 0 or voxels[row, FLATNESS] < 0.0 or voxels[row, COUNT] < FEWEST:
            continue
        v = voxels[row]
        off, away = -v[LEVEL], 0.0
        for c in range(3):
            off += v[NORMAL + c] * place[c]
            away += (place[c] - v[MEAN + c]) ** 2
        if abs(off) > GATE_M:
            continue
        variance = max(RANGE_SIGMA_M**2, v[FLATNESS]) / returns[n] + max(v[FLATNESS] - CLEAN_SIGMA_M**2, 0.0)
        variance += ROUGH_SIGMA_M**2 + v[TILT] * away
        weight = min(1.0, HUBER * np.sqrt(variance) / max(abs(off), 1e-9)) / variance
        x = mat[0, 0] * v[NORMAL] + mat[1, 0] * v[NORMAL + 1] + mat[2, 0] * v[NORMAL + 2]
        y = mat[0, 1] * v[NORMAL] + mat[1, 1] * v[NORMAL + 1] + mat[2, 1] * v[NORMAL + 2]
        z = mat[0, 2] * v[NORMAL] + mat[1, 2] * v[NORMAL + 1] + mat[2, 2] * v[NORMAL + 2]
        j[0], j[1], j[2] = xyz[n, 1] * z - xyz[n, 2] * y, xyz[n, 2] * x - xyz[n, 0] * z, xyz[n, 0] * y - xyz[n, 1] * x
        for a in range(3):
            pull[i, a] += weight * (1.0 - share) * off * j[a]
            pull[i + 1, a] += weight * share * off * j[a]
            for b in range(3):
                both = weight * j[a] * j[b]
                diagonal[i, a, b] += (1.0 - share) ** 2 * both
                diagonal[i + 1, a, b] += share**2 * both
                beside[i, a, b] += share * (1.0 - share) * both
