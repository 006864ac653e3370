"""Points of thin lines joined along them."""

from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_GAP_M: Final = 5.0
_OFF_M: Final = 0.25
_TURN: Final = float(np.cos(np.deg2rad(9.0)))


def chained(xyz_m: Array, direction: Array, fewest: int, shortest_m: float) -> list[Ints]:
    """Numbers of the points of each chain.

    Two points are of one chain that lie near each other on each other's lines.

    Parameters
    ----------
    xyz_m, direction : ndarray, shape (n, 3)
        See `thin.Thin`.
    fewest : int
    shortest_m : float
        Points and length that a chain has at least.
    """
    if len(xyz_m) < fewest:
        return []
    pairs = cKDTree(xyz_m).query_pairs(_GAP_M, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    between = xyz_m[b] - xyz_m[a]
    joined = np.abs(np.sum(direction[a] * direction[b], axis=1)) > _TURN
    for each in (a, b):
        along = np.sum(between * direction[each], axis=1)
        off = np.sum(between**2, axis=1) - along**2
        joined &= off < _OFF_M**2
    a, b = a[joined], b[joined]
    graph = scipy.sparse.coo_array((np.ones(len(a), np.int8), (a, b)), shape=(len(xyz_m),) * 2)
    count, number = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(number, kind="stable")
    chains = np.split(order, np.searchsorted(number[order], np.arange(1, count)))
    return [
        each for each in chains if len(each) >= fewest and np.linalg.norm(np.ptp(xyz_m[each], axis=0)) >= shortest_m
    ]
