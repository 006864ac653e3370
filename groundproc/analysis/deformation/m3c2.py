"""Distance between two clouds along the normals of one, with the smallest that can be told from none (M3C2).

Around each core point stands a cylinder along the normal of epoch A. Its distance is that between the means of both epochs' points in it.
Source: Lague, Brodu and Leroux (2013), eq. 1; the covariance of the registration carried to each core point, and points with sigmas of
their own, as Winiwarter, Anders and Höfle (2021). What points claim to be off by beyond their scatter they are off by together: it does not
shrink with their number.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.voxels import find
from groundproc.numerics.voxelhash import assign, sorted_by, spread, voxel_key

Array = npt.NDArray[np.float64]

FEWEST: Final = 4
"""Points of each epoch in a cylinder."""
TWO_SIDED_95: Final = 1.96
_EDGES_ALONG: Final = 8.0
"""Voxels that a cylinder goes through, about."""


class Bins(NamedTuple):
    """Points by voxel, as the kernel takes them.

    Attributes
    ----------
    xyz : ndarray, shape (n, 3)
        In the order of voxels.
    variance : ndarray, shape (n, 2)
        Of each horizontal axis and of the height; 0 where it is not known.
    table, keys, first : ndarray
        Hash table of voxels, their keys, and where each begins.
    edge_m : float
    """

    xyz: Array
    variance: Array
    table: npt.NDArray[np.int32]
    keys: npt.NDArray[np.int64]
    first: npt.NDArray[np.int64]
    edge_m: float


class Cylinders(NamedTuple):
    """What an epoch has in each cylinder, shape (k,) each.

    Attributes
    ----------
    points : ndarray of int64
    mean_m : ndarray
        Along the normal, from the core point.
    scatter_m : ndarray
        One standard deviation of single points about it.
    claimed_m2 : ndarray
        Mean variance along the normal that the points say they have.
    """

    points: npt.NDArray[np.int64]
    mean_m: Array
    scatter_m: Array
    claimed_m2: Array


class Distances(NamedTuple):
    """Of each core point, shape (k,); not a number where an epoch has too few points.

    Attributes
    ----------
    distance_m : ndarray
        From A to B along the normal.
    own_m2 : ndarray
        Its variance from the scatter of both, which neighbours do not share.
    shared_m2 : ndarray
        What both claim to be off by beyond their scatter.
    seen : ndarray of bool
        The other epoch has enough points there.
    """

    distance_m: Array
    own_m2: Array
    shared_m2: Array
    seen: npt.NDArray[np.bool_]


def bins(xyz_m: Array, radius_m: float, reach_m: float, sigmas_m: Array | None = None) -> Bins:
    """Sort the points of an epoch.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
        Not far from zero: within 2^20 voxels of it.
    radius_m, reach_m : float
        Of the cylinders: radius, and half length.
    sigmas_m : ndarray, shape (n, 2), optional
        Of each horizontal axis, and of the height; not a number where it is not known.
    """
    edge = max(2.0 * radius_m, reach_m / _EDGES_ALONG)
    voxel, voxels = assign(xyz_m, edge)
    order, first = sorted_by(voxel, voxels)
    xyz = np.ascontiguousarray(xyz_m[order])
    variance = np.zeros((len(xyz), 2)) if sigmas_m is None else np.nan_to_num(np.square(sigmas_m[order]))
    table = np.full(1 << int(np.ceil(np.log2(max(4 * voxels, 1 << 10)))), -1, np.int32)
    keys = np.empty(voxels, np.int64)
    _enter(xyz, first, edge, table, keys)
    return Bins(xyz, np.ascontiguousarray(variance), table, keys, first, edge)


def cylinders(cores_m: Array, normals: Array, of: Bins, radius_m: float, reach_m: float) -> Cylinders:
    """Mean and scatter of the points of an epoch in cylinders.

    Parameters
    ----------
    cores_m, normals : ndarray, shape (k, 3)
    of : Bins
    radius_m, reach_m : float
    """
    found = np.zeros((len(cores_m), 4))
    _gather(np.ascontiguousarray(cores_m), np.ascontiguousarray(normals), of, radius_m, reach_m, found)
    return Cylinders(found[:, 0].astype(np.int64), found[:, 1], found[:, 2], found[:, 3])


def distances(cores_m: Array, normals: Array, epochs: tuple[Bins, Bins], radius_m: float, reach_m: float) -> Distances:
    """Distance of B from A at core points.

    Parameters
    ----------
    cores_m, normals : ndarray, shape (k, 3)
    epochs : tuple of 2 Bins
    radius_m, reach_m : float

    Returns
    -------
    Distances
    """
    a, b = (cylinders(cores_m, normals, each, radius_m, reach_m) for each in epochs)
    seen = (a.points >= FEWEST) & (b.points >= FEWEST)
    own = sum(np.square(each.scatter_m) / np.maximum(each.points, 1) for each in (a, b))
    shared = sum(np.maximum(each.claimed_m2 - np.square(each.scatter_m), 0.0) for each in (a, b))
    gone = np.where(seen, 0.0, np.nan)
    return Distances(b.mean_m - a.mean_m + gone, np.asarray(own) + gone, np.asarray(shared) + gone, seen)


def detectable(variance_m2: Array) -> Array:
    """Level of detection at 95 % [m]: a smaller distance may be none."""
    return np.asarray(TWO_SIDED_95 * np.sqrt(variance_m2))


@njit(cache=True, nogil=True)
def _enter(xyz: Any, first: Any, edge_m: float, table: Any, keys: Any) -> None:
    mask = len(table) - 1
    for v in range(len(keys)):
        p = first[v]
        keys[v] = voxel_key(xyz[p, 0], xyz[p, 1], xyz[p, 2], 1.0 / edge_m)
        slot = spread(keys[v]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = v


@njit(cache=True, nogil=True)
def _gather(cores: Any, normals: Any, of: Bins, radius: float, reach: float, found: Any) -> None:
    """Look through the voxels around each cylinder."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    sums = np.empty(4)
    for c in range(len(cores)):
        for a in range(3):
            n = normals[c, a]
            half = reach * abs(n) + radius * np.sqrt(max(1.0 - n * n, 0.0))
            low[a], high[a] = np.floor((cores[c, a] - half) / of.edge_m), np.floor((cores[c, a] + half) / of.edge_m)
        sums[:] = 0.0
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    _look_into((i, j, k), of, cores[c], normals[c], (radius, reach), sums)
        points = sums[0]
        if points > 0.0:
            found[c, 0], found[c, 1], found[c, 3] = points, sums[1], sums[3] / points
        if points > 1.0:
            found[c, 2] = np.sqrt(sums[2] / (points - 1.0))


