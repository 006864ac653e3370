"""One step of a cloud towards another, from points over planes; in the end with its covariance.

Points of one cloud are paired with planes of the other. From afar what they scatter by is told by all of them, then by groups of four
metres each: what moved as one piece makes no other group's scatter wider, and has no weight. Steps in between are those that most groups
agree in (random draws, as RANSAC: Fischler and Bolles 1981). The covariance is of such groups, which share their patches, each judged by
all others, for one bush may tell all there is of a direction. What normals tell by their own errors is no information.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from groundproc.numerics.robust import MAD_TO_SIGMA, cauchy, sigma

Array = npt.NDArray[np.float64]

_DRAWS, _DRAWN, _JUDGES = 300, 5, 4_000
"""Of groups: with a third of them moved, one draw in eight has none of those."""
_BEYOND: Final = 3.0
"""Sigmas of a group's own scatter; points further off are none of a draw."""
_FARTHEST: Final = np.array([3.0, 3.0, 3.0, 2.0, 2.0, 2.0])
"""Of the prior: no draw takes the whole further. Half of a wave is a plane too, tilted."""
PRIOR: Final = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
"""What clouds that say where they are may be off by [m, rad]."""
_GROUP_M: Final = 4.0
_FEWEST_ALIKE: Final = 50
"""Points of like roughness of which a scatter is told."""
_MORE: Final = 1.5
"""A direction has to be told so many times better than by the prior, and than normals tell it by their errors."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Points on surfaces: places and unit normals, shape (n, 3), and how rough their patches are [m].

    All that is told of clouds is in metres about a place in their midst.
    """

    xyz: Array
    normal: Array
    rough: Array

    def some(self, rows: npt.NDArray[Any] | slice) -> "Surface":
        """Places and planes of some of its points."""
        return Surface(self.xyz[rows], self.normal[rows], self.rough[rows])

    def over(self, xyz: Array, nearest: npt.NDArray[Any]) -> Array:
        """Distance of points from the planes at points of A."""
        return np.asarray(np.einsum("ni,ni->n", self.normal[nearest], xyz - self.xyz[nearest]))


class _Rows(NamedTuple):
    """What points over planes say of shift and turn, all six in one unit: what the prior is wide."""

    over: Array
    rows: Array
    scale: Array
    weight: Array
    hessian: Array
    right: Array


def _rows(
    surface: Surface, other: Surface, moved: Array, matrix: Array, group: npt.NDArray[np.int64] | None = None
) -> tuple[_Rows, Array]:
    """Rows, and how far the whole has gone from where B said it was, which the prior asks back.

    With groups what points scatter by is that within them: what has moved as one makes nobody else's scatter wider, and has no weight.
    """
    over = np.einsum("ni,ni->n", surface.normal, moved - surface.xyz)
    rows = np.concatenate([surface.normal, np.cross(moved, surface.normal)], axis=1) * PRIOR
    within = over if group is None else over - _medians(over, group)[group]
    scale = _scales(within, np.hypot(other.rough, surface.rough))
    weight = cauchy(over / (2.0 * scale)) if group is None else cauchy(over / (_BEYOND * scale)) ** 2
    weight /= scale**2
    gone = np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_rotvec()]) / PRIOR
    weighted = rows * weight[:, None]
    return _Rows(over, rows, scale, weight, weighted.T @ rows, -weighted.T @ over - gone), gone


def step_towards(surface: Surface, other: Surface, moved: Array, matrix: Array, consensus: bool, close: bool) -> Array:
    """One step of shift and turn, [m] and [rad]."""
    group = _groups(moved)
    said, gone = _rows(surface, other, moved, matrix, group if close else None)
    step = np.asarray(np.linalg.solve(said.hessian + np.eye(6), said.right))
    if consensus:
        step = _agreed(said, group, np.hypot(other.rough, surface.rough), step, gone)
    return np.asarray(step * PRIOR)


def _agreed(said: _Rows, group: npt.NDArray[np.int64], rough: Array, step: Array, gone: Array) -> Array:
    """The step that fits most points, of one of all and those of a few groups each (always the same draws); in the unit of the rows."""
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(group))[:-1])
    scale = _BEYOND * _scales(said.over - _medians(said.over, group)[group], rough)
    weighted = said.rows / scale[:, None] ** 2
    hessian = np.array([weighted[each].T @ said.rows[each] for each in parts])
    right = np.array([-weighted[each].T @ said.over[each] for each in parts])
    rng = np.random.default_rng(len(parts))
    drawn = rng.integers(len(parts), size=(_DRAWS, _DRAWN))
    steps = np.linalg.solve(hessian[drawn].sum(axis=1) + np.eye(6), right[drawn].sum(axis=1)[:, :, None])[:, :, 0]
    steps = steps[(np.abs(gone + steps) < _FARTHEST).all(axis=1)]
    some = slice(None, None, max(1, len(group) // _JUDGES))
    steps = np.vstack([step, steps])
    left = (said.over[some, None] + said.rows[some] @ steps.T) / scale[some, None]
    best = steps[np.minimum(left**2, 1.0).sum(axis=0).argmin()]
    on = np.abs(said.over + said.rows @ best) < scale
    weighted = weighted * on[:, None]
    return np.asarray(np.linalg.solve(weighted.T @ said.rows + np.eye(6), -weighted.T @ said.over))


def settled(surface: Surface, other: Surface, moved: Array, matrix: Array) -> tuple[Array, Array, float]:
    """A step in the end, back to the start where nothing tells; its covariance, and what scatter is left."""
    group = _groups(moved)
    (over, rows, scale, weight, hessian, right), gone = _rows(surface, other, moved, matrix, group)
    noise = _leaning(rows, weight, moved, other.normal @ matrix[:3, :3].T)
    told, untold = _told(hessian, noise)
    step = told @ np.linalg.solve(told.T @ (hessian + np.eye(6)) @ told, told.T @ right)
    step -= untold @ np.linalg.solve(untold.T @ untold, untold.T @ (gone + step))
    left = over + rows @ step
    inverse = told @ np.linalg.solve(told.T @ (hessian - noise + np.eye(6)) @ told, told.T)
    covariance = inverse @ (_scatter(rows, weight, left, group) + np.eye(6)) @ inverse
    covariance += _split(rows, scale, left, told, group, (noise + np.eye(6)) @ told, covariance)
    covariance += untold @ np.linalg.solve(untold.T @ untold, untold.T)
    return step * PRIOR, covariance * np.outer(PRIOR, PRIOR), sigma(left)


def _medians(values: Array, group: npt.NDArray[np.int64]) -> Array:
    """The median of each group."""
    ordered = values[np.lexsort((values, group))]
    count = np.bincount(group)
    first = np.cumsum(count) - count
    return np.asarray(0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2]))


