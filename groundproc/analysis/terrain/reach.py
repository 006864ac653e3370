"""How near the ground's surface a point is ground."""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

from groundproc.analysis.terrain.settings import Settings

Raster = npt.NDArray[np.float32]

_AROUND_M: Final = 2.0
"""Slopes within this of a cell are held against each other."""


def reach_of(height_m: Raster, settings: Settings) -> Raster:
    """Points within this of a surface, up or down, are ground [m].

    The steeper it is, the less sure is its height within a cell; more so where slopes change, as at the edge of a terrace. On an even slope
    it is well known, and what stands half a metre above it is a shrub.
    """
    if min(height_m.shape) < 2:
        return np.full(height_m.shape, settings.height_m, np.float32)
    slopes = np.gradient(height_m, np.float32(settings.cell_m))
    width = 2 * round(_AROUND_M / settings.cell_m) + 1
    scatter = uniform_filter(slopes[0] ** 2 + slopes[1] ** 2, width) - sum(
        uniform_filter(each, width) ** 2 for each in slopes
    )
    uneven = np.sqrt(np.maximum(scatter, np.float32(0.0)))
    return np.asarray(
        np.float32(settings.height_m)
        + np.float32(settings.slack) * np.hypot(*slopes)
        + np.float32(settings.bend) * uneven,
        np.float32,
    )


def slope_of(height_m: Raster, cell_m: float) -> Raster:
    """Rise over run of a raster of heights."""
    if min(height_m.shape) < 2:
        return np.zeros_like(height_m)
    down, right = np.gradient(height_m, np.float32(cell_m))
    return np.asarray(np.hypot(down, right), np.float32)
