"""Values of rasters at places, between the centres of cells."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.raster.grid import Grid

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
    return np.asarray(_bilinear(values, grid.west_m, grid.north_m, grid.cell_m, xyz_m))


@njit(cache=True, nogil=True)
def _bilinear(values: Any, west: float, north: float, cell: float, xyz: Any) -> Any:
    rows, columns = values.shape
    out = np.empty(len(xyz), np.float32)
    for n in range(len(xyz)):
        u = min(max((xyz[n, 0] - west) / cell - 0.5, 0.0), columns - 1.0)
        v = min(max((north - xyz[n, 1]) / cell - 0.5, 0.0), rows - 1.0)
        j, i = int(u), int(v)
        j2, i2 = min(j + 1, columns - 1), min(i + 1, rows - 1)
        fu, fv = u - j, v - i
        total, weight = 0.0, 0.0
        for a, b, w in (
            (i, j, (1.0 - fu) * (1.0 - fv)), (i, j2, fu * (1.0 - fv)), (i2, j, (1.0 - fu) * fv), (i2, j2, fu * fv),
        ):  # fmt: skip
            value = values[a, b]
            if value == value:
                total += w * value
                weight += w
        out[n] = total / weight if weight > 0.0 else np.nan
    return out
