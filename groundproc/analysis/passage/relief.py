"""Slope and steps of a raster of ground heights."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

Array = npt.NDArray[np.float64]

REACH: Final = 3
"""Cells on either side that a step is told by."""
_SIDES: Final = ((0, 1), (1, 0), (1, 1), (1, -1))
_WEIGHTS: Final = ((4.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0), (2.0, -1.0))
"""Of three cells in a row, and of two: their line, carried on to the next place."""
_FEWEST: Final = 4
"""Cells for a plane."""


@dataclass(frozen=True, slots=True)
class Plane:
    """Of each cell the plane through the cells around it, shape (rows, columns) each.

    Attributes
    ----------
    height_m : ndarray
        At the middle of the cell; NaN where too few cells are known.
    east, north : ndarray
        Rise over run.
    share : ndarray
        Share of the cells around that are known.
    """

    height_m: Array
    east: Array
    north: Array
    share: Array

    @property
    def slope(self) -> Array:
        """Rise over run of the steepest way."""
        return np.hypot(self.east, self.north)


def planes(height_m: npt.NDArray[np.floating], cell_m: float, radius: int) -> Plane:
    """Fit a plane around each cell by least squares.

    Parameters
    ----------
    height_m : ndarray, shape (rows, columns)
        Mean heights of cells; NaN without any.
    cell_m : float
    radius : int
        Of the square of cells that take part.
    """
    side = 2 * radius + 1
    known = np.isfinite(height_m)
    base = float(np.nanmean(height_m)) if known.any() else 0.0
    z = np.where(known, height_m - base, 0.0).astype(np.float64)
    row, column = np.indices(z.shape, np.float64)

    def total(values: Array) -> Array:
        return np.asarray(uniform_filter(values, side, mode="constant")) * side**2

    n = np.rint(total(known.astype(np.float64)))
    safe = np.maximum(n, 1.0)
    # sums about the cell itself, as those of coordinates in a large raster would cancel
    x, y = total(known * column) - n * column, total(known * row) - n * row
    xx = total(known * column**2) - 2.0 * column * total(known * column) + n * column**2
    yy = total(known * row**2) - 2.0 * row * total(known * row) + n * row**2
    xy = total(known * column * row) - column * total(known * row) - row * total(known * column) + n * column * row
    s, xs, ys = total(z), total(z * column), total(z * row)
    xz, yz = xs - column * s, ys - row * s
    sxx, syy, sxy = xx - x * x / safe, yy - y * y / safe, xy - x * y / safe
    sxz, syz = xz - x * s / safe, yz - y * s / safe
    det = sxx * syy - sxy**2
    good = (n >= _FEWEST) & (det > 1e-6 * np.maximum(sxx, syy) ** 2) & (det > 0.5)
    det = np.where(good, det, 1.0)
    a, b = (sxz * syy - syz * sxy) / det, (syz * sxx - sxz * sxy) / det
    middle = (s - a * x - b * y) / safe + base
    nan = np.nan
    return Plane(
        np.where(good, middle, nan), np.where(good, a / cell_m, nan), np.where(good, -b / cell_m, nan), n / side**2
    )


def steps(height_m: npt.NDArray[np.floating]) -> Array:
    """Highest jump of the ground at each cell [m], shape (rows, columns); NaN where no direction tells.

    Along each of four directions the line of the three cells before and that of the three after are carried on to the cell: where they
    do not meet is a step, if the lines of two cells do not meet either. A slope, however steep, and a round hill give none. It has at
    most 2.2 times the error of a cell's height.
    """
    rows, columns = height_m.shape
    padded = np.pad(np.asarray(height_m, np.float64), REACH, constant_values=np.nan)

    def at(down: int, right: int) -> Array:
        return padded[REACH + down : REACH + down + rows, REACH + right : REACH + right + columns]

    highest = np.full((rows, columns), np.nan)
    for down, right in _SIDES:
        jumps = []
        for weights in _WEIGHTS:
            before, after = (
                sum(weight * at(sign * k * down, sign * k * right) for k, weight in enumerate(weights, 1))
                for sign in (-1, 1)
            )
            jumps.append(np.abs(before - after))
        # beyond the edge itself, a step further on tilts the one line or the other, but not both
        highest = np.fmax(highest, np.minimum(*jumps))
    return highest
