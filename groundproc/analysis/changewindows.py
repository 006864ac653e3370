"""Places where the points of an epoch lie off the surface of another together, though none of them does by itself.

Distances from the surface are averaged in windows along it, of the size of the smallest change, and held against those of the surface's own
points there: what was a bump before is none now. How far windows differ where nothing changed tells what a difference means.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from groundproc.numerics.robust import sigma

Array = npt.NDArray[np.float64]

_MOST: Final = 3.5
"""Sigmas that a point counts for: a bird is not much higher than a stone."""
_APART: Final = 3.0
"""Sigmas by which points have to differ from those that the surface has in a window, whatever bumps are like elsewhere."""
_QUANTILE: Final = 0.998
_THICK_M: Final = 1.0
"""Surfaces so far above each other have windows of their own."""
_BITS: Final = 20


class Apart(NamedTuple):
    """Points, and the surface that each is held against.

    Attributes
    ----------
    foot_m : ndarray, shape (n, 3)
        Where it stands on the surface.
    normal : ndarray, shape (n, 3)
    sigmas : ndarray, shape (n,)
        Signed distance from the surface; not a number where a point is not to count.
    """

    foot_m: Array
    normal: Array
    sigmas: Array


def together(points: Apart, surface: Apart, edge_m: float, chance: float) -> npt.NDArray[np.int8]:
    """On which side of the surface each point lies off it together with those around it: 1, -1, or 0 for none.

    Parameters
    ----------
    points, surface : Apart
        Those of one epoch; and those of the other, that has the surface.
    edge_m : float
        Of a window.
    chance : float
        Of a window, to differ as much.
    """
    found = np.zeros(len(points.sigmas), np.int8)
    rows = np.flatnonzero(np.isfinite(points.sigmas))
    if not len(rows):
        return found
    own = _keys(points, rows, edge_m)
    cells, of_point = np.unique(own, return_inverse=True)
    of_point = of_point.ravel()
    # a shift that all have is of the registration
    value = np.clip(points.sigmas[rows] - np.median(points.sigmas[rows]), -_MOST, _MOST)
    number, mean = _windows(cells, np.bincount(of_point).astype(np.float64), np.bincount(of_point, value))
    there = np.flatnonzero(np.isfinite(surface.sigmas))
    at = np.searchsorted(cells, keys := _keys(surface, there, edge_m)).clip(0, len(cells) - 1)
    met = cells[at] == keys
    before = np.clip(surface.sigmas[there[met]], -_MOST, _MOST)
    held, relief = _windows(
        cells,
        np.bincount(at[met], minlength=len(cells)).astype(np.float64),
        np.bincount(at[met], before, minlength=len(cells)),
    )
    score = _scores(number, mean, held, relief)
    limit = float(norm.isf(chance))
    for sign in (1, -1):
        of_window = sign * score > limit
        inside = np.zeros(len(cells), np.bool_)
        for index in _squares(cells):
            inside[index[(index >= 0) & of_window]] = True
        found[rows[inside[of_point] & (sign * value > 1.0)]] = sign
    return found


def _scores(number: Array, mean: Array, held: Array, relief: Array) -> Array:
    """Difference of windows from what was there, in its sigmas; those on the surface are one wide by construction."""
    bumps = 0.0
    many = held >= 4
    if many.sum() > 30:
        bumps = max(sigma(relief[many], 0.0) ** 2 - float(np.mean(1.0 / held[many])), 0.0)
    share = held * bumps / (held * bumps + 1.0)
    score = (mean - share * relief) / np.sqrt(1.0 / number + bumps * (1.0 - share))
    score -= np.median(score)
    wide = float(norm.isf(1.0 - _QUANTILE))
    # what changed is on one side for the most part; the other tells how wide no change is
    tail = min(np.quantile(score, _QUANTILE), -np.quantile(score, 1.0 - _QUANTILE)) / wide
    score /= max(tail, sigma(score, 0.0), 1.0)
    apart = np.abs(mean - relief) / np.sqrt(1.0 / number + 1.0 / np.maximum(held, 1.0))
    return np.where((number >= 3) & ((held < 3) | (apart > _APART)), score, 0.0)


def _keys(points: Apart, rows: npt.NDArray[Any], edge_m: float) -> npt.NDArray[np.int64]:
    """One number for each cell of half a window along the surface, neighbours by what is added to it."""
    normal, foot = np.abs(points.normal[rows]), points.foot_m[rows]
    axis = normal.argmax(axis=1)
    # along the two other axes, as the surface lies mostly
    first, second = (axis + 1) % 3, (axis + 2) % 3
    n = np.arange(len(rows))
    u = np.floor(foot[n, first] / (0.5 * edge_m)).astype(np.int64)
    v = np.floor(foot[n, second] / (0.5 * edge_m)).astype(np.int64)
    w = np.floor(foot[n, axis] / _THICK_M).astype(np.int64)
    half = 1 << (_BITS - 1)
    return np.asarray((((w + half) * 3 + axis) << (2 * _BITS)) + ((u + half) << _BITS) + (v + half))


def _squares(cells: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Places of the four cells of the window that begins at each, -1 where one is empty."""
    found = []
    for step in (0, 1, 1 << _BITS, (1 << _BITS) + 1):
        at = np.searchsorted(cells, cells + step).clip(0, len(cells) - 1)
        found.append(np.where(cells[at] == cells + step, at, -1))
    return found


def _windows(cells: npt.NDArray[np.int64], count: Array, total: npt.NDArray[Any]) -> tuple[Array, Array]:
    """Number of the points in the window that begins at each cell, and their mean."""
    number, whole = np.zeros(len(cells)), np.zeros(len(cells))
    for index in _squares(cells):
        some = index >= 0
        number[some] += count[index[some]]
        whole[some] += total[index[some]]
    return number, whole / np.maximum(number, 1.0)
