"""Distances of clusters from the planes of their voxels as rows of a least-squares problem, each plane solved for within.

A plane of a voxel has an offset and two tilts. For given poses the best plane is linear in them, so it is put back into the residuals
(variable projection; Liu, Liu, Zhang, "Efficient and consistent bundle adjustment on lidar point clouds", 2023, in its idea). What
remains couples all clusters of the voxel, however far apart in time; it is never written down, only applied to vectors.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.parts import at_once
from groundproc.numerics.planeproducts import ABREAST, RowArrays, products, products_abreast, row_times, solved_plane
from groundproc.numerics.planes import Placed, VoxelPlanes, axes_along

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

TILT_PRIOR: Final = 0.3
"""What a plane's tilt may differ from that of its moments, one sigma [rad]: keeps narrow voxels solvable."""
HUBER: Final = 2.0
"""Sigmas beyond which a residual loses weight."""
CUT: Final = 5.0
"""Sigmas beyond which a cluster is none of this plane: moving things, mixed echoes."""
PIECE: Final = 1 << 16
"""Rows that are made or changed at a time by each core, about, where what it takes is larger than they are."""
PARTS: Final = 8
"""Pieces that the voxels are shared out in between cores."""
_NOTHING: Final = np.empty(0)
_NO_VECTOR: Final = np.empty((0, 6))


