"""What the lidar says: clusters on the planes of their voxels, as rows of the path (`numerics.planerows`)."""

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.observations.filled import filled_rows
from groundproc.estimation.observations.lasers import UNKNOWNS, LaserColumns, border_of, columns_of
from groundproc.estimation.observations.retiming import RetimingColumn, retiming_column
from groundproc.estimation.observations.spin import SpinColumns, spin_columns
from groundproc.estimation.observations.told import Poses, keep_told
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path, PathArrays
from groundproc.machine.system import give_back_memory
from groundproc.numerics.parts import at_once
from groundproc.numerics.planeproducts import RowArrays
from groundproc.numerics.planerows import PlaneRows
from groundproc.numerics.planes import Placed, VoxelPlanes, find_planes, scatter_along
from groundproc.numerics.rotations import mat_of_quat
from groundproc.numerics.splines import basis
from groundproc.numerics.voxelhash import assign, sorted_by, spread

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Knots = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

RANGE_SIGMA_M: Final = 0.02
"""Noise of a return (data sheet); what a voxel's own residuals show comes on top."""
ROUGHNESS_M: Final = 0.006
"""Roughness of a surface before its residuals tell, one sigma of a cluster [m]."""
_MANY: Final = 500_000
"""Rows from which on what was freed goes back to the system while they are made: a minute's, and tens of megabytes."""
_FEW: Final = 20_000
"""Clusters that are placed before a second thread has begun."""

Columns = LaserColumns | RetimingColumn | SpinColumns


@dataclass(slots=True)
class Rows(PlaneRows):
    """Rows of a path; corrections of the lasers, the delay of its gyro and the line of the spin are further unknowns where asked for.

    Attributes
    ----------
    more : list of Columns
        By further unknowns, which follow those of the path.
    border : ndarray, shape (further, path)
        Normal matrix between them and the path, planes solved for within.
    corner : ndarray, shape (further, further)
        The same of them alone.
    """

    more: "list[Columns]" = field(default_factory=list)
    border: Array = field(default_factory=lambda: np.zeros((0, 0)))
    corner: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def size(self) -> int:
        """Unknowns of the path, and further ones."""
        return self.path_size + len(self.corner)

    def apply(self, vector: Array) -> Array:
        """The normal matrix of the lidar times a vector, shape (size,)."""
        path, further = vector[: self.path_size], vector[self.path_size :]
        out = PlaneRows.apply(self, path)
        if not self.more:
            return out
        return np.concatenate([out + further @ self.border, self.border @ path + self.corner @ further])

    def apply_all(self, vectors: Array) -> Array:
        """The same of several vectors, shape (size, m)."""
        path, further = vectors[: self.path_size], vectors[self.path_size :]
        out = PlaneRows.apply_all(self, path)
        if not self.more:
            return out
        return np.concatenate([out + self.border.T @ further, self.border @ path + self.corner @ further])

    def spread(self, values_m: Array) -> Array:
        """The columns of all unknowns times values of the rows, shape (n,), weighed and less the best plane of each voxel."""
        if not self.more:
            return PlaneRows.spread(self, values_m)
        by_path, projected = self.spread_and_projected(values_m)
        return np.concatenate([by_path, self._gradient(projected)])

    def along(self, vector: Array) -> Array:
        """The rows times a vector of unknowns, shape (n,)."""
        out, at = PlaneRows.along(self, vector[: self.path_size]), self.path_size
        for each in self.more:
            out += each.along(vector[at : at + each.UNKNOWNS])
            at += each.UNKNOWNS
        return out

    def with_lasers(self, laser: npt.NDArray[np.int32], xyz_m: Singles, normal: Array) -> None:
        """Take the corrections of the lasers in: each row's laser, its cluster and its plane's normal in the sensor frame."""
        lasers = columns_of(laser, xyz_m, normal)
        border, corner = np.zeros((UNKNOWNS, self.path_size)), np.zeros((UNKNOWNS, UNKNOWNS))
        border_of(self.arrays, lasers.arrays, border, corner)
        self.more, self.border, self.corner = [lasers], border, corner

    def with_retiming(self, turning: Array, time_ns: Ints, path: Path) -> None:
        """Take the delay of the gyro in, after the lasers: what the path turns by for it, and the times of the clusters."""
        value = np.empty(len(self), np.float32)
        for _, part in self.pieces():
            value[part] = retiming_column(self.jacobian[part], turning, time_ns[self.cluster[part]], path).value
        self._with(RetimingColumn(value))

    def with_spin(self, xyz_m: Singles) -> None:
        """Take the line of the spin in, after these: the clusters in the sensor frame."""
        circle = np.empty((len(self), 2), np.float32)
        for _, part in self.pieces():
            circle[part] = spin_columns(self.jacobian[part], xyz_m[self.cluster[part]]).circle
        self._with(SpinColumns(self.jacobian[:, :3], circle))

    def _with(self, columns: "RetimingColumn | SpinColumns") -> None:
        path, before = self.path_size, len(self.corner)
        self.more = [*self.more, columns]
        products = np.array([self.spread(columns.column(number)) for number in range(columns.UNKNOWNS)])
        self.border = np.concatenate([self.border.reshape(-1, path), products[:, :path]])
        corner = np.zeros((before + columns.UNKNOWNS, before + columns.UNKNOWNS))
        corner[:before, :before], corner[before:] = self.corner, products[:, path:]
        corner[:before, before:] = corner[before:, :before].T
        self.corner = corner

    def _gradient(self, projected: Array) -> Array:
        return np.concatenate([each.gradient(projected) for each in self.more])


