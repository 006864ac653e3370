"""How many times more than stated the errors of fixes are, by what the adjusted path says of them.

A receiver states a size of its errors, and that they last for a minute is assumed. How much of a changing error the path
shows depends on what else holds it: along a street the path follows the fixes and shows nothing, across it everything.
The coarse problem of the last step has exactly that: of residuals v = W^T (r + A x) of some slow courses W, whitened,
it says that their covariance is

    R = W^T W - (A^T W)^T N^-1 (A^T W),

if errors are as stated. R is near zero where the path follows the fixes, and one where all of an error shows. The sum
of squares v^T R^-1 v over the directions that show is a chi-square, and compared with their number it is the variance
factor of the receiver (Foerstner 1979).
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from groundproc.estimation.adjustment.coarse import Coarse
from groundproc.estimation.observations.fixes import SLID, SLID_SIGMAS
from groundproc.estimation.observations.rows import Factor

Array = npt.NDArray[np.float64]

SHORTEST_ROWS: Final = 10.0
"""Seconds that half a wave of a course is long at least. What changes faster a receiver smooths away, or `strain_of` finds."""
SHOWS: Final = 0.3
"""Share of an error that shows in the residuals, below which a direction judges nothing: what the path follows shows too little."""
WORTH: Final = 4.0
"""The stated size counts as much as so many errors that one has seen. In 60 s of an honest receiver, factors are 1.03 in the mean and 1.1
in one of ten; of one that is three times worse than stated 2.1; of one that walks 8 m in 36 s where it states 3 m 1.45."""
HORIZONTAL: Final = (0, 1)
UPWARD: Final = (2,)


def strains(factors: Sequence[Factor], x: Array, coarse: Coarse, figures: Mapping[str, float]) -> dict[str, Array]:
    """Times that errors are larger than stated, east, north, up, shape (3,) and 1 at least, by the source of a course.

    None where the path slides away from its fixes: then one of the two is wrong, and which one is judged by the sigmas as stated
    (`refuting`).

    Parameters
    ----------
    factors : sequence of Factor
        Those with a `source` and three rows a second, east, north, up, are courses.
    x : ndarray
        Solution of the problem that they are of.
    coarse : Coarse
        Of that problem.
    figures : mapping of str to float
        Of the step that it is of.
    """
    if figures.get(SLID, 0.0) > SLID_SIGMAS:
        return {}
    found: dict[str, Array] = {}
    for factor in factors:
        if factor.course and factor.source:
            seconds = len(factor.residual) // 3 - 1
            most = int(min(seconds / SHORTEST_ROWS, coarse.nodes / 2))
            if seconds >= 2 and most >= 1:
                strain = np.ones(3)
                for axes, weakened in ((HORIZONTAL, factor.weakened), (UPWARD, 1.0)):
                    strain[list(axes)] = _strain(factor, x, coarse, axes, most, weakened)
                found[factor.source] = np.maximum(strain, found.get(factor.source, 1.0))
    return found


def _strain(factor: Factor, x: Array, coarse: Coarse, axes: Sequence[int], most: int, weakened: float) -> float:
    """Of some axes together, by the slowest courses, so many an axis at most: the largest factor that the first of them give.

    Rows that are `weakened` because of what changes fast are judged by what is stated: what changes slowly may well be of that size.
    """
    left = (factor.residual + factor.matrix @ x) / factor.sigma
    courses = slow_courses(len(left) // 3, most)
    whitened = sparse.diags(1.0 / factor.sigma) @ factor.matrix
    # by course, then by axis
    spread = np.zeros((len(left), len(axes) * most))
    for i, axis in enumerate(axes):
        spread[axis::3, i :: len(axes)] = courses
    seen = whitened.T @ spread
    shown = np.eye(spread.shape[1]) - seen.T @ coarse.solve(seen)
    return float(np.sqrt(variance_factor(weakened * (spread.T @ left), shown, len(axes))))


def slow_courses(count: int, most: int) -> Array:
    """Cosines over rows, slowest first, orthonormal, shape (count, most); the first row, which has no change before it, is not of them."""
    at = (np.arange(count - 1) + 0.5) / (count - 1)
    waves = np.cos(np.pi * at[:, None] * np.arange(most))
    return np.concatenate([np.zeros((1, most)), waves / np.linalg.norm(waves, axis=0)])


def variance_factor(left: Array, shown: Array, step: int) -> float:
    """Largest variance factor, 1 at least, of the first `step`, 2 `step`, ... of residuals `left`, shape (n,), with covariance `shown`."""
    largest = 1.0
    for count in range(step, len(left) + 1, step):
        share, axes = np.linalg.eigh(shown[:count, :count])
        good = share > SHOWS
        square = float((np.square(axes[:, good].T @ left[:count]) / share[good]).sum())
        largest = max(largest, (WORTH + square) / (WORTH + int(good.sum())))
    return largest


def of_source(strain: Mapping[str, Array], factor: Factor) -> Array:
    """Times that the errors of a factor's rows are larger than these take them to be, shape (rows,)."""
    known = strain.get(factor.source)
    if known is None:
        return np.ones(len(factor.residual))
    beyond = np.maximum(known / np.array([factor.weakened, factor.weakened, 1.0]), 1.0)
    return np.asarray(np.tile(beyond, len(factor.residual) // len(known)))
