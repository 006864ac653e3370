"""Points that nothing is near: birds, insects, dust, echoes of nothing."""

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Keys = npt.NDArray[np.int64]

FELLOWS: Final = 2
"""A wire or a twig has more within two voxels."""
LEAST_SIDE_M: Final = 2.0
_WAITING: Final = 4_000_000
_BIAS: Final = 1 << 20


class Lonely:
    """Counts points by voxel, and finds those that are alone.

    Memory: 16 bytes for each voxel with points.

    Parameters
    ----------
    side_m : float
        Of a voxel.
    """

    def __init__(self, side_m: float = LEAST_SIDE_M) -> None:
        self._side_m = side_m
        self._keys: list[Keys] = []
        self._counts: list[Keys] = []

    def add(self, xyz_m: Array) -> None:
        """Count points, shape (n, 3)."""
        keys, counts = np.unique(_key(self._cells(xyz_m)), return_counts=True)
        self._keys.append(keys)
        self._counts.append(counts)
        if sum(map(len, self._keys[1:])) > _WAITING:
            self._merge()

    def alone(self, xyz_m: Array) -> npt.NDArray[np.bool_]:
        """Points whose voxel and the 26 around it hold no more than `FELLOWS` others, shape (n,)."""
        self._merge()
        cells = self._cells(xyz_m)
        left = np.flatnonzero(self._of(cells) <= FELLOWS + 1)
        total = np.zeros(len(left), np.int64)
        for step in np.ndindex(3, 3, 3):
            total += self._of(cells[left] + np.array(step) - 1)
        out = np.zeros(len(xyz_m), np.bool_)
        out[left[total <= FELLOWS + 1]] = True
        return out

    def _cells(self, xyz_m: Array) -> Keys:
        return np.floor(xyz_m / self._side_m).astype(np.int64)

    def _of(self, cells: Keys) -> Keys:
        keys = _key(cells)
        place = np.searchsorted(self._keys[0], keys).clip(0, len(self._keys[0]) - 1)
        return np.where(self._keys[0][place] == keys, self._counts[0][place], 0)

    def _merge(self) -> None:
        if len(self._keys) > 1:
            keys, number = np.unique(np.concatenate(self._keys), return_inverse=True)
            counts = np.bincount(number, np.concatenate(self._counts)).astype(np.int64)
            self._keys, self._counts = [keys], [counts]


def _key(cells: Keys) -> Keys:
    """One number for each voxel, with 21 bits for each axis."""
    mask = 2 * _BIAS - 1
    x, y, z = ((cells[:, axis] + _BIAS) & mask for axis in range(3))
    return np.asarray((x << 42) | (y << 21) | z)
