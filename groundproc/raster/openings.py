"""Grey-scale openings of rasters by octagons: what is narrower than twice the radius is levelled down to its surroundings.

An octagon, close to a disc, is a square widened by a diamond, and decomposes into lines. The least value along a line is found by doubling:
of two cells, of two such pairs, and so on. All steps of an octagon follow each other row by row, so that the rows in hand stay in the
processor's cache, and a step takes several cells at once.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Raster = npt.NDArray[np.float32]

_CROSS: Final = 2
"""Rows that a step reaches which widens by a cell's four neighbours."""


def opened(surface: Raster, radius: int) -> Raster:
    """Opening by an octagon of a radius in cells; beyond the edge nothing counts.

    Parameters
    ----------
    surface : ndarray of float32, shape (rows, columns)
        Finite.
    radius : int
    """
    square, diamond = _parts(radius)
    low = _octagon(surface, square, diamond, False)
    return _octagon(low, square, diamond, True)


def dilated(surface: Raster, radius: int) -> Raster:
    """Greatest value within an octagon."""
    return _octagon(surface, *_parts(radius), True)


def eroded(surface: Raster, radius: int) -> Raster:
    """Least value within an octagon."""
    return _octagon(surface, *_parts(radius), False)


def _parts(radius: int) -> tuple[int, int]:
    """Half sides of the square and of the diamond; in a regular octagon the square takes tan(22.5 deg) of the radius."""
    square = round(0.4142 * radius)
    if radius == 1:
        square = 0
    return square, radius - square


def _octagon(surface: Raster, square: int, diamond: int, highest: bool) -> Raster:
    # two diagonal lines make a diamond with holes like a chess board; a small cross closes them, and adds one to its half side
    half = max(diamond - 1, 0) // 2
    across = np.array(_doublings(2 * square + 1), np.int64)
    down = [(step, 0, step) for step in _doublings(2 * square + 1)]
    down += [(step, turn * step, step) for turn in (1, -1) for step in _doublings(2 * half + 1)]
    down += [(1, 0, _CROSS)] * (diamond - 2 * half)
    sign = np.float32(-1.0 if highest else 1.0)
    steps = np.array(down, np.int64).reshape(-1, 3)
    return np.asarray(_widened(surface, sign, square + diamond, 2 * half, across, steps))


def _doublings(length: int) -> list[int]:
    """Steps after which a cell has the least value of so many from itself on."""
    steps, covered = [], 1
    while covered < length:
        steps.append(min(covered, length - covered))
        covered += steps[-1]
    return steps


@njit(cache=True, nogil=True)
def _widened(surface: Any, sign: Any, margin: int, left: int, across: Any, down: Any) -> Any:
    """Least values of a surface times a sign, after steps to the right, then steps of rows and columns and the rows that they reach.

    Steps lead to the right, downwards, and down to the left. So the least value around a cell stands `margin` rows above it in the end, and
    `margin` - `left` columns before it. A row has taken a step before the rows above it take the next.
    """
    rows, columns = surface.shape
    # lines may lead out of the raster and back into it
    wide, high = columns + 2 * margin, rows + 2 * margin
    values = np.full((high, wide), np.float32(np.inf))
    out = np.empty((rows, columns), np.float32)
    line, spare = np.empty(wide, np.float32), np.empty(wide, np.float32)
    for newest in range(high + 2 * margin):
        if margin <= newest < margin + rows:
            line[:] = np.inf
            _load(surface[newest - margin], sign, line[margin : margin + columns])
            for step in across:
                # to and fro: a row that is read where it is written is done a cell at a time
                _lesser(line[: wide - step], line[step:], spare)
                spare[wide - step :] = line[wide - step :]
                line, spare = spare, line
            values[newest] = line
        row = newest
        for n in range(len(down)):
            row -= down[n, 2]
            if 0 <= row < high - down[n, 2]:
                _step(values, row, down[n, 0], down[n, 1], down[n, 2])
        if 0 <= row < rows:
            _load(values[row, left : left + columns], sign, out[row])
    return out


@njit(cache=True, nogil=True)
def _step(values: Any, row: int, down: int, right: int, reach: int) -> None:
    """One step of a row."""
    ours, other = values[row], values[row + down]
    if reach > down:
        _cross(ours, other, values[row + _CROSS])
    elif right < 0:
        _lesser(ours[-right:], other[:right], ours[-right:])
    else:
        _lesser(ours[: len(ours) - right], other[right:], ours)


@njit(cache=True, nogil=True)
def _load(source: Any, sign: Any, out: Any) -> None:
    for j in range(len(out)):
        out[j] = sign * source[j]


@njit(cache=True, nogil=True)
def _lesser(one: Any, other: Any, out: Any) -> None:
    for j in range(len(one)):
        out[j] = one[j] if one[j] < other[j] else other[j]


@njit(cache=True, nogil=True)
def _cross(top: Any, middle: Any, low: Any) -> None:
    """Least value of a cell and its four neighbours, kept where the row above begins."""
    for j in range(len(top) - 2):
        a = top[j + 1] if top[j + 1] < low[j + 1] else low[j + 1]
        b = middle[j] if middle[j] < middle[j + 2] else middle[j + 2]
        a = a if a < b else b
        top[j] = a if a < middle[j + 1] else middle[j + 1]
    top[len(top) - 2 :] = np.float32(np.inf)
