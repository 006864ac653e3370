"""What appeared or vanished between two epochs, in a piece of ground.

A point is explained by the other epoch if it lies on a surface there, within that surface's roughness and the
registration's sigma, or near leaves there, which sway. Points that are not explained, by themselves or together with
those around them (`changewindows`), form clusters. A cluster counts if chance cannot have put it together, given the
number of sets of points that could have come out as unlikely. It is a claim if the other epoch had to have seen
several points of it, by its own density there or by its own beams that went through, and did look past it on every
side. Otherwise it is unseen, which is no change. The sides matter because beams pass in front of a wall that they do
not show; behind it, where it stands, none passes.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from groundproc.analysis.changebeams import Side, passes
from groundproc.analysis.changemodel import CHANCE, FEWEST, UNLIKELY, Model, Odds, Rule, clusters, odds

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAME: Final = 0
APPEARED: Final = 1
VANISHED: Final = 2
UNSEEN: Final = 3
HALO_M: Final = 5.0
"""How far around a square others may decide on a point, and how large a change may be to be told as one."""
_MISSED: Final = 2.5
"""Points that the other epoch has to have missed."""
_MOST_EACH: Final = 3.0
"""Beams that count for one point: a stop over one place must not outweigh all else of a change."""
_AROUND_M: Final = 1.0
"""Densities are compared within so much."""
_SIDES: Final = np.array([(np.cos(turn), np.sin(turn), 0.0) for turn in np.arange(8) * np.pi / 4.0])
_LOOKED: Final = 0.4
"""Share of the points of a change that the other epoch has to have looked past, on each of these sides: a tenth at a wall that stayed, nine
tenths where nothing was."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A change.

    Attributes
    ----------
    place_m : ndarray, shape (3,)
        Its centroid.
    volume_m3 : float
    points : int
    missed : float
        Points of it that the other epoch would have seen.
    first : int
        The first of its points.
    """

    place_m: Array
    volume_m3: float
    points: int
    missed: float
    first: int


@dataclass(frozen=True, slots=True)
class Compared:
    """One epoch against the other.

    Attributes
    ----------
    state : ndarray of uint8, shape (n,)
        `SAME`, `APPEARED` for what the other has not, or `UNSEEN`.
    distance_m, sigma_m : ndarray, shape (n,)
    claims : list of Claim
    """

    state: npt.NDArray[np.uint8]
    distance_m: Array
    sigma_m: Array
    claims: list[Claim]


def compare(own: Model, other: Model, rule: Rule) -> Compared:
    """Hold the points of one epoch against another.

    Parameters
    ----------
    own, other : Model
    rule : Rule
    """
    xyz = own.side.xyz
    state = np.zeros(len(xyz), np.uint8)
    lies = odds(xyz, other, rule)
    found = [each for each in _unlikely(xyz, lies, rule) if not _swayed(each, own, other, rule)]
    claims: list[Claim] = []
    if found:
        expected, seen = _expected(np.concatenate(found), own.side, other, rule)
        ends = np.cumsum([len(each) for each in found])
        for cluster, missed, looked in zip(
            found, np.split(expected, ends[:-1]), np.split(seen, ends[:-1]), strict=True
        ):
            if looked.mean(axis=0).min() < _LOOKED or missed.sum() < _MISSED:
                state[cluster] = UNSEEN
                continue
            state[cluster] = APPEARED
            place, volume = _extent(xyz[cluster[_sure(lies, cluster)]], other, rule)
            claims.append(Claim(place, volume, len(cluster), float(missed.sum()), int(cluster.min())))
    return Compared(state, lies.distance, lies.sigma, claims)


def _unlikely(xyz: Array, lies: Odds, rule: Rule) -> list[npt.NDArray[Any]]:
    """Clusters of points that chance has not put together, above the surface and below it."""
    found: list[npt.NDArray[Any]] = []
    alone, below = lies.cost > -np.log(rule.odds), lies.distance < 0.0
    for sign, rest in ((1, ~below), (-1, below)):
        rows = np.flatnonzero((alone & rest) | (lies.together == sign))
        if not len(rows):
            continue
        group = clusters(xyz[rows], rule.edge_m)
        number, cost = np.bincount(group), np.bincount(group, lies.cost[rows])
        joint = np.bincount(group, lies.together[rows] == sign) >= min(rule.fewest, FEWEST)
        counts = (number >= rule.fewest) & (joint | (rule.by_chance(cost, number) < CHANCE))
        order = np.argsort(group, kind="stable")
        parts = np.split(rows[order], np.cumsum(number)[:-1])
        found += [parts[each] for each in np.flatnonzero(counts)]
    return found


def _swayed(cluster: npt.NDArray[Any], own: Model, other: Model, rule: Rule) -> bool:
    """Whether it is of a bush, at whose other end the other epoch has it too: a whole bush leans further than its leaves."""
    if own.bushes is None or other.bushes is None:
        return False
    xyz = own.side.xyz[cluster]
    beside = np.isfinite(own.bushes.query(xyz, distance_upper_bound=2.0 * rule.edge_m)[0])
    there = np.isfinite(other.bushes.query(xyz, distance_upper_bound=2.0 * rule.sway_m)[0])
    return bool(beside.mean() > 0.5 and there.mean() > 0.5)


def _sure(lies: Odds, cluster: npt.NDArray[Any]) -> Mask:
    """Points of a cluster that are no ground by its noise; all where these are too few."""
    sure = lies.cost[cluster] > -0.6 * np.log(UNLIKELY)
    return sure if sure.sum() >= FEWEST else np.ones(len(cluster), np.bool_)


def _expected(rows: npt.NDArray[Any], own: Side, other: Model, rule: Rule) -> tuple[Array, npt.NDArray[np.bool_]]:
    """How many points of the other epoch each of the points stands for, and on which sides of it the other looked past, shape (n, 8)."""
    xyz, looked = own.xyz[rows], other.side
    if other.plan is None:
        return np.zeros(len(rows)), np.zeros((len(rows), len(_SIDES)), np.bool_)
    beside = (xyz[:, None] + 0.5 * rule.edge_m * _SIDES).reshape(-1, 3)
    if looked.away.any():
        keys, of_point = _voxels(xyz, rule.edge_m)
        through, own_through = (passes(keys, each, rule.edge_m) for each in (looked, own))
        held = np.bincount(of_point, minlength=len(keys))
        # of the beams that enter a voxel, so many end in it: the other epoch's would have too
        ends = held / (held + own_through)
        missed = np.minimum(through * ends / held, _MOST_EACH)[of_point]
        keys, of_side = _voxels(beside, 0.5 * rule.edge_m)
        free = passes(keys, looked, 0.5 * rule.edge_m) > 0
        return missed, free[of_side].reshape(len(rows), -1)
    around = cKDTree(own.xyz[:, :2]).query_ball_point(xyz[:, :2], _AROUND_M, return_length=True)
    there = other.plan.query_ball_point(xyz[:, :2], _AROUND_M, return_length=True)
    # something of the other epoch is behind it, as seen from above
    spacing = np.sqrt(np.pi * _AROUND_M**2 / np.maximum(there, 1))
    apart, index = other.plan.query(beside[:, :2])
    below = looked.xyz[index, 2] < beside[:, 2]
    behind = (apart < 1.5 * np.repeat(spacing, len(_SIDES))) & below
    return np.asarray(there / np.maximum(around, 1)), behind.reshape(len(rows), -1)


def _voxels(xyz: Array, edge_m: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Numbers of the voxels that hold points, shape (v, 3), and the voxel of each."""
    keys, of_point = np.unique(np.floor(xyz / edge_m).astype(np.int64), axis=0, return_inverse=True)
    return keys, of_point.ravel()


