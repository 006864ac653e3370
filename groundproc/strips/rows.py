"""Distances of clusters from the planes of their voxels, as rows for the adjustment.

Unlike within one flight, strips may lie decimetres apart to begin with. So a plane's direction and flatness come from the scatter within
each strip, pooled: strips that do not lie on each other yet do not make a surface thick.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.numerics.planeproducts import RowArrays, solved_plane
from groundproc.numerics.planerows import PlaneRows
from groundproc.numerics.planes import Placed, VoxelPlanes, find_planes, scatter_along
from groundproc.numerics.voxelhash import voxel_key
from groundproc.strips.correction import Correction

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Knots = npt.NDArray[np.int32]

NOISE_M: Final = 0.03
"""Noise of a point before the scatter of the clusters tells, one sigma [m]; counts as much as four points."""
ROUGHNESS_M: Final = 0.01
"""Roughness of surfaces before their residuals tell, one sigma of a cluster [m]."""
CONTROL: Final = -2
"""Strip of a control point."""
MOST_INTERVALS_SEEN: Final = 24
"""Intervals between knots from which one voxel is taken to be seen, at most."""


@dataclass(slots=True)
class Bordered:
    """Rows, and what they say about constants.

    Attributes
    ----------
    rows : PlaneRows
        By the splines.
    constants : ndarray, shape (n, m)
        Columns of the constants.
    projected : ndarray, shape (n, m)
        The same, weighted, with the planes taken out.
    names : dict of str to slice
    deflation : float
    """

    rows: PlaneRows
    constants: Array
    projected: Array
    names: dict[str, slice]

    def normal(self) -> Array:
        """Lower triangle of the normal matrix of splines and constants, planes taken out, shape (path + m, path + m)."""
        rows = self.rows
        size, wide = (rows.intervals + 3) * 6, self.constants.shape[1]
        out = np.zeros((size + wide, size + wide))
        _normal(rows.arrays, out)
        for k in range(wide):
            out[size + k, :size] = rows.spread(np.ascontiguousarray(self.constants[:, k]))
        out[size:, size:] = self.constants.T @ self.projected
        return out

    def right(self, value: Array) -> Array:
        """Half a gradient for distances, shape (n,), by splines and constants."""
        return np.concatenate([self.rows.spread(value), self.projected.T @ value])


def bordered(
    clusters: npt.NDArray[np.void], correction: Correction, voxel_m: float, roughness_m: float, cut: bool, constants: list[str],
    control_sigma_m: Array,
) -> Bordered | None:  # fmt: skip
    """Put clusters into voxels where the correction places them, find the planes, and linearise; None where there is no plane.

    Parameters
    ----------
    clusters : ndarray of clusters.CLUSTER
    correction : Correction
    voxel_m : float
    roughness_m : float
        What surfaces may depart from planes in such voxels, one sigma.
    cut : bool
        Whether what lies far off its plane is dropped.
    constants : list of str
        Names of the constants that are unknown: "boresight_rad", "lever_m", "shift_m".
    control_sigma_m : ndarray, shape (n,)
        Of control points; 0 for clusters.
    """
    time_ns, quat = np.ascontiguousarray(clusters["time_ns"]), clusters["quat"].astype(np.float64)
    move, arm = correction.moved(time_ns, clusters["arm"].astype(np.float64), quat)
    fixed = control_sigma_m > 0
    move[fixed] = 0.0
    knot, weights = correction.located(time_ns)
    seen = Placed(
        clusters["place"] + move, np.ascontiguousarray(clusters["scatter"]), np.ascontiguousarray(clusters["count"]), knot,
        np.ascontiguousarray(clusters["strip"]),
    )  # fmt: skip
    order, first = _by_voxel(seen.world_m, voxel_m)
    planes = VoxelPlanes.empty(len(first) - 1)
    find_planes(first, order, seen, voxel_m, planes)
    good = planes.good
    if not good.any():
        return None
    size = np.diff(first)
    kept = order[np.repeat(good, size)]
    starts = np.concatenate([[0], np.cumsum(size[good])]).astype(np.int64)
    kept, starts = _thinned(starts, kept, knot, seen.group)
    n = len(kept)
    rows = PlaneRows(
        starts, knot[kept], weights[kept], np.empty((n, 6), np.float32), np.empty((n, 2), np.float32), np.empty(n), np.empty(n),
        np.empty((len(starts) - 1, 6)), kept, correction.intervals,
    )  # fmt: skip
    chosen, variance = VoxelPlanes(planes.normal[good], planes.mean_m[good], good[good]), np.empty(n)
    rows.lay(kept, seen, chosen, voxel_m)
    _linearise(rows.arrays, kept, seen, _Arms(arm, control_sigma_m), chosen.normal, variance)
    rows.weigh(variance, roughness_m, cut, voxel_m)
    return _with_constants(rows, quat[kept], constants)


class _Arms(NamedTuple):
    """What the kernel needs of clusters besides `Placed`.

    Attributes
    ----------
    arm_m : ndarray, shape (n, 3)
        From the scanner to the cluster, map axes.
    control_sigma_m : ndarray, shape (n,)
        Of control points, which do not move; 0 for clusters.
    """

    arm_m: Array
    control_sigma_m: Array


def _with_constants(rows: PlaneRows, quat: Array, constants: list[str]) -> Bordered:
    mats = frames.mat_from_quat(quat).astype(np.float32)
    columns: list[Array] = []
    names: dict[str, slice] = {}
    for name in constants:
        part = rows.jacobian[:, :3] if name == "boresight_rad" else rows.jacobian[:, 3:]
        names[name] = slice(3 * len(columns), 3 * len(columns) + 3)
        columns.append(part.astype(np.float64) if name == "shift_m" else np.einsum("ni,nij->nj", part, mats))
    together = np.concatenate(columns, axis=1).astype(np.float64) if columns else np.zeros((len(rows), 0))
    projected = np.empty_like(together)
    for k in range(together.shape[1]):
        projected[:, k] = rows.projected(np.ascontiguousarray(together[:, k]))
    return Bordered(rows, together, projected, names)


def _by_voxel(world: Array, voxel_m: float) -> tuple[Ints, Ints]:
    """Order of the clusters by voxel, those of a voxel in order of time, and where each voxel begins."""
    keys = np.empty(len(world), np.int64)
    _voxels(world, voxel_m, keys)
    order = np.argsort(keys, kind="stable")
    new = np.flatnonzero(np.diff(keys[order])) + 1
    return order, np.concatenate([[0], new, [len(order)]]).astype(np.int64)


@njit(cache=True, nogil=True)
def _voxels(world: Array, voxel_m: float, keys: Ints) -> None:
    for n in range(len(world)):
        keys[n] = voxel_key(world[n, 0], world[n, 1], world[n, 2], 1.0 / voxel_m)


@njit(cache=True, nogil=True)
def _thinned(first: Ints, rows: Ints, knot: Knots, strip: Knots) -> Any:
    """Rows of at most `MOST_INTERVALS_SEEN` intervals of each voxel, evenly chosen: a hover sees the same voxels all the time.

    Control points are kept, in whatever interval they stand.
    """
    out, starts, count = np.empty(len(rows), np.int64), np.empty(len(first), np.int64), 0
    for v in range(len(first) - 1):
        starts[v] = count
        distinct = 0
        for i in range(first[v], first[v + 1]):
            distinct += i == first[v] or knot[rows[i]] != knot[rows[i - 1]]
        stride, number = (distinct + MOST_INTERVALS_SEEN - 1) // MOST_INTERVALS_SEEN, -1
        for i in range(first[v], first[v + 1]):
            number += i == first[v] or knot[rows[i]] != knot[rows[i - 1]]
            if (number + v) % stride == 0 or strip[rows[i]] == CONTROL:
                out[count] = rows[i]
                count += 1
    starts[-1] = count
    return out[:count], starts


@njit(cache=True, nogil=True)
def _normal(rows: RowArrays, out: Array) -> None:
    """Lower triangle of the normal matrix of the splines: that for known planes, less what finding the planes costs."""
    first, knot = rows.first, rows.knot
    most = 4 * (MOST_INTERVALS_SEEN + 1)
    coefficients, sums = np.empty(most, np.int64), np.empty((most, 6, 3))
    for v in range(len(first) - 1):
        used = 0
        for i in range(first[v], first[v + 1]):
            k = np.int64(knot[i])
            # rows are in order of time: what this interval adds to the coefficients comes last
            new = k if used == 0 else max(coefficients[used - 1] + 1, k)
            for one in range(new, k + 4):
                coefficients[used] = one
                sums[used] = 0.0
                used += 1
            at = used - 1
            while coefficients[at] != k:
                at -= 1
            _add_row(i, rows, sums[at : at + 4], out[6 * k : 6 * k + 24, 6 * k :])
        _take_planes(coefficients[:used], sums, rows.inverse[v], out)


@njit(cache=True, nogil=True)
def _add_row(i: int, rows: RowArrays, sums: Array, out: Array) -> None:
    """Add a row's products with itself, below the diagonal, and with the plane's three columns."""
    weights, jacobian, plane, weight = rows.weights[i], rows.jacobian[i], rows.plane[i], rows.weight[i]
    for j in range(4):
        for c in range(6):
            value = weight * weights[j] * jacobian[c]
            sums[j, c, 0] += value
            sums[j, c, 1] += value * plane[0]
            sums[j, c, 2] += value * plane[1]
            for m in range(j + 1):
                for d in range(6):
                    out[6 * j + c, 6 * m + d] += value * weights[m] * jacobian[d]


@njit(cache=True, nogil=True)
def _take_planes(coefficients: Ints, sums: Array, inverse: Array, out: Array) -> None:
    """Take off what finding a voxel's plane costs."""
    for one in range(len(coefficients)):
        for c in range(6):
            x, y, z = solved_plane(inverse, sums[one, c, 0], sums[one, c, 1], sums[one, c, 2])
            here = out[coefficients[one] * 6 + c]
            for other in range(one + 1):
                place = coefficients[other] * 6
                for d in range(6):
                    t = sums[other, d]
                    here[place + d] -= x * t[0] + y * t[1] + z * t[2]


