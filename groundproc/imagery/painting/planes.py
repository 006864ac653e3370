"""Planes in small cells of a cloud: how far points stand apart, which way the surface looks, how rough it is.

Cells, not neighbours of each point: a plane of a few points each, for all points at the cost of sorting them.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

_COLUMN_M: Final = 0.5
_HALF: Final = 1 << 31
_SIDE: Final = 3.5
"""Of a cell, in usual spacings of the points."""
_LEAST: Final = 6
"""Points of a plane."""
_FLAT: Final = 0.3
"""A plane is no rougher than so much of its smaller extent."""
_UPRIGHT: Final = 0.3
"""Vertical part of the normal below which a plane is a wall."""
_SMOOTH: Final = 1.5
"""A cell that is rougher than so many times the usual may hold more than one surface."""
_ON: Final = 3.0
"""Deviations from a neighbouring cell's plane at which a point still lies on it."""
_STEP_M: Final = 0.75
_LOWER_M: Final = 0.5
"""A wall looks to the side where the top of everything, so far away from it, is so much lower than on its other side."""


class Known(NamedTuple):
    """What is known of the surface about each of n points.

    Attributes
    ----------
    spacing_m, rough_m, above_m : ndarray, shape (n,)
        Distance of neighbours, deviation of points from their plane, and that of this one, along the normal.
    normal : ndarray, shape (n, 3)
        Of length 1 where outwards is known, 1/2 where not, 0 where there is no plane.
    """

    spacing_m: Array
    normal: Array
    rough_m: Array
    above_m: Array


class _Cells(NamedTuple):
    """Cells of a grid that hold points, in the order of their keys, and the planes of their points."""

    size_m: float
    offset: float
    first: npt.NDArray[np.int64]
    wide: npt.NDArray[np.int64]
    key: npt.NDArray[np.int64]
    points: npt.NDArray[np.int64]
    normal: Array
    rough_m: Array
    middle_m: Array


def surfaces(xyz_m: Array) -> tuple[float, Known]:
    """The usual spacing of points, shape (n, 3), and what is known about each.

    Of two grids of cells, one half a cell off: a plane that lies along the border of the cells of one lies within those of the other. A
    cell at an edge holds points of two surfaces. Those take the best plane among their cell's and its neighbours' that they lie on.
    """
    tops = _tops(xyz_m)
    usual_m = float(np.sqrt(np.count_nonzero(np.isfinite(tops[0])) * _COLUMN_M**2 / len(xyz_m)))
    grids = [_cells(xyz_m, _SIDE * usual_m, offset, tops) for offset in (0.0, 0.5)]
    smooth = [cells.rough_m[(cells.normal != 0.0).any(axis=1)] for cells, _ in grids]
    usual_rough_m = float(np.median(np.concatenate(smooth))) if sum(map(len, smooth)) else 0.0
    score = np.full(len(xyz_m), np.inf)
    known = Known(np.zeros(len(xyz_m)), np.zeros((len(xyz_m), 3)), np.zeros(len(xyz_m)), np.zeros(len(xyz_m)))
    for cells, of_point in grids:
        _assign(xyz_m, of_point, cells, usual_rough_m, score, known)
    (one, of_one), (other, of_other) = grids
    fuller = np.maximum(one.points[of_one], other.points[of_other])
    known.spacing_m[:] = _SIDE * usual_m / np.sqrt(fuller)
    return usual_m, known


def _cells(
    xyz_m: Array, cell_m: float, offset: float, tops: tuple[Array, npt.NDArray[np.int64]]
) -> tuple[_Cells, npt.NDArray[np.int64]]:
    """The cells of one grid, and the cell of each point."""
    cell = np.floor(xyz_m / cell_m + offset).astype(np.int64)
    first = cell.min(axis=0)
    cell -= first
    wide = cell.max(axis=0) + 1
    packed = (cell[:, 0] * wide[1] + cell[:, 1]) * wide[2] + cell[:, 2]
    key, of_point, count = np.unique(packed, return_inverse=True, return_counts=True)
    of_point = of_point.reshape(-1)
    normal, rough_m, middle_m = _planes(xyz_m, of_point, count)
    normal = _outwards(normal, middle_m, tops)
    return _Cells(cell_m, offset, first, wide, key, count, normal, rough_m, middle_m), of_point


@njit(cache=True, nogil=True)
def _assign(xyz_m: Any, of_point: Any, cells: Any, usual_rough_m: float, score: Any, known: Any) -> None:
    """Give points the best plane of one grid that they lie on, where it is better than what they have.

    A cell that is as smooth as most is no edge, and its points look no farther.
    """
    good = np.empty(len(cells.key), np.bool_)
    for c in range(len(good)):
        flat = cells.normal[c, 0] != 0.0 or cells.normal[c, 1] != 0.0 or cells.normal[c, 2] != 0.0
        good[c] = flat and cells.rough_m[c] <= _SMOOTH * usual_rough_m
    around = np.full((len(cells.key), 27), -1, np.int64)
    for c in range(len(good)):
        if good[c]:
            around[c, 0] = c
        else:
            _neighbours(cells, c, around[c])
    for i in range(len(xyz_m)):
        for c in around[of_point[i]]:
            if c >= 0:
                _offer(xyz_m[i], cells, c, (c == of_point[i], usual_rough_m), score[i : i + 1], known, i)


