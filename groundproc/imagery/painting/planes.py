"""Planes in small cells of a cloud: how far points stand apart, which way the surface looks, how rough it is.

Cells, not neighbours of each point: a plane of a few points each, for all points at the cost of sorting them.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

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
_STEP_M: Final = 0.75
_LOWER_M: Final = 0.5
"""A wall looks to the side where the top of everything, so far away from it, is so much lower than on its other side."""


class Known(NamedTuple):
    """What is known of the surface about each of n points.

    Attributes
    ----------
    spacing_m, rough_m : ndarray, shape (n,)
    normal : ndarray, shape (n, 3)
        Of length 1 where outwards is known, 1/2 where not, 0 where there is no plane.
    """

    spacing_m: Array
    normal: Array
    rough_m: Array


def surfaces(xyz_m: Array) -> tuple[float, Known]:
    """The usual spacing of points, shape (n, 3), and what is known about each.

    Of two grids of cells, one half a cell off: a plane that lies along the border of the cells of one lies within those of the other.
    """
    tops = _tops(xyz_m)
    usual_m = float(np.sqrt(np.count_nonzero(np.isfinite(tops[0])) * _COLUMN_M**2 / len(xyz_m)))
    known, count = _in_cells(xyz_m, _SIDE * usual_m, 0.0, tops)
    other, more = _in_cells(xyz_m, _SIDE * usual_m, 0.5, tops)
    plane, other_plane = (known.normal != 0.0).any(axis=1), (other.normal != 0.0).any(axis=1)
    better = np.where(plane == other_plane, more > count, other_plane)
    return usual_m, Known(
        np.where(better, other.spacing_m, known.spacing_m),
        np.where(better[:, None], other.normal, known.normal),
        np.where(better, other.rough_m, known.rough_m),
    )


def _in_cells(
    xyz_m: Array, cell_m: float, offset: float, tops: tuple[Array, npt.NDArray[np.int64]]
) -> tuple[Known, npt.NDArray[np.int64]]:
    """What the cells of one grid tell of each point, and how many points are in its cell."""
    cell = np.floor(xyz_m / cell_m + offset).astype(np.int64)
    cell -= cell.min(axis=0)
    wide = cell.max(axis=0) + 1
    key = (cell[:, 0] * wide[1] + cell[:, 1]) * wide[2] + cell[:, 2]
    _, of_point, count = np.unique(key, return_inverse=True, return_counts=True)
    normal, rough_m, middle_m = _planes(xyz_m, of_point, count)
    spacing_m = cell_m / np.sqrt(count)
    normal = _outwards(normal, middle_m, tops)
    return Known(spacing_m[of_point], normal[of_point], rough_m[of_point]), count[of_point]


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
    normal[enough[flat]], rough[enough[flat]] = axes[flat, :, 0], extent[flat, 0]
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
