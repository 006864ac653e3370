"""Cells for a cloud that was thinned to a point in some hundreds of square metres: rasters go by its points, not by its bounds."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import laspy
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SPARSE_M2: Final = 0.0125
"""Points in a square metre of the bounds, below which a cloud may be thin."""
_PER_CELL: Final = 0.05
"""Points in a cell: as few as a cloud of a point in 20 m2 has in cells of a metre."""
_PLACE_M: Final = 128.0
"""Side of the squares that are looked into: a corridor fills few of its bounds."""
_WIDEST_M: Final = 16.0


def bounds_m2(path: Path, across_m: float) -> float:
    """Area of the bounds that the head of a file states, in units of so many metres."""
    with laspy.open(path) as file:
        sides = (file.header.maxs - file.header.mins)[:2] * across_m
    return float(sides.prod())


def density_of(pieces: Iterable[Array]) -> float:
    """Points in a square metre, of the squares of 128 m that have any; of places in metres, shape (n, 3) each."""
    keys, points = np.empty(0, np.int64), 0
    for xyz_m in pieces:
        square = np.floor(xyz_m[:, :2] / _PLACE_M).astype(np.int64)
        keys = np.union1d(keys, square[:, 0] * (1 << 32) + square[:, 1])
        points += len(xyz_m)
    return points / max(len(keys), 1) / _PLACE_M**2


def cell_for(density_m2: float, widest_m: float) -> float:
    """Side of a cell: a power of two metres, 1 to 16."""
    fits = math.sqrt(_PER_CELL / max(density_m2, 1e-12))
    return float(2 ** math.floor(math.log2(min(max(fits, 1.0), _WIDEST_M, max(widest_m, 1.0)))))
