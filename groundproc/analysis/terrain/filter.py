"""Which of the lowest points of cells are ground.

Progressive morphological openings (Zhang et al. 2003) with a threshold that grows with the radius, as in the simple morphological filter
(Pingel et al. 2013), and three changes. What lies far too low is taken out and filled before anything is opened. Openings work on heights
above the ground that a first run found, smoothed over some metres: a slope is level for them, and an object on it stands out as it would
on a plain. And the threshold follows the ground's own relief at each place, its deviation from its smoothed self and its slope: in a
quarry an edge of a metre is ground, on a lawn it is none.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import uniform_filter

from groundproc.analysis.terrain.settings import Settings, radii
from groundproc.raster.fill import fill
from groundproc.raster.openings import opened

Raster = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_PIT_M: Final = 2.0
"""A lowest point that lies so far below those around it, and that fewer than ..."""
_PIT_FELLOWS: Final = 3
"""... so many other cells within ..."""
_PIT_AROUND_M: Final = 5.0
"""... this distance come near, is an error of ranging or an echo by way of a mirror. In a wood ground seen through one gap has fellows."""
_BOXES: Final = 3
"""Boxes one after the other are a bell to 3 %."""


class Bare(NamedTuple):
    """The ground as the lowest points of cells give it.

    Attributes
    ----------
    height_m : ndarray of float32, shape (rows, columns)
        Known everywhere.
    reach_m : ndarray of float32, shape (rows, columns)
        Points within this of it, up or down, are ground.
    lowest : ndarray of bool, shape (rows, columns)
        Cells whose lowest point is ground.
    pit : ndarray of bool, shape (rows, columns)
        Cells whose lowest point lies below the ground.
    """

    height_m: Raster
    reach_m: Raster
    lowest: Mask
    pit: Mask


def bare_ground(lowest_m: Raster, settings: Settings) -> Bare:
    """Find the ground.

    Parameters
    ----------
    lowest_m : ndarray of float32, shape (rows, columns)
        Height of the lowest point of each cell; NaN without any. At least one is known.
    settings : Settings
    """
    cell_m = settings.cell_m
    known = np.isfinite(lowest_m)
    surface = fill(lowest_m)
    pit = known & (opened(-surface, 1) < -surface - np.float32(_PIT_M))
    _keep_alone(pit, np.where(known, lowest_m, np.float32(np.inf)), max(round(_PIT_AROUND_M / cell_m), 2))
    known &= ~pit
    surface = fill(np.where(known, lowest_m, np.float32(np.nan)))
    lengths = [(radius, radius * cell_m) for radius in radii(settings.window_m, cell_m)]

    objects = np.zeros(known.shape, np.bool_)
    opened_m = surface
    for radius, length_m in lengths:
        opened_m = _level(opened_m, radius, objects, np.float32(settings.step_m + settings.slope * length_m))
    ground = known & ~objects
    height = _without(surface, ground)

    sigma = settings.smoothing_m / cell_m
    smooth = smoothed(height, sigma)
    deviation = np.where(ground, (surface - smooth) ** 2, np.float32(0.0))
    share = smoothed(ground.astype(np.float32), sigma)
    relief = np.sqrt(np.maximum(smoothed(deviation, sigma), 0.0) / (np.maximum(share, 0.0) + np.float32(1e-3)))
    base = np.float32(settings.step_m) + np.float32(settings.relief) * relief
    rise = np.float32(settings.slope) + np.float32(settings.steepness) * slope_of(smooth, cell_m)
    objects[:] = False
    opened_m = surface - smooth
    for radius, length_m in lengths:
        opened_m = _level(opened_m, radius, objects, base + rise * np.float32(length_m))
    ground = known & ~objects
    height = _without(surface, ground)
    reach = np.float32(settings.height_m) + np.float32(settings.slack) * slope_of(height, cell_m)
    return Bare(height, reach, ground, pit)


@njit(cache=True, nogil=True)
def _keep_alone(pit: Any, lowest: Any, half: int) -> None:
    """Take back pits that have fellows within a square of that half side."""
    rows, columns = pit.shape
    for i in range(rows):
        for j in range(columns):
            if not pit[i, j]:
                continue
            below, fellows = lowest[i, j] + _PIT_M, -1
            for a in range(max(i - half, 0), min(i + half + 1, rows)):
                for b in range(max(j - half, 0), min(j + half + 1, columns)):
                    fellows += lowest[a, b] < below
            pit[i, j] = fellows < _PIT_FELLOWS


def _level(surface: Raster, radius: int, objects: Mask, threshold: Raster | np.float32) -> Raster:
    """Open a surface, and mark what stands above it by more than a threshold."""
    low = opened(surface, radius)
    objects |= surface - low > threshold
    return low


def _without(surface: Raster, ground: Mask) -> Raster:
    """The surface with all that is no ground filled from what is; the surface itself where nothing is."""
    if not ground.any():
        return surface
    return fill(np.where(ground, surface, np.float32(np.nan)))


def smoothed(values: Raster, sigma: float) -> Raster:
    """Mean under a bell of so many cells, by boxes: its time does not grow with its width."""
    width = max(round(np.sqrt(12.0 * sigma**2 / _BOXES + 1.0)), 1) | 1
    for _ in range(_BOXES):
        values = uniform_filter(values, width, mode="nearest")
    return values


def slope_of(height_m: Raster, cell_m: float) -> Raster:
    """Rise over run of a raster of heights."""
    if min(height_m.shape) < 2:
        return np.zeros_like(height_m)
    down, right = np.gradient(height_m, np.float32(cell_m))
    return np.asarray(np.hypot(down, right), np.float32)
