"""Values of rasters at places, between the centres of cells."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.layout import to_read
from groundproc.raster import geotiff
from groundproc.raster.grid import Grid, Window

Array = npt.NDArray[np.float64]


def bilinear(values: npt.NDArray[np.float32], grid: Grid, xyz_m: Array) -> npt.NDArray[np.float32]:
    """Values between the centres of cells, shape (n,); beyond the outermost centres those of the edge.

    Parameters
    ----------
    values : ndarray of float32, shape (rows, columns)
        Of the whole grid, the first row in the north. NaN among the four cells around a place is left out of the mean, unless all are.
    grid : Grid
    xyz_m : ndarray, shape (n, 2 or 3)
    """
    return np.asarray(_bilinear(to_read(values), grid.west_m, grid.north_m, grid.cell_m, to_read(xyz_m)))


@njit(cache=True, nogil=True)
def _bilinear(values: Any, west: float, north: float, cell: float, xyz: Any) -> Any:
    frame = west, north, cell, values.shape[0], values.shape[1]
    out = np.empty(len(xyz), np.float32)
    for n in range(len(xyz)):
        total, weight = 0.0, 0.0
        for row, column, share in around(xyz[n, 0], xyz[n, 1], frame):
            value = values[row, column]
            if value == value:
                total += share * value
                weight += share
        out[n] = total / weight if weight > 0.0 else np.nan
    return out


@njit(cache=True, nogil=True, inline="always")
def around(east: float, north: float, frame: Any) -> Any:
    """Row, column and weight of the four cells around a place; frame: west and north edge, cell [m], rows, columns."""
    west, top, cell, rows, columns = frame
    u = min(max((east - west) / cell - 0.5, 0.0), columns - 1.0)
    v = min(max((top - north) / cell - 0.5, 0.0), rows - 1.0)
    j, i = int(u), int(v)
    j2, i2 = min(j + 1, columns - 1), min(i + 1, rows - 1)
    fu, fv = u - j, v - i
    return (
        (i, j, (1.0 - fu) * (1.0 - fv)), (i, j2, fu * (1.0 - fv)), (i2, j, (1.0 - fu) * fv), (i2, j2, fu * fv),
    )  # fmt: skip


def heights_at(raster: geotiff.Raster, xy_m: Array) -> Array:
    """Values of a file between the centres of its cells, shape (n,); NaN outside, and beside cells that are not known.

    Read a block of cells at a time, so that a long line does not need the whole raster at once.

    Parameters
    ----------
    raster : Raster
    xy_m : ndarray, shape (n, 2)

    Raises
    ------
    CaptureError
        The file is damaged.
    """
    grid, out = raster.grid, np.full(len(xy_m), np.nan)
    column = (xy_m[:, 0] - raster.west_m) / grid.cell_m - 0.5
    down = (raster.north_m - xy_m[:, 1]) / grid.cell_m - 0.5
    within = (column > -1.0) & (column < grid.columns) & (down > -1.0) & (down < grid.rows)
    block = np.floor(np.column_stack([column, down]) / geotiff.BLOCK)
    side = geotiff.BLOCK + 1
    for key in np.unique(block[within], axis=0).astype(np.int64):
        some = within & (block == key).all(axis=1)
        left, top = key * geotiff.BLOCK
        values = raster.window(Window(grid.column + left, grid.row + grid.rows - top - side, side, side)).astype(
            np.float64
        )
        i, j = np.floor(column[some]).astype(int) - left, np.floor(down[some]).astype(int) - top
        u, v = column[some] - left - i, down[some] - top - j
        out[some] = (1 - v) * ((1 - u) * values[j, i] + u * values[j, i + 1]) + v * (
            (1 - u) * values[j + 1, i] + u * values[j + 1, i + 1]
        )
    return out
