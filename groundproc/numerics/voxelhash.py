"""Keys of voxels and their places in a hash table; for kernels."""

from typing import Any

import numpy as np
from numba import njit


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
