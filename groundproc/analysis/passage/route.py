"""The best route over a raster of costs."""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

Array = npt.NDArray[np.float64]
Cell = tuple[int, int]
Index = npt.NDArray[np.int64]

MOST_CELLS: Final = 16_000_000
"""That can be gone on, of one search: each takes some 100 bytes."""
_SIDES: Final = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, np.sqrt(2.0)), (1, -1, np.sqrt(2.0)))
_NONE: Final = -9999


def best_route(cells: tuple[Index, Index], cost: npt.NDArray[np.floating], start: Cell, end: Cell) -> Index | None:
    """Cells of the way of least cost from one cell to another, shape (n, 2) of row and column; None: there is none.

    A step from a cell to one of its eight neighbours costs its length in cells times the mean of both costs; over a corner it goes only
    where both cells beside it can be gone on too.

    Parameters
    ----------
    cells : tuple of two ndarrays of int64, shape (n,)
        Rows and columns of the cells that can be gone on, sorted by row, then by column.
    cost : ndarray, shape (n,)
        Of a cell's width.
    start, end : (int, int)
        Row and column, each one of the cells.
    """
    row, column = cells
    width = int(column.max()) + 3
    key = row * width + column + 1  # a margin, so that no row runs on into the next
    parts: list[tuple[Index, Index, Array]] = []
    for down, right, length in _SIDES:
        other, both = _found(key, key + down * width + right)
        if down and right:
            both &= _found(key, key + right)[1] & _found(key, key + down * width)[1]
        first = np.flatnonzero(both)
        second = other[both]
        parts.append((first, second, length * 0.5 * (cost[first] + cost[second]).astype(np.float64)))
    first, second, weight = (np.concatenate([part[k] for part in parts]) for k in range(3))
    size = len(key)
    graph = coo_array((weight, (first, second)), shape=(size, size)).tocsr()
    first_cell, place = (int(np.searchsorted(key, each[0] * width + each[1] + 1)) for each in (start, end))
    before = dijkstra(graph, directed=False, indices=np.array([first_cell]), return_predecessors=True)[1][0]
    way = [place]
    while place != first_cell:
        place = int(before[place])
        if place == _NONE:
            return None
        way.append(place)
    return np.column_stack([row, column])[way[::-1]]


def _found(sorted_keys: Index, wanted: Index) -> tuple[Index, npt.NDArray[np.bool_]]:
    """Where keys stand among sorted ones, and whether they do."""
    at = np.minimum(np.searchsorted(sorted_keys, wanted), len(sorted_keys) - 1)
    return at, sorted_keys[at] == wanted