@njit(cache=True, nogil=True, inline="always")
def _look_into(at: Any, of: Bins, core: Any, n: Any, size: Any, sums: Any) -> None:
    """Add the points of a voxel that the cylinder can meet."""
    i, j, k = at
    radius, reach = size
    edge = of.edge_m
    x, y, z = (i + 0.5) * edge - core[0], (j + 0.5) * edge - core[1], (k + 0.5) * edge - core[2]
    along = x * n[0] + y * n[1] + z * n[2]
    slack = 0.87 * edge  # half the diagonal of a voxel
    if x * x + y * y + z * z - along * along > (radius + slack) ** 2:
        return
    v = find(voxel_key((i + 0.5) * edge, (j + 0.5) * edge, (k + 0.5) * edge, 1.0 / edge), of.table, of.keys)
    if v >= 0:
        _add(of, of.first[v], of.first[v + 1], core, n, (radius * radius, reach), sums)


@njit(cache=True, nogil=True, inline="always")
def _add(of: Bins, begin: Any, end: Any, core: Any, n: Any, size: Any, sums: Any) -> None:
    """Add points of a voxel: count, mean, squares about it (Welford 1962), variance along the normal."""
    square, reach = size
    for p in range(begin, end):
        x, y, z = of.xyz[p, 0] - core[0], of.xyz[p, 1] - core[1], of.xyz[p, 2] - core[2]
        t = x * n[0] + y * n[1] + z * n[2]
        if abs(t) > reach or x * x + y * y + z * z - t * t > square:
            continue
        sums[0] += 1.0
        off = t - sums[1]
        sums[1] += off / sums[0]
        sums[2] += off * (t - sums[1])
        flat = 1.0 - n[2] * n[2]
        sums[3] += of.variance[p, 0] * flat + of.variance[p, 1] * n[2] * n[2]