def _extent(xyz: Array, other: Model, rule: Rule) -> tuple[Array, float]:
    """Centroid and volume: columns of half a voxel from the other epoch's ground, or its own lowest point, to the highest."""
    edge = rule.edge_m / 2.0
    cell = np.floor(xyz[:, :2] / edge).astype(np.int64)
    cells, number = np.unique(cell, axis=0, return_inverse=True)
    number = number.ravel()
    top, low = np.full(len(cells), -np.inf), np.full(len(cells), np.inf)
    np.maximum.at(top, number, xyz[:, 2])
    np.minimum.at(low, number, xyz[:, 2])
    centre = (cells + 0.5) * edge
    if other.surface is not None:
        base = other.side.xyz[other.smooth]
        beside, index = other.surface.query(np.column_stack([centre, low]), distance_upper_bound=4.0 * rule.edge_m)
        found = np.isfinite(beside)
        ground = np.where(found, base[np.where(found, index, 0), 2], np.inf)
        low = np.where(ground < low, ground, low)
    high = np.maximum(top - low, edge / 2.0)
    volume = high * edge**2
    middle = np.column_stack([centre, low + high / 2.0])
    # a column is hit by chance only where points are few: the area is that of the outline then
    share = _filled(cells)
    return np.asarray((middle * volume[:, None]).sum(axis=0) / volume.sum()), float(volume.sum() * share)


def _filled(cells: npt.NDArray[np.int64]) -> float:
    """Cells of an outline by those that are hit: those between two hit ones in both directions belong to it."""
    low = cells.min(axis=0)
    size = cells.max(axis=0) - low + 1
    if size.prod() > 1_000_000:
        return 1.0
    hit = np.zeros(size, np.bool_)
    hit[tuple((cells - low).T)] = True

    def between(axis: int) -> npt.NDArray[np.bool_]:
        before = np.maximum.accumulate(hit, axis=axis)
        after = np.flip(np.maximum.accumulate(np.flip(hit, axis), axis=axis), axis)
        return np.asarray(before & after)

    return float((between(0) & between(1)).sum() / len(cells))
