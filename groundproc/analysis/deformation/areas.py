"""Where a surface was lost or gained: connected core points whose distance is significant, with their volume and its sigma."""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely
from scipy.optimize import brentq
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.stats import norm, t

from groundproc.analysis.deformation.m3c2 import TWO_SIDED_95

Array = npt.NDArray[np.float64]

_WITHIN: Final = 1.5
"""Sigmas within which distances are looked at for what they scatter by beyond their own sigma: what has changed lies mostly outside."""
_MEDIAN: Final = float(norm.ppf(0.5 + 0.25 * (2.0 * norm.cdf(_WITHIN) - 1.0)))
"""Median of the absolute value of a normal deviate that lies within."""
_FEWEST: Final = 50
_CHANCE: Final = 0.05
"""Areas that chance alone may make in the whole of a place."""
_NEAR: Final = 1.8
"""Of the spacing: core points that touch, diagonals of voxels included."""
_RIM: Final = 4.0
"""Of the spacing: towards its rim a change becomes too small to be told, but is part of the volume. All that lies so near to an area
counts, whatever its sign, so that noise takes nothing away and adds nothing."""
_FREEDOM: Final = 40.0
"""Of the scatter of two cylinders of some 20 points: its own uncertainty makes tails longer than normal ones."""


class Measured(NamedTuple):
    """Core points and their distances.

    Attributes
    ----------
    xyz_m : ndarray, shape (k, 3)
    area_m2, distance_m : ndarray, shape (k,)
    own_m2, shared_m2 : ndarray, shape (k,)
        Variance that each has alone, and that neighbours share.
    """

    xyz_m: Array
    area_m2: Array
    distance_m: Array
    own_m2: Array
    shared_m2: Array


@dataclass(frozen=True, slots=True)
class Area:
    """Surface that was lost or gained.

    Attributes
    ----------
    kind : str
        lost or gained.
    outline : shapely geometry
        In plan.
    place_m : ndarray, shape (3,)
        Centroid.
    area_m2 : float
        Of what is significant.
    volume_m3, sigma_m3 : float
        With its rim.
    mean_m, most_m : float
        Distance along the normals: mean, and largest.
    cores : int
    """

    kind: str
    outline: Any
    place_m: Array
    area_m2: float
    volume_m3: float
    sigma_m3: float
    mean_m: float
    most_m: float
    cores: int


def excess_m(distance_m: Array, variance_m2: Array) -> float:
    """What distances of a place that is mostly unchanged scatter by beyond their own sigma: drift between strips, terrain that is rough.

    Parameters
    ----------
    distance_m, variance_m2 : ndarray, shape (k,)

    Returns
    -------
    float
        One sigma [m], so that those within 1.5 sigmas have the median that normal ones have; 0 where there are too few to tell.
    """

    def over(sigma: float) -> float:
        z = np.abs(distance_m) / np.sqrt(variance_m2 + sigma**2 + 1e-12)
        within = z[z < _WITHIN]
        return float(np.median(within)) - _MEDIAN if len(within) >= _FEWEST else 1.0

    if len(distance_m) < _FEWEST or over(0.0) <= 0.0:
        return 0.0
    most = float(np.abs(distance_m).max()) / _MEDIAN
    return float(brentq(over, 0.0, most, xtol=1e-6)) if over(most) < 0.0 else 0.0


