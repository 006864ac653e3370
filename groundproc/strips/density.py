"""How dense a cloud is, and so how large its patches should be."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics.cellsample import cells, chosen

Array = npt.NDArray[np.float64]

CELL_M: Final = 2.0
_MOST_CELLS: Final = 8192
"""Cells that are counted: all where there are no more, else one in so many."""
_POINTS: Final = 40.0
"""Points that a patch should have, of all strips together."""
_SMALLEST_M, _LARGEST_M = 0.5, 4.0


@dataclass(slots=True)
class Density:
    """Counts the points of cells of ground, chunk by chunk; of a large area those of one cell in so many."""

    _every: int = 1
    _keys: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    _counts: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def add(self, xyz_m: Array) -> None:
        """Take points, shape (n, 3)."""
        keys = cells(xyz_m, CELL_M)
        unique, count = np.unique(keys[chosen(keys, self._every)], return_counts=True)
        both, where = np.unique(np.concatenate([self._keys, unique]), return_inverse=True)
        summed = np.bincount(where, np.concatenate([self._counts, count]), len(both))
        self._keys, self._counts = both, summed.astype(np.int64)
        while len(self._keys) > _MOST_CELLS:
            self._every *= 2
            held = chosen(self._keys, self._every)
            self._keys, self._counts = self._keys[held], self._counts[held]

    def voxel_m(self) -> float:
        """Edge of patches of enough points where half of the cells are at least that dense."""
        if not len(self._counts):
            return _LARGEST_M
        per_m2 = float(np.median(self._counts)) / CELL_M**2
        return float(np.clip(np.sqrt(_POINTS / per_m2), _SMALLEST_M, _LARGEST_M))