@dataclass(slots=True)
class PlaneRows:
    """Rows, linear in the coefficients of a spline of rotation and position; sorted by voxel.

    Attributes
    ----------
    first : ndarray of int64, shape (voxels + 1,)
        Where each voxel's rows begin.
    knot : ndarray of int32, shape (n,)
        Interval that the cluster lies in.
    weights : ndarray of float32, shape (n, 4)
        Spline weights.
    jacobian : ndarray of float32, shape (n, 6)
        By rotation [m/rad] and by position.
    plane : ndarray of float32, shape (n, 2)
        Coordinates along the plane, in voxels.
    weight : ndarray, shape (n,)
        1 / variance [1/m^2], less what the loss takes; 0 where cut.
    residual_m : ndarray, shape (n,)
        Distance from the voxel's mean plane.
    inverse : ndarray, shape (voxels, 6)
        Inverse of each plane's normal matrix: 00 01 02 11 12 22.
    cluster : ndarray of int32, shape (n,)
        Where each row's cluster stands.
    intervals : int
        Of the spline.
    """

    first: Ints
    knot: npt.NDArray[np.int32]
    weights: Singles
    jacobian: Singles
    plane: Singles
    weight: Array
    residual_m: Array
    inverse: Array
    cluster: npt.NDArray[np.int32]
    intervals: int

    def __len__(self) -> int:
        return len(self.knot)

    @property
    def path_size(self) -> int:
        """Unknowns of the spline."""
        return (self.intervals + 3) * 6

    @property
    def arrays(self) -> RowArrays:
        """What the kernels take."""
        return RowArrays(
            self.first, self.knot, self.weights, self.jacobian, self.plane, self.weight, self.residual_m, self.inverse
        )

    def pieces(self) -> Iterator[tuple[slice, slice]]:
        """The voxels some at a time, with their rows: about `PIECE` rows, or one voxel where that has more."""
        voxels, begin = len(self.first) - 1, 0
        while begin < voxels:
            end = max(int(np.searchsorted(self.first, self.first[begin] + PIECE, side="right")) - 1, begin + 1)
            yield slice(begin, end), slice(int(self.first[begin]), int(self.first[end]))
            begin = end

    def some(self, piece: tuple[slice, slice]) -> RowArrays:
        """What the kernels take of some voxels and their rows."""
        of, part = piece
        return RowArrays(
            self.first[of.start : of.stop + 1] - part.start, self.knot[part], self.weights[part], self.jacobian[part], self.plane[part],
            self.weight[part], self.residual_m[part], self.inverse[of],
        )  # fmt: skip

    def lay(
        self, kept: Ints, placed: Placed, planes: VoxelPlanes, voxel_m: float, piece: tuple[slice, slice] | None = None
    ) -> None:
        """Set distances from the planes and places along them.

        Parameters
        ----------
        kept : ndarray of int64, shape (n,)
            Cluster of each row.
        placed : Placed
            All clusters.
        planes : VoxelPlanes
            Of the voxels that the rows have.
        voxel_m : float
        piece : (slice, slice), optional
            One of `pieces`: all of this is of its rows and voxels alone.
        """
        _lay(self.arrays if piece is None else self.some(piece), kept, placed.world_m, planes, voxel_m)

    def weigh(self, variance_m2: Array, roughness_m: float, cut: bool, voxel_m: float) -> None:
        """Set weights, and the planes that they make.

        Parameters
        ----------
        variance_m2 : ndarray, shape (n,)
            Noise of each row by the returns of its cluster.
        roughness_m : float
            Of the surfaces, one sigma, before their residuals tell.
        cut : bool
            Whether rows beyond `CUT` sigmas are dropped.
        voxel_m : float
        """
        _weigh(self.arrays, variance_m2, roughness_m**2, cut, _prior(voxel_m))

    def replane(self, voxel_m: float) -> None:
        """Find the inverse of each plane's normal matrix for weights that have changed."""
        _replane(self.arrays, _prior(voxel_m))

    def apply(self, vector: Array) -> Array:
        """The normal matrix times a vector, shape (path_size,)."""
        return self._products(vector.reshape(-1, 6), _NOTHING)

    def gradient(self) -> Array:
        """Half the gradient of the cost, same shape."""
        return self.spread(self.residual_m)

    def spread(self, values_m: Array) -> Array:
        """The columns of all unknowns times values of the rows, shape (n,), weighed and less the best plane of each voxel."""
        return self._products(_NO_VECTOR, values_m)

    def spread_and_projected(self, values_m: Array) -> tuple[Array, Array]:
        """What `spread` and `projected` give, found together."""
        projected = np.empty(len(self))
        return self._products(_NO_VECTOR, values_m, projected), projected

    def _products(self, vector: Array, values_m: Array, projected: Array = _NOTHING) -> Array:
        out = np.zeros((PARTS, self.intervals + 3, 6))
        arrays = self.arrays
        at_once(lambda part: products(arrays, self._part(part), vector, values_m, out[part], projected), PARTS)
        return np.asarray(out.sum(axis=0).ravel())

    def apply_all(self, vectors: Array) -> Array:
        """The normal matrix times several vectors, shape (path_size, m)."""
        size, count = vectors.shape
        blocks = -(-count // ABREAST)
        padded = np.zeros((size, blocks * ABREAST))
        padded[:, :count] = vectors
        some = np.ascontiguousarray(padded.reshape(size, blocks, ABREAST).swapaxes(0, 1)).reshape(
            blocks, -1, 6, ABREAST
        )
        out, arrays = np.zeros((PARTS, *some.shape)), self.arrays

        def multiply(part: int) -> None:
            for block in range(blocks):
                products_abreast(arrays, self._part(part), some[block], out[part, block])

        at_once(multiply, PARTS)
        found = out.sum(axis=0).reshape(blocks, size, ABREAST).swapaxes(0, 1)
        return np.asarray(found.reshape(size, -1)[:, :count])

    def _part(self, number: int) -> tuple[int, int]:
        """One of `PARTS` pieces of the voxels: the first, and the one after the last."""
        voxels = len(self.first) - 1
        return voxels * number // PARTS, voxels * (number + 1) // PARTS

    def along(self, vector: Array) -> Array:
        """The rows times a vector of unknowns, shape (n,)."""
        out = np.empty(len(self))
        _along(self.arrays, vector.reshape(-1, 6), out)
        return out

    def seen(self, vector: Array) -> Array:
        """The transpose of `spread`: the rows times a vector, weighed and less the best plane of each voxel, shape (n,)."""
        return self.projected(self.along(vector))

    def projected(self, values_m: Array) -> Array:
        """Values of the rows, shape (n,), less the best plane of each voxel, weighed."""
        out = np.empty(len(self))
        _project(self.arrays, values_m, out)
        return out

    def band(self) -> Array:
        """The normal matrix were the planes known: of each interval's four coefficients, shape (intervals, 4, 4, 6, 6)."""
        out = np.zeros((self.intervals, 4, 4, 6, 6))
        _band(self.arrays, out)
        for a in range(6):
            out[:, :, :, a, :a] = out[:, :, :, :a, a]
        for i in range(4):
            out[:, i, :i] = out[:, :i, i]
        return out

    def cost(self) -> tuple[float, int]:
        """Weighted sum of squares left after the planes, and the rows that count."""
        return _cost(self.arrays), int((self.weight > 0).sum())


def _prior(voxel_m: float) -> float:
    """Information of a plane's tilt before its rows, in voxels."""
    return float((voxel_m * TILT_PRIOR) ** -2.0)


@njit(cache=True, nogil=True)
def _lay(rows: RowArrays, kept: Ints, world: Array, planes: VoxelPlanes, voxel_m: float) -> None:
    first, plane, residual, means = rows.first, rows.plane, rows.residual_m, planes.mean_m
    for v in range(len(first) - 1):
        nx, ny, nz = planes.normal[v]
        ax, ay, az, bx, by, bz = axes_along(nx, ny, nz)
        for i in range(first[v], first[v + 1]):
            n = kept[i]
            dx, dy, dz = world[n, 0] - means[v, 0], world[n, 1] - means[v, 1], world[n, 2] - means[v, 2]
            residual[i] = nx * dx + ny * dy + nz * dz
            plane[i, 0] = (ax * dx + ay * dy + az * dz) / voxel_m
            plane[i, 1] = (bx * dx + by * dy + bz * dz) / voxel_m


@njit(cache=True, nogil=True)
def _weigh(rows: RowArrays, variance: Array, first_rough: float, cut: bool, prior: float) -> None:
    """Weights of all rows, by their noise, the roughness that the residuals show and the loss; and the planes with them."""
    first, weight = rows.first, rows.weight
    for v in range(len(first) - 1):
        start, end = first[v], first[v + 1]
        rough, d, a, b = first_rough, 0.0, 0.0, 0.0
        for attempt in range(3):
            for i in range(start, end):
                weight[i] = 1.0 / (variance[i] + rough)
                if attempt:
                    z = abs(_off_plane(i, rows.plane, rows.residual_m, d, a, b)) * np.sqrt(weight[i])
                    if cut and attempt == 2 and z > CUT:
                        weight[i] = 0.0
                    elif z > HUBER:
                        weight[i] *= HUBER / z
            d, a, b = _fit(v, rows, prior)
            if attempt == 0:
                # what the residuals show beyond the noise of the returns; four of the expected kind go before them
                squares, expected, count = 0.0, 0.0, 0
                for i in range(start, end):
                    e = _off_plane(i, rows.plane, rows.residual_m, d, a, b)
                    squares += min(e * e, 25.0 * (variance[i] + rough))
                    expected += variance[i]
                    count += 1
                rough = max((4.0 * first_rough + squares - expected) / (max(count - 3, 0) + 4.0), 0.25 * first_rough)


@njit(cache=True, nogil=True)
def _replane(rows: RowArrays, prior: float) -> None:
    for v in range(len(rows.first) - 1):
        _fit(v, rows, prior)


@njit(cache=True, nogil=True, inline="always")
def _off_plane(i: int, plane: Singles, values: Array, d: float, a: float, b: float) -> Any:
    return values[i] - d - a * plane[i, 0] - b * plane[i, 1]


@njit(cache=True, nogil=True)
def _fit(v: int, rows: RowArrays, prior: float) -> Any:
    """Offset and tilts of the best plane of a voxel's residuals; its `inverse` takes the inverse of its normal matrix."""
    plane, weight, residual, inverse = rows.plane, rows.weight, rows.residual_m, rows.inverse[v]
    n00, n01, n02, n11, n12, n22 = 1e-6, 0.0, 0.0, prior, 0.0, prior
    r0, r1, r2 = 0.0, 0.0, 0.0
    for i in range(rows.first[v], rows.first[v + 1]):
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
    inverse[3] = (n00 * n22 - n02 * n02) / det
    inverse[4] = (n01 * n02 - n00 * n12) / det
    inverse[5] = (n00 * n11 - n01 * n01) / det
    return solved_plane(inverse, r0, r1, r2)


@njit(cache=True, nogil=True, fastmath=True)
def _along(rows: RowArrays, vector: Array, out: Array) -> None:
    """Each row times a vector of the path's unknowns."""
    knot, weights, jacobian = rows.knot, rows.weights, rows.jacobian
    for i in range(len(knot)):
        out[i] = row_times(i, knot, weights, jacobian, vector)


@njit(cache=True, nogil=True)
def _best_plane(v: int, rows: RowArrays, values: Array) -> Any:
    """Offset and tilts of the plane that fits the values of a voxel's rows best."""
    plane, weight = rows.plane, rows.weight
    r0, r1, r2 = 0.0, 0.0, 0.0
    for i in range(rows.first[v], rows.first[v + 1]):
        y = weight[i] * values[i]
        r0 += y
        r1 += y * plane[i, 0]
        r2 += y * plane[i, 1]
    return solved_plane(rows.inverse[v], r0, r1, r2)


@njit(cache=True, nogil=True)
def _project(rows: RowArrays, values: Array, out: Array) -> None:
    first, plane, weight = rows.first, rows.plane, rows.weight
    for v in range(len(first) - 1):
        d, a, b = _best_plane(v, rows, values)
        for i in range(first[v], first[v + 1]):
            out[i] = weight[i] * _off_plane(i, plane, values, d, a, b)


@njit(cache=True, nogil=True)
def _cost(rows: RowArrays) -> float:
    first, plane, weight, residual = rows.first, rows.plane, rows.weight, rows.residual_m
    total = 0.0
    for v in range(len(first) - 1):
        d, a, b = _best_plane(v, rows, residual)
        for i in range(first[v], first[v + 1]):
            total += weight[i] * _off_plane(i, plane, residual, d, a, b) ** 2
    return total


@njit(cache=True, nogil=True, fastmath=True)
def _band(rows: RowArrays, out: Array) -> None:
    """The upper triangles of the blocks of each interval."""
    knot, weights, jacobian, weight = rows.knot, rows.weights, rows.jacobian, rows.weight
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