@njit(cache=True, nogil=True)
def _offer(place: Any, cells: Any, c: int, terms: Any, score: Any, known: Any, point: int) -> None:
    """Give a point the plane of a cell where it lies on it and this is more certain there than what it has."""
    own, usual_rough_m = terms
    square, off, away = 0.0, 0.0, 0.0
    for axis in range(3):
        normal, way = cells.normal[c, axis], place[axis] - cells.middle_m[c, axis]
        square += normal * normal
        off += normal * way
        away += way * way
    if square == 0.0:
        return
    off /= np.sqrt(square)
    rough_m = max(cells.rough_m[c], usual_rough_m)
    if not own and abs(off) > _ON * rough_m:
        return
    # rough planes of few points are uncertain, and those that the point lies away from
    found = (rough_m**2 * (1.0 + 12.0 * away / cells.size_m**2) + off * off) / cells.points[c] + rough_m**2
    if found >= score[0]:
        return
    score[0] = found
    known.rough_m[point], known.above_m[point] = rough_m, off
    for axis in range(3):
        known.normal[point, axis] = cells.normal[c, axis]


@njit(cache=True, nogil=True)
def _neighbours(cells: Any, c: int, out: Any) -> None:
    """The cell itself and those of the 26 around it that hold points."""
    wide, count = cells.wide, 0
    z = cells.key[c] % wide[2]
    y = cells.key[c] // wide[2] % wide[1]
    x = cells.key[c] // (wide[2] * wide[1])
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                i, j, k = x + dx, y + dy, z + dz
                if i < 0 or j < 0 or k < 0 or i >= wide[0] or j >= wide[1] or k >= wide[2]:
                    continue
                key = (i * wide[1] + j) * wide[2] + k
                place = np.searchsorted(cells.key, key)
                if place < len(cells.key) and cells.key[place] == key:
                    out[count] = place
                    count += 1


def _tops(xyz_m: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """The highest point of each column of ground, and the first column."""
    column = np.floor(xyz_m[:, :2] / _COLUMN_M).astype(np.int64)
    first = column.min(axis=0)
    column -= first
    top = np.full(column.max(axis=0) + 1, -np.inf)
    np.maximum.at(top, (column[:, 0], column[:, 1]), xyz_m[:, 2])
    return top, first


def _planes(xyz_m: Array, of_point: npt.NDArray[np.int64], count: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Normals, shape (cells, 3), 0 where there is no plane, roughnesses and middles."""
    cells = len(count)

    def sums(values: npt.NDArray[Any]) -> Array:
        return np.bincount(of_point, values, cells) / count

    middle = np.stack([sums(xyz_m[:, axis]) for axis in range(3)], axis=1)
    off = xyz_m - middle[of_point]
    spread = np.empty((cells, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            spread[:, i, j] = spread[:, j, i] = sums(off[:, i] * off[:, j])
    normal, rough = np.zeros((cells, 3)), np.zeros(cells)
    enough = np.flatnonzero(count >= _LEAST)
    size, axes = np.linalg.eigh(spread[enough])
    extent = np.sqrt(np.maximum(size, 0.0))
    flat = extent[:, 0] < _FLAT * extent[:, 1]
    # a plane takes three of the points' freedoms
    free = count[enough][flat] / (count[enough][flat] - 3.0)
    normal[enough[flat]], rough[enough[flat]] = axes[flat, :, 0], extent[flat, 0] * np.sqrt(free)
    return normal, rough, middle


def _outwards(normal: Array, middle_m: Array, tops: tuple[Array, npt.NDArray[np.int64]]) -> Array:
    """Normals turned outwards: up, and of walls to where there is less."""
    top, first = tops
    wall = (np.abs(normal[:, 2]) < _UPRIGHT) & (normal != 0.0).any(axis=1)
    out = np.where(normal[:, 2:] < 0.0, -normal, normal)
    across = out[wall, :2] / np.linalg.norm(out[wall, :2], axis=1, keepdims=True)

    def height(sign: float) -> Array:
        column = np.floor((middle_m[wall, :2] + sign * _STEP_M * across) / _COLUMN_M).astype(np.int64) - first
        inside = ((column >= 0) & (column < top.shape)).all(axis=1)
        column[~inside] = 0
        return np.where(inside, top[column[:, 0], column[:, 1]], np.nan)

    ahead, back = height(1.0), height(-1.0)
    with np.errstate(invalid="ignore"):
        out[wall] *= np.select([back - ahead > _LOWER_M, ahead - back > _LOWER_M], [1.0, -1.0], 0.5)[:, None]
    return np.asarray(out)
