"""Keys of voxels and their places in a hash table; for kernels. And points sorted by where they lie."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

_FIRST_VOXELS: Final = 1 << 16
"""Voxels that a numbering begins with room for."""
_CELLS_A_POINT: Final = 2.0
"""Cells that points are sorted by, at most: most of a larger area is empty, and counting it would take longer than its points."""


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
    """Number of the voxel of each point, in the order in which they first come, and how many voxels there are."""
    # most points share a voxel: a table for as many voxels as points is larger than they are, and outside the cache
    voxel, keys = np.empty(len(world_m), np.int32), np.empty(_FIRST_VOXELS, np.int64)
    table, at, found = table_for(2 * len(keys)), 0, 0
    while True:
        at, found = _number(world_m, 1.0 / voxel_m, (at, found), keys, table, voxel)
        if at == len(world_m):
            return voxel, int(found)
        keys = np.concatenate([keys, np.empty_like(keys)])
        table = table_for(2 * len(keys))
        _enter(keys[:found], table)


def newcomers(xyz_m: Array, corner_m: Array, voxel_m: float) -> tuple[npt.NDArray[np.bool_], int]:
    """Which points, shape (n, 3), are the first in their voxel, counted from a corner; and how many voxels there are."""
    first = np.zeros(len(xyz_m), np.bool_)
    table, at, found = np.full(2 * _FIRST_VOXELS, -1, np.int64), 0, 0
    while True:
        at, found = _newcomers(xyz_m, corner_m, 1.0 / voxel_m, (at, found), table, first)
        if at == len(xyz_m):
            return first, int(found)
        table, known = np.full(2 * len(table), -1, np.int64), table
        _enter_keys(known, table)


def table_for(slots: int) -> npt.NDArray[np.int32]:
    """An empty table with room for so many voxels and more."""
    return np.full(1 << int(np.ceil(np.log2(max(slots, 1 << 10)))), -1, np.int32)


@njit(cache=True, nogil=True)
def _number(
    xyz: Any, per_m: float, begin: tuple[int, int], keys: Any, table: npt.NDArray[np.int32], voxel: npt.NDArray[np.int32]
) -> Any:  # fmt: skip
    """Number points from one on, so many voxels being known: the point where there is no room for one more, and the voxels by then."""
    mask, (first, found) = len(table) - 1, begin
    for n in range(first, len(xyz)):
        key = voxel_key(xyz[n, 0], xyz[n, 1], xyz[n, 2], per_m)
        slot = spread(key) & mask
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            if found == len(keys):
                return n, found
            table[slot], keys[found] = found, key
            found += 1
        voxel[n] = table[slot]
    return len(xyz), found


@njit(cache=True, nogil=True)
def _enter(keys: npt.NDArray[np.int64], table: npt.NDArray[np.int32]) -> None:
    """Put voxels into an empty table, by their numbers."""
    mask = len(table) - 1
    for number in range(len(keys)):
        slot = spread(keys[number]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = number


@njit(cache=True, nogil=True)
def _newcomers(
    xyz: Any, corner: Any, per_m: float, begin: tuple[int, int], table: npt.NDArray[np.int64], out: npt.NDArray[np.bool_]
) -> Any:  # fmt: skip
    """Mark the first points of voxels from one on, so many voxels being known: the point where the table is full, and the voxels then.

    The table holds keys, not numbers: one place in memory for each point, not two.
    """
    mask, (first, found) = len(table) - 1, begin
    x, y, z = corner[0], corner[1], corner[2]
    for n in range(first, len(xyz)):
        key = voxel_key(xyz[n, 0] - x, xyz[n, 1] - y, xyz[n, 2] - z, per_m)
        slot = spread(key) & mask
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] < 0:
            if 2 * found >= len(table):
                return n, found
            table[slot], out[n] = key, True
            found += 1
    return len(xyz), found


@njit(cache=True, nogil=True)
def _enter_keys(keys: npt.NDArray[np.int64], table: npt.NDArray[np.int64]) -> None:
    """Put the keys of a table into an empty one."""
    mask = len(table) - 1
    for n in range(len(keys)):
        if keys[n] >= 0:
            slot = spread(keys[n]) & mask
            while table[slot] >= 0:
                slot = (slot + 1) & mask
            table[slot] = keys[n]


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


def row_by_row(xyz_m: Array, cell_m: float) -> npt.NDArray[np.int64]:
    """Order of points by cells of the ground, row by row, so that neighbours lie near each other in memory.

    Searches of neighbours are two to four times faster then: points that come in the order of time, or in none, miss the cache.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 2) or (n, 3)
    cell_m : float
        Edge of a cell; wider ones are taken for areas that are mostly empty.
    """
    if not len(xyz_m):
        return np.empty(0, np.int64)
    along = [np.ascontiguousarray(xyz_m[:, axis]) for axis in (0, 1)]
    low = [float(each.min()) for each in along]
    size_m = [float(each.max()) - least for each, least in zip(along, low, strict=True)]
    cells = _CELLS_A_POINT * len(xyz_m)
    per_m = 1.0 / max(cell_m, float(np.sqrt(size_m[0] * size_m[1] / cells)), max(size_m) / cells)
    column, row = (((each - least) * per_m).astype(np.int32) for each, least in zip(along, low, strict=True))
    columns, rows = (int(size * per_m) + 2 for size in size_m)
    order, _ = sorted_by(row * np.int32(columns) + column, columns * rows)
    return np.asarray(order, np.int64)
