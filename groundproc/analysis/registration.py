"""One cloud laid on another: six numbers and their covariance, or why not.

Both clouds are smoothed: their points are put on the plane of the patch around them (`numerics.normals`). Points of B
are matched to the planes of the nearest points of A (Chen and Medioni 1992), from far to near (`registrationstep`), so
that changes do not pull. Each point is weighted by how well patches of its roughness repeat, because leaves sway.
Planes cut off crests and fill hollows; as both clouds are smoothed alike, that does not pull either. A direction that
no plane determines stays as it was.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from flightlog.errors import CoverageError
from groundproc.analysis.registrationstep import PRIOR, Surface, settled, step_towards
from groundproc.numerics.normals import EDGES_M, FEWEST, normals
from groundproc.numerics.voxelhash import assign, row_by_row

Array = npt.NDArray[np.float64]

MOST: Final = 400_000
"""Points of A that are looked at."""
_PLANES: Final = 150_000
"""Of them that have planes of their own: those around a point are nearly the same."""
_SAMPLE: Final = 60_000
"""Points of B that are laid on A, and fewer from afar."""
_FAR_SAMPLE: Final = 10_000
_CELL_M: Final = 1.0
"""Points are sorted by cells of the ground: searches among neighbours find what they need in the cache."""
_FAR_M: Final = 0.3
_STAGES_M: Final = (3.0, 1.5, 0.8, 0.8, 0.4, 0.4, 0.25, 0.25, 0.25)
_CONSENSUS: Final = (3, 4)
"""Stages that ask what most groups agree in: where a block moved as one, a fit of all lies between it and the rest, and stays there."""
_FEWEST: Final = 200
_LEAST_OVERLAP: Final = 0.05
_LEAST_FIT: Final = 0.5
"""Share of the points next to A that have to lie on it in the end."""
_ON_M: Final = 0.05
_SETTLED: Final = 2
"""Stages at the end in which it is known what is told."""


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
        told = found < 0.5 * PRIOR[:3]
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
    a, b = (each.take(row_by_row(each, _CELL_M), axis=0) - about for each in (a_m, b_m))
    surface, sample = _smoothed(a, what, _PLANES), _smoothed(b, what, _SAMPLE)
    tree: Any = cKDTree(surface.xyz, balanced_tree=False)
    few = max(1, len(sample.xyz) // _FAR_SAMPLE)
    matrix, covariance, residual_m = np.eye(4), np.diag(PRIOR**2), 0.0
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
        pairs = surface.some(nearest[near]), other.some(near), moved[near]
        if number < len(_STAGES_M) - _SETTLED:
            step_m = step_towards(*pairs, matrix, number in _CONSENSUS, number > _CONSENSUS[-1])
        else:
            step_m, covariance, residual_m = settled(*pairs, matrix)
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


def _smoothed(xyz: Array, what: str, most: int) -> Surface:
    """Points that lie on surfaces, on them, so many at most; a quarter more are looked at."""
    looked = slice(None, None, max(1, round(len(xyz) / (1.25 * most))))
    planes = normals(xyz, _edges(xyz), looked)
    rows = np.flatnonzero(np.isfinite(planes.sigma_rad) & (planes.roughness_m < 0.2))
    if len(rows) < _FEWEST:
        raise CoverageError(
            f"{what}: {len(rows)} points on surfaces found, expected {_FEWEST} or more to lay them on each other"
        )
    rows = rows[:: max(1, round(len(rows) / most))]
    on = xyz[looked][rows] - planes.off_m[rows, None] * planes.normal[rows]
    return Surface(on, planes.normal[rows], planes.roughness_m[rows])


def _edges(xyz: Array) -> tuple[float, ...]:
    """Edges of voxels, without the narrowest where hardly any of them has the points of a plane."""
    voxels = assign(xyz - xyz.min(axis=0), EDGES_M[0])[1]
    return EDGES_M[9 * len(xyz) < 2 * FEWEST * voxels :]


def _fit(surface: Surface, tree: Any, moved: Array) -> float:
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
