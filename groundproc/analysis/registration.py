"""One cloud laid on another: six numbers and their covariance, or why not.

Both clouds are smoothed: their points are put on the plane of the patch around them (`numerics.normals`). Points of B
are matched to the planes of the nearest points of A (Chen and Medioni 1992), from far to near. Cauchy weights keep
changes from pulling, and each point is weighted by how well patches of its roughness repeat, because leaves sway.
Planes cut off crests and fill hollows; as both clouds are smoothed alike, that does not pull either. The covariance
comes from groups of residuals within four metres, which share their patches. Each group is judged by all others,
because one bush may hold all the information on a direction. What normals tell by their own errors is no information.
A direction that no plane determines stays as it was.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from flightlog.errors import CoverageError
from groundproc.numerics.normals import normals
from groundproc.numerics.robust import MAD_TO_SIGMA, cauchy, sigma

Array = npt.NDArray[np.float64]

MOST: Final = 400_000
"""Points of A that are looked at."""
_SAMPLE: Final = 60_000
"""Points of B that are laid on A, and fewer from afar."""
_FAR_SAMPLE: Final = 10_000
_FAR_M: Final = 0.5
_STAGES_M: Final = (3.0, 1.5, 0.8, 0.4, 0.4, 0.25, 0.25, 0.25)
_FEWEST: Final = 200
_PRIOR: Final = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
"""What clouds that say where they are may be off by [m, rad]."""
_LEAST_OVERLAP: Final = 0.05
_LEAST_FIT: Final = 0.5
"""Share of the points next to A that have to lie on it in the end."""
_ON_M: Final = 0.05
_GROUP_M: Final = 4.0
_SETTLED: Final = 2
"""Stages at the end in which it is known what is told."""
_FEWEST_ALIKE: Final = 50
"""Points of like roughness of which a scatter is told."""
_MORE: Final = 1.5
"""A direction has to be told so many times better than by the prior, and than normals tell it by their errors."""


@dataclass(frozen=True, slots=True)
class Registration:
    """B laid on A.

    Attributes
    ----------
    matrix : ndarray, shape (4, 4)
        A from B, in map coordinates.
    about_m : ndarray, shape (3,)
        Place about which it turns; `covariance` is of what happens there.
    covariance : ndarray, shape (6, 6)
        Of shift [m] and turn [rad].
    residual_m : float
        Scatter of points of B about the planes of A.
    overlap, fit : float
        Share of B that is next to A, and of that what lies on it.
    """

    matrix: Array
    about_m: Array
    covariance: Array
    residual_m: float
    overlap: float
    fit: float

    def move(self, xyz_m: Array) -> Array:
        """Points of B in the frame of A, shape (n, 3)."""
        turn = self.matrix[:3, :3]
        shift = self.matrix[:3, 3] + turn @ self.about_m - self.about_m
        return np.asarray((xyz_m - self.about_m) @ turn.T + shift + self.about_m)

    @property
    def sigma_m(self) -> float:
        """Of a shift, the mean of three axes, without directions that nothing tells."""
        found = np.sqrt(np.diag(self.covariance)[:3])
        told = found < 0.5 * _PRIOR[:3]
        return float(found[told].mean()) if told.any() else float(found.mean())

    def sigma_along_m(self, xyz_m: Array, normal: Array) -> Array:
        """How well it is known along a direction at places in the frame of A, both of shape (n, 3)."""
        rows = np.concatenate([normal, np.cross(xyz_m - self.about_m, normal)], axis=1)
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", rows, self.covariance, rows)))

    def seen_from(self, origin_m: Array) -> "Registration":
        """The same, where coordinates are counted from another origin."""
        matrix = self.matrix.copy()
        matrix[:3, 3] += self.matrix[:3, :3] @ origin_m - origin_m
        return replace(self, matrix=matrix, about_m=self.about_m - origin_m)


def register(a_m: Array, b_m: Array, what: str = "the two clouds") -> Registration:
    """Lay B on A.

    Parameters
    ----------
    a_m, b_m : ndarray, shape (n, 3)
        Samples of both, as dense as they are.
    what : str
        For the sentence.

    Raises
    ------
    CoverageError
        They have no place in common, or do not fit.
    """
    about = np.round(a_m.mean(axis=0))
    a, b = a_m - about, b_m - about
    surface, sample = _smoothed(a, what), _smoothed(b, what, _SAMPLE)
    tree: Any = cKDTree(surface.xyz, balanced_tree=False)
    few = max(1, len(sample.xyz) // _FAR_SAMPLE)
    matrix, covariance, residual_m = np.eye(4), np.diag(_PRIOR**2), 0.0
    overlap = 0.0
    for number, reach in enumerate(_STAGES_M):
        other = sample.some(slice(None, None, few if reach > _FAR_M else 1))
        moved = other.xyz @ matrix[:3, :3].T + matrix[:3, 3]
        distance, nearest = tree.query(moved, distance_upper_bound=reach)
        near = np.isfinite(distance)
        if number == 0:
            overlap = float(near.mean())
            if overlap < _LEAST_OVERLAP or near.sum() < _FEWEST:
                raise CoverageError(
                    f"{what}: {overlap:.1%} of the second lies within {reach:g} m of the first, expected {_LEAST_OVERLAP:.0%} or more: "
                    "are they of one place?"
                )
        if near.sum() < _FEWEST:
            break
        settled = number >= len(_STAGES_M) - _SETTLED
        step_m, covariance, residual_m = _adjust(surface, other.some(near), moved[near], nearest[near], matrix, settled)
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = Rotation.from_rotvec(step_m[3:]).as_matrix(), step_m[:3]
        matrix = change @ matrix
    fit = _fit(surface, tree, sample.xyz @ matrix[:3, :3].T + matrix[:3, 3])
    if fit < _LEAST_FIT:
        raise CoverageError(
            f"{what}: {fit:.0%} of the points next to each other lie on one surface, expected {_LEAST_FIT:.0%} or more: "
            "are they of one place?"
        )
    return Registration(_about(matrix, about), about, covariance, residual_m, overlap, fit)


def _smoothed(xyz: Array, what: str, most: int | None = None) -> "_Surface":
    """Points that lie on surfaces, on them: all, or so many at most, of twice as many that are looked at."""
    looked = slice(None, None, max(1, len(xyz) // (2 * most))) if most else slice(None)
    planes = normals(xyz, of=looked)
    good = np.isfinite(planes.sigma_rad) & (planes.roughness_m < 0.2)
    if good.sum() < _FEWEST:
        raise CoverageError(
            f"{what}: {int(good.sum())} points on surfaces found, expected {_FEWEST} or more to lay them on each other"
        )
    rows = np.flatnonzero(good)
    rows = rows[:: max(1, len(rows) // most)] if most else rows
    on = xyz[looked][rows] - planes.off_m[rows, None] * planes.normal[rows]
    return _Surface(on, planes.normal[rows], planes.roughness_m[rows])


@dataclass(frozen=True, slots=True)
class _Surface:
    xyz: Array
    normal: Array
    rough: Array

    def some(self, rows: npt.NDArray[Any] | slice) -> "_Surface":
        """Places and planes of some of its points."""
        return _Surface(self.xyz[rows], self.normal[rows], self.rough[rows])

    def over(self, xyz: Array, nearest: npt.NDArray[Any]) -> Array:
        """Distance of points from the planes at points of A."""
        return np.asarray(np.einsum("ni,ni->n", self.normal[nearest], xyz - self.xyz[nearest]))


def _adjust(
    surface: _Surface, other: _Surface, moved: Array, nearest: npt.NDArray[Any], matrix: Array, settled: bool
) -> tuple[Array, Array, float]:
    """One step of shift and turn, its covariance, and what scatter is left; in the end back to the start where nothing tells."""
    normal = surface.normal[nearest]
    over = surface.over(moved, nearest)
    # one unit for all six: what the prior is wide
    rows = np.concatenate([normal, np.cross(moved, normal)], axis=1) * _PRIOR
    rough = np.hypot(other.rough, surface.rough[nearest])
    scale = _scales(over, rough)
    weight = cauchy(over / (2.0 * scale)) / scale**2
    hessian = (rows * weight[:, None]).T @ rows
    noise = _leaning(rows, weight, moved, other.normal @ matrix[:3, :3].T)
    told, untold = _told(hessian, noise) if settled else (np.eye(6), np.empty((6, 0)))
    # what is told already by the prior: how far the whole has gone from where B said it was
    gone = np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_rotvec()]) / _PRIOR
    right = -(rows * weight[:, None]).T @ over - gone
    step = told @ np.linalg.solve(told.T @ (hessian + np.eye(6)) @ told, told.T @ right)
    step -= untold @ np.linalg.solve(untold.T @ untold, untold.T @ (gone + step))
    left = over + rows @ step
    group = _groups(moved)
    inverse = told @ np.linalg.solve(told.T @ (hessian - noise + np.eye(6)) @ told, told.T)
    covariance = inverse @ (_scatter(rows, weight, left, group) + np.eye(6)) @ inverse
    covariance += _split(rows, scale, left, told, group, (noise + np.eye(6)) @ told, covariance)
    covariance += untold @ np.linalg.solve(untold.T @ untold, untold.T)
    return step * _PRIOR, covariance * np.outer(_PRIOR, _PRIOR), sigma(left)


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
    others = np.concatenate([normal, np.cross(moved, normal)], axis=1) * _PRIOR
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


def _fit(surface: _Surface, tree: Any, moved: Array) -> float:
    """Share of the points next to A that lie on it."""
    distance, nearest = tree.query(moved, distance_upper_bound=1.0)
    near = np.isfinite(distance)
    if near.sum() < _FEWEST:
        return 0.0
    over = np.abs(surface.over(moved[near], nearest[near]))
    return float(np.mean(over < np.maximum(_ON_M, 2.5 * surface.rough[nearest[near]])))


def _about(matrix: Array, about: Array) -> Array:
    """A motion about a place as one about the origin of the map."""
    out = matrix.copy()
    out[:3, 3] = matrix[:3, 3] + about - matrix[:3, :3] @ about
    return out
