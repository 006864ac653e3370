"""Robust statistics: the sigma that a median tells, and the weights of losses that bend. Arrays in, arrays out."""

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MAD_TO_SIGMA: Final = 1.4826
"""Standard deviation of a normal variable over its median distance from the middle: 1 / Phi^-1(3/4)."""


def sigma(values: Array, centre: Array | float | None = None) -> float:
    """Standard deviation by the median absolute deviation, of all values together.

    Parameters
    ----------
    values : ndarray
        Not empty.
    centre : ndarray or float, optional
        What deviations are taken from, broadcast against the values; their median where left out.
    """
    middle = np.median(values) if centre is None else centre
    return float(MAD_TO_SIGMA * np.median(np.abs(values - middle)))


def sigma_of_columns(values: Array, centre: Array | float | None = None) -> Array:
    """The same of each column, shape (m,), of values of shape (n, m); about the column's median where no centre is given."""
    middle = np.median(values, axis=0) if centre is None else centre
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(values - middle), axis=0))


def white_noise(samples: Array) -> float:
    """White noise of one sample, all columns of shape (n, m) together, from second differences, which smooth motion hardly enters.

    The second difference of independent samples has six times their variance. At least three samples.
    """
    second = samples[2:] - 2.0 * samples[1:-1] + samples[:-2]
    return sigma(second, np.median(second, axis=0)) / float(np.sqrt(6.0))


def huber(distance: Array, limit: Array | float) -> Array:
    """Weights of Huber's loss: one up to the limit, limit / distance beyond it.

    Parameters
    ----------
    distance : ndarray
        Not negative, in the unit of the limit.
    limit : ndarray or float
        Above zero.

    Source: Huber, "Robust estimation of a location parameter" (1964).
    """
    return np.asarray(limit / np.maximum(distance, limit))


def cauchy(distance: Array) -> Array:
    """Weights of Cauchy's loss for distances in units of its scale: 1 / (1 + distance^2)."""
    return np.asarray(1.0 / (1.0 + np.square(distance)))
