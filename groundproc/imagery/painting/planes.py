"""Planes in small cells of a cloud: how far points stand apart, which way the surface looks, how rough it is.

Cells, not neighbours of each point: a plane of a few points each, for all points at the cost of finding their cells.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import ndimage

from groundproc.numerics.planes import flattest
from groundproc.numerics.voxelhash import around, numbered, table_for

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

COLUMN_M: Final = 0.5
"""Side of the columns of ground whose tops tell which side of a wall is outside; wider where points are fewer."""
_FILLED: Final = 2.5
"""Spacings that a column is wide, at least: of points at random one column in 500 is then empty."""
_SIDE: Final = 3.5
"""Of a cell, in usual spacings of the points."""
_LEAST: Final = 6
"""Points of a plane."""
_FLAT: Final = 0.3
"""A plane is no rougher than so much of its smaller extent."""
_FILLS: Final = 0.5 / np.sqrt(12.0)
"""Smaller extent of a plane, in sides of a cell, at least: of points all over half the width of one. Leaves and branches do not fill it."""
_UPRIGHT: Final = 0.3
"""Vertical part of the normal below which a plane is a wall."""
_SMOOTH: Final = 1.5
"""A cell that is rougher than so many times the usual may hold more than one surface."""
_ON: Final = 3.0
"""Deviations from a neighbouring cell's plane at which a point still lies on it."""
_STEP: Final = 1.5
"""Columns ahead of a wall and behind it."""
_LOWER_M: Final = 0.5
"""A wall looks to the side where the top of everything, so far away from it, is so much lower than on its other side."""


class Known(NamedTuple):
    """What is known of the surface about each of n points.

    Attributes
    ----------
    spacing_m, rough_m, above_m : ndarray of float32, shape (n,)
        Distance of neighbours, deviation of points from their plane, and that of this one, along the normal.
    normal : ndarray of float32, shape (n, 3)
        Of length 1 where outwards is known, 1/2 where not, 0 where there is no plane.
    """

    spacing_m: npt.NDArray[np.float32]
    normal: npt.NDArray[np.float32]
    rough_m: npt.NDArray[np.float32]
    above_m: npt.NDArray[np.float32]


class _Cells(NamedTuple):
    """Cells of a grid that hold points, the table that finds them by their keys, and the planes of their points."""

    size_m: float
    keys: npt.NDArray[np.int64]
    table: Ints
    points: npt.NDArray[np.int64]
    normal: Array
    rough_m: Array
    middle_m: Array


class _Tops(NamedTuple):
    """The highest point of each column of ground; -inf where there is none. `low` is the number of the first column both ways."""

    wide_m: float
    low: Array
    top_m: Array


def columns(xyz_m: Array, wide_m: float = COLUMN_M) -> tuple[Ints, tuple[int, int]]:
    """The column of ground that each point, shape (n, 3), stands in, row by row, and how many there are both ways."""
    low = np.floor(xyz_m[:, :2].min(axis=0) / wide_m)
    rows, across = (np.floor(xyz_m[:, :2].max(axis=0) / wide_m) - low).astype(int) + 1
    out = np.empty(len(xyz_m), np.int32)
    _columns(xyz_m, low, int(across), wide_m, out)
    return out, (int(rows), int(across))


def surfaces(xyz_m: Array, known: Known) -> float:
    """Fill in what is known about points, shape (n, 3), and give their usual spacing.

    Of two grids of cells, one half a cell off: a plane that lies along the border of the cells of one lies within those of the other. A
    cell at an edge holds points of two surfaces. Those take the best plane among their cell's and its neighbours' that they lie on.
    """
    tops, usual_m = _tops(xyz_m)
    grids = [_cells(xyz_m, _SIDE * usual_m, offset, tops) for offset in (0.0, 0.5)]
    smooth = [cells.rough_m[(cells.normal != 0.0).any(axis=1)] for cells, _ in grids]
    usual_rough_m = float(np.median(np.concatenate(smooth))) if sum(map(len, smooth)) else 0.0
    score = np.full(len(xyz_m), np.inf)
    for values in known:
        values[:] = 0.0
    for cells, of_point in grids:
        _assign(xyz_m, of_point, cells, usual_rough_m, score, known)
    (one, of_one), (other, of_other) = grids
    _spacings(one.points, of_one, other.points, of_other, _SIDE * usual_m, known.spacing_m)
    return usual_m