def _groups(moved: Array) -> npt.NDArray[np.int64]:
    """Numbers of the cubes of some metres that points lie in, from 0."""
    cube = np.floor(moved / _GROUP_M).astype(np.int64)
    cube -= cube.min(axis=0)
    size = cube.max(axis=0) + 1
    _, number = np.unique((cube[:, 0] * size[1] + cube[:, 1]) * size[2] + cube[:, 2], return_inverse=True)
    return np.asarray(number.ravel(), np.int64)


def _scales(over: Array, rough: Array) -> Array:
    """What distances of points scatter by, as patches are rough: smooth ones repeat, leaves do not."""
    octave = np.floor(2.0 * np.log2(rough)).astype(np.int64)
    _, number = np.unique(octave, return_inverse=True)
    number = number.ravel()
    least = np.maximum(0.02 * rough, 1e-4)
    found = np.empty(len(over))
    for each in range(int(number.max()) + 1):
        own = number == each
        found[own] = sigma(over[own]) if own.sum() >= _FEWEST_ALIKE else np.inf
    return np.maximum(np.where(np.isfinite(found), found, np.maximum(rough, sigma(over))), least)


def _leaning(rows: Array, weight: Array, moved: Array, normal: Array) -> Array:
    """What leaning normals seem to tell, though they do not: that which the other cloud's normals at the same places do not say as well."""
    others = np.concatenate([normal, np.cross(moved, normal)], axis=1) * PRIOR
    others *= np.sign(np.einsum("ni,ni->n", rows[:, :3], normal))[:, None]
    crossed = rows.T @ ((rows - others) * weight[:, None])
    value, axis = np.linalg.eigh(0.5 * (crossed + crossed.T))
    return np.asarray((axis * np.maximum(value, 0.0)) @ axis.T)


def _told(hessian: Array, noise: Array) -> tuple[Array, Array]:
    """Directions that are told by more than the prior and the lean of normals, shape (6, k), and the others, shape (6, 6 - k)."""
    value, direction = eigh(hessian + np.eye(6), noise + np.eye(6))
    return direction[:, value > _MORE], direction[:, value <= _MORE]


def _scatter(rows: Array, weight: Array, left: Array, group: npt.NDArray[Any]) -> Array:
    """Second moments of the groups' sums of residuals, each by a solution without it (a jackknife: Efron and Stein 1981)."""
    score = rows * (weight * left)[:, None]
    sums = np.stack([np.bincount(group, score[:, k]) for k in range(6)], axis=1)
    own = np.empty((len(sums), 6, 6))
    for i in range(6):
        for j in range(6):
            own[:, i, j] = np.bincount(group, weight * rows[:, i] * rows[:, j])
    # of the prior there is always some left
    whole = own.sum(axis=0) + np.eye(6)
    without = np.linalg.solve(whole - own, sums[:, :, None])[:, :, 0] @ whole
    return np.asarray(without.T @ without)


def _split(
    rows: Array, scale: Array, left: Array, told: Array, group: npt.NDArray[Any], parts: Array, known: Array
) -> Array:
    """What is to be added to a covariance by how far the groups that tell of a direction disagree about it, those without weight too.

    Both are of the same error: the larger counts. `parts`, shape (6, k), take the part of each direction told out of a solution.
    Where half of them contradict the rest, as bushes do that lean each its own way, robust weights choose some that agree by chance.
    """
    out = np.zeros((6, 6))
    for direction, part in zip(told.T, parts.T, strict=True):
        along = rows @ direction / scale
        own = np.bincount(group, along**2)
        if not own.any():
            continue
        asked = np.abs(np.bincount(group, along * left / scale)) / np.maximum(own, 1e-12)
        order = np.argsort(asked)
        middle = MAD_TO_SIGMA * asked[order[np.searchsorted(np.cumsum(own[order]), 0.5 * own.sum())]]
        apart = middle**2 * (own**2).sum() / own.sum() ** 2
        out += np.outer(direction, direction) * max(0.0, apart - float(part @ known @ part))
    return out
