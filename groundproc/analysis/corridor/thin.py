"""Points on thin lines: many others lie along a direction, and hardly any beside it."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from groundproc.numerics.voxelhash import assign

Array = npt.NDArray[np.float64]

RADIUS_M: Final = 4.0
"""How far along a line is looked: a wire has a hit or two of each laser that passes over it."""
_NEIGHBOURS: Final = 64
_MORE: Final = 256
_CROWDED_M: Final = 2.5
"""Where all neighbours are nearer, as amid the wires of one pole, more are looked at."""
_PIECE: Final = 25_000
_DIRECTIONS: Final = 20
_TUBES_M: Final = ((0.15, 0.35, 4.0), (0.09, 0.2, 6.0))
"""Points nearer to a line than the first are on it: noise, and what strips disagree in. Points up to the second are beside it. The third is
how many are on it at least: in a crown some lie on a narrow line by chance. The wide tube bears strips that disagree, and conductors hang
further apart than that; the narrow one tells the four of a rack or a bundle, 25 to 40 cm apart."""
_FEWEST: Final = 4
_SPAN_M: Final = 2.0
VOXEL_M: Final = 0.2
"""Of points nearer to each other one is enough: so dense clouds see as far as thin ones."""


class Thin(NamedTuple):
    """Points on lines.

    Attributes
    ----------
    xyz_m : ndarray, shape (n, 3)
    direction : ndarray, shape (n, 3)
        Unit vectors of either sign.
    core : ndarray of bool, shape (n,)
    """

    xyz_m: Array
    direction: Array
    core: npt.NDArray[np.bool_]


def thin_points(xyz_m: Array, core: npt.NDArray[np.bool_]) -> Thin:
    """Points on lines among some, one of each small voxel.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    core : ndarray of bool, shape (n,)
        Handed through.
    """
    if len(xyz_m) < _FEWEST + 1:
        return Thin(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.bool_))
    origin = np.floor(xyz_m.min(axis=0))
    voxel, count = assign(xyz_m - origin, VOXEL_M)
    first = np.full(count, -1, np.int64)
    first[voxel[::-1]] = np.arange(len(voxel))[::-1]
    places, core = xyz_m[first] - origin, core[first]
    tree: Any = cKDTree(places)
    directions = np.zeros_like(places)
    tubes = np.array(_TUBES_M)
    for start in range(0, len(places), _PIECE):
        number = np.arange(start, min(start + _PIECE, len(places)))
        away, near = tree.query(places[number], k=min(_NEIGHBOURS, len(places)), distance_upper_bound=RADIUS_M)
        _directions(places, near, number, tubes, directions)
        crowded = number[(away[:, -1] < _CROWDED_M) & (len(places) > _NEIGHBOURS)]
        _, near = tree.query(places[crowded], k=min(_MORE, len(places)), distance_upper_bound=RADIUS_M)
        _directions(places, near, crowded, tubes, directions)
    on = np.abs(directions).sum(axis=1) > 0.0
    return Thin(places[on] + origin, directions[on], core[on])


@njit(cache=True, nogil=True)
def _directions(places: Any, near: Any, number: Any, tubes: Any, out: Any) -> None:
    """The line through each point along which most neighbours lie, if it is a thin one; else it stays what it was."""
    n = len(places)
    d = np.empty((near.shape[1], 3))
    for row in range(len(near)):
        i, m = number[row], 0
        for k in range(near.shape[1]):
            j = near[row, k]
            if j >= n:
                break
            if j != i:
                d[m] = places[j] - places[i]
                m += 1
        if m < _FEWEST:
            continue
        best = 0.0
        for k in range(m - 1, -1, -max(m // _DIRECTIONS, 1)):
            length = np.sqrt(d[k, 0] ** 2 + d[k, 1] ** 2 + d[k, 2] ** 2)
            if length < 0.5 * _SPAN_M:
                break
            for tube in range(len(tubes)):
                score = _score(d[:m], d[k] / length, tubes[tube])
                if score > best:
                    best = score
                    out[i] = d[k] / length


@njit(cache=True, nogil=True)
def _score(d: Any, way: Any, tube: Any) -> float:
    """Points on a line less those beside it; 0 where it is no thin one."""
    inside, beside, low, high = 0, 0, 0.0, 0.0
    x, y, z, on, by = way[0], way[1], way[2], tube[0] ** 2, tube[1] ** 2
    for j in range(len(d)):
        along = d[j, 0] * x + d[j, 1] * y + d[j, 2] * z
        off = d[j, 0] ** 2 + d[j, 1] ** 2 + d[j, 2] ** 2 - along * along
        if off < on:
            inside += 1
            low, high = min(low, along), max(high, along)
        elif off < by:
            beside += 1
    score = inside - 1.5 * beside
    return score if inside >= tube[2] and high - low >= _SPAN_M and score > 0.4 * inside else 0.0
