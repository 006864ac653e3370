"""What the lidar says: clusters on the planes of their voxels, each plane solved for within, so that only the path remains.

A plane of a voxel has an offset and two tilts. For given poses the best plane is linear in them, so it is put back into the residuals
(variable projection; Liu, Liu, Zhang, "Efficient and consistent bundle adjustment on lidar point clouds", 2023, in its idea). What
remains couples all slices that saw the voxel, however far apart in time; it is never written down, only applied to vectors.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy.ndimage import uniform_filter1d

from groundproc.estimation.observations.lasers import UNKNOWNS, LaserColumns, border_of, columns_of
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.odometry import GROUND, observable
from groundproc.estimation.odometry.spline import Path, basis
from groundproc.numerics.rotations import flattest, mat_of_quat
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

RANGE_SIGMA_M: Final = 0.02
"""Noise of a return (data sheet); what a voxel's own residuals show comes on top."""
ROUGHNESS_M: Final = 0.006
"""Roughness of a surface before its residuals tell, one sigma of a cluster [m]."""
TILT_PRIOR: Final = 0.3
"""What a plane's tilt may differ from that of its moments, one sigma [rad]: keeps narrow voxels solvable."""
HUBER: Final = 2.0
"""Sigmas beyond which a residual loses weight."""
CUT: Final = 5.0
"""Sigmas beyond which a cluster is none of this plane: moving things, mixed echoes."""
GROUND_SLICES: Final = 201
"""Slices whose ground makes one mean normal: were it each slice's own, its changes would seem to hold the place along the ground."""
SHAPE_SIGMA_RAD: Final = np.deg2rad(0.01)
"""What gyros of the lidar's class leave of the path's shape between two knots, 0.1 deg/sqrt(s) over a tenth of a second."""
PARTS: Final = 8
"""Pieces that the voxels are shared out in between cores."""


