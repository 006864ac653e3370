"""Keys of voxels and their places in a hash table; for kernels. And points sorted by the voxel that they lie in."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]


@njit(cache=True, nogil=True, inline="always")
def voxel_key(x: float, y: float, z: float, per_m: float) -> Any:
    """Key of the voxel that a point lies in: 21 bits for each axis."""
    i = np.int64(np.floor(x * per_m)) & 0x1FFFFF
    j = np.int64(np.floor(y * per_m)) & 0x1FFFFF
    k = np.int64(np.floor(z * per_m)) & 0x1FFFFF
    return (i << 42) | (j << 21) | k


@njit(cache=True, nogil=True, inline="always")
def spread(key: Any) -> Any:
    """Hash of a key, 0 to 2^31 - 1 (Fibonacci hashing with one fold)."""
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    h ^= h >> np.uint64(32)
    return np.int64(h & np.uint64(0x7FFFFFFF))


def assign(world_m: Array, voxel_m: float) -> tuple[npt.NDArray[np.int32], int]:
    """Number of the voxel of each point, and how many voxels there are."""
    table = np.full(1 << int(np.ceil(np.log2(max(4 * len(world_m), 1 << 12)))), -1, np.int32)
    voxel, voxels = _assign(world_m, voxel_m, table)
    return voxel, int(voxels)


@njit(cache=True, nogil=True)
def _assign(world: Array, voxel_m: float, table: npt.NDArray[np.int32]) -> Any:
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
def sorted_by(voxel: npt.NDArray[np.int32], voxels: int) -> Any:
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