def rows_of(
    clusters: Clusters, path: Path, voxel_m: float, most: int, cut: bool, filled: int = 0, spin: bool = False, turning: Array | None = None,
    doubted: Mask | None = None,
) -> Rows:  # fmt: skip
    """Put clusters into voxels where the path places them, find the planes and what fills its voxel instead, and linearise.

    Parameters
    ----------
    clusters : Clusters
    path : Path
    voxel_m : float
    most : int
        Rows of a slice; what has more is thinned, planes of rare direction last.
    cut : bool
        Whether rows beyond `CUT` sigmas are dropped: not while the path is still rough.
    filled : int
        Clusters of a slice on what fills its voxel that are used.
    spin : bool
        Whether the line of the spin is an unknown.
    turning : ndarray, shape (grid, 3), optional
        What the path turns by for a second of its gyro's delay, where that is an unknown.
    doubted : ndarray of bool, shape (intervals,), optional
        As of `keep_told`.
    """
    world, _, knot, _ = _place_all(clusters, path, turns=False)
    voxel, voxels = assign(world, voxel_m)
    order, first = sorted_by(voxel, voxels)
    del voxel
    seen = Placed(world, clusters.scatter_m2, clusters.count, knot, np.empty(0, np.int32))
    planes = _planes_of(first, order, seen, voxel_m)
    keep = _choose(first, order, knot, planes, path.intervals, most)
    leaves = filled_rows(first, order, seen, voxel_m, planes.good, path.intervals, filled)
    flat = len(keep)
    kept = np.concatenate([order[keep], leaves.cluster], dtype=np.int32)
    good = np.repeat(np.arange(voxels, dtype=np.int32), np.diff(first))[keep]
    at = np.flatnonzero(np.diff(good, prepend=np.int32(-1)))
    starts = np.concatenate([at, flat + leaves.first]).astype(np.int64)
    normals = np.concatenate([planes.normal[good[at]], leaves.axis])
    means = np.concatenate([planes.mean_m[good[at]], leaves.mean_m])
    n, knots, of_leaves = len(kept), knot[kept], leaves.variance_m2
    # a window has millions of clusters: what all of them have goes before the rows come, and rows are made some at a time
    del world, knot, order, good, keep, seen, planes, leaves
    _make_room(n)
    rows = Rows(
        starts, knots, np.empty((n, 4), np.float32), np.empty((n, 6), np.float32), np.empty((n, 2), np.float32), np.empty(n), np.empty(n),
        np.empty((len(starts) - 1, 6)), kept, path.intervals,
    )  # fmt: skip
    variance = np.empty(n)
    pieces = list(rows.pieces())

    def fill(at: int, into: Array = variance) -> None:
        _fill(rows, pieces[at], clusters, path, (normals, means), into, voxel_m)

    at_once(fill, len(pieces))
    rows.plane[flat:], variance[flat:] = 0.0, of_leaves  # they have no tilts
    rows.weigh(variance, ROUGHNESS_M, cut, voxel_m)
    del variance, of_leaves, fill
    _make_room(n)

    def poses(part: slice) -> Poses:
        some = _instants(clusters, kept[part])
        return Poses(_place_all(some, path).rotation, some.xyz_m)

    keep_told(rows, poses, flat, voxel_m, means, doubted)
    if clusters.laser is not None:
        in_sensor = np.empty((n, 3))
        for of, part in rows.pieces():
            facing = np.repeat(normals[of], np.diff(starts)[of], axis=0)
            in_sensor[part] = np.einsum("nji,nj->ni", poses(part).rotation.reshape(-1, 3, 3), facing)
        rows.with_lasers(clusters.laser[kept], clusters.xyz_m[kept], in_sensor)
    _make_room(n)
    if turning is not None:
        rows.with_retiming(turning, clusters.time_ns, path)
    if spin:
        rows.with_spin(clusters.xyz_m)
    return rows