@dataclass(slots=True)
class Rows:
    """Distances of clusters from the planes of their voxels, linear in the path; sorted by voxel.

    Attributes
    ----------
    first : ndarray of int64, shape (voxels + 1,)
        Where each voxel's rows begin.
    knot : ndarray of int32, shape (n,)
        Interval that the cluster lies in.
    weights : ndarray of float32, shape (n, 4)
        Spline weights.
    jacobian : ndarray of float32, shape (n, 6)
        By rotation in the body and by position.
    plane : ndarray of float32, shape (n, 2)
        Coordinates along the plane, in voxels.
    weight : ndarray, shape (n,)
        1 / variance, less what the loss takes; 0 where cut.
    residual_m : ndarray, shape (n,)
        Distance from the voxel's mean plane.
    inverse : ndarray, shape (voxels, 6)
        Inverse of each plane's normal matrix: 00 01 02 11 12 22.
    cluster : ndarray of int64, shape (n,)
        Where each row's cluster stands.
    lasers : LaserColumns, optional
        By the corrections of the lasers, whose unknowns follow those of the path.
    """

    first: Ints
    knot: npt.NDArray[np.int32]
    weights: npt.NDArray[np.float32]
    jacobian: npt.NDArray[np.float32]
    plane: npt.NDArray[np.float32]
    weight: Array
    residual_m: Array
    inverse: Array
    cluster: Ints
    intervals: int
    lasers: LaserColumns | None = None

    def __len__(self) -> int:
        return len(self.knot)

    @property
    def path_size(self) -> int:
        """Unknowns of the path."""
        return (self.intervals + 3) * 6

    @property
    def size(self) -> int:
        """Unknowns of the path and of the lasers."""
        return self.path_size + (0 if self.lasers is None else UNKNOWNS)

    def apply(self, vector: Array) -> Array:
        """The normal matrix of the lidar times a vector, shape (size,)."""
        path = vector[: self.path_size]
        if self.lasers is None:
            return self._apply(path)
        lasers, corrections = self.lasers, vector[self.path_size :]
        return np.concatenate(
            [self._apply(path) + corrections @ lasers.border, lasers.border @ path + lasers.corner @ corrections]
        )

    def _apply(self, vector: Array) -> Array:
        out = np.zeros((PARTS, len(vector)))
        _apply(
            self.first,
            self.knot,
            self.weights,
            self.jacobian,
            self.plane,
            self.weight,
            self.inverse,
            vector.reshape(-1, 6),
            out,
        )
        return np.asarray(out.sum(axis=0))

    def gradient(self) -> Array:
        """Half the gradient of the cost, same shape."""
        return self.spread(self.residual_m)

    def spread(self, values_m: Array) -> Array:
        """The columns of all unknowns times values of the rows, shape (n,), weighed and less the best plane of each voxel."""
        out = np.zeros((PARTS, self.path_size))
        _gradient(
            self.first, self.knot, self.weights, self.jacobian, self.plane, self.weight, self.inverse, values_m, out
        )  # fmt: skip
        if self.lasers is None:
            return np.asarray(out.sum(axis=0))
        return np.concatenate([out.sum(axis=0), self.lasers.gradient(self._projected(values_m))])

    def along(self, vector: Array) -> Array:
        """The rows times a vector of unknowns, shape (n,)."""
        out = np.empty(len(self))
        _along(self.knot, self.weights, self.jacobian, vector[: self.path_size].reshape(-1, 6), out)
        return out if self.lasers is None else out + self.lasers.along(vector[self.path_size :])

    def seen(self, vector: Array) -> Array:
        """The transpose of `spread`: the rows times a vector, weighed and less the best plane of each voxel, shape (n,)."""
        return self._projected(self.along(vector))

    def _projected(self, values_m: Array) -> Array:
        out = np.empty(len(self))
        _project(self.first, self.plane, self.weight, self.inverse, values_m, out)
        return out

    def with_lasers(self, laser: npt.NDArray[np.int32], xyz_m: npt.NDArray[np.float32], normal: Array) -> None:
        """Take the corrections of the lasers in: each row's laser, its cluster and its plane's normal in the sensor frame."""
        lasers = columns_of(laser, xyz_m, normal)
        lasers.border, lasers.corner = np.zeros((UNKNOWNS, self.path_size)), np.zeros((UNKNOWNS, UNKNOWNS))
        border_of(
            self.first, self.knot, self.weights, self.jacobian, self.plane, self.weight, self.inverse, lasers.laser,
            lasers.change, lasers.border, lasers.corner,
        )  # fmt: skip
        self.lasers = lasers

    def band(self) -> Array:
        """The normal matrix were the planes known: of each interval's four coefficients, shape (intervals, 4, 4, 6, 6)."""
        out = np.zeros((self.intervals, 4, 4, 6, 6))
        _band(self.knot, self.weights, self.jacobian, self.weight, out)
        for a in range(6):
            out[:, :, :, a, :a] = out[:, :, :, :a, a]
        for i in range(4):
            out[:, i, :i] = out[:, :i, i]
        return out

    def cost(self) -> tuple[float, int]:
        """Weighted sum of squares left after the planes, and the rows that count."""
        return _cost(self.first, self.plane, self.weight, self.inverse, self.residual_m), int((self.weight > 0).sum())


