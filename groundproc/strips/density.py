"""How dense a cloud is, and so how large its patches should be."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]

CELL_M: Final = 2.0
_EVERY: Final = 64
"""One of so many cells is looked at."""
_POINTS: Final = 40.0
"""Points that a patch should have, of all strips together."""
_SMALLEST_M, _LARGEST_M = 0.5, 4.0


@dataclass(slots=True)
class Density:
    """Counts points in some of the cells, chunk by chunk."""

    _keys: list[npt.NDArray[np.int64]] = field(default_factory=list)
    _counts: list[npt.NDArray[np.int64]] = field(default_factory=list)

    def add(self, xyz_m: Array) -> None:
        """Take points, shape (n, 3)."""
        keys = _cells(xyz_m, CELL_M, _EVERY)
        unique, count = np.unique(keys, return_counts=True)
        self._keys.append(unique)
        self._counts.append(count)
        if len(self._keys) > 64:
            self._keys, self._counts = ([part] for part in self._summed())

    def _summed(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        keys, where = np.unique(np.concatenate(self._keys), return_inverse=True)
        return keys, np.bincount(where, np.concatenate(self._counts), len(keys)).astype(np.int64)

    def voxel_m(self) -> float:
        """Edge of patches of enough points where half of the cells are at least that dense."""
        _, count = self._summed()
        if not len(count):
            return _LARGEST_M
        per_m2 = float(np.median(count)) / CELL_M**2
        return float(np.clip(np.sqrt(_POINTS / per_m2), _SMALLEST_M, _LARGEST_M))


@njit(cache=True, nogil=True)
def _cells(xyz: Any, cell_m: float, every: int) -> Any:
    out, count = np.empty(len(xyz), np.int64), 0
    for i in range(len(xyz)):
        key = voxel_key(xyz[i, 0], xyz[i, 1], 0.0, 1.0 / cell_m)
        if spread(key) % every == 0:
            out[count] = key
            count += 1
    return out[:count]
