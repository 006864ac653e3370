"""Lowest points of cells that lie far below those around them: errors, echoes by way of mirrors, gaps in a canopy, and real pits.

A few alone are errors. More of them may be a shaft, a ditch or gaps in a wood, and stay. But a few deep cells some metres apart, in a
corner or between a building and a terrace, make all that lies among them look like one object, and pull the ground down to themselves.
A run without them shows which it is: if most of what lies around them then is ground, and goes on level in ground that was found with them
too, they are pits in it. Canopies and maize end in a step instead. Such pits stay ground, but are bridged where objects are looked for.
"""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import label, maximum_filter, uniform_filter

from groundproc.analysis.terrain.reach import reach_of
from groundproc.analysis.terrain.settings import Settings
from groundproc.raster.fill import fill
from groundproc.raster.openings import opened

Raster = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_PIT_M: Final = 2.0
"""A lowest point that lies so far below those around it, and that fewer than ..."""
_PIT_FELLOWS: Final = 3
"""... so many other cells within ..."""
_AROUND_M: Final = 5.0
"""... this distance come near, is an error of ranging or an echo by way of a mirror. In a wood ground seen through one gap has fellows."""
_BESIDE_M: Final = 2.0
"""Cells so near each other belong to one area; as wide as the narrowest pit that the openings take for more than a slot."""


def narrow_pits(lowest_m: Raster, cell_m: float) -> tuple[Mask, Mask]:
    """Cells far below their surroundings, in pits less than three cells wide.

    Parameters
    ----------
    lowest_m : ndarray of float32, shape (rows, columns)
        NaN where nothing is known.
    cell_m : float

    Returns
    -------
    narrow, alone : ndarray of bool, shape (rows, columns)
        All of them, and those without fellows, which are errors.
    """
    known = np.isfinite(lowest_m)
    surface = fill(lowest_m)
    narrow = known & (opened(-surface, 1) < -surface - np.float32(_PIT_M))
    alone = narrow.copy()
    _keep_alone(alone, np.where(known, lowest_m, np.float32(np.inf)), _square(_AROUND_M, cell_m) // 2)
    return narrow, alone


def pulling(
    surface: Raster, narrow: Mask, known: Mask, objects: Mask, without: Iterable[Mask], settings: Settings
) -> tuple[Mask, Mask]:
    """Narrow pits in ground that is found only without them.

    Parameters
    ----------
    surface : ndarray of float32, shape (rows, columns)
        Lowest points, filled.
    narrow, known : ndarray of bool, shape (rows, columns)
        Cells of such pits, and all that were measured.
    objects : ndarray of bool, shape (rows, columns)
        What stands above the ground if the pits are there.
    without : iterable of ndarray of bool, shape (rows, columns)
        The same without them, after each opening: it only grows, so that the rest is spared where nothing can come of it, as in a wood.
    settings : Settings

    Returns
    -------
    pulls, gained : ndarray of bool, shape (rows, columns)
        These pits, and the ground that is to be had without them.
    """
    none = np.zeros_like(narrow), np.zeros_like(narrow)
    lost = known & objects & ~narrow
    gained = lost
    if not amid(narrow, gained, known, settings).any():
        return none
    for standing in without:
        gained = lost & ~standing
        if not amid(narrow, gained, known, settings).any():
            return none
    gained = _joined(surface, gained, known & ~objects & ~narrow, settings)
    sure = amid(narrow, gained, known, settings)
    if not sure.any():
        return none
    # what leads on out of the area, as a ditch does, is no small group
    groups, count = label(maximum_filter(narrow, _square(_BESIDE_M, settings.cell_m)))
    inside = np.bincount(groups[sure], minlength=count + 1)
    whole = np.bincount(groups[narrow], minlength=count + 1)
    return np.asarray(narrow & ((inside > 0) & (2 * inside >= whole))[groups]), gained


def amid(narrow: Mask, area: Mask, known: Mask, settings: Settings) -> Mask:
    """Pits of whose surroundings most cells that were measured belong to an area."""
    around = _square(_AROUND_M, settings.cell_m)
    return np.asarray(narrow & (_share(area, around) > np.float32(0.5) * _share(known, around)))


def _joined(surface: Raster, gained: Mask, sure: Mask, settings: Settings) -> Mask:
    """Areas that go on level in sure ground at most of their cells beside it."""
    if not sure.any():
        return np.zeros_like(gained)
    beside = _square(_BESIDE_M, settings.cell_m)
    floor = fill(np.where(sure, surface, np.float32(np.nan)))
    edge = gained & maximum_filter(sure, beside)
    level = edge & (np.abs(surface - floor) <= reach_of(floor, settings))
    areas, count = label(maximum_filter(gained, beside))
    edges = np.bincount(areas[edge], minlength=count + 1)
    levels = np.bincount(areas[level], minlength=count + 1)
    return np.asarray(gained & ((levels >= _PIT_FELLOWS) & (2 * levels > edges))[areas])


def _square(half_m: float, cell_m: float) -> int:
    """Side of a square in cells."""
    return 2 * max(round(half_m / cell_m), 2) + 1


def _share(mask: Mask, width: int) -> Raster:
    """Share of a square about each cell; beyond the edge is nothing."""
    return np.asarray(uniform_filter(mask.astype(np.float32), width, mode="constant"))


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
