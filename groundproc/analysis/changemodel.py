"""How the points of one epoch are explained by another: by surfaces, by leaves that sway, or by chance."""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import gammaincc, gammaln
from scipy.stats import norm

from groundproc.analysis.changebeams import Side
from groundproc.analysis.changewindows import Apart, together
from groundproc.analysis.registration import Registration
from groundproc.numerics.normals import normals

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

EDGES_M: Final = (0.15, 0.3, 0.6, 1.2)
FEWEST: Final = 3
"""Points of a claim."""
_SHARE: Final = 0.2
"""Of the points that the top of a voxel has."""
CHANCE: Final = 0.1
"""Clusters that chance may put together in 100 square metres, of each epoch and on each side of the ground."""
_ALONE: Final = 0.05
"""Points that may lie off their surface by chance, on one side, in a voxel and its neighbours."""
UNLIKELY: Final = 1e-5
"""No single point is less likely: echoes of two surfaces, birds and dust lie anywhere."""
_TAIL: Final = (4.0, 0.95, 1.93)
"""Of distances below so many sigmas, this share is less than so many if they are normal."""
_WIDEST: Final = 1.6
"""Sigmas of the roughness that its tail may stand for."""
_SMOOTH: Final = 0.6
"""Of an edge of a voxel: a rougher surface is one of leaves."""
_NEAREST: Final = 8


@dataclass(frozen=True, slots=True)
class Rule:
    """What counts as a change.

    Attributes
    ----------
    edge_m : float
        Of the voxels.
    sway_m : float
        How far leaves move.
    registration : Registration
        How well the epochs lie on each other.
    per_m2 : float
        Points on a square metre.
    """

    edge_m: float
    sway_m: float
    registration: Registration
    per_m2: float

    @property
    def around(self) -> float:
        """Points next to a point."""
        return float(max(np.pi * self.per_m2 * self.edge_m**2, 1.0))

    @property
    def odds(self) -> float:
        """Chance of a point to lie so far off its surface that it is not on it."""
        return float(min(_ALONE / max(self.per_m2 * 9.0 * self.edge_m**2, 1e-9), 0.01))

    @property
    def of_window(self) -> float:
        """Chance of a window of the size of a voxel, at steps of half of it."""
        return CHANCE * self.edge_m**2 / 400.0

    @property
    def fewest(self) -> int:
        """Points of a claim."""
        return max(FEWEST, round(_SHARE * self.per_m2 * self.edge_m**2))

    def by_chance(self, cost: npt.NDArray[Any], number: npt.NDArray[Any]) -> Array:
        """How many clusters in 100 square metres chance puts together that are as unlikely.

        Parameters
        ----------
        cost : ndarray, shape (c,)
            Sums of -log of the odds of each point.
        number : ndarray of int, shape (c,)
            Of points.

        Notes
        -----
        The sum of k such logarithms has a gamma distribution (Fisher 1932). There are no more sets of k points that hang together than
        trees on k points: k^(k-2) / k! for each point, times the number next to a point to the power k - 1.
        """
        k = number.astype(np.float64)
        sets = np.log(100.0 * self.per_m2) + (k - 1) * np.log(self.around) + (k - 2) * np.log(k) - gammaln(k + 1)
        tail = np.log(np.maximum(gammaincc(k, cost), 1e-300))
        return np.asarray(np.exp(np.minimum(sets + tail, 50.0)))


class Model(NamedTuple):
    """An epoch as the other is held against it: surfaces, leaves with how far each sways, and those that hang on something large."""

    side: Side
    normal: Array
    off: Array
    rough: Array
    smooth: Mask
    surface: Any
    leaves: Any
    sway: Array
    bushes: Any
    plan: Any
    apart: Apart


class Odds(NamedTuple):
    """Of each point: signed distance from the nearest surface and its sigma, -log of how likely it lies there by chance, `together`."""

    distance: Array
    sigma: Array
    cost: Array
    together: npt.NDArray[np.int8]


def model(side: Side, rule: Rule) -> Model:
    """Surfaces and leaves of an epoch."""
    xyz = side.xyz
    lies = normals(xyz, EDGES_M)
    smooth = np.isfinite(lies.roughness_m) & (lies.roughness_m <= _SMOOTH * rule.edge_m)
    sway = np.zeros(len(xyz))
    sway[~smooth] = _sway(xyz[~smooth], rule)
    bushes = _tree(xyz[sway >= rule.sway_m])
    none = Apart(xyz, xyz, np.full(len(xyz), np.nan))
    trees = (_tree(xyz[smooth]), _tree(xyz[~smooth]), sway, bushes, _tree(xyz[:, :2]))
    found = Model(side, lies.normal, lies.off_m, lies.roughness_m, smooth, *trees, none)
    return found if found.surface is None else found._replace(apart=_nearest_surface(xyz, found, rule)[0])