@njit(cache=True, nogil=True)
def _linearise(rows: RowArrays, kept: Ints, seen: Placed, arms: _Arms, normals: Array, variance: Array) -> None:
    """Fill in jacobians of rows, and the variance of each by its points [m^2].

    `kept` has the cluster of each row, `normals` are those of the voxels that the rows have.
    """
    first, jacobian = rows.first, rows.jacobian
    scatter, counts, arm, control = seen.scatter_m2, seen.returns, arms.arm_m, arms.control_sigma_m
    for v in range(len(first) - 1):
        nx, ny, nz = normals[v]
        across, spare = 4.0 * NOISE_M**2, 4.0
        for i in range(first[v], first[v + 1]):
            n = kept[i]
            x, y, z = arm[n, 0], arm[n, 1], arm[n, 2]
            moves = 0.0 if control[n] > 0.0 else 1.0
            jacobian[i, 0], jacobian[i, 1] = moves * (y * nz - z * ny), moves * (z * nx - x * nz)
            jacobian[i, 2] = moves * (x * ny - y * nx)
            jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = moves * nx, moves * ny, moves * nz
            across += scatter_along(scatter[n], nx, ny, nz)
            spare += counts[n] - 1
        noise = across / spare
        for i in range(first[v], first[v + 1]):
            n = kept[i]
            variance[i] = control[n] ** 2 if control[n] > 0.0 else noise / counts[n]
