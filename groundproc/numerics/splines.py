"""Uniform cubic B-splines.

In the interval from knot k to k + 1 the coefficients k to k + 3 count, with the weights of `basis`; n intervals have n + 3 coefficients.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

AT_KNOT: Final = (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0)
"""Weights of the coefficients k to k + 2 at knot k; that of k + 3 is nothing."""


@njit(cache=True, nogil=True, inline="always")
def basis(u: float) -> Any:
    """The four weights at u in [0, 1]."""
    v = 1.0 - u
    u2 = u * u
    return (
        v * v * v / 6.0,
        (4.0 - 6.0 * u2 + 3.0 * u2 * u) / 6.0,
        (1.0 + 3.0 * u + 3.0 * u2 - 3.0 * u2 * u) / 6.0,
        u2 * u / 6.0,
    )


@njit(cache=True, nogil=True, inline="always")
def value_at(coefficients: Array, k: int, u: float, out: Array) -> None:
    """Value of a spline at u in [0, 1] of interval k, shape (m,), of coefficients of shape (intervals + 3, m)."""
    w0, w1, w2, w3 = basis(u)
    for c in range(len(out)):
        out[c] = (
            w0 * coefficients[k, c]
            + w1 * coefficients[k + 1, c]
            + w2 * coefficients[k + 2, c]
            + w3 * coefficients[k + 3, c]
        )


def through(values: Array) -> Array:
    """Coefficients of a spline near values at the knots: (intervals + 1, ...) to (intervals + 3, ...).

    Cubics come out exactly; beyond the ends the values are taken to go on straight.
    """
    for _ in range(2):
        values = np.concatenate([2.0 * values[:1] - values[1:2], values, 2.0 * values[-1:] - values[-2:-1]])
    return np.asarray(values[1:-1] - (values[2:] - 2.0 * values[1:-1] + values[:-2]) / 6.0)
