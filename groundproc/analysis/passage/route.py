"""The best route over a raster of costs."""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

Array = npt.NDArray[np.float64]
Cell = tuple[int, int]

MOST_CELLS: Final = 16_000_000
"""That can be gone on, of one search: each takes some 100 bytes."""
_SIDES: Final = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, np.sqrt(2.0)), (1, -1, np.sqrt(2.0)))
_NONE: Final = -9999


def best_route(cost: npt.NDArray[np.floating], start: Cell, end: Cell) -> npt.NDArray[np.int64] | None:
    """Cells of the way of least cost from one cell to another, shape (n, 2) of row and column; None: there is none.

    A step from a cell to one of its eight neighbours costs its length in cells times the mean of both costs; over a corner it goes only
    where both cells beside it can be gone on too.

    Parameters
    ----------
    cost : ndarray, shape (rows, columns)
        Of a cell's width; NaN where nobody can go.
    start, end : (int, int)
        Row and column, where it can be gone.
    """
    rows, columns = cost.shape
    free = np.isfinite(cost)
    number = np.full(cost.shape, -1, np.int32)
    number[free] = np.arange(int(free.sum()), dtype=np.int32)
    parts: list[tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], Array]] = []
    for down, right, length in _SIDES:
        a = (slice(0, rows - down), slice(max(-right, 0), columns - max(right, 0)))
        b = (slice(down, rows), slice(max(right, 0), columns - max(-right, 0)))
        both = free[a] & free[b]
        if down and right:
            both &= free[a[0], b[1]] & free[b[0], a[1]]
        parts.append(
            (number[a][both], number[b][both], length * 0.5 * (cost[a][both] + cost[b][both]).astype(np.float64))
        )
    first, second, weight = (np.concatenate([part[k] for part in parts]) for k in range(3))
    size = int(free.sum())
    graph = coo_array((weight, (first, second)), shape=(size, size)).tocsr()
    first_cell = int(number[start])
    before = dijkstra(graph, directed=False, indices=np.array([first_cell]), return_predecessors=True)[1][0]
    place, way = int(number[end]), [int(number[end])]
    while place != first_cell:
        place = int(before[place])
        if place == _NONE:
            return None
        way.append(place)
    return np.argwhere(free)[way[::-1]]