def areas(measured: Measured, spacing_m: float, independent: int) -> list[Area]:
    """Connected core points that are significantly lower or higher, unless chance makes such.

    Parameters
    ----------
    measured : Measured
    spacing_m : float
    independent : int
        Cylinders of the whole place that do not overlap: so many tries chance has.
    """
    told = np.abs(measured.distance_m) > TWO_SIDED_95 * np.sqrt(measured.own_m2 + measured.shared_m2)
    least = float(t.isf(min(_CHANCE / max(independent, 1), _CHANCE) / 2.0, _FREEDOM))
    group = np.full(len(told), -1)
    kinds: list[str] = []
    for kind, sign in (("lost", -1.0), ("gained", 1.0)):
        rows = np.flatnonzero(told & (sign * measured.distance_m > 0.0))
        parts = [rows[own] for own in _connected(measured.xyz_m[rows], _NEAR * spacing_m)]
        sure = [own for own in parts if _is_sure(measured, own, least)]
        kept = np.concatenate(sure) if sure else rows[:0]
        for own in _connected(measured.xyz_m[kept], _RIM * spacing_m):
            group[kept[own]] = len(kinds)
            kinds.append(kind)
    rims = _rims(measured.xyz_m, group, _RIM * spacing_m)
    found = [
        _area(kind, measured, (np.flatnonzero(group == number), np.flatnonzero(rims == number)), spacing_m)
        for number, kind in enumerate(kinds)
    ]
    return sorted(found, key=lambda each: -each.volume_m3)


def _rims(xyz_m: Array, group: npt.NDArray[Any], reach_m: float) -> npt.NDArray[Any]:
    """Number of the area that each core point belongs to, with its rim; -1: none."""
    rims = group.copy()
    inside, beside = np.flatnonzero(group >= 0), np.flatnonzero(group < 0)
    if len(inside) and len(beside):
        away, at = cKDTree(xyz_m[inside]).query(xyz_m[beside], distance_upper_bound=reach_m)
        near = np.isfinite(away)
        rims[beside[near]] = group[inside[np.asarray(at)[near]]]
    return rims


def _connected(xyz_m: Array, reach_m: float) -> list[npt.NDArray[Any]]:
    if not len(xyz_m):
        return []
    pairs = cKDTree(xyz_m).query_pairs(reach_m, output_type="ndarray")
    ones = np.ones(len(pairs), np.int8)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(xyz_m), len(xyz_m)))
    _, group = connected_components(graph, directed=False)
    order = np.argsort(group, kind="stable")
    return np.split(order, np.cumsum(np.bincount(group))[:-1])


def _is_sure(measured: Measured, own: npt.NDArray[Any], least: float) -> bool:
    """Whether one distance alone is no chance, or all that they are beyond what chance chose them by."""
    size, sigma = np.abs(measured.distance_m[own]), np.sqrt(measured.own_m2[own] + measured.shared_m2[own])
    beyond = float(measured.area_m2[own] @ (size - TWO_SIDED_95 * sigma))
    return bool((size > least * sigma).any()) or beyond > least * volume_sigma(measured, own)


def _volume(measured: Measured, own: npt.NDArray[Any]) -> float:
    return float(measured.area_m2[own] @ measured.distance_m[own])


def _area(kind: str, measured: Measured, own: tuple[npt.NDArray[Any], npt.NDArray[Any]], spacing_m: float) -> Area:
    """An area of significant core points, and those with its rim."""
    sure, whole = own
    weight, distance = measured.area_m2[sure], measured.distance_m[sure]
    area = float(weight.sum())
    cell = np.unique(np.floor(measured.xyz_m[sure, :2] / spacing_m), axis=0) * spacing_m
    outline = shapely.union_all(shapely.box(*cell.T, *(cell + spacing_m).T))
    sign = -1.0 if kind == "lost" else 1.0
    return Area(
        kind, outline, np.average(measured.xyz_m[sure], axis=0, weights=weight), area, sign * _volume(measured, whole),
        volume_sigma(measured, whole), float(weight @ distance) / area, float(distance[int(np.argmax(np.abs(distance)))]), len(sure),
    )  # fmt: skip


def volume_sigma(measured: Measured, own: npt.NDArray[Any]) -> float:
    """Sigma of the volume of some core points [m3]: what each has alone averages out, what they share does not."""
    weight = measured.area_m2[own]
    alone = float(np.square(weight) @ measured.own_m2[own])
    shared = float(weight @ np.sqrt(measured.shared_m2[own]))
    return float(np.sqrt(alone + shared**2))
