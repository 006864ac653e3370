"""Planes through second moments, inside numba kernels: of voxels, of cells of strips, of patches.

Scatter is the sum of w (x - mean)(x - mean)^T over points of weight w, kept as its six numbers xx xy xz yy yz zz [m^2]. Normals are unit
vectors of either sign.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.parts import at_once

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Scatter = npt.NDArray[np.float32] | Array

MOST_RETURNS: Final = 20.0
"""Returns of a cluster that count for its plane, at most: a stop over one place must not outweigh a pass."""
FEWEST_CLUSTERS: Final = 3
LEAST_RETURNS: Final = 12.0
"""Returns of a plane, counted so."""


@njit(cache=True, nogil=True)
def flattest(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, normal: Array) -> Any:
    """Smallest and middle eigenvalue of a symmetric 3 x 3 matrix; `normal` takes the unit eigenvector of the smallest.

    By Cardano's formula, and the vector as the longest cross product of two rows of A - l I.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    p = np.sqrt(max((a * a + b * b + c * c + 2.0 * off) / 6.0, 1e-60))
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    ratio = min(max(0.5 * det / (p * p * p), -1.0), 1.0)
    angle = np.arccos(ratio) / 3.0
    largest = mean + 2.0 * p * np.cos(angle)
    smallest = mean + 2.0 * p * np.cos(angle + 2.0943951023931953)
    middle = 3.0 * mean - largest - smallest
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    s0 = x0 * x0 + y0 * y0 + z0 * z0
    s1 = x1 * x1 + y1 * y1 + z1 * z1
    s2 = x2 * x2 + y2 * y2 + z2 * z2
    if s0 >= s1 and s0 >= s2:
        x, y, z, s = x0, y0, z0, s0
    elif s1 >= s2:
        x, y, z, s = x1, y1, z1, s1
    else:
        x, y, z, s = x2, y2, z2, s2
    if s <= 0.0:
        normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    else:
        s = 1.0 / np.sqrt(s)
        normal[0], normal[1], normal[2] = x * s, y * s, z * s
    return smallest, middle


@njit(cache=True, nogil=True, inline="always")
def flattest_of(scatter: Scatter, share: float, normal: Array) -> Any:
    """`flattest` of a share of a scatter, shape (6,): of its variance where the share is one over the weight."""
    return flattest(
        share * scatter[0], share * scatter[1], share * scatter[2], share * scatter[3], share * scatter[4],
        share * scatter[5], normal,
    )  # fmt: skip


@njit(cache=True, nogil=True, inline="always")
def add_scatter(total: Array, share: float, scatter: Scatter, weight: float, away: tuple[float, float, float]) -> None:
    """Add a share of a cluster's own scatter, and its mean with a weight, `away` from the mean of all, to a scatter; shapes (6,)."""
    x, y, z = away
    total[0] += share * scatter[0] + weight * x * x
    total[1] += share * scatter[1] + weight * x * y
    total[2] += share * scatter[2] + weight * x * z
    total[3] += share * scatter[3] + weight * y * y
    total[4] += share * scatter[4] + weight * y * z
    total[5] += share * scatter[5] + weight * z * z


@njit(cache=True, nogil=True, inline="always")
def scatter_along(scatter: Scatter, x: float, y: float, z: float) -> Any:
    """Scatter along a direction [m^2]."""
    s = scatter
    return x * (s[0] * x + 2 * s[1] * y + 2 * s[2] * z) + y * (s[3] * y + 2 * s[4] * z) + z * s[5] * z


@njit(cache=True, nogil=True, inline="always")
def axes_along(x: float, y: float, z: float) -> Any:
    """Two directions along the plane of a normal, at right angles: six numbers."""
    if abs(z) < 0.9:
        length = np.sqrt(x * x + y * y)
        ax, ay, az = -y / length, x / length, 0.0
    else:
        length = np.sqrt(y * y + z * z)
        ax, ay, az = 0.0, z / length, -y / length
    return ax, ay, az, y * az - z * ay, z * ax - x * az, x * ay - y * ax


