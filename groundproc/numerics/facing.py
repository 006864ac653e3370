"""Which way surfaces face as a whole: planes near each other that face nearly one way, by their mean normal and its covariance.

Planes fitted to a few noisy returns lean a little, each differently. What their normals have in common is the surface's; what each has
beyond that is as likely noise, and how much of it is left in the mean follows from how they scatter.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

ONE_WAY: Final = 0.966
"""Cosine of what a normal leans from the mean of those that it is counted with at most: 15 deg."""
MOST_WAYS: Final = 12
"""Ways that planes face within one cell; what comes after keeps its own normal."""
FEWEST: Final = 3
"""Planes that show by how they scatter what their normals are worth; of fewer, what is stated of each goes."""


class Ways(NamedTuple):
    """Sums over the planes that face one way, for each way of a cell.

    Attributes
    ----------
    planes : ndarray, shape (ways,)
    normal : ndarray, shape (ways, 3)
        On one side.
    square : ndarray, shape (ways, 3, 3)
        Of outer products.
    tilt : ndarray, shape (ways,)
        Of stated variances.
    """

    planes: Array
    normal: Array
    square: Array
    tilt: Array


@njit(cache=True, nogil=True)
def mean_normals(place_m: Array, normal: Array, tilt: Array, cell_m: float) -> tuple[Array, Array]:
    """Unit normals by which planes face as a whole, shape (n, 3), and the covariance of their errors, shape (n, 3, 3).

    Parameters
    ----------
    place_m, normal : ndarray, shape (n, 3)
        Where the planes are, and their unit normals of either side.
    tilt : ndarray, shape (n,)
        Stated variance of each normal's direction about one axis [rad^2].
    cell_m : float
        Edge of the cubes within which planes are near each other.
    """
    count = len(place_m)
    key, per_m = np.empty(count, np.int64), 1.0 / cell_m
    for i in range(count):
        key[i] = voxel_key(place_m[i, 0], place_m[i, 1], place_m[i, 2], per_m)
    order = np.argsort(key)
    mean, covariance, way = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(count, np.int64)
    ways = Ways(np.empty(MOST_WAYS), np.empty((MOST_WAYS, 3)), np.empty((MOST_WAYS, 3, 3)), np.empty(MOST_WAYS))
    first = 0
    while first < count:
        last = first + 1
        while last < count and key[order[last]] == key[order[first]]:
            last += 1
        _sort_by_way(order[first:last], normal, tilt, way, ways)
        for at in range(first, last):
            i = order[at]
            _mean(normal[i], tilt[i], ways, way[i], mean[i], covariance[i])
        first = last
    return mean, covariance


@njit(cache=True, nogil=True)
def _sort_by_way(rows: Ints, normal: Array, tilt: Array, way: Ints, ways: Ways) -> None:
    """Way that each of some planes faces, -1 where there are too many, and the sums of each way."""
    known, sums = 0, ways.normal
    for i in rows:
        nx, ny, nz, best, nearest = normal[i, 0], normal[i, 1], normal[i, 2], -1, ONE_WAY
        for k in range(known):
            x, y, z = sums[k, 0], sums[k, 1], sums[k, 2]
            lean = abs(nx * x + ny * y + nz * z) / np.sqrt(x**2 + y**2 + z**2)
            if lean > nearest:
                best, nearest = k, lean
        if best < 0 and known < MOST_WAYS:
            best, known = known, known + 1
            ways.planes[best], ways.tilt[best], sums[best], ways.square[best] = 0.0, 0.0, 0.0, 0.0
        way[i] = best
        if best < 0:
            continue
        side = 1.0 if nx * sums[best, 0] + ny * sums[best, 1] + nz * sums[best, 2] >= 0.0 else -1.0
        ways.planes[best] += 1.0
        ways.tilt[best] += tilt[i]
        for a in range(3):
            sums[best, a] += side * normal[i, a]
            for b in range(3):
                ways.square[best, a, b] += normal[i, a] * normal[i, b]


@njit(cache=True, nogil=True)
def _mean(normal: Array, tilt: float, ways: Ways, way: int, mean: Array, covariance: Array) -> None:
    """Mean normal of a plane's way, on the side of its own, and the covariance of its error."""
    mean[:] = normal
    count = 1.0 if way < 0 else ways.planes[way]
    if count < FEWEST:
        each = tilt if way < 0 else ways.tilt[way] / count
        for a in range(3):
            for b in range(3):
                covariance[a, b] = each / count * ((1.0 if a == b else 0.0) - normal[a] * normal[b])
        if count == 1.0:
            return
    t = ways.normal[way]
    size = np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    side = 1.0 if normal[0] * t[0] + normal[1] * t[1] + normal[2] * t[2] >= 0.0 else -1.0
    for a in range(3):
        mean[a] = side * t[a] / size
        for b in range(3):
            if count >= FEWEST:
                covariance[a, b] = (ways.square[way, a, b] - t[a] * t[b] / count) / (count * (count - 1.0))