def _cells(xyz_m: Array, cell_m: float, offset: float, tops: _Tops) -> tuple[_Cells, Ints]:
    """The cells of one grid, and the cell of each point."""
    table = table_for(2 * len(xyz_m))
    of_point, keys, count = numbered(xyz_m + offset * cell_m, 1.0 / cell_m, table)
    points, middle_m, spread = np.zeros(count, np.int64), np.zeros((count, 3)), np.zeros((count, 6))
    _moments(xyz_m, of_point, points, middle_m, spread)
    normal, rough_m = np.zeros((count, 3)), np.zeros(count)
    _planes(points, spread, (_FILLS * cell_m) ** 2, normal, rough_m)
    normal = _outwards(normal, middle_m, tops)
    return _Cells(cell_m, keys[:count], table, points, normal, rough_m, middle_m), of_point


@njit(cache=True, nogil=True)
def _columns(xyz: Any, low: Any, across: int, wide_m: float, out: Any) -> None:
    for i in range(len(xyz)):
        row, column = np.floor(xyz[i, 0] / wide_m) - low[0], np.floor(xyz[i, 1] / wide_m) - low[1]
        out[i] = np.int32(row) * across + np.int32(column)


@njit(cache=True, nogil=True)
def _assign(xyz_m: Any, of_point: Any, cells: Any, usual_rough_m: float, score: Any, known: Any) -> None:
    """Give points the best plane of one grid that they lie on, where it is better than what they have.

    A cell that is as smooth as most is no edge, and its points look no farther.
    """
    good = np.empty(len(cells.keys), np.bool_)
    for c in range(len(good)):
        flat = cells.normal[c, 0] != 0.0 or cells.normal[c, 1] != 0.0 or cells.normal[c, 2] != 0.0
        good[c] = flat and cells.rough_m[c] <= _SMOOTH * usual_rough_m
    near: Any = np.empty(27, np.int32)
    of_near: Any = -1
    for i in range(len(xyz_m)):
        own = of_point[i]
        if good[own]:
            _offer(xyz_m, cells, own, (True, usual_rough_m), score, known, i)
            continue
        if of_near != own:  # points of one cell often follow each other
            around(cells.keys, cells.table, own, near)
            of_near = own
        for c in near:
            if c >= 0:
                _offer(xyz_m, cells, c, (c == own, usual_rough_m), score, known, i)


@njit(cache=True, nogil=True)
def _offer(xyz_m: Any, cells: Any, c: int, terms: Any, score: Any, known: Any, point: int) -> None:
    """Give a point the plane of a cell where it lies on it and this is more certain there than what it has."""
    own, usual_rough_m = terms
    square, off, away = 0.0, 0.0, 0.0
    for axis in range(3):
        normal, way = cells.normal[c, axis], xyz_m[point, axis] - cells.middle_m[c, axis]
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
    if found >= score[point]:
        return
    score[point] = found
    known.rough_m[point], known.above_m[point] = rough_m, off
    for axis in range(3):
        known.normal[point, axis] = cells.normal[c, axis]


@njit(cache=True, nogil=True)
def _spacings(ones: Any, of_one: Any, others: Any, of_other: Any, side_m: float, out: Any) -> None:
    """The distance of neighbours by the fuller one of a point's two cells."""
    for i in range(len(out)):
        out[i] = side_m / np.sqrt(max(ones[of_one[i]], others[of_other[i]]))


