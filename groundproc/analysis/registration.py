"""One cloud laid on another: six numbers and their covariance, or why not.

Both clouds are smoothed: their points are put on the plane of the patch around (`numerics.normals`). Those of B are held against the planes
of those of A that they are next to (Chen and Medioni 1992), from far to near, with weights by Cauchy, so that what has changed does not
pull. Planes cut off crests and fill hollows; as both are smoothed alike that does not pull either. The covariance is of groups of residuals
within four metres, which share their patches. A direction that no plane tells stays as it was.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from flightlog.errors import CoverageError
from groundproc.numerics.normals import normals
from groundproc.numerics.robust import cauchy, sigma

Array = npt.NDArray[np.float64]

MOST: Final = 400_000
"""Points of A that are looked at."""
_SAMPLE: Final = 60_000
_STAGES_M: Final = (3.0, 1.5, 0.8, 0.4, 0.4, 0.25, 0.25, 0.25)
_FEWEST: Final = 200
_PRIOR: Final = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
"""What clouds that say where they are may be off by [m, rad]."""
_LEAST_OVERLAP: Final = 0.05
_LEAST_FIT: Final = 0.5
"""Share of the points next to A that have to lie on it in the end."""
_ON_M: Final = 0.05
_GROUP_M: Final = 4.0


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
    surface, other = _smoothed(a, what), _smoothed(b, what)
    step = max(1, len(other.xyz) // _SAMPLE)
    sample = other.xyz[::step]
    matrix, covariance, residual_m = np.eye(4), np.diag(_PRIOR**2), 0.0
    overlap = 0.0
    for number, reach in enumerate(_STAGES_M):
        moved = sample @ matrix[:3, :3].T + matrix[:3, 3]
        distance, nearest = surface.tree.query(moved, distance_upper_bound=reach)
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
        step_m, covariance, residual_m = _adjust(surface, moved[near], nearest[near], reach, matrix)
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = Rotation.from_rotvec(step_m[3:]).as_matrix(), step_m[:3]
        matrix = change @ matrix
    fit = _fit(surface, sample @ matrix[:3, :3].T + matrix[:3, 3])
    if fit < _LEAST_FIT:
        raise CoverageError(
            f"{what}: {fit:.0%} of the points next to each other lie on one surface, expected {_LEAST_FIT:.0%} or more: "
            "are they of one place?"
        )
    return Registration(_about(matrix, about), about, covariance, residual_m, overlap, fit)


def _smoothed(xyz: Array, what: str) -> "_Surface":
    """Points that lie on surfaces, on them."""
    planes = normals(xyz)
    good = np.isfinite(planes.sigma_rad) & (planes.roughness_m < 0.2)
    if good.sum() < _FEWEST:
        raise CoverageError(
            f"{what}: {int(good.sum())} points on surfaces found, expected {_FEWEST} or more to lay them on each other"
        )
    on = xyz[good] - planes.off_m[good, None] * planes.normal[good]
    return _Surface(cKDTree(on), on, planes.normal[good], planes.roughness_m[good])


@dataclass(frozen=True, slots=True)
class _Surface:
    tree: Any
    xyz: Array
    normal: Array
    rough: Array

    def over(self, xyz: Array, nearest: npt.NDArray[Any]) -> Array:
        """Distance of points from the planes at points of A."""
        return np.asarray(np.einsum("ni,ni->n", self.normal[nearest], xyz - self.xyz[nearest]))


def _adjust(
    surface: _Surface, moved: Array, nearest: npt.NDArray[Any], reach: float, matrix: Array
) -> tuple[Array, Array, float]:
    """One step of shift and turn, its covariance, and the scatter that is left."""
    normal = surface.normal[nearest]
    over = surface.over(moved, nearest)
    rows = np.concatenate([normal, np.cross(moved, normal)], axis=1)
    scale = max(sigma(over), 1e-4)
    weight = cauchy(over / (2.0 * scale)) / scale**2
    # what is told already by the prior: how far the whole has gone from where B said it was
    gone = np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_rotvec()])
    hessian = (rows * weight[:, None]).T @ rows + np.diag(_PRIOR**-2)
    right = -(rows * weight[:, None]).T @ over - gone / _PRIOR**2
    step = np.linalg.solve(hessian, right)
    left = over + rows @ step
    cell = np.floor(moved / _GROUP_M).astype(np.int64)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    score = rows * (weight * left)[:, None]
    sums = np.stack([np.bincount(group.ravel(), score[:, k]) for k in range(6)], axis=1)
    inverse = np.linalg.inv(hessian)
    covariance = inverse @ (sums.T @ sums + np.diag(_PRIOR**-2)) @ inverse
    return step, covariance, sigma(left)


def _fit(surface: _Surface, moved: Array) -> float:
    """Share of the points next to A that lie on it."""
    distance, nearest = surface.tree.query(moved, distance_upper_bound=1.0)
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
