"""A sample of a cloud that keeps whole cells of ground: densities and surfaces are in it as they are in the cloud."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]


class CellSample:
    """Takes points piece by piece, and holds those of some cells: of all at first, and of ever fewer as points become too many.

    Cells stand in an order that follows from their place alone, as if shuffled; held are as many of the first as have room. So the sample
    does not hang on the pieces, and is never empty, however unevenly the points are spread.

    Parameters
    ----------
    cell_m : float
        Side of a cell on the map.
    most : int
        Points that are held, at most: of a single cell that has more, those that come first.
    """

    def __init__(self, cell_m: float, most: int) -> None:
        self._cell_m, self._most = cell_m, most
        self._last: int | None = None  # place in the order of the last cell that is held; None: all are
        self._parts: list[tuple[npt.NDArray[np.int64], Array]] = []
        self._held = 0

    def add(self, xyz_m: Array) -> None:
        """Take points, shape (n, 3)."""
        self._keep(places(np.ascontiguousarray(xyz_m), self._cell_m), xyz_m)
        if self._held <= self._most:
            return
        order, count = np.unique(np.concatenate([place for place, _ in self._parts]), return_counts=True)
        room = int(np.searchsorted(np.cumsum(count), self._most, side="right"))
        self._last = int(order[max(room - 1, 0)])
        parts, self._parts, self._held = self._parts, [], 0
        for part in parts:
            self._keep(*part)
        if self._held > self._most:  # one cell alone
            place, xyz = (np.concatenate(each)[: self._most] for each in zip(*self._parts, strict=True))
            self._parts, self._held = [(place, xyz)], self._most

    def points(self) -> Array:
        """Those held, shape (k, 3)."""
        return np.concatenate([np.empty((0, 3)), *(xyz for _, xyz in self._parts)])

    def _keep(self, place: npt.NDArray[np.int64], xyz_m: Array) -> None:
        if self._last is not None:
            wanted = place <= self._last
            place, xyz_m = place[wanted], xyz_m[wanted]
        if len(place):
            self._parts.append((place, xyz_m))
            self._held += len(place)


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


@njit(cache=True, nogil=True)
def places(xyz: Any, cell_m: float) -> Any:
    """Where in the shuffled order of all cells that of each point stands, shape (n,)."""
    out = cells(xyz, cell_m)
    for i in range(len(out)):
        out[i] = spread(out[i])
    return out
