"""How echoes from no surface depend on the viewing direction, as overlapping strips reveal it.

The incidence on a leaf, a needle or a twig is not known. But as a layer they are darker or brighter when seen at a
slant, depending on how the leaves hang. If they hang at random, the angle has no effect; if they lie flat, the effect
is that of the cosine of the angle from the vertical; if they stand upright, it is the opposite. One exponent of this
cosine is fitted for a flight, to the means of cells that several strips saw at different angles. Differences of whole
strips are left out, so that a strip that is brighter everywhere tells nothing.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics import robust
from groundproc.radiometry.patches import Seen, parent

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_FEWEST: Final = 15
"""Single echoes of a strip in a cell of 4 m."""
_FEWEST_BLOCKS: Final = 10
_SURE: Final = 3.0
"""Sigmas that the exponent differs from 0 by, or there is none."""
_HUBER: Final = 1.5
_ROUNDS: Final = 15


@dataclass(frozen=True, slots=True)
class Leaves:
    """Strengths of echoes from no surface go with the cosine from the vertical to this power; 0: they do not."""

    exponent: float = 0.0
    sigma: float = 0.0

    def facing(self, rise: Array) -> Array:
        """What such an echo is divided by, by the cosine of its beam from the vertical, shape (n,)."""
        return np.asarray(np.power(np.clip(rise, 0.02, 1.0), self.exponent))

    def tell(self) -> dict[str, float]:
        """For the report."""
        return {"exponent": round(self.exponent, 4), "sigma": round(self.sigma, 4)}

    def freed(self, seen: Seen) -> Seen:
        """Strengths of patches freed of it."""
        mean, variance = _moments(seen.count, seen.log_rise, seen.log_squares)
        factor = _mean_power(self.exponent, mean, variance)
        return seen.freed_of(np.where(seen.leaf, np.exp(factor), 1.0))


NONE: Final = Leaves()


def leaves_of(seen: Seen) -> Leaves:
    """The exponent, within -1 and 1; none where it is that of chance."""
    cell, strip, level, (mean, variance) = _cells(seen)
    if len(cell) == 0:
        return NONE
    block = np.unique(parent(cell), return_inverse=True)[1].ravel()
    weight, exponent, sigma = np.ones(len(cell)), 0.0, np.inf
    for _ in range(_ROUNDS):
        curved = _mean_power(exponent, mean, variance) - exponent * mean
        y, x = (_centred(values, weight, cell, strip) for values in (level - curved, mean))
        information = float(np.sum(weight * x**2))
        if information <= 1e-9:
            return NONE
        exponent = float(np.clip(np.sum(weight * x * y) / information, -1.0, 1.0))
        off = y - exponent * x
        # neighbouring cells err alike: the scores of blocks of 16 m scatter by themselves
        sigma = float(np.sqrt(np.sum(np.bincount(block, weight * x * off) ** 2))) / information
        scale = robust.sigma(off, 0.0)
        weight = 1.0 / np.maximum(1.0, np.abs(off) / max(_HUBER * scale, 1e-9))
    if len(np.unique(block)) < _FEWEST_BLOCKS or abs(exponent) < _SURE * sigma:
        return NONE
    return Leaves(exponent, sigma)


def _moments(count: npt.NDArray[Any], total: Array, squares: Array) -> tuple[Array, Array]:
    """Mean and variance of numbers by their count and sums, shape (n,) each."""
    mean = total / np.maximum(count, 1)
    return mean, np.maximum(squares / np.maximum(count, 1) - mean**2, 0.0)


def _mean_power(exponent: float, mean: Array, variance: Array) -> Array:
    """Logarithm of the mean of a power, by mean and variance of the logarithms, shape (n,): to the second order."""
    return exponent * mean + 0.5 * exponent**2 * variance


def _cells(seen: Seen) -> tuple[Ints, Ints, Array, tuple[Array, Array]]:
    """Of cells that several strips saw: cell and strip, logarithm of the mean strength, moments of the logarithm of the cosine."""
    rows = np.flatnonzero(seen.leaf)
    keys, number = np.unique(np.column_stack([parent(seen.patch[rows]), seen.strip[rows]]), axis=0, return_inverse=True)
    count, freed, logs, squares = (
        np.asarray(np.bincount(number.ravel(), values[rows].astype(np.float64), len(keys)), np.float64)
        for values in (seen.count, seen.freed, seen.log_rise, seen.log_squares)
    )
    many = np.flatnonzero((count >= _FEWEST) & (freed > 0))
    if not len(many):
        return many, many, freed[many], (logs[many], squares[many])
    cell = np.unique(keys[many, 0], return_inverse=True)[1].ravel()
    shared = many[np.bincount(cell)[cell] > 1]
    strip = np.unique(keys[shared, 1], return_inverse=True)[1].ravel()
    moments = _moments(count[shared], logs[shared], squares[shared])
    return keys[shared, 0], strip, np.log(freed[shared] / count[shared]), moments


def _centred(values: Array, weight: Array, cell: Ints, strip: Ints) -> Array:
    """Values without what cells and strips have as a whole."""
    place = np.unique(cell, return_inverse=True)[1].ravel()
    values = values.copy()
    for _ in range(_ROUNDS):
        for group in (place, strip):
            values -= (np.bincount(group, weight * values) / np.bincount(group, weight))[group]
    return values