def _tops(xyz_m: Array) -> tuple[_Tops, float]:
    """The tops of columns so wide that few are empty, and the usual spacing of points seen from above."""
    wide_m = COLUMN_M
    while True:
        of_point, shape = columns(xyz_m, wide_m)
        top = np.full(shape[0] * shape[1], -np.inf)
        _highest(xyz_m, of_point, top)
        usual_m = float(wide_m * np.sqrt(np.count_nonzero(np.isfinite(top)) / len(xyz_m)))
        if _FILLED * usual_m <= wide_m or max(shape) == 1:
            break
        wide_m *= 2.0
    found = top.reshape(shape)
    empty = ~np.isfinite(found)
    if empty.any():  # one column without points between others is no pit
        found = np.where(empty, ndimage.maximum_filter(found, 3, mode="nearest"), found)
    return _Tops(wide_m, np.floor(xyz_m[:, :2].min(axis=0) / wide_m), found), usual_m


@njit(cache=True, nogil=True)
def _highest(xyz: Any, of_point: Any, top: Any) -> None:
    for i in range(len(xyz)):
        top[of_point[i]] = max(top[of_point[i]], xyz[i, 2])


@njit(cache=True, nogil=True)
def _moments(xyz: Any, of_point: Any, points: Any, middle: Any, spread: Any) -> None:
    """Number, middle and mean products of the deviations from it (xx, xy, xz, yy, yz, zz) of the points of each cell."""
    first = np.zeros((len(points), 3))
    for i in range(len(xyz)):
        c = of_point[i]
        if points[c] == 0:
            first[c] = xyz[i]
        points[c] += 1
        # from the first of them: sums of squares of coordinates themselves would lose the digits that count
        x, y, z = xyz[i, 0] - first[c, 0], xyz[i, 1] - first[c, 1], xyz[i, 2] - first[c, 2]
        m, s = middle[c], spread[c]
        m[0], m[1], m[2] = m[0] + x, m[1] + y, m[2] + z
        s[0], s[1], s[2] = s[0] + x * x, s[1] + x * y, s[2] + x * z
        s[3], s[4], s[5] = s[3] + y * y, s[4] + y * z, s[5] + z * z
    for c in range(len(points)):
        m, s = middle[c], spread[c]
        place = 0
        for axis in range(3):
            m[axis] /= points[c]
        for i in range(3):
            for j in range(i, 3):
                s[place] = s[place] / points[c] - m[i] * m[j]
                place += 1
        for axis in range(3):
            m[axis] += first[c, axis]


@njit(cache=True, nogil=True)
def _planes(points: Any, spread: Any, least_square: float, normal: Any, rough: Any) -> None:
    """Normals and roughnesses where there is a plane."""
    found = np.empty(3)
    for c in range(len(points)):
        if points[c] < _LEAST:
            continue
        s = spread[c]
        least, middle = flattest(s[0], s[1], s[2], s[3], s[4], s[5], found)
        least = max(least, 0.0)
        if least < _FLAT * _FLAT * middle and middle >= least_square:
            normal[c] = found
            rough[c] = np.sqrt(least * points[c] / (points[c] - 3.0))  # a plane takes three of the points' freedoms


def _outwards(normal: Array, middle_m: Array, tops: _Tops) -> Array:
    """Normals turned outwards: up, and of walls to where there is less."""
    top = tops.top_m
    wall = (np.abs(normal[:, 2]) < _UPRIGHT) & (normal != 0.0).any(axis=1)
    out = np.where(normal[:, 2:] < 0.0, -normal, normal)
    across = out[wall, :2] / np.linalg.norm(out[wall, :2], axis=1, keepdims=True)

    def height(sign: float) -> Array:
        place = middle_m[wall, :2] / tops.wide_m + sign * _STEP * across
        column = (np.floor(place) - tops.low).astype(np.int64)
        inside = ((column >= 0) & (column < top.shape)).all(axis=1)
        column[~inside] = 0
        return np.where(inside, top[column[:, 0], column[:, 1]], np.nan)

    ahead, back = height(1.0), height(-1.0)
    with np.errstate(invalid="ignore"):
        out[wall] *= np.select([back - ahead > _LOWER_M, ahead - back > _LOWER_M], [1.0, -1.0], 0.5)[:, None]
    return np.asarray(out)
