"""Grey-scale openings of rasters by octagons: what is narrower than twice the radius is levelled down to its surroundings.

An octagon, close to a disc, is a square widened by a diamond, and decomposes into lines: a minimum along a line costs three comparisons a
cell whatever its length (van Herk 1992).
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Raster = npt.NDArray[np.float32]


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
    # lines may lead out of the raster and back into it
    margin = square + diamond
    rows, columns = surface.shape
    values = np.full((rows + 2 * margin, columns + 2 * margin), np.inf, np.float32)
    inner = (slice(margin, margin + rows), slice(margin, margin + columns))
    values[inner] = -surface if highest else surface
    if square:
        values = _along_rows(values, square)
        values = np.ascontiguousarray(_along_rows(np.ascontiguousarray(values.T), square).T)
    # two diagonal lines make a diamond with holes like a chess board; a small cross closes them, and adds one to its half side
    half = max(diamond - 1, 0) // 2
    if half:
        values = _along_diagonals(_along_diagonals(values, half, 1), half, -1)
    for _ in range(diamond - 2 * half):
        values = _cross(values)
    found = values[inner]
    return -found if highest else np.ascontiguousarray(found)


@njit(cache=True, nogil=True)
def _along_rows(values: Any, half: int) -> Any:
    """Least value within `half` cells to the left and right."""
    rows, columns = values.shape
    length = 2 * half + 1
    out = np.empty((rows, columns), np.float32)
    padded = columns + 2 * half
    pieces = (padded + length - 1) // length
    size = pieces * length
    line, back = np.empty(size, np.float32), np.empty(size, np.float32)
    for i in range(rows):
        line[:half] = np.inf
        line[half : half + columns] = values[i]
        line[half + columns :] = np.inf
        _van_herk(line, back, length, out[i], columns)
    return out


@njit(cache=True, nogil=True)
def _van_herk(line: Any, back: Any, length: int, out: Any, count: int) -> None:
    """Least of each `length` values that follow each other: by least values from the ends of pieces."""
    size = len(line)
    for start in range(0, size, length):
        end = start + length - 1
        back[end] = line[end]
        for k in range(end - 1, start - 1, -1):
            back[k] = min(line[k], back[k + 1])
        for k in range(start + 1, end + 1):
            line[k] = min(line[k], line[k - 1])
    for k in range(count):
        out[k] = min(back[k], line[k + length - 1])


@njit(cache=True, nogil=True)
def _along_diagonals(values: Any, half: int, turn: int) -> Any:
    """Least value within `half` steps along a diagonal, down to the right (1) or to the left (-1)."""
    rows, columns = values.shape
    if half == 0:
        return values.copy()
    length = 2 * half + 1
    out = np.empty((rows, columns), np.float32)
    longest = min(rows, columns) + 2 * half
    size = (longest + length - 1) // length * length
    line, back, found = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    for start in range(-(rows - 1), columns):
        i0, j0 = max(0, -start), max(0, start)
        count = min(rows - i0, columns - j0)
        used = (count + 2 * half + length - 1) // length * length
        line[:used] = np.inf
        for k in range(count):
            j = j0 + k
            line[half + k] = values[i0 + k, j if turn > 0 else columns - 1 - j]
        _van_herk(line[:used], back[:used], length, found, count)
        for k in range(count):
            j = j0 + k
            out[i0 + k, j if turn > 0 else columns - 1 - j] = found[k]
    return out


@njit(cache=True, nogil=True)
def _cross(values: Any) -> Any:
    """Least value of a cell and its four neighbours."""
    rows, columns = values.shape
    out = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            low = values[i, j]
            if i > 0:
                low = min(low, values[i - 1, j])
            if i < rows - 1:
                low = min(low, values[i + 1, j])
            if j > 0:
                low = min(low, values[i, j - 1])
            if j < columns - 1:
                low = min(low, values[i, j + 1])
            out[i, j] = low
    return out