def _planes_of(first: Ints, order: Ints, seen: Placed, voxel_m: float) -> VoxelPlanes:
    """The planes of voxels whose clusters begin at `first` of an order, found half by each core."""
    voxels = len(first) - 1
    planes = VoxelPlanes.empty(voxels)

    def find(half: int) -> None:
        some = slice(half * voxels // 2, (half + 1) * voxels // 2)
        few = VoxelPlanes(planes.normal[some], planes.mean_m[some], planes.good[some])
        find_planes(first[some.start : some.stop + 1], order, seen, voxel_m, few)

    at_once(find, 2)
    return planes


def _fill(
    rows: Rows, some: tuple[slice, slice], clusters: Clusters, path: Path, voxels: tuple[Array, Array], variance: Array, voxel_m: float
) -> None:  # fmt: skip
    """Fill in some rows, those of some voxels: weights of the spline, jacobians, distances, and variances by the returns.

    `voxels` are the normals and the places of all.
    """
    of_voxels, part = some
    normals, means = (each[of_voxels] for each in voxels)
    few, none = _of(clusters, rows.cluster[part]), np.empty(0, np.int32)
    world, rotation, _, weights = _place_all(few, path)
    rows.weights[part] = weights
    seen = Placed(world, few.scatter_m2, few.count, none, none)
    rows.lay(np.arange(len(world)), seen, VoxelPlanes(normals, means, np.ones(len(means), np.bool_)), voxel_m, some)
    _linearise(rows.some(some), seen, Poses(rotation, few.xyz_m), normals, variance[part])


def _of(clusters: Clusters, which: Knots) -> Clusters:
    """Some clusters, by their numbers; without their lasers."""
    # take: a third of the time of indexing where rows are short
    return Clusters(
        clusters.time_ns.take(which),
        clusters.xyz_m.take(which, axis=0),
        clusters.scatter_m2.take(which, axis=0),
        clusters.count.take(which),
    )


def _instants(clusters: Clusters, which: Knots) -> Clusters:
    """When and where the sensor saw some clusters, by their numbers: no more of them is read."""
    none = Clusters.none()
    return Clusters(clusters.time_ns[which], clusters.xyz_m[which], none.scatter_m2, none.count)


def _make_room(rows: int) -> None:
    """Have what was freed go back, where so many rows are large."""
    if rows >= _MANY:
        give_back_memory()


def placed(clusters: Clusters, path: Path) -> tuple[Array, Singles]:
    """Where a path places clusters, shape (n, 3), and the matrices "local from sensor" that it does so with, shape (n, 9)."""
    world, rotation, _, _ = _place_all(clusters, path)
    return world, rotation


def places(clusters: Clusters, path: Path) -> Array:
    """The first of these, in less memory."""
    return _place_all(clusters, path, turns=False).world_m


class _Located(NamedTuple):
    """Where a path places clusters; what nobody asks for has no rows.

    Attributes
    ----------
    world_m : ndarray, shape (n, 3)
    rotation : ndarray of float32, shape (n, 9)
        Local from sensor, row by row.
    knot : ndarray of int32, shape (n,)
        Interval of the spline, and its weights there, float32, shape (n, 4).
    """

    world_m: Array
    rotation: Singles
    knot: npt.NDArray[np.int32]
    weights: Singles


def _place_all(clusters: Clusters, path: Path, turns: bool = True) -> _Located:
    """`turns`: with rotations and weights, two thirds of all."""
    count = len(clusters)
    turned = count if turns else 0
    out = _Located(
        np.empty((count, 3)), np.empty((turned, 9), np.float32), np.empty(count, np.int32), np.empty((turned, 4), np.float32)
    )  # fmt: skip
    if count < _FEW:
        _place(clusters.time_ns, clusters.xyz_m, path.arrays, out)
        return out

    def place(half: int) -> None:
        part = slice(half * count // 2, (half + 1) * count // 2)
        some = _Located(out.world_m[part], out.rotation[part], out.knot[part], out.weights[part])
        _place(clusters.time_ns[part], clusters.xyz_m[part], path.arrays, some)

    at_once(place, 2)
    return out


@njit(cache=True, nogil=True)
def _place(time_ns: Ints, xyz: Singles, path: PathArrays, out: _Located) -> None:
    quat, position = path.quat, path.position_m
    world, rotation, knot, weights = out.world_m, out.rotation, out.knot, out.weights
    m, a, b = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    last = len(quat) - 2
    intervals = (len(quat) - 1) // STEPS
    turns = len(rotation) > 0
    for n in range(len(time_ns)):
        g = (time_ns[n] - path.start_ns) / path.step_ns
        i = min(max(int(g), 0), last)
        u = g - i
        mat_of_quat(quat[i], a)
        mat_of_quat(quat[i + 1], b)
        for r in range(3):
            for c in range(3):
                m[r, c] = a[r, c] + u * (b[r, c] - a[r, c])
            world[n, r] = position[i, r] + u * (position[i + 1, r] - position[i, r])
        for r in range(3):
            world[n, r] += m[r, 0] * xyz[n, 0] + m[r, 1] * xyz[n, 1] + m[r, 2] * xyz[n, 2]
        k = min(max(int(g / STEPS), 0), intervals - 1)
        knot[n] = k
        if turns:
            for r in range(3):
                for c in range(3):
                    rotation[n, 3 * r + c] = m[r, c]
            w0, w1, w2, w3 = basis(g / STEPS - k)
            weights[n, 0], weights[n, 1], weights[n, 2], weights[n, 3] = w0, w1, w2, w3


@njit(cache=True, nogil=True)
def _shares(bins: Ints, most: int) -> Array:
    """Part of each slice's rows to keep by direction: even numbers, and what one direction does not use goes to the others."""
    share = np.empty(bins.shape)
    for k in range(len(bins)):
        left, open_bins = np.float64(most), 4
        share[k, :] = -1.0
        for _ in range(4):
            level = left / max(open_bins, 1)
            changed = False
            for b in range(4):
                if share[k, b] < 0.0 and bins[k, b] <= level:
                    share[k, b] = 1.0
                    left -= bins[k, b]
                    open_bins -= 1
                    changed = True
            if not changed:
                break
        for b in range(4):
            if share[k, b] < 0.0:
                share[k, b] = left / open_bins / bins[k, b]
    return share


@njit(cache=True, nogil=True)
def _choose(first: Ints, order: Ints, knot: Knots, planes: VoxelPlanes, intervals: int, most: int) -> Ints:
    """Positions in `order` of the rows to keep: of planes only, at most `most` of a slice.

    Rows are thinned by the direction of their planes, so that few walls count as much as all the ground.
    """
    normals, good = planes.normal, planes.good
    bins = np.zeros((intervals, 4), np.int64)
    kind = np.empty(len(good), np.int8)
    for v in range(len(good)):
        a, b, c = abs(normals[v, 0]), abs(normals[v, 1]), abs(normals[v, 2])
        kind[v] = 3 if c > 0.9 else (2 if c > 0.5 else (0 if a > b else 1))
        if not good[v]:
            continue
        for at in range(first[v], first[v + 1]):
            bins[knot[order[at]], kind[v]] += 1
    share = _shares(bins, most)
    keep = np.empty(len(order), np.int64)
    count = 0
    for v in range(len(good)):
        if not good[v]:
            continue
        start = count
        for at in range(first[v], first[v + 1]):
            p = share[knot[order[at]], kind[v]]
            # a draw by voxel, the same in every run, so that the voxels kept are seen by many slices
            if p >= 1.0 or (spread(v * 2654435761) & 0xFFFFF) < p * 0x100000:
                keep[count] = at
                count += 1
        if count - start < 2:
            count = start
    return keep[:count]


@njit(cache=True, nogil=True)
def _linearise(rows: RowArrays, seen: Placed, poses: Poses, normals: Array, variance: Array) -> None:
    """Fill in jacobians of rows, and the variance of each by its returns [m^2].

    `seen` and `poses` are the clusters of the rows, `normals` those of the voxels that they lie in.
    """
    first, jacobian = rows.first, rows.jacobian
    scatter, counts, rotation, xyz = seen.scatter_m2, seen.returns, poses.rotation, poses.xyz_m
    for v in range(len(first) - 1):
        nx, ny, nz = normals[v]
        for i in range(first[v], first[v + 1]):
            r = rotation[i]
            p = nx * r[0] + ny * r[3] + nz * r[6]
            q = nx * r[1] + ny * r[4] + nz * r[7]
            s = nx * r[2] + ny * r[5] + nz * r[8]
            x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            jacobian[i, 0], jacobian[i, 1], jacobian[i, 2] = y * s - z * q, z * p - x * s, x * q - y * p
            jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = nx, ny, nz
            # returns of one cluster spread across the plane more than their noise: two surfaces, or an edge
            across = scatter_along(scatter[i], nx, ny, nz) / counts[i]
            variance[i] = max(RANGE_SIGMA_M**2, across) / counts[i]