def rows_of(clusters: Clusters, path: Path, voxel_m: float, most: int, cut: bool) -> Rows:
    """Put clusters into voxels where the path places them, find the planes, and linearise.

    Parameters
    ----------
    clusters : Clusters
    path : Path
    voxel_m : float
    most : int
        Rows of a slice; what has more is thinned, planes of rare direction last.
    cut : bool
        Whether rows beyond `CUT` sigmas are dropped: not while the path is still rough.
    """
    count = len(clusters)
    world, knot, weights = np.empty((count, 3)), np.empty(count, np.int32), np.empty((count, 4), np.float32)
    rotation = np.empty((count, 9), np.float32)
    _place(
        clusters.time_ns, clusters.xyz_m, path.start_ns, path.step_ns, path.quat, path.position_m, world, rotation, knot, weights
    )  # fmt: skip
    voxel, voxels = assign(world, voxel_m)
    order, first = sorted_by(voxel, voxels)
    normals, means, flat = np.empty((voxels, 3)), np.empty((voxels, 3)), np.empty(voxels)
    _planes(first, order, world, clusters.scatter_m2, clusters.count, knot, voxel_m, normals, means, flat)
    keep = _choose(first, order, knot, normals, flat, path.intervals, most)
    kept = order[keep]
    good = np.repeat(np.arange(voxels), np.diff(first))[keep]
    ids, at = np.unique(good, return_index=True)
    starts = np.append(at, len(good)).astype(np.int64)
    n = len(kept)
    jacobian, plane = np.empty((n, 6), np.float32), np.empty((n, 2), np.float32)
    weight, residual = np.empty(n), np.empty(n)
    inverse = np.empty((len(ids), 6))
    _linearise(
        starts, kept, world, rotation, clusters.xyz_m, clusters.scatter_m2, clusters.count, normals[ids], means[ids],
        voxel_m, cut, jacobian, plane, weight, residual, inverse,
    )  # fmt: skip
    rows = Rows(starts, knot[kept], weights[kept], jacobian, plane, weight, residual, inverse, kept, path.intervals)
    rotation, xyz = rotation[kept], clusters.xyz_m[kept]
    del world, knot, weights, voxel, order, good, keep  # a hundred bytes a cluster
    _drop_unobserved(rows, rotation, xyz, voxel_m)
    if clusters.laser is not None:
        normal = np.repeat(normals[ids], np.diff(starts), axis=0)
        in_sensor = np.einsum("nji,nj->ni", rotation.reshape(-1, 3, 3), normal)
        rows.with_lasers(clusters.laser[kept], xyz, in_sensor)
    return rows


def placed(clusters: Clusters, path: Path) -> tuple[Array, npt.NDArray[np.float32]]:
    """Where a path places clusters, shape (n, 3), and the matrices "local from sensor" that it does so with, shape (n, 9)."""
    count = len(clusters)
    world, rotation = np.empty((count, 3)), np.empty((count, 9), np.float32)
    knot, weights = np.empty(count, np.int32), np.empty((count, 4), np.float32)
    _place(
        clusters.time_ns, clusters.xyz_m, path.start_ns, path.step_ns, path.quat, path.position_m, world, rotation, knot, weights
    )  # fmt: skip
    return world, rotation


def assign(world_m: Array, voxel_m: float) -> tuple[npt.NDArray[np.int32], int]:
    """Number of the voxel of each point, and how many voxels there are."""
    table = np.full(1 << int(np.ceil(np.log2(max(4 * len(world_m), 1 << 12)))), -1, np.int32)
    voxel, voxels = _assign(world_m, voxel_m, table)
    return voxel, int(voxels)


def _drop_unobserved(
    rows: Rows, rotation: npt.NDArray[np.float32], xyz: npt.NDArray[np.float32], voxel_m: float
) -> None:
    """Take out of the rows of each interval the directions that its planes do not show, as the odometry does.

    Judged and taken out on the axes of the map: on those of a body that tilts within the interval, what is unseen would change with it,
    and each change of tilt would seem to tell a little of the heading. Where the heading is not seen at all, tilts count no more than
    the shape of the path between two knots is known: a gyro's offset about the vertical shows in them by the small part that a body
    leans, and what is far below that noise would settle it wrongly. `rotation` (local from sensor) and `xyz` are those of the rows'
    clusters.
    """
    normals, level = np.zeros((rows.intervals, 3)), np.empty_like(rows.jacobian)
    _sum_ground(rows.knot, rows.jacobian, rows.weight, normals)
    normals = uniform_filter1d(normals, GROUND_SLICES, axis=0, mode="constant")
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    _level(rows.knot, rows.jacobian, rotation, xyz, normals, level)
    blocks = np.zeros((rows.intervals, 6, 6))
    _blocks(rows.knot, level, rows.weight, blocks)
    known = np.array([observable(block) if block[3:, 3:].any() else np.eye(6) for block in blocks])
    affected = np.trace(known, axis1=1, axis2=2) < 5.5
    _keep_known(rows.knot, affected, known, level, rotation, rows.jacobian)
    blind = affected & (known[:, 2, 2] < 0.5)
    if blind.any():
        share = np.ones(rows.intervals)
        share[blind] = 1.0 / (1.0 + SHAPE_SIGMA_RAD**2 * np.linalg.eigvalsh(blocks[blind, :3, :3])[:, 2])
        rows.weight *= share[rows.knot]
        _replane(rows.first, rows.plane, rows.weight, rows.residual_m, voxel_m, rows.inverse)


