"""Buildings wider than the openings: smooth pieces of what passed for ground that end in a wall all around.

A spur, a bank or a plateau is as wide as a hall. But it goes down to its surroundings in a slope somewhere, reaches
the edge of the cloud, or has ground above it on one side. A wider opening would take all of these (see the blind
alleys). The rim alone, tried on small pieces, would take the edges of quarries. Only on pieces that no opening has
reached is a rim without a gap a proof.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, find_objects, label, maximum_filter

from groundproc.analysis.terrain.settings import HALL_M, Settings

Raster = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_STEEP: Final = 1.5
"""Rise over run of a wall between measured cells; a heap of earth stays below one."""
_DROP_M: Final = 2.0
"""Of a wall."""
_RIM_M: Final = 6.0
"""The ground beside a wall is looked for within this."""
HALO_M: Final = HALL_M + 2.0 * _RIM_M
"""A piece and what lies beside it end within so much."""
_SHARE: Final = 0.9
"""Of the ground beside it that lies below the wall."""
_BESIDE: Final = 0.3
"""Of what lies beside it that has to be ground; the rest is trees, other buildings, things that stand there."""
_ROUNDS: Final = 3
"""Roofs at several levels go from the top down."""


def halls(surface_m: Raster, ground: Mask, known: Mask, settings: Settings) -> Mask:
    """Find them.

    Parameters
    ----------
    surface_m : ndarray of float32, shape (rows, columns)
        Lowest points, gaps filled.
    ground, known : ndarray of bool, shape (rows, columns)
        Cells that passed for ground, and those that were measured.
    settings : Settings

    Returns
    -------
    ndarray of bool, shape (rows, columns)
        Cells that are no ground.
    """
    found, cell_m = np.zeros_like(ground), settings.cell_m
    pieces, _ = label(~_steep(surface_m, cell_m))
    # smaller ones are for the openings
    large = np.flatnonzero(np.bincount(pieces.ravel()) * cell_m**2 >= settings.window_m**2)
    places = find_objects(pieces)
    left = [number for number in large if number and _whole(places[number - 1], ground.shape, settings.hall_m / cell_m)]
    reach = 2 * round(_RIM_M / cell_m) + 1
    for _ in range(_ROUNDS):
        before = found.sum()
        for number in list(left):
            part = _grown(places[number - 1], reach, ground.shape)
            piece = pieces[part] == number
            if not (piece & ground[part]).any():
                left.remove(number)
                continue
            near = maximum_filter(known[part], reach)
            if _walled(surface_m[part], piece, (ground & ~found)[part], near, reach):
                found[part] |= maximum_filter(piece, 5) & _upper(surface_m[part], piece)
                left.remove(number)
        if found.sum() == before:
            break
    return np.asarray(found & ground)


def _steep(height: Raster, cell_m: float) -> Mask:
    """Cells beside a step."""
    limit = np.float32(_STEEP * cell_m)
    steep = np.zeros(height.shape, np.bool_)
    for axis in (0, 1):
        jump = np.abs(np.diff(height, axis=axis)) > limit
        ahead: tuple[Any, ...] = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        behind: tuple[Any, ...] = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        steep[ahead] |= jump
        steep[behind] |= jump
    return steep


def _whole(place: tuple[slice, ...], shape: tuple[int, ...], largest: float) -> bool:
    """Whether a piece is small enough, and inside."""
    return all(
        own.start > 0 and own.stop < size and own.stop - own.start <= largest
        for own, size in zip(place, shape, strict=True)
    )


def _grown(place: tuple[slice, ...], by: int, shape: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(
        slice(max(own.start - by, 0), min(own.stop + by, size)) for own, size in zip(place, shape, strict=True)
    )


def _walled(height: Raster, piece: Mask, ground: Mask, near: Mask, reach: int) -> bool:
    """Whether the ground beside a piece lies below it, all around."""
    beside = maximum_filter(piece, reach) & ~maximum_filter(piece, 3)
    if not near[beside].all():
        return False
    level = beside & ground
    if level.sum() < _BESIDE * beside.sum():
        return False
    row, column = distance_transform_edt(~piece, return_distances=False, return_indices=True)
    drop = height[row[level], column[level]] - height[level]
    return bool(np.mean(drop > _DROP_M) >= _SHARE)


def _upper(height: Raster, piece: Mask) -> Mask:
    """Cells at the height of the piece next to them: the rim of a roof, and not the ground below."""
    row, column = distance_transform_edt(~piece, return_distances=False, return_indices=True)
    return np.asarray(height[row, column] - height < 0.5 * _DROP_M)
