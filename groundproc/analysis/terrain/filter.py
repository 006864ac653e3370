"""Which of the lowest points of cells are ground.

Progressive morphological openings (Zhang et al. 2003) with a threshold that grows with the radius, as in the simple
morphological filter (Pingel et al. 2013), with three changes. Points that lie far too low are removed and filled
before anything is opened. Openings work on heights above the ground that a first run found, smoothed over some metres:
for them a slope is level, and an object on it stands out as it would on a plain. And the threshold follows the
ground's own relief at each place, its slope and its deviation from its smoothed self: in a quarry an edge of a metre
is ground, on a lawn it is not.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

from groundproc.analysis.terrain.halls import halls
from groundproc.analysis.terrain.pits import amid, narrow_pits, pulling
from groundproc.analysis.terrain.reach import reach_of, slope_of
from groundproc.analysis.terrain.settings import Settings, radii
from groundproc.raster.fill import fill
from groundproc.raster.openings import opened

Raster = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Threshold = Raster | np.float32

_BOXES: Final = 3
"""Boxes one after the other are a bell to 3 %."""
_TRIES: Final = 3
"""Pits that gain nothing are taken back so often; then all are."""


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
    narrow, pit = narrow_pits(lowest_m, settings.cell_m)
    known = np.isfinite(lowest_m) & ~pit
    surface, pulls, objects = _first(lowest_m, known, narrow & known, settings)
    ground = known & ~objects & ~pulls
    height = _without(surface, ground)

    sigma = settings.smoothing_m / settings.cell_m
    smooth = smoothed(height, sigma)
    deviation = np.where(ground, (surface - smooth) ** 2, np.float32(0.0))
    share = smoothed(ground.astype(np.float32), sigma)
    relief = np.sqrt(np.maximum(smoothed(deviation, sigma), 0.0) / (np.maximum(share, 0.0) + np.float32(1e-3)))
    base = np.float32(settings.step_m) + np.float32(settings.relief) * relief
    rise = np.float32(settings.slope) + np.float32(settings.steepness) * slope_of(smooth, settings.cell_m)
    ground = known & (~_objects(surface - smooth, base, rise, settings) | pulls)
    surface = np.where(pulls, lowest_m, surface)
    height = _without(surface, ground)
    if settings.hall_m:
        wide = halls(surface, ground, known, settings)
        if wide.any():
            ground &= ~wide
            height = _without(surface, ground)
    return Bare(height, reach_of(height, settings), ground, pit)


def _first(lowest: Raster, known: Mask, narrow: Mask, settings: Settings) -> tuple[Raster, Mask, Mask]:
    """The lowest points, filled and with pits bridged that pull their surroundings down; these pits; and what stands on that."""
    step, slope = np.float32(settings.step_m), np.float32(settings.slope)
    surface = _filled(lowest, known)
    objects = _objects(surface, step, slope, settings)
    if not narrow.any():
        return surface, narrow, objects
    without = _growing(_filled(lowest, known & ~narrow), step, slope, settings)
    pulls, gained = pulling(surface, narrow, known, objects, without, settings)
    for _ in range(_TRIES):
        if not pulls.any():
            break
        bridged = _filled(lowest, known & ~pulls)
        left = _objects(bridged, step, slope, settings)
        # where others hold the ground down as well, half a remedy is none
        kept = amid(pulls, gained & ~left, gained, settings)
        if np.array_equal(kept, pulls):
            return bridged, pulls, left
        pulls = kept
    return surface, np.zeros_like(known), objects


def _objects(surface: Raster, step: Threshold, slope: Threshold, settings: Settings) -> Mask:
    """What stands above openings of growing radius r by more than step + slope r."""
    *_, objects = _growing(surface, step, slope, settings)
    return objects


def _growing(surface: Raster, step: Threshold, slope: Threshold, settings: Settings) -> Iterator[Mask]:
    """What stands above them after each opening, in one array."""
    objects = np.zeros(surface.shape, np.bool_)
    for radius in radii(settings.window_m, settings.cell_m):
        surface = _level(surface, radius, objects, step + slope * np.float32(radius * settings.cell_m))
        yield objects


def _filled(lowest: Raster, known: Mask) -> Raster:
    return fill(np.where(known, lowest, np.float32(np.nan)))


def _level(surface: Raster, radius: int, objects: Mask, threshold: Threshold) -> Raster:
    """Open a surface, and mark what stands above it by more than a threshold."""
    low = opened(surface, radius)
    objects |= surface - low > threshold
    return low


def _without(surface: Raster, ground: Mask) -> Raster:
    """The surface with all that is no ground filled from what is; the surface itself where nothing is."""
    if not ground.any():
        return surface
    return _filled(surface, ground)


def smoothed(values: Raster, sigma: float) -> Raster:
    """Mean under a bell of so many cells, by boxes: its time does not grow with its width."""
    width = max(round(np.sqrt(12.0 * sigma**2 / _BOXES + 1.0)), 1) | 1
    for _ in range(_BOXES):
        values = uniform_filter(values, width, mode="nearest")
    return values
