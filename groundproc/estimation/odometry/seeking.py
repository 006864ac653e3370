"""Where one map may lie on another, roughly: every shift and heading within reach, tried on a grid.

The grid says which cubes hold what stands and which hold ground (the idea of correlative matching, Olson 2009). Over a
wide reach, cubes of 2 m are tried first, and cubes of 1 m around the best places.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial.transform import Rotation

from groundproc.estimation.odometry.surfaces import FILLED, GROUND, STANDING, Surfaces

Array = npt.NDArray[np.float64]
Bits = npt.NDArray[np.uint8]

CELL_M: Final = 1.0
WIDE_CELL_M: Final = 2.0
WIDE_M: Final = 9.0
"""Reach from which on the wide cubes go before."""
EVERY: Final = 3
"""Of so many points one is tried on wide cubes."""
ARM_M: Final = 30.0
"""A step of the heading moves what is so far away by a cube."""
CANDIDATES: Final = 14
WIDE_CANDIDATES: Final = 30
MOST: Final = 3000
LIKELY: Final = 0.6
"""Places that meet less than such a share of what the best one meets are none."""
LEVEL_SHARE: Final = 0.5
"""Ground tells of the height alone: however much there is of it, all of it weighs so many times what stands."""


class _Grid(NamedTuple):
    """Cubes: bit 1 where something stands, bit 2 where there is ground; `low_m` is the lower corner of the first one."""

    low_m: Array
    cell_m: float
    cells: Bits


class _Tried(NamedTuple):
    """Points to be tried about a middle: the bit of each that has to be met, and its weight."""

    arm_m: Array
    about_m: Array
    bits: Bits
    weights: Array


def starts(mine: Surfaces, theirs: Surfaces, about_m: Array, reach: Array) -> list[Array]:
    """Places to begin from, the best first.

    Parameters
    ----------
    mine, theirs : Surfaces
    about_m : ndarray, shape (3,)
        What the first turns about.
    reach : ndarray, shape (4,)
        East, north, up [m] and heading [rad], to either side.

    Returns
    -------
    list of ndarray, shape (4,)
        Shifts and headings that are apart.
    """
    grid, nothing = _grid(theirs, CELL_M), np.zeros(4)
    whole = _tried(mine, about_m)
    if reach[:2].max() <= WIDE_M:
        return [start for _, start in _best(whole, grid, nothing, reach, CANDIDATES)]
    wide = _best(
        _tried(mine.of(np.arange(0, len(mine), EVERY)), about_m),
        _grid(theirs, WIDE_CELL_M),
        nothing,
        reach,
        WIDE_CANDIDATES,
    )
    step = np.array([WIDE_CELL_M, WIDE_CELL_M, WIDE_CELL_M, CELL_M / ARM_M])
    near = [_best(whole, grid, start, step, 1)[0] for _, start in wide]
    near.sort(key=lambda each: -each[0])
    return [start for score, start in near if score > LIKELY * near[0][0]]


def _grid(other: Surfaces, cell_m: float) -> _Grid:
    low = other.place_m.min(axis=0) - cell_m
    cell = np.floor((other.place_m - low) / cell_m).astype(np.int64)
    cells = np.zeros(cell.max(axis=0) + 2, np.uint8)
    for bit, chosen in ((1, np.isin(other.kind, (STANDING, FILLED))), (2, other.kind == GROUND)):
        mask = np.zeros(cells.shape, np.bool_)
        mask[tuple(cell[chosen].T)] = True
        cells |= (bit * mask).astype(np.uint8)
    return _Grid(low, cell_m, cells)


def _tried(mine: Surfaces, about_m: Array) -> _Tried:
    level = mine.kind == GROUND
    weights = np.where(level, LEVEL_SHARE * (len(level) - level.sum()) / max(level.sum(), 1), 1.0)
    return _Tried(mine.place_m - about_m, about_m, np.where(level, 2, 1).astype(np.uint8), weights)


def _best(tried: _Tried, grid: _Grid, middle: Array, reach: Array, most: int) -> list[tuple[float, Array]]:
    """The best places about one, with what they meet, so many at most; they are more than a cube apart."""
    step = np.array([grid.cell_m, grid.cell_m, grid.cell_m, grid.cell_m / ARM_M])
    axes = [m + s * np.arange(-np.ceil(r / s), np.ceil(r / s) + 1) for m, s, r in zip(middle, step, reach, strict=True)]
    scores = np.empty((len(axes[3]), *(len(axis) for axis in axes[:3])))
    cells = tuple(axis / grid.cell_m for axis in axes[:3])
    for number, turn in enumerate(axes[3].tolist()):
        turned = tried.arm_m @ Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix().T + tried.about_m
        _score((turned - grid.low_m) / grid.cell_m, tried.bits, tried.weights, grid.cells, cells, scores[number])
    flat = scores.ravel()
    order = np.argpartition(flat, -min(MOST, len(flat)))[-min(MOST, len(flat)) :]
    order = order[flat[order] >= LIKELY * flat.max()]
    order = order[np.argsort(-flat[order], kind="stable")]
    found: list[tuple[float, Array]] = []
    for n in order.tolist():
        t, i, j, k = np.unravel_index(n, scores.shape)
        start = np.array([axes[0][i], axes[1][j], axes[2][k], axes[3][t]])
        if all(np.abs(start[:3] - each[:3]).max() > 1.5 * grid.cell_m for _, each in found):
            found.append((float(flat[n]), start))
        if len(found) == most:
            break
    return found


@njit(cache=True, nogil=True)
def _score(place: Array, bits: Bits, weights: Array, cells: Bits, axes: tuple[Array, ...], out: Array) -> None:
    """Weight of the points, in cells, that meet their like, for each shift."""
    wide, deep, high = cells.shape
    for i in range(len(axes[0])):
        for j in range(len(axes[1])):
            for k in range(len(axes[2])):
                total = 0.0
                for n in range(len(place)):
                    x = int(np.floor(place[n, 0] + axes[0][i]))
                    y = int(np.floor(place[n, 1] + axes[1][j]))
                    z = int(np.floor(place[n, 2] + axes[2][k]))
                    if 0 <= x < wide and 0 <= y < deep and 0 <= z < high and cells[x, y, z] & bits[n]:
                        total += weights[n]
                out[i, j, k] = total
