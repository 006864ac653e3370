"""The normal matrix of rows on planes times vectors, planes solved for within: the kernels of `planerows` that most of an adjustment takes.

Four vectors at a time take a quarter of the time (1.9 ms each in place of 7.8 with 83,000 rows): a row is read once for all of them, and
their numbers lie side by side and are multiplied at once.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

ABREAST: Final = 4
"""Vectors that are multiplied at once."""


class RowArrays(NamedTuple):
    """The arrays of `PlaneRows`, as kernels take them; their meaning, shapes and units stand there."""

    first: Ints
    knot: npt.NDArray[np.int32]
    weights: Singles
    jacobian: Singles
    plane: Singles
    weight: Array
    residual_m: Array
    inverse: Array


@njit(cache=True, nogil=True, inline="always")
def solved_plane(q: Array, r0: float, r1: float, r2: float) -> Any:
    """Offset and tilts of a plane by the inverse of its normal matrix, shape (6,), and its right side."""
    return q[0] * r0 + q[1] * r1 + q[2] * r2, q[1] * r0 + q[3] * r1 + q[4] * r2, q[2] * r0 + q[4] * r1 + q[5] * r2


@njit(cache=True, nogil=True, fastmath=True)
def products(
    rows: RowArrays, voxels: tuple[int, int], vector: Array, values: Array, out: Array, projected: Array
) -> None:  # fmt: skip
    """Columns times values of the rows of some voxels, weighed and less the best plane of each, added to `out`, shape (coefficients, 6).

    Where no values are given, shape (0,), they are the rows times a vector, shape (coefficients, 6). What is left of the values less
    their planes, weighed, is told in `projected`, unless that has the shape (0,). `voxels` are the first, and the one after the last.
    """
    first, knot, weights, jacobian = rows.first, rows.knot, rows.weights, rows.jacobian
    plane, weight, inverse = rows.plane, rows.weight, rows.inverse
    given, told = len(values) > 0, len(projected) > 0
    scratch = np.empty(64)
    for v in range(voxels[0], voxels[1]):
        start, end = first[v], first[v + 1]
        if end - start > len(scratch):
            scratch = np.empty(2 * (end - start))
        r0, r1, r2 = 0.0, 0.0, 0.0
        for i in range(start, end):
            y = values[i] if given else row_times(i, knot, weights, jacobian, vector)
            scratch[i - start] = y
            y *= weight[i]
            r0 += y
            r1 += y * plane[i, 0]
            r2 += y * plane[i, 1]
        d, a, b = solved_plane(inverse[v], r0, r1, r2)
        for i in range(start, end):
            y = weight[i] * (scratch[i - start] - d - a * plane[i, 0] - b * plane[i, 1])
            if told:
                projected[i] = y
            k = knot[i]
            w0, w1, w2, w3 = y * weights[i, 0], y * weights[i, 1], y * weights[i, 2], y * weights[i, 3]
            for c in range(6):
                j = jacobian[i, c]
                out[k, c] += w0 * j
                out[k + 1, c] += w1 * j
                out[k + 2, c] += w2 * j
                out[k + 3, c] += w3 * j


@njit(cache=True, nogil=True, inline="always", fastmath=True)
def row_times(i: int, knot: npt.NDArray[np.int32], weights: Singles, jacobian: Singles, vector: Array) -> float:
    """One row times a vector."""
    k = knot[i]
    w0, w1, w2, w3 = weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3]
    y = 0.0
    for c in range(6):
        y += jacobian[i, c] * (
            w0 * vector[k, c] + w1 * vector[k + 1, c] + w2 * vector[k + 2, c] + w3 * vector[k + 3, c]
        )
    return y


@njit(cache=True, nogil=True, fastmath=True)
def products_abreast(  # noqa: C901 (a kernel: calls would cost)
    rows: RowArrays, voxels: tuple[int, int], vectors: Array, out: Array
) -> None:
    """`products` of `ABREAST` vectors, added to `out`, both of shape (coefficients, 6, ABREAST)."""
    first, knot, weights, jacobian = rows.first, rows.knot, rows.weights, rows.jacobian
    plane, weight, inverse = rows.plane, rows.weight, rows.inverse
    y, sums = np.empty((64, ABREAST)), np.empty((3, ABREAST))
    for v in range(voxels[0], voxels[1]):
        start, end = first[v], first[v + 1]
        if end - start > len(y):
            y = np.empty((2 * (end - start), ABREAST))
        sums[:] = 0.0
        for i in range(start, end):
            k, n, w = knot[i], i - start, weight[i]
            a, b = np.float64(plane[i, 0]), np.float64(plane[i, 1])
            w0, w1, w2, w3 = weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3]
            for q in range(ABREAST):
                y[n, q] = 0.0
            for c in range(6):
                j = np.float64(jacobian[i, c])
                j0, j1, j2, j3 = j * w0, j * w1, j * w2, j * w3
                for q in range(ABREAST):
                    y[n, q] += (
                        j0 * vectors[k, c, q] + j1 * vectors[k + 1, c, q]
                        + j2 * vectors[k + 2, c, q] + j3 * vectors[k + 3, c, q]
                    )  # fmt: skip
            for q in range(ABREAST):
                z = w * y[n, q]
                sums[0, q] += z
                sums[1, q] += z * a
                sums[2, q] += z * b
        for q in range(ABREAST):
            sums[0, q], sums[1, q], sums[2, q] = solved_plane(inverse[v], sums[0, q], sums[1, q], sums[2, q])
        for i in range(start, end):
            k, n, w = knot[i], i - start, weight[i]
            a, b = np.float64(plane[i, 0]), np.float64(plane[i, 1])
            w0, w1, w2, w3 = weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3]
            for q in range(ABREAST):
                y[n, q] = w * (y[n, q] - sums[0, q] - a * sums[1, q] - b * sums[2, q])
            for c in range(6):
                j = np.float64(jacobian[i, c])
                j0, j1, j2, j3 = j * w0, j * w1, j * w2, j * w3
                for q in range(ABREAST):
                    z = y[n, q]
                    out[k, c, q] += j0 * z
                    out[k + 1, c, q] += j1 * z
                    out[k + 2, c, q] += j2 * z
                    out[k + 3, c, q] += j3 * z