@njit(cache=True, nogil=True)
def _sum_ground(knot: Any, jacobian: Any, weight: Any, normals: Any) -> None:
    """Weighted sum of the ground's normals in each interval, up."""
    for i in range(len(knot)):
        if abs(jacobian[i, 5]) > GROUND:
            signed = weight[i] if jacobian[i, 5] > 0.0 else -weight[i]
            for c in range(3):
                normals[knot[i], c] += signed * jacobian[i, 3 + c]


@njit(cache=True, nogil=True)
def _level(knot: Any, jacobian: Any, rotation: Any, xyz: Any, normals: Any, out: Any) -> None:
    """Rows by rotation about the map's axes and by position, those of ground with the ground's mean normal."""
    for i in range(len(jacobian)):
        m, j = rotation[i], jacobian[i]
        if abs(j[5]) > GROUND:
            side = 1.0 if j[5] > 0.0 else -1.0
            n = normals[knot[i]]
            nx, ny, nz = side * n[0], side * n[1], side * n[2]
            x = m[0] * xyz[i, 0] + m[1] * xyz[i, 1] + m[2] * xyz[i, 2]
            y = m[3] * xyz[i, 0] + m[4] * xyz[i, 1] + m[5] * xyz[i, 2]
            z = m[6] * xyz[i, 0] + m[7] * xyz[i, 1] + m[8] * xyz[i, 2]
            out[i, 0], out[i, 1], out[i, 2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            out[i, 3], out[i, 4], out[i, 5] = nx, ny, nz
        else:
            for r in range(3):
                out[i, r] = m[3 * r] * j[0] + m[3 * r + 1] * j[1] + m[3 * r + 2] * j[2]
                out[i, 3 + r] = j[3 + r]


@njit(cache=True, nogil=True)
def _keep_known(knot: Any, affected: Any, known: Any, level: Any, rotation: Any, jacobian: Any) -> None:
    """Rows of the affected intervals anew: what is known of them, by rotation in the body again."""
    row = np.empty(6)
    for i in range(len(knot)):
        k = knot[i]
        if not affected[k]:
            continue
        row[:] = 0.0
        for a in range(6):
            for b in range(6):
                row[b] += level[i, a] * known[k, a, b]
        m = rotation[i]
        for c in range(3):
            jacobian[i, c] = m[c] * row[0] + m[3 + c] * row[1] + m[6 + c] * row[2]
            jacobian[i, 3 + c] = row[3 + c]


@njit(cache=True, nogil=True)
def _place(
    time_ns: Any, xyz: Any, start_ns: int, step_ns: int, quat: Any, position: Any, world: Any, rotation: Any, knot: Any,
    weights: Any,
) -> None:  # fmt: skip
    m, a, b = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    last = len(quat) - 2
    intervals = (len(quat) - 1) // STEPS
    for n in range(len(time_ns)):
        g = (time_ns[n] - start_ns) / step_ns
        i = min(max(int(g), 0), last)
        u = g - i
        mat_of_quat(quat[i], a)
        mat_of_quat(quat[i + 1], b)
        for r in range(3):
            for c in range(3):
                m[r, c] = a[r, c] + u * (b[r, c] - a[r, c])
                rotation[n, 3 * r + c] = m[r, c]
            world[n, r] = position[i, r] + u * (position[i + 1, r] - position[i, r])
        for r in range(3):
            world[n, r] += m[r, 0] * xyz[n, 0] + m[r, 1] * xyz[n, 1] + m[r, 2] * xyz[n, 2]
        k = min(max(int(g / STEPS), 0), intervals - 1)
        knot[n] = k
        w0, w1, w2, w3 = basis(g / STEPS - k)
        weights[n, 0], weights[n, 1], weights[n, 2], weights[n, 3] = w0, w1, w2, w3


@njit(cache=True, nogil=True)
def _assign(world: Any, voxel_m: float, table: Any) -> Any:
    """Number of the voxel of each point, and how many there are."""
    voxel = np.empty(len(world), np.int32)
    keys = np.empty(len(world), np.int64)
    mask, per_m, found = len(table) - 1, 1.0 / voxel_m, 0
    for n in range(len(world)):
        key = voxel_key(world[n, 0], world[n, 1], world[n, 2], per_m)
        slot = spread(key) & mask
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            table[slot], keys[found] = found, key
            found += 1
        voxel[n] = table[slot]
    return voxel, found


@njit(cache=True, nogil=True)
def sorted_by(voxel: Any, voxels: int) -> Any:
    """Order of the points by voxel, and where each voxel begins."""
    first = np.zeros(voxels + 1, np.int64)
    for n in range(len(voxel)):
        first[voxel[n] + 1] += 1
    for v in range(voxels):
        first[v + 1] += first[v]
    order, at = np.empty(len(voxel), np.int64), first[:-1].copy()
    for n in range(len(voxel)):
        order[at[voxel[n]]] = n
        at[voxel[n]] += 1
    return order, first


@njit(cache=True, nogil=True)
def _planes(
    first: Any,
    order: Any,
    world: Any,
    scatter: Any,
    counts: Any,
    knot: Any,
    voxel_m: float,
    normals: Any,
    means: Any,
    flat: Any,
) -> None:
    """Plane of each voxel from the moments of its clusters; `flat` is the variance along the normal, negative where it is none."""
    s = np.empty(6)
    for v in range(len(first) - 1):
        flat[v] = -1.0
        rows = first[v + 1] - first[v]
        if rows < 3:
            continue
        total, x, y, z = 0.0, 0.0, 0.0, 0.0
        low_knot, high_knot = 1 << 30, -1
        for at in range(first[v], first[v + 1]):
            n = order[at]
            # a stop over one place must not outweigh a pass
            w = min(np.float64(counts[n]), 20.0)
            total += w
            x += w * world[n, 0]
            y += w * world[n, 1]
            z += w * world[n, 2]
            low_knot, high_knot = min(low_knot, knot[n]), max(high_knot, knot[n])
        if high_knot == low_knot or total < 12.0:
            continue
        x, y, z = x / total, y / total, z / total
        s[:] = 0.0
        for at in range(first[v], first[v + 1]):
            n = order[at]
            w = min(np.float64(counts[n]), 20.0)
            inside = w / counts[n]
            dx, dy, dz = world[n, 0] - x, world[n, 1] - y, world[n, 2] - z
            s[0] += inside * scatter[n, 0] + w * dx * dx
            s[1] += inside * scatter[n, 1] + w * dx * dy
            s[2] += inside * scatter[n, 2] + w * dx * dz
            s[3] += inside * scatter[n, 3] + w * dy * dy
            s[4] += inside * scatter[n, 4] + w * dy * dz
            s[5] += inside * scatter[n, 5] + w * dz * dz
        s /= total
        low, middle = flattest(s[0], s[1], s[2], s[3], s[4], s[5], normals[v])
        means[v, 0], means[v, 1], means[v, 2] = x, y, z
        if low < (0.04 + 0.02 * voxel_m) ** 2 and middle > (0.12 * voxel_m) ** 2 and low < 0.15 * middle:
            flat[v] = max(low, 0.0)


@njit(cache=True, nogil=True)
def _shares(bins: Any, most: int) -> Any:
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
def _choose(first: Any, order: Any, knot: Any, normals: Any, flat: Any, intervals: int, most: int) -> Any:
    """Positions in `order` of the rows to keep: of planes only, at most `most` of a slice.

    Rows are thinned by the direction of their planes, so that few walls count as much as all the ground.
    """
    bins = np.zeros((intervals, 4), np.int64)
    kind = np.empty(len(flat), np.int8)
    for v in range(len(flat)):
        a, b, c = abs(normals[v, 0]), abs(normals[v, 1]), abs(normals[v, 2])
        kind[v] = 3 if c > 0.9 else (2 if c > 0.5 else (0 if a > b else 1))
        if flat[v] < 0.0:
            continue
        for at in range(first[v], first[v + 1]):
            bins[knot[order[at]], kind[v]] += 1
    share = _shares(bins, most)
    keep = np.empty(len(order), np.int64)
    count = 0
    for v in range(len(flat)):
        if flat[v] < 0.0:
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
def _linearise(
    first: Any, rows: Any, world: Any, rotation: Any, xyz: Any, scatter: Any, counts: Any, normals: Any, means: Any, voxel_m: float,
    cut: bool, jacobian: Any, plane: Any, weight: Any, residual: Any, inverse: Any,
) -> None:  # fmt: skip
    variance = np.empty(len(rows))
    for v in range(len(first) - 1):
        nx, ny, nz = normals[v]
        # any two directions along the plane
        if abs(nz) < 0.9:
            length = np.sqrt(nx * nx + ny * ny)
            ax, ay, az = -ny / length, nx / length, 0.0
        else:
            length = np.sqrt(ny * ny + nz * nz)
            ax, ay, az = 0.0, nz / length, -ny / length
        bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        for i in range(first[v], first[v + 1]):
            n = rows[i]
            dx, dy, dz = world[n, 0] - means[v, 0], world[n, 1] - means[v, 1], world[n, 2] - means[v, 2]
            residual[i] = nx * dx + ny * dy + nz * dz
            plane[i, 0] = (ax * dx + ay * dy + az * dz) / voxel_m
            plane[i, 1] = (bx * dx + by * dy + bz * dz) / voxel_m
            r = rotation[n]
            p = nx * r[0] + ny * r[3] + nz * r[6]
            q = nx * r[1] + ny * r[4] + nz * r[7]
            s = nx * r[2] + ny * r[5] + nz * r[8]
            x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
            jacobian[i, 0], jacobian[i, 1], jacobian[i, 2] = y * s - z * q, z * p - x * s, x * q - y * p
            jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = nx, ny, nz
            # returns of one cluster spread across the plane more than their noise: two surfaces, or an edge
            t = scatter[n]
            across = (
                nx * (t[0] * nx + 2 * t[1] * ny + 2 * t[2] * nz) + ny * (t[3] * ny + 2 * t[4] * nz) + nz * t[5] * nz
            ) / counts[n]
            variance[i] = max(RANGE_SIGMA_M**2, across) / counts[n]
        _weigh(first[v], first[v + 1], variance, cut, plane, weight, residual, voxel_m, inverse[v])


@njit(cache=True, nogil=True)
def _weigh(
    start: int, end: int, variance: Any, cut: bool, plane: Any, weight: Any, residual: Any, voxel_m: float, inverse: Any
) -> None:
    """Weights of a voxel's rows, by the noise of the ranges, the roughness that they show and the loss; and its plane with them."""
    rough, d, a, b = ROUGHNESS_M**2, 0.0, 0.0, 0.0
    for attempt in range(3):
        for i in range(start, end):
            weight[i] = 1.0 / (variance[i] + rough)
            if attempt:
                e = _off_plane(i, plane, residual, d, a, b)
                z = abs(e) * np.sqrt(weight[i])
                if cut and attempt == 2 and z > CUT:
                    weight[i] = 0.0
                elif z > HUBER:
                    weight[i] *= HUBER / z
        d, a, b = _plane(start, end, plane, weight, residual, voxel_m, inverse)
        if attempt == 0:
            # what the residuals show beyond the noise of the ranges; four of the expected kind go before them
            squares, expected, count = 0.0, 0.0, 0
            for i in range(start, end):
                e = _off_plane(i, plane, residual, d, a, b)
                squares += min(e * e, 25.0 * (variance[i] + rough))
                expected += variance[i]
                count += 1
            rough = max((4.0 * ROUGHNESS_M**2 + squares - expected) / (max(count - 3, 0) + 4.0), 0.25 * ROUGHNESS_M**2)


@njit(cache=True, nogil=True)
def _replane(first: Any, plane: Any, weight: Any, residual: Any, voxel_m: float, inverse: Any) -> None:
    """Inverse of each plane's normal matrix for weights that have changed."""
    for v in range(len(first) - 1):
        _plane(first[v], first[v + 1], plane, weight, residual, voxel_m, inverse[v])


@njit(cache=True, nogil=True, inline="always")
def _off_plane(i: int, plane: Any, residual: Any, d: float, a: float, b: float) -> Any:
    return residual[i] - d - a * plane[i, 0] - b * plane[i, 1]


@njit(cache=True, nogil=True)
def _plane(start: int, end: int, plane: Any, weight: Any, residual: Any, voxel_m: float, inverse: Any) -> Any:
    """Offset and tilts of the best plane; `inverse` takes the inverse of its normal matrix."""
    prior = (voxel_m * TILT_PRIOR) ** -2.0
    n00, n01, n02, n11, n12, n22 = 1e-6, 0.0, 0.0, prior, 0.0, prior
    r0, r1, r2 = 0.0, 0.0, 0.0
    for i in range(start, end):
        w, a, b = weight[i], np.float64(plane[i, 0]), np.float64(plane[i, 1])
        n00 += w
        n01 += w * a
        n02 += w * b
        n11 += w * a * a
        n12 += w * a * b
        n22 += w * b * b
        r0 += w * residual[i]
        r1 += w * residual[i] * a
        r2 += w * residual[i] * b
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    det = n00 * c00 + n01 * c01 + n02 * c02
    inverse[0], inverse[1], inverse[2] = c00 / det, c01 / det, c02 / det
    inverse[3], inverse[4], inverse[5] = (
        (n00 * n22 - n02 * n02) / det,
        (n01 * n02 - n00 * n12) / det,
        (n00 * n11 - n01 * n01) / det,
    )
    return (
        inverse[0] * r0 + inverse[1] * r1 + inverse[2] * r2,
        inverse[1] * r0 + inverse[3] * r1 + inverse[4] * r2,
        inverse[2] * r0 + inverse[4] * r1 + inverse[5] * r2,
    )


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _apply(
    first: Any, knot: Any, weights: Any, jacobian: Any, plane: Any, weight: Any, inverse: Any, vector: Any, out: Any
) -> None:
    voxels = len(first) - 1
    for part in prange(PARTS):
        mine = out[part].reshape(-1, 6)
        scratch = np.empty(64)
        for v in range(voxels * part // PARTS, voxels * (part + 1) // PARTS):
            start, end = first[v], first[v + 1]
            if end - start > len(scratch):
                scratch = np.empty(2 * (end - start))
            r0, r1, r2 = 0.0, 0.0, 0.0
            for i in range(start, end):
                y = _row(i, knot, weights, jacobian, vector)
                scratch[i - start] = y
                y *= weight[i]
                r0 += y
                r1 += y * plane[i, 0]
                r2 += y * plane[i, 1]
            _spread_back(start, end, knot, weights, jacobian, plane, weight, inverse[v], r0, r1, r2, scratch, mine)


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _gradient(
    first: Any, knot: Any, weights: Any, jacobian: Any, plane: Any, weight: Any, inverse: Any, residual: Any, out: Any
) -> None:
    voxels = len(first) - 1
    for part in prange(PARTS):
        mine = out[part].reshape(-1, 6)
        scratch = np.empty(64)
        for v in range(voxels * part // PARTS, voxels * (part + 1) // PARTS):
            start, end = first[v], first[v + 1]
            if end - start > len(scratch):
                scratch = np.empty(2 * (end - start))
            r0, r1, r2 = 0.0, 0.0, 0.0
            for i in range(start, end):
                y = residual[i]
                scratch[i - start] = y
                y *= weight[i]
                r0 += y
                r1 += y * plane[i, 0]
                r2 += y * plane[i, 1]
            _spread_back(start, end, knot, weights, jacobian, plane, weight, inverse[v], r0, r1, r2, scratch, mine)


@njit(cache=True, nogil=True, fastmath=True)
def _along(knot: Any, weights: Any, jacobian: Any, vector: Any, out: Any) -> None:
    """Each row times a vector of the path's unknowns."""
    for i in range(len(knot)):
        out[i] = _row(i, knot, weights, jacobian, vector)


@njit(cache=True, nogil=True)
def _best_plane(start: int, end: int, plane: Any, weight: Any, inverse: Any, values: Any) -> Any:
    """Offset and tilts of the plane that fits the values of a voxel's rows best."""
    r0, r1, r2 = 0.0, 0.0, 0.0
    for i in range(start, end):
        y = weight[i] * values[i]
        r0 += y
        r1 += y * plane[i, 0]
        r2 += y * plane[i, 1]
    return (
        inverse[0] * r0 + inverse[1] * r1 + inverse[2] * r2,
        inverse[1] * r0 + inverse[3] * r1 + inverse[4] * r2,
        inverse[2] * r0 + inverse[4] * r1 + inverse[5] * r2,
    )


@njit(cache=True, nogil=True)
def _project(first: Any, plane: Any, weight: Any, inverse: Any, values: Any, out: Any) -> None:
    """Values of the rows less the best plane of each voxel, weighed."""
    for v in range(len(first) - 1):
        d, a, b = _best_plane(first[v], first[v + 1], plane, weight, inverse[v], values)
        for i in range(first[v], first[v + 1]):
            out[i] = weight[i] * _off_plane(i, plane, values, d, a, b)


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def _row(i: int, knot: Any, weights: Any, jacobian: Any, vector: Any) -> float:
    """One row times a vector."""
    k = knot[i]
    w0, w1, w2, w3 = weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3]
    y = 0.0
    for c in range(6):
        y += jacobian[i, c] * (
            w0 * vector[k, c] + w1 * vector[k + 1, c] + w2 * vector[k + 2, c] + w3 * vector[k + 3, c]
        )
    return y


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def _spread_back(
    start: int, end: int, knot: Any, weights: Any, jacobian: Any, plane: Any, weight: Any, inverse: Any, r0: float, r1: float,
    r2: float, scratch: Any, out: Any,
) -> None:  # fmt: skip
    """Take the best plane off the values of a voxel's rows, weigh them, and add their columns to `out`."""
    d = inverse[0] * r0 + inverse[1] * r1 + inverse[2] * r2
    a = inverse[1] * r0 + inverse[3] * r1 + inverse[4] * r2
    b = inverse[2] * r0 + inverse[4] * r1 + inverse[5] * r2
    for i in range(start, end):
        y = weight[i] * (scratch[i - start] - d - a * plane[i, 0] - b * plane[i, 1])
        k = knot[i]
        w0, w1, w2, w3 = y * weights[i, 0], y * weights[i, 1], y * weights[i, 2], y * weights[i, 3]
        for c in range(6):
            j = jacobian[i, c]
            out[k, c] += w0 * j
            out[k + 1, c] += w1 * j
            out[k + 2, c] += w2 * j
            out[k + 3, c] += w3 * j


@njit(cache=True, nogil=True)
def _blocks(knot: Any, jacobian: Any, weight: Any, out: Any) -> None:
    for i in range(len(knot)):
        k = knot[i]
        for a in range(6):
            wa = weight[i] * jacobian[i, a]
            for b in range(6):
                out[k, a, b] += wa * jacobian[i, b]


@njit(cache=True, nogil=True, fastmath=True)
def _band(knot: Any, weights: Any, jacobian: Any, weight: Any, out: Any) -> None:
    """The upper triangles of the blocks of each interval."""
    for n in range(len(knot)):
        block = out[knot[n]]
        for a in range(6):
            y = weight[n] * jacobian[n, a]
            for b in range(a, 6):
                z = y * jacobian[n, b]
                for i in range(4):
                    u = z * weights[n, i]
                    for j in range(i, 4):
                        block[i, j, a, b] += u * weights[n, j]


@njit(cache=True, nogil=True)
def _cost(first: Any, plane: Any, weight: Any, inverse: Any, residual: Any) -> float:
    total = 0.0
    for v in range(len(first) - 1):
        d, a, b = _best_plane(first[v], first[v + 1], plane, weight, inverse[v], residual)
        for i in range(first[v], first[v + 1]):
            total += weight[i] * _off_plane(i, plane, residual, d, a, b) ** 2
    return total
