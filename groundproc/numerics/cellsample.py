"""A sample of a cloud that keeps whole cells of ground: densities and surfaces are in it as they are in the cloud."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]

_RAREST: Final = 1 << 30


class CellSample:
    """Takes points piece by piece, and holds those of some cells: of all at first, and of half as many whenever there are too many.

    Which cells stay follows from their place alone, so the sample does not hang on the pieces.

    Parameters
    ----------
    cell_m : float
        Side of a cell on the map.
    most : int
        Points that are held, at most: of a single cell that has more, those that come first.

    Attributes
    ----------
    every : int
        One of so many cells is held.
    """

    def __init__(self, cell_m: float, most: int) -> None:
        self.every = 1
        self._cell_m, self._most = cell_m, most
        self._parts: list[tuple[npt.NDArray[np.int64], Array]] = []
        self._held = 0

    def add(self, xyz_m: Array) -> None:
        """Take points, shape (n, 3)."""
        self._keep(cells(np.ascontiguousarray(xyz_m), self._cell_m), xyz_m)
        while self._held > self._most and not self._alone():
            self.every *= 2
            parts, self._parts, self._held = self._parts, [], 0
            for part in parts:
                self._keep(*part)
        if self._held > self._most:
            keys, xyz = self._parts[-1]
            left = max(len(keys) - (self._held - self._most), 0)
            self._parts[-1] = keys[:left], xyz[:left]
            self._held += left - len(keys)

    def points(self) -> Array:
        """Those held, shape (k, 3)."""
        return np.concatenate([np.empty((0, 3)), *(xyz for _, xyz in self._parts)])

    def _keep(self, keys: npt.NDArray[np.int64], xyz_m: Array) -> None:
        wanted = chosen(keys, self.every)
        if wanted.any():
            self._parts.append((keys[wanted], xyz_m[wanted]))
            self._held += int(np.count_nonzero(wanted))

    def _alone(self) -> bool:
        """Whether all are of one cell, or of cells that no thinning tells apart."""
        first = next(keys[0] for keys, _ in self._parts if len(keys))
        return self.every >= _RAREST or not any((keys != first).any() for keys, _ in self._parts)


@njit(cache=True, nogil=True)
def cells(xyz: Any, cell_m: float) -> Any:
    """Key of the cell of each point, shape (n,)."""
    out = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        out[i] = voxel_key(xyz[i, 0], xyz[i, 1], 0.0, 1.0 / cell_m)
    return out


@njit(cache=True, nogil=True)
def chosen(keys: Any, every: int) -> Any:
    """Which cells are of the one in so many that are held; of twice as rare ones, part of the same."""
    out = np.empty(len(keys), np.bool_)
    for i in range(len(keys)):
        out[i] = spread(keys[i]) % every == 0
    return out