def _tree(xyz: Array) -> Any:
    return cKDTree(xyz) if len(xyz) else None


def _sway(xyz: Array, rule: Rule) -> Array:
    """How far leaves move: no farther than the rule says, and than half of what they hang on is large. A stone is as rough as a bush."""
    if not len(xyz):
        return np.empty(0)
    group = clusters(xyz, 2.0 * rule.edge_m)
    low, high = np.full((group.max() + 1, 3), np.inf), np.full((group.max() + 1, 3), -np.inf)
    np.minimum.at(low, group, xyz)
    np.maximum.at(high, group, xyz)
    half = 0.5 * np.linalg.norm(high - low, axis=1)
    return np.asarray(np.clip(half, 0.5 * rule.edge_m, rule.sway_m)[group])


def odds(xyz: Array, other: Model, rule: Rule) -> Odds:
    """Each point against the surface that explains it best, and against leaves."""
    distance, sigma = np.full(len(xyz), np.nan), np.full(len(xyz), np.nan)
    swayed, side = np.zeros(len(xyz), np.bool_), np.zeros(len(xyz), np.int8)
    if other.leaves is not None:
        rows = np.flatnonzero(~other.smooth)
        apart, index = other.leaves.query(xyz, _NEAREST, distance_upper_bound=rule.sway_m)
        far = np.append(other.sway[rows], -1.0)
        swayed = (apart <= far[index]).any(axis=1)
    if other.surface is not None:
        own, distance, sigma = _nearest_surface(xyz, other, rule)
        own.sigmas[swayed] = np.nan
        side = together(own, other.apart, rule.edge_m, rule.of_window)
    ratio = np.abs(distance) / sigma
    ordinary = ratio[(ratio < _TAIL[0]) & ~swayed]
    wide = np.clip(np.quantile(ordinary, _TAIL[1]) / _TAIL[2], 1.0, _WIDEST) if len(ordinary) else 1.0
    sigma *= wide
    cost = np.full(len(xyz), -np.log(UNLIKELY))
    near = np.isfinite(distance)
    cost[near] = np.minimum(-norm.logsf(ratio[near] / wide), -np.log(UNLIKELY))
    cost[swayed] = 0.0
    return Odds(distance, sigma, cost, side)


def _nearest_surface(xyz: Array, other: Model, rule: Rule) -> tuple[Apart, Array, Array]:
    """The one of the surfaces around that explains a point best, signed distance from it, and its sigma."""
    distance, sigma = np.full(len(xyz), np.nan), np.full(len(xyz), np.nan)
    rows = np.flatnonzero(other.smooth)
    apart, index = other.surface.query(xyz, _NEAREST, distance_upper_bound=3.0 * rule.edge_m)
    place, chosen = other.side.xyz, np.full(len(xyz), -1)
    unsure = np.full(len(place), np.nan)
    unsure[rows] = np.hypot(other.rough[rows], rule.registration.sigma_along_m(place[rows], other.normal[rows]))
    for k in range(_NEAREST):
        ok = np.flatnonzero(np.isfinite(apart[:, k]))
        q = rows[index[ok, k]]
        side = np.where(other.normal[q, 2] < 0, -1.0, 1.0)
        over = side * (np.einsum("ni,ni->n", other.normal[q], xyz[ok] - place[q]) + other.off[q])
        better = np.isnan(distance[ok]) | (np.abs(over) / unsure[q] < np.abs(distance[ok]) / sigma[ok])
        distance[ok[better]], sigma[ok[better]], chosen[ok[better]] = over[better], unsure[q][better], q[better]
    normal = np.where(other.normal[chosen, 2:] < 0, -1.0, 1.0) * other.normal[chosen]
    foot = xyz - np.nan_to_num(distance)[:, None] * np.nan_to_num(normal)
    # a common shift of all points is no scatter of windows
    return (
        Apart(foot, np.nan_to_num(normal), distance / np.where(chosen >= 0, other.rough[chosen], np.nan)),
        distance,
        sigma,
    )


def clusters(xyz: Array, edge_m: float) -> npt.NDArray[Any]:
    """Number of the group of each point: those whose halves of a voxel touch, by faces, edges or corners."""
    voxel = np.floor(xyz / (0.5 * edge_m)).astype(np.int64)
    keys, of_point = np.unique(voxel, axis=0, return_inverse=True)
    pairs = cKDTree(keys.astype(np.float64)).query_pairs(1.8, output_type="ndarray")
    ones = np.ones(len(pairs), np.int8)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    return np.asarray(connected_components(graph, directed=False)[1][of_point.ravel()])
