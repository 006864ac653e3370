"""Points of thin lines joined along them."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.poles import Pole

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_GAP_M: Final = 5.0
_OFF_M: Final = 0.08
_LEAN: Final = 0.035
"""How far points are off each other's lines: noise, and what the direction errs by, along the way between them."""
_OVER_M: Final = 0.3
"""Wires so far above the top of a pole go on over it: it is a lamp post."""
_BLOCK: Final = 2_000
"""Points whose neighbours are looked at at a time."""
_TURN: Final = float(np.cos(np.deg2rad(9.0)))


def chained(xyz_m: Array, direction: Array, fewest: int, shortest_m: float, poles: Sequence[Pole] = ()) -> list[Ints]:
    """Numbers of the points of each chain.

    Two points are of one chain that lie near each other on each other's lines, with no pole between them.

    Parameters
    ----------
    xyz_m, direction : ndarray, shape (n, 3)
        See `thin.Thin`.
    fewest : int
    shortest_m : float
        Points and length that a chain has at least.
    poles : sequence of Pole
        Where wires end. One that is none, such as a stem, does no harm: pieces of one curve are joined again.
    """
    if len(xyz_m) < fewest:
        return []
    a, b = _unsupported(xyz_m, *_on_each_other(xyz_m, direction), poles)
    graph = scipy.sparse.coo_array((np.ones(len(a), np.int8), (a, b)), shape=(len(xyz_m),) * 2)
    count, number = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(number, kind="stable")
    chains = np.split(order, np.searchsorted(number[order], np.arange(1, count)))
    return [
        each for each in chains if len(each) >= fewest and np.linalg.norm(np.ptp(xyz_m[each], axis=0)) >= shortest_m
    ]


def _on_each_other(xyz_m: Array, direction: Array) -> tuple[Ints, Ints]:
    """Pairs of points that lie near each other on each other's lines."""
    tree = cKDTree(xyz_m)
    found = []
    # block by block: most points have many near them, and few of these on their line
    for start in range(0, len(xyz_m), _BLOCK):
        block = cKDTree(xyz_m[start : start + _BLOCK])
        near: Any = block.sparse_distance_matrix(tree, _GAP_M, output_type="ndarray")
        a, b = near["i"].astype(np.int64) + start, near["j"].astype(np.int64)
        once = a < b
        a, b = a[once], b[once]
        between = xyz_m[b] - xyz_m[a]
        joined = np.abs(np.sum(direction[a] * direction[b], axis=1)) > _TURN
        for each in (a, b):
            along = np.sum(between * direction[each], axis=1)
            off = np.sum(between**2, axis=1) - along**2
            joined &= off < (_OFF_M + _LEAN * np.abs(along)) ** 2
        found.append(np.column_stack([a[joined], b[joined]]))
    pairs = np.concatenate(found)
    return pairs[:, 0], pairs[:, 1]


def _unsupported(xyz_m: Array, a: Ints, b: Ints, poles: Sequence[Pole]) -> tuple[Ints, Ints]:
    """Pairs of points without those that a pole stands between."""
    tree = cKDTree(xyz_m[:, :2])
    for pole in poles:
        place = np.array([pole.x, pole.y])
        reach = pole.arm_m
        near = np.zeros(len(xyz_m), np.bool_)
        near[tree.query_ball_point(place, reach + _GAP_M)] = True
        some = np.flatnonzero(near[a] & near[b])
        way = xyz_m[b[some], :2] - xyz_m[a[some], :2]
        length = np.maximum(np.hypot(*way.T), 1e-9)
        way /= length[:, None]
        to = place - xyz_m[a[some], :2]
        along, off = np.sum(to * way, axis=1), np.abs(to[:, 0] * way[:, 1] - to[:, 1] * way[:, 0])
        keep = np.ones(len(a), np.bool_)
        under = np.minimum(xyz_m[a[some], 2], xyz_m[b[some], 2]) < pole.foot_m + pole.height_m + _OVER_M
        keep[some[(along > 0.0) & (along < length) & (off < reach) & under]] = False
        a, b = a[keep], b[keep]
    return a, b
