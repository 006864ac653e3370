"""Moving planes: the value at a place from a plane through the values of the points around it.

A plane, weighted by distance, follows a slope of the values and does not shift to where points are dense, as a mean does. Where few
points, or points in a row, would tilt it at will, it becomes a mean (the tilt is held by a weak prior at the noise of the values).

Source: Briese et al. (2012); OPALS, module Grid, method moving planes.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

NEIGHBOURS: Final = 8
"""Points of a plane, at least, where there are so many within the reach."""
_REACH_CELLS: Final = 3.0


class Planes(NamedTuple):
    """What planes say at the centres of cells; not a number where no point is near.

    Attributes
    ----------
    value, sigma0 : ndarray of float32, shape (rows, columns)
        First row in the north; sigma0 is the scatter of the values about the plane.
    points : ndarray of int32, shape (rows, columns)
        Points that it is through.
    """

    value: npt.NDArray[np.float32]
    sigma0: npt.NDArray[np.float32]
    points: npt.NDArray[np.int32]


def moving_planes(
    xy_m: Array, values: Array, corner_m: tuple[float, float], shape: tuple[int, int], cell_m: float
) -> Planes:
    """Planes at the centres of cells.

    Parameters
    ----------
    xy_m : ndarray, shape (n, 2)
    values : ndarray, shape (n,)
        Finite.
    corner_m : tuple of 2 floats
        West and north edge of the cells.
    shape : tuple of 2 ints
        Rows and columns.
    cell_m : float

    Returns
    -------
    Planes
    """
    rows, columns = shape
    out = Planes(np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32), np.zeros(shape, np.int32))
    margin = int(np.ceil(_REACH_CELLS)) + 1
    wide, high = columns + 2 * margin, rows + 2 * margin
    column = np.floor((xy_m[:, 0] - corner_m[0]) / cell_m).astype(np.int64) + margin
    row = np.floor((corner_m[1] - xy_m[:, 1]) / cell_m).astype(np.int64) + margin
    inside = (column >= 0) & (column < wide) & (row >= 0) & (row < high)
    number = row[inside] * wide + column[inside]
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], np.arange(wide * high + 1))
    chosen = np.flatnonzero(inside)[order]
    local = np.column_stack([(xy_m[chosen, 0] - corner_m[0]) / cell_m, (corner_m[1] - xy_m[chosen, 1]) / cell_m])
    _planes(local, np.ascontiguousarray(values[chosen], np.float64), first, (margin, wide), out)
    return out


@njit(cache=True, nogil=True)
def _planes(local: Any, values: Any, first: Any, layout: Any, out: Any) -> None:
    """Widen the ring of cells around each centre until it holds enough points, and put a plane through them."""
    margin, wide = layout
    rows, columns = out.value.shape
    most = margin - 1
    for r in range(rows):
        for c in range(columns):
            held, ring = 0, 0
            while ring <= most:
                held = 0
                for i in range(r + margin - ring, r + margin + ring + 1):
                    held += first[i * wide + c + margin + ring + 1] - first[i * wide + c + margin - ring]
                if held >= NEIGHBOURS:
                    break
                ring += 1
            ring = min(ring, most)
            if held == 0:
                continue
            _plane(local, values, first, (r, c, ring, margin, wide), out)


@njit(cache=True, nogil=True)
def _plane(local: Any, values: Any, first: Any, at: Any, out: Any) -> None:
    """The plane of one cell: weighted normal equations of value, slope east and slope south about the centre."""
    r, c, ring, margin, wide = at
    x0, y0, reach = c + 0.5, r + 0.5, ring + 0.75
    w0, wx, wy, wxx, wxy, wyy, wv, wxv, wyv, wvv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n = 0
    for i in range(r + margin - ring, r + margin + ring + 1):
        for k in range(first[i * wide + c + margin - ring], first[i * wide + c + margin + ring + 1]):
            x, y, v = local[k, 0] - x0, local[k, 1] - y0, values[k]
            d = (x * x + y * y) / (reach * reach)
            w = 1.0 / (1.0 + 4.0 * d)
            n += 1
            w0, wx, wy = w0 + w, wx + w * x, wy + w * y
            wxx, wxy, wyy = wxx + w * x * x, wxy + w * x * y, wyy + w * y * y
            wv, wxv, wyv, wvv = wv + w * v, wxv + w * x * v, wyv + w * y * v, wvv + w * v * v
    mx, my, mv = wx / w0, wy / w0, wv / w0
    sxx, sxy, syy = wxx - wx * mx, wxy - wx * my, wyy - wy * my
    sxv, syv, svv = wxv - wx * mv, wyv - wy * mv, max(wvv - wv * mv, 0.0)
    a, b = 0.0, 0.0
    det = sxx * syy - sxy * sxy
    spread = 0.5 * (sxx + syy)
    # points all around the centre, or so many that the slope is known: else the mean
    if n >= 4 and det > 0.02 * spread * spread and spread > 0.01 * w0:
        a, b = (syy * sxv - sxy * syv) / det, (sxx * syv - sxy * sxv) / det
    left = max(svv - a * sxv - b * syv, 0.0)
    freedom = n - 3 if a != 0.0 or b != 0.0 else n - 1
    value = mv - a * mx - b * my
    # beyond the points a plane is a guess: no farther from their mean than four times their scatter
    bound = 4.0 * np.sqrt(svv / w0)
    value = min(max(value, mv - bound), mv + bound)
    out.value[r, c], out.points[r, c] = value, n
    if freedom > 0:
        out.sigma0[r, c] = np.sqrt(left / w0 * n / freedom)