class Placed(NamedTuple):
    """Clusters where a path places them, as kernels take them.

    Attributes
    ----------
    world_m : ndarray, shape (n, 3)
    scatter_m2 : ndarray of float32, shape (n, 6)
        Of the returns about the cluster's mean, summed.
    returns : ndarray of int32, shape (n,)
        How many each has.
    knot : ndarray of int32, shape (n,)
        Interval of the spline that each is in.
    group : ndarray of int32, shape (n,) or (0,)
        Clusters of a voxel whose scatter is about a mean of their own; those of a group follow each other. Empty: all are of one.
    """

    world_m: Array
    scatter_m2: npt.NDArray[np.float32]
    returns: npt.NDArray[np.int32]
    knot: npt.NDArray[np.int32]
    group: npt.NDArray[np.int32]


class VoxelPlanes(NamedTuple):
    """Plane of each voxel.

    Attributes
    ----------
    normal, mean_m : ndarray, shape (voxels, 3)
    good : ndarray of bool, shape (voxels,)
        Whether there is one; the others mean nothing where it is False.
    """

    normal: Array
    mean_m: Array
    good: npt.NDArray[np.bool_]

    @classmethod
    def empty(cls, voxels: int) -> "VoxelPlanes":
        """None yet."""
        return cls(np.zeros((voxels, 3)), np.empty((voxels, 3)), np.zeros(voxels, np.bool_))


def by_halves(work: Callable[[slice], None], first: Ints) -> None:
    """Do a work for all voxels, on both cores: those before and after the middle of what they hold, `first` being where each begins."""
    voxels = len(first) - 1
    middle = int(np.searchsorted(first, first[-1] // 2))
    parts = [slice(0, middle), slice(middle, voxels)]
    at_once(lambda number: work(parts[number]), 2)


@njit(cache=True, nogil=True)
def find_planes(first: Ints, order: Ints, placed: Placed, voxel_m: float, planes: VoxelPlanes) -> None:
    """Find the plane of each voxel from the moments of its clusters: of those that are flat and seen from two intervals or more.

    Parameters
    ----------
    first : ndarray of int64, shape (voxels + 1,)
        Where each voxel begins in `order`.
    order : ndarray of int64, shape (n,)
        Numbers of the clusters, voxel after voxel.
    placed : Placed
    voxel_m : float
        Edge of the voxels.
    planes : VoxelPlanes
        Filled in.
    """
    world, scatter, count, knot = placed.world_m, placed.scatter_m2, placed.returns, placed.knot
    group, normal, mean = placed.group, planes.normal, planes.mean_m
    one = len(group) == 0
    s = np.empty(6)
    for v in range(len(first) - 1):
        stop = first[v + 1]
        if stop - first[v] < FEWEST_CLUSTERS:
            continue
        s[:] = 0.0
        whole, x, y, z = 0.0, 0.0, 0.0, 0.0
        low_knot, high_knot = 1 << 30, -1
        begin = first[v]
        while begin < stop:
            end = begin
            total, a, b, c = 0.0, 0.0, 0.0, 0.0
            while end < stop and (one or group[order[end]] == group[order[begin]]):
                n = order[end]
                w = min(np.float64(count[n]), MOST_RETURNS)
                total += w
                a += w * world[n, 0]
                b += w * world[n, 1]
                c += w * world[n, 2]
                low_knot, high_knot = min(low_knot, knot[n]), max(high_knot, knot[n])
                end += 1
            whole, x, y, z = whole + total, x + a, y + b, z + c
            if end == stop and (high_knot == low_knot or whole < LEAST_RETURNS):
                break
            a, b, c = a / total, b / total, c / total
            for k in range(begin, end):
                n = order[k]
                w = min(np.float64(count[n]), MOST_RETURNS)
                add_scatter(s, w / count[n], scatter[n], w, (world[n, 0] - a, world[n, 1] - b, world[n, 2] - c))
            begin = end
        if high_knot == low_knot or whole < LEAST_RETURNS:
            continue
        s /= whole
        low, middle = flattest_of(s, 1.0, normal[v])
        mean[v, 0], mean[v, 1], mean[v, 2] = x / whole, y / whole, z / whole
        planes.good[v] = low < (0.04 + 0.02 * voxel_m) ** 2 and middle > (0.12 * voxel_m) ** 2 and low < 0.15 * middle
