"""Points that nothing is near: birds, insects, dust, echoes of nothing."""

from typing import Final, Self

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Keys = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

FELLOWS: Final = 2
"""A wire or a twig has more within two voxels."""
LEAST_SIDE_M: Final = 2.0
_IN_COLUMN: Final = 4
"""Points in most columns of voxels: with these, one of nine columns has two others beside it but once in 10^12."""
_WAITING: Final = 4_000_000
_BITS: Final = 21
"""Of each axis in a key."""


class Lonely:
    """Counts points by voxel, and finds those that are alone.

    Memory: 16 bytes for each voxel with points.

    Parameters
    ----------
    side_m : float
        Of a voxel.
    """

    def __init__(self, side_m: float = LEAST_SIDE_M) -> None:
        self._side_m, self._doubled = side_m, 0
        self._keys: list[Keys] = []
        self._counts: list[Keys] = []

    def add(self, xyz_m: Array) -> None:
        """Count points, shape (n, 3)."""
        self._take(*np.unique(self._key(self._cells(xyz_m)), return_counts=True))

    def join(self, other: Self) -> None:
        """Count the points of another, with voxels of the same side."""
        other._merge()
        for keys, counts in zip(other._keys, other._counts, strict=True):
            self._take(keys, counts)

    def widen(self) -> None:
        """Double the voxels until half of their columns and more hold `_IN_COLUMN` points: those of a sparse cloud are far apart.

        Where even the widest do not, no point has company, and so none stands out: none is alone.
        """
        self._merge()
        while self._keys and not self._full():
            if self._doubled == _BITS - 2:
                self._keys, self._counts = [], []
                return
            self._doubled += 1
            half = [(self._keys[0] >> (axis * _BITS) & (1 << _BITS) - 1) >> 1 for axis in range(3)]
            self._keys = [half[2] << 2 * _BITS | half[1] << _BITS | half[0]]
            self._merge(again=True)

    def alone(self, xyz_m: Array) -> Mask:
        """Points whose voxel and the 26 around it hold no more than `FELLOWS` others, shape (n,)."""
        self._merge()
        out = np.zeros(len(xyz_m), np.bool_)
        if not self._keys:
            return out
        cells = self._cells(xyz_m)
        left = np.flatnonzero(self._of(cells) <= FELLOWS + 1)
        total = np.zeros(len(left), np.int64)
        for step in np.ndindex(3, 3, 3):
            total += self._of(cells[left] + np.array(step) - 1)
        out[left[total <= FELLOWS + 1]] = True
        return out

    def _full(self) -> bool:
        """Whether half of the columns that have points have enough."""
        _, column = np.unique(self._keys[0] >> _BITS, return_inverse=True)
        return bool(np.median(np.bincount(column, self._counts[0])) >= _IN_COLUMN)

    def _take(self, keys: Keys, counts: Keys) -> None:
        self._keys.append(keys)
        self._counts.append(counts)
        if sum(map(len, self._keys[1:])) > _WAITING:
            self._merge()

    def _cells(self, xyz_m: Array) -> Keys:
        return np.floor(xyz_m / self._side_m).astype(np.int64) >> self._doubled

    def _of(self, cells: Keys) -> Keys:
        keys = self._key(cells)
        place = np.searchsorted(self._keys[0], keys).clip(0, len(self._keys[0]) - 1)
        return np.where(self._keys[0][place] == keys, self._counts[0][place], 0)

    def _merge(self, again: bool = False) -> None:
        if len(self._keys) > 1 or again:
            keys, number = np.unique(np.concatenate(self._keys), return_inverse=True)
            counts = np.bincount(number, np.concatenate(self._counts)).astype(np.int64)
            self._keys, self._counts = [keys], [counts]

    def _key(self, cells: Keys) -> Keys:
        """One number for each voxel, with 21 bits for each axis, height the lowest."""
        bits = _BITS - self._doubled
        x, y, z = ((cells[:, axis] + (1 << bits - 1)) & ((1 << bits) - 1) for axis in range(3))
        return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)
