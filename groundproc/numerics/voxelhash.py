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
    voxel, _, voxels = numbered(world_m, 1.0 / voxel_m, table_for(4 * len(world_m)))
    return voxel, int(voxels)


def table_for(slots: int) -> npt.NDArray[np.int32]:
    """An empty table with room for so many voxels and more."""
    return np.full(1 << int(np.ceil(np.log2(max(slots, 1 << 10)))), -1, np.int32)


@njit(cache=True, nogil=True)
def numbered(xyz: Any, per_m: float, table: npt.NDArray[np.int32]) -> Any:
    """Number of the voxel of each point, the key of each voxel, and how many there are."""
    voxel, keys = np.empty(len(xyz), np.int32), np.empty(len(xyz), np.int64)
    mask, found = len(table) - 1, 0
    for n in range(len(xyz)):
        key = voxel_key(xyz[n, 0], xyz[n, 1], xyz[n, 2], per_m)
        slot = spread(key) & mask
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            table[slot], keys[found] = found, key
            found += 1
        voxel[n] = table[slot]
    return voxel, keys, found


@njit(cache=True, nogil=True)
def around(keys: Any, table: Any, voxel: int, near: Any) -> None:
    """Numbers of the 27 voxels at and around one, by x, y, z; -1: holds no point."""
    mask, low = len(table) - 1, np.int64(0x1FFFFF)
    x, y, z = (keys[voxel] >> 42) & low, (keys[voxel] >> 21) & low, keys[voxel] & low
    k = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for h in range(-1, 2):
                key = (((x + i) & low) << 42) | (((y + j) & low) << 21) | ((z + h) & low)
                slot = spread(key) & mask
                while table[slot] >= 0 and keys[table[slot]] != key:
                    slot = (slot + 1) & mask
                near[k] = table[slot]
                k += 1


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
