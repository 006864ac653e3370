"""What is derived of heights: hillshade, local relief, sky-view factor, and small gaps filled.

Functions of an array of heights, shape (rows, columns), the first row in the north, NaN where there is none; the result has its shape.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import ndimage

from groundproc.raster.grid import Window

Heights = npt.NDArray[np.float32]

SUN_AZIMUTH_DEG: Final = 315.0
SUN_ELEVATION_DEG: Final = 45.0
SKY_DIRECTIONS: Final = 16
BAND_ROWS: Final = 512
"""Of a raster that is filled band after band."""


def filled(height_m: Heights, cells: int) -> Heights:
    """Heights with gaps filled that are nowhere more than so many cells from a height, by means of what is near."""
    known = np.isfinite(height_m)
    if known.all() or not known.any():
        return height_m
    sigma = max(cells / 2.0, 1.0)
    weight = ndimage.gaussian_filter(known.astype(np.float32), sigma, truncate=4.0)
    total = ndimage.gaussian_filter(
        np.where(known, height_m - _base(height_m), 0.0).astype(np.float32), sigma, truncate=4.0
    )
    near = ndimage.distance_transform_edt(~known) <= cells
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total / weight + _base(height_m)
    return np.where(known, height_m, np.where(near & (weight > 1e-6), mean, np.nan)).astype(np.float32)


def filled_by_bands(take: Callable[[Window], Heights], grid: Window, cells: int) -> Heights:
    """`filled` of a large raster, band after band: beside the result, the memory of one band.

    Parameters
    ----------
    take : callable
        Gives heights of a window, the first row in the north; NaN beyond the raster.
    grid : Window
    cells : int
    """
    margin = 2 * cells + 1  # the means reach four sigmas, half a gap each
    out = np.empty((grid.rows, grid.columns), np.float32)
    for top in range(0, grid.rows, BAND_ROWS):
        count = min(BAND_ROWS, grid.rows - top)
        band = Window(grid.column, grid.row + grid.rows - top - count, grid.columns, count)
        out[top : top + count] = filled(take(band.grown(margin)), cells)[margin : margin + count, margin:-margin]
    return out


def hillshade(
    height_m: Heights, cell_m: float, azimuth_deg: float = SUN_AZIMUTH_DEG, elevation_deg: float = SUN_ELEVATION_DEG
) -> Heights:
    """Cosine of the angle between the surface and the sun, 0 (away or in its own shade) to 1; slopes by Horn (1981)."""
    padded = np.pad(height_m.astype(np.float64), 1, mode="edge")
    a, b, c = padded[:-2, :-2], padded[:-2, 1:-1], padded[:-2, 2:]
    d, f = padded[1:-1, :-2], padded[1:-1, 2:]
    g, h, i = padded[2:, :-2], padded[2:, 1:-1], padded[2:, 2:]
    east = (c + 2.0 * f + i - a - 2.0 * d - g) / (8.0 * cell_m)
    north = (a + 2.0 * b + c - g - 2.0 * h - i) / (8.0 * cell_m)
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    toward = -east * math.sin(azimuth) - north * math.cos(azimuth)
    light = (toward * math.cos(elevation) + math.sin(elevation)) / np.sqrt(1.0 + east**2 + north**2)
    return np.clip(light, 0.0, 1.0).astype(np.float32)


def local_relief(height_m: Heights, cell_m: float, radius_m: float) -> Heights:
    """Heights less their own smooth surface: a Gaussian mean over what is known within some `radius_m` (its sigma) [m]."""
    known = np.isfinite(height_m)
    sigma, base = radius_m / cell_m, _base(height_m)
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma, truncate=3.0)
    total = ndimage.gaussian_filter(np.where(known, height_m - base, 0.0), sigma, truncate=3.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, height_m - base - total / weight, np.nan).astype(np.float32)


def sky_view(height_m: Heights, cell_m: float, radius_m: float) -> Heights:
    """Share of the sky that a cell sees, 0 to 1: one less the mean sine of the horizon in 16 directions (Zaksek et al. 2011)."""
    steps = max(math.ceil(radius_m / cell_m), 1)
    turns = np.arange(SKY_DIRECTIONS) * (2.0 * math.pi / SKY_DIRECTIONS)
    directions = np.stack([np.sin(turns), np.cos(turns)], axis=1)
    return np.asarray(_sky_view(np.ascontiguousarray(height_m, np.float32), cell_m, steps, directions))


def _base(height_m: Heights) -> float:
    """A height near the others, so that sums keep their digits."""
    return float(np.nanmean(height_m)) if np.isfinite(height_m).any() else 0.0


@njit(cache=True, nogil=True)
def _sky_view(height_m: Any, cell_m: float, steps: int, directions: Any) -> Any:
    """The share for each cell; what is not known hides nothing."""
    rows, columns = height_m.shape
    out = np.full((rows, columns), np.nan, np.float32)
    for j in range(rows):
        for i in range(columns):
            own = height_m[j, i]
            if np.isnan(own):
                continue
            total = 0.0
            for k in range(len(directions)):
                highest = 0.0  # tangent of the horizon
                for step in range(1, steps + 1):
                    y = j - int(np.rint(step * directions[k, 1]))
                    x = i + int(np.rint(step * directions[k, 0]))
                    if not (0 <= y < rows and 0 <= x < columns):
                        break
                    rise = height_m[y, x] - own
                    if rise > highest * step * cell_m:
                        highest = rise / (step * cell_m)
                total += highest / np.sqrt(1.0 + highest * highest)
            out[j, i] = 1.0 - total / len(directions)
    return out
