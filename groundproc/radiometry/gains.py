"""Gains of single lasers, from patches of ground that several of them saw alike."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LASERS: Final = 256
_PRIOR: Final = 0.2
"""Gains of lasers differ by so much, where nothing else is known of them."""
_TEXTURE: Final = 0.05
"""Two lasers see a patch alike to so much: their echoes are at other places of it."""
_FEWEST: Final = 4
_DEFAULT_SPECKLE: Final = 0.15


@dataclass(frozen=True, slots=True)
class Table:
    """Strengths by patch and laser, freed of range and incidence.

    Attributes
    ----------
    patch, laser, count : ndarray of int64, shape (n,)
    total, squares : ndarray, shape (n,)
        Sums of the strengths, and of their squares.
    """

    patch: Ints
    laser: Ints
    count: Ints
    total: Array
    squares: Array


@dataclass(frozen=True, slots=True)
class Gains:
    """What the strengths of a laser are divided by.

    Attributes
    ----------
    gain, sigma : ndarray, shape (LASERS,)
        The mean of those seen is 1; so is that of lasers that were not seen.
    seen : ndarray of bool, shape (LASERS,)
    """

    gain: Array
    sigma: Array
    seen: npt.NDArray[np.bool_]


def speckle(table: Table) -> float:
    """Relative scatter of single echoes from one patch and laser."""
    many = (table.count >= 8) & (table.total > 0)
    if many.sum() < 10:
        return _DEFAULT_SPECKLE
    mean = table.total[many] / table.count[many]
    variance = (table.squares[many] / table.count[many] - mean**2) * table.count[many] / (table.count[many] - 1.0)
    return float(np.sqrt(max(np.median(variance / mean**2), 1e-6)))


def gains(table: Table) -> Gains:
    """Gains by least squares on logarithms: strength of a patch by a laser = the patch's own x the laser's.

    A laser that shares no patch with others keeps the gain 1.
    """
    usable = (table.count >= _FEWEST) & (table.total > 0)
    patch, laser = np.unique(table.patch[usable], return_inverse=True)[1], table.laser[usable]
    value = np.log(table.total[usable] / table.count[usable])
    weight = 1.0 / (speckle(table) ** 2 / table.count[usable] + _TEXTURE**2)
    seen = np.zeros(LASERS, np.bool_)
    seen[laser] = True
    if seen.sum() < 2:
        return Gains(np.ones(LASERS), np.full(LASERS, _PRIOR), seen)
    patches = int(patch.max()) + 1
    share = np.bincount(patch, weight, patches)
    mean = np.bincount(patch, weight * value, patches) / share
    normal = np.diag(np.bincount(laser, weight, LASERS) + _PRIOR**-2)
    right = np.bincount(laser, weight * (value - mean[patch]), LASERS)
    # the patches' own strengths are eliminated
    order = np.argsort(patch, kind="stable")
    first = np.searchsorted(patch[order], np.arange(patches + 1))
    for p in np.flatnonzero(np.diff(first) > 1):
        rows = order[first[p] : first[p + 1]]
        np.subtract.at(normal, np.ix_(laser[rows], laser[rows]), np.outer(weight[rows], weight[rows]) / share[p])
    alone = np.flatnonzero(np.diff(first) == 1)
    rows = order[first[alone]]
    np.subtract.at(normal, (laser[rows], laser[rows]), weight[rows])
    inverse = np.linalg.inv(normal)
    gain = np.exp(inverse @ right)
    gain /= gain[seen].mean()
    gain[~seen] = 1.0
    return Gains(gain, np.sqrt(np.diag(inverse)), seen)
