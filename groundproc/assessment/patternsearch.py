"""Where a pattern may be: every place, size and turn on a grid, with sharp edges, by what it explains of the intensities."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

BOARD, CROSS, DISC = range(3)
_TURNS: Final = 6
"""Turns within a right angle: 15 degrees apart."""
_STEPS: Final = 3.0
"""Steps in half a size."""
_ARM: Final = 0.25
"""Half the width of an arm in half a cross."""
_LEAST: Final = 3
"""Points in the figure, beside it, and in each quarter."""


def candidates(u_m: Array, v_m: Array, value: Array, kind: int, halves_m: Array, reach_m: float, most: int) -> Array:
    """Places, turns and half sizes that explain most, best first and apart from each other.

    Parameters
    ----------
    u_m, v_m, value : ndarray, shape (n,)
        Places on the surface, about the middle of the search, and intensities.
    kind : int
        `BOARD`, `CROSS` or `DISC`.
    halves_m : ndarray
        Half sizes that are tried.
    reach_m : float
        How far from the middle centres are tried.
    most : int

    Returns
    -------
    ndarray, shape (m, 5)
        u, v, turn, half size, and explained over unexplained sum of squares times the number of points.
    """
    found = []
    u_m, v_m, value = (np.ascontiguousarray(each) for each in (u_m, v_m, value))
    for half in halves_m:
        steps = int(np.ceil(_STEPS * reach_m / half))
        axis = np.linspace(-reach_m, reach_m, 2 * steps + 1)
        score = np.zeros((len(axis), len(axis), 1 if kind == DISC else _TURNS))
        _scan(u_m, v_m, value, kind, half, axis, score)
        best = score.max(axis=2)
        for i, j in _peaks(best, most):
            turn = float(np.argmax(score[i, j])) * np.pi / 2.0 / _TURNS
            found.append((axis[i], axis[j], turn, half, best[i, j]))
    found.sort(key=lambda each: -each[4])
    kept: list[tuple[float, ...]] = []
    for each in found:
        apart = all(np.hypot(each[0] - o[0], each[1] - o[1]) > 0.5 * min(each[3], o[3]) for o in kept)
        if apart and len(kept) < most:
            kept.append(each)
    return np.array(kept).reshape(-1, 5)


def _peaks(score: Array, most: int) -> list[tuple[int, int]]:
    """Cells that no neighbour exceeds, highest first."""
    wide = np.pad(score, 1)
    around = np.max([wide[i : i + len(score), j : j + len(score)] for i in range(3) for j in range(3)], axis=0)
    places = np.argwhere((score == around) & (score > 0.0))
    order = np.argsort(-score[places[:, 0], places[:, 1]], kind="stable")[:most]
    return [(int(i), int(j)) for i, j in places[order]]


@njit(cache=True, nogil=True, inline="always")
def _side(kind: int, x: float, y: float, half: float) -> Any:
    """1: in the figure, 0: in the ground around it, -1: neither."""
    if kind == 0:
        if abs(x) > half or abs(y) > half:
            return -1
        return 1 if x * y > 0.0 else 0
    away = np.sqrt(x * x + y * y)
    if kind == 2:
        if away <= half:
            return 1
        return 0 if 1.15 * half < away <= 1.6 * half else -1
    short, far = min(abs(x), abs(y)), max(abs(x), abs(y))
    if short <= _ARM * half and far <= half:
        return 1
    return 0 if away <= 1.3 * half else -1


@njit(cache=True, nogil=True)
def _scan(u: Array, v: Array, value: Array, kind: int, half: float, axis: Array, score: Array) -> None:
    """Fill in the score of every centre and turn."""
    reach = 1.61 * half
    cosine, sine = np.empty(score.shape[2]), np.empty(score.shape[2])
    for t in range(score.shape[2]):
        cosine[t], sine[t] = np.cos(t * np.pi / 2.0 / _TURNS), np.sin(t * np.pi / 2.0 / _TURNS)
    near = np.empty(len(u), np.int64)
    for i in range(len(axis)):
        for j in range(len(axis)):
            count = 0
            for k in range(len(u)):
                if abs(u[k] - axis[i]) <= reach and abs(v[k] - axis[j]) <= reach:
                    near[count] = k
                    count += 1
            for t in range(score.shape[2]):
                score[i, j, t] = _explained(
                    (u, v, value), near[:count], (axis[i], axis[j]), (cosine[t], sine[t]), kind, half
                )


@njit(cache=True, nogil=True)
def _explained(points: Any, near: Any, centre: Any, turn: Any, kind: int, half: float) -> Any:
    """Explained over unexplained sum of squares times the number of points; 0 where points are too few."""
    u, v, value = points
    part = np.zeros(4, np.int64)
    n0, n1, s0, s1, squares = 0, 0, 0.0, 0.0, 0.0
    for k in near:
        du, dv = u[k] - centre[0], v[k] - centre[1]
        x, y = turn[0] * du + turn[1] * dv, turn[0] * dv - turn[1] * du
        side = _side(kind, x, y, half)
        if side < 0:
            continue
        part[(1 if x > 0.0 else 0) + (2 if y > 0.0 else 0)] += 1
        squares += value[k] * value[k]
        n1, s1 = n1 + side, s1 + side * value[k]
        n0, s0 = n0 + 1 - side, s0 + (1 - side) * value[k]
    if n0 < _LEAST or n1 < _LEAST or part.min() < _LEAST:
        return 0.0
    total = squares - (s0 + s1) ** 2 / (n0 + n1)
    told = s0 * s0 / n0 + s1 * s1 / n1 - (s0 + s1) ** 2 / (n0 + n1)
    return (n0 + n1) * told / max(total - told, 1e-6 * total + 1e-12)
