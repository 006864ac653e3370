"""What is painted on a flat surface, as a beam with a footprint sees it: targets, and what might be taken for one.

A pattern gives the bright share, 0 to 1, at places of the surface. Its edges are blurred by a normal distribution: the footprint of the
beam, and the noise of the points across it. All patterns have the same parameters, and each says which of them it has.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

Array = npt.NDArray[np.float64]

U, V, TURN, HALF, WIDTH, BLUR = range(6)
"""Parameters: centre [m], turn [rad], half size [m], half the width of an arm or the other half size [m], sigma of the blur [m]."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """A pattern.

    Attributes
    ----------
    name : str
    free : tuple of int
        Of the parameters above, those it has.
    share : callable
        Bright share at places along its own axes, shape (n,) each, with all parameters.
    """

    name: str
    free: tuple[int, ...]
    share: Callable[[Array, Array, Array], Array]

    def at(self, u_m: Array, v_m: Array, values: Array) -> Array:
        """Bright share at places of the surface, shape (n,)."""
        return self.share(*turned(u_m, v_m, values), values)


def turned(u_m: Array, v_m: Array, values: Array) -> tuple[Array, Array]:
    """Places along the axes of a pattern, about its centre."""
    c, s = np.cos(values[TURN]), np.sin(values[TURN])
    u, v = u_m - values[U], v_m - values[V]
    return c * u + s * v, c * v - s * u


def _band(across: Array, half: float, blur: float) -> Array:
    return np.asarray(ndtr((across + half) / blur) - ndtr((across - half) / blur))


def _board(u: Array, v: Array, p: Array) -> Array:
    return np.asarray(0.5 + 0.5 * (2.0 * ndtr(u / p[BLUR]) - 1.0) * (2.0 * ndtr(v / p[BLUR]) - 1.0))


def _disc(u: Array, v: Array, p: Array) -> Array:
    return np.asarray(ndtr((p[HALF] - np.hypot(u, v)) / p[BLUR]))


def _union(one: Array, other: Array) -> Array:
    return one + other - one * other


def _cross(u: Array, v: Array, p: Array) -> Array:
    along = _band(u, p[HALF], p[BLUR]) * _band(v, p[WIDTH], p[BLUR])
    return _union(along, _band(v, p[HALF], p[BLUR]) * _band(u, p[WIDTH], p[BLUR]))


def _edge(u: Array, v: Array, p: Array) -> Array:
    return np.asarray(ndtr(u / p[BLUR]))


def _strip(u: Array, v: Array, p: Array) -> Array:
    return _band(u, p[WIDTH], p[BLUR])


def _corner(u: Array, v: Array, p: Array) -> Array:
    return np.asarray(ndtr(u / p[BLUR]) * ndtr(v / p[BLUR]))


def _bend(u: Array, v: Array, p: Array) -> Array:
    one = _band(u, p[WIDTH], p[BLUR]) * ndtr((v + p[WIDTH]) / p[BLUR])
    return _union(one, _band(v, p[WIDTH], p[BLUR]) * ndtr((u + p[WIDTH]) / p[BLUR]))


def _tee(u: Array, v: Array, p: Array) -> Array:
    return _union(_band(u, p[WIDTH], p[BLUR]), _band(v, p[WIDTH], p[BLUR]) * ndtr(u / p[BLUR]))


def _crossing(u: Array, v: Array, p: Array) -> Array:
    return _union(_band(u, p[WIDTH], p[BLUR]), _band(v, p[WIDTH], p[BLUR]))


def _end(u: Array, v: Array, p: Array) -> Array:
    return np.asarray(_band(u, p[WIDTH], p[BLUR]) * ndtr(v / p[BLUR]))


def _bar(u: Array, v: Array, p: Array) -> Array:
    return _band(u, p[HALF], p[BLUR]) * _band(v, p[WIDTH], p[BLUR])


_PLACED: Final = (U, V, TURN, BLUR)
BOARD: Final = Pattern("checkerboard", _PLACED, _board)
CROSS: Final = Pattern("cross", (U, V, TURN, HALF, WIDTH, BLUR), _cross)
DISC: Final = Pattern("disc", (U, V, HALF, BLUR), _disc)
TARGETS: Final = (BOARD, CROSS, DISC)
RIVALS: Final = (
    Pattern("edge", (U, TURN, BLUR), _edge),
    Pattern("line", (U, TURN, WIDTH, BLUR), _strip),
    Pattern("corner", _PLACED, _corner),
    Pattern("end of a line", (*_PLACED, WIDTH), _end),
    Pattern("bend of a line", (*_PLACED, WIDTH), _bend),
    Pattern("junction", (*_PLACED, WIDTH), _tee),
    Pattern("crossing", (*_PLACED, WIDTH), _crossing),
    Pattern("bar", (U, V, TURN, HALF, WIDTH, BLUR), _bar),
)
"""What is painted on roads, and edges between two kinds of ground."""
