"""What appeared or vanished between two epochs, in a piece of ground.

A point is explained by the other epoch if it lies on a surface of it, by the roughness of that surface and the registration, or near to
leaves of it, which sway. Points that are not make clusters of touching voxels. A cluster is a claim if the other epoch had to have seen
several points of it, by its own density there or by its own beams that went through, and did look there: else it is unseen, which is no
change.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.stats import norm

from groundproc.numerics.normals import normals
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAME: Final = 0
APPEARED: Final = 1
VANISHED: Final = 2
UNSEEN: Final = 3
EDGES_M: Final = (0.15, 0.3, 0.6, 1.2)
HALO_M: Final = 5.0
"""How far around a square others may decide on a point, and how large a change may be to be told as one."""
FEWEST: Final = 4
"""Points of a claim, and points that the other epoch has to have missed."""
_CHANCE: Final = 0.05
"""Points that may lie off their surface by chance, on one side, in a voxel and its neighbours: four that touch are then none."""
_SHARE: Final = 0.25
"""Of the points that the top of a voxel has."""
_SMOOTH: Final = 0.6
"""Of an edge of a voxel: a rougher surface is one of leaves."""
_NEAREST: Final = 8
_MOST_EACH: Final = 3.0
"""Beams that count for one point: a stop over one place must not outweigh all else of a change."""
_AROUND_M: Final = 1.0
"""Densities are compared within so much."""


class Side(NamedTuple):
    """Points of an epoch, and where they were seen from.

    Attributes
    ----------
    xyz : ndarray, shape (n, 3)
    away : ndarray, shape (n, 3)
        To the sensor [m]; zero where it is not known.
    """

    xyz: Array
    away: Array


@dataclass(frozen=True, slots=True)
class Rule:
    """What counts as a change.

    Attributes
    ----------
    edge_m : float
        Of the voxels.
    sway_m : float
        How far leaves move.
    registration_m : float
        Sigma of the registration.
    per_m2 : float
        Points on a square metre.
    """

    edge_m: float
    sway_m: float
    registration_m: float
    per_m2: float

    @property
    def sigmas(self) -> float:
        """Of the distance from a surface, beyond which a point is not on it."""
        return float(norm.isf(min(_CHANCE / max(self.per_m2 * 9.0 * self.edge_m**2, 1e-9), 0.01)))

    @property
    def fewest(self) -> int:
        """Points of a claim."""
        return max(FEWEST, round(_SHARE * self.per_m2 * self.edge_m**2))


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


class _Model(NamedTuple):
    """An epoch as the other is held against it."""

    xyz: Array
    normal: Array
    off: Array
    rough: Array
    smooth: Mask
    surface: Any
    leaves: Any
    every: Any
    plan: Any


def model(xyz: Array, rule: Rule) -> _Model:
    """Surfaces and leaves of an epoch."""
    lies = normals(xyz, EDGES_M)
    smooth = np.isfinite(lies.roughness_m) & (lies.roughness_m <= _SMOOTH * rule.edge_m)
    return _Model(
        xyz, lies.normal, lies.off_m, lies.roughness_m, smooth, _tree(xyz[smooth]), _tree(xyz[~smooth]), _tree(xyz), _tree(xyz[:, :2])
    )  # fmt: skip


def _tree(xyz: Array) -> Any:
    return cKDTree(xyz) if len(xyz) else None


def compare(side: Side, other: _Model, looked: Side, rule: Rule) -> Compared:
    """Hold the points of one epoch against another.

    Parameters
    ----------
    side : Side
    other : _Model
    looked : Side
        The other epoch's beams.
    rule : Rule
    """
    count = len(side.xyz)
    state = np.zeros(count, np.uint8)
    distance, sigma, explained = _explained(side.xyz, other, rule)
    left = np.flatnonzero(~explained)
    claims: list[Claim] = []
    if len(left):
        voxel = np.floor(side.xyz[left] / rule.edge_m).astype(np.int64)
        keys, of_point = np.unique(voxel, axis=0, return_inverse=True)
        of_point = of_point.ravel()
        group = _connected(keys)[of_point]
        expected, seen = _expected(side, left, other, looked, rule, keys, of_point)
        for number in range(int(group.max()) + 1):
            own = np.flatnonzero(group == number)
            missed = float(expected[own].sum())
            if len(own) < rule.fewest or float(np.mean(seen[own])) < 0.5 or missed < FEWEST:
                state[left[own]] = SAME if len(own) < rule.fewest else UNSEEN
                continue
            state[left[own]] = APPEARED
            place, volume = _extent(side.xyz[left[own]], other, rule)
            claims.append(Claim(place, volume, len(own), missed, int(left[own].min())))
    return Compared(state, distance, sigma, claims)


def _explained(xyz: Array, other: _Model, rule: Rule) -> tuple[Array, Array, Mask]:
    """Signed distance from the nearest surface, its sigma, and whether a point is explained."""
    distance, sigma = np.full(len(xyz), np.nan), np.full(len(xyz), np.nan)
    explained = np.zeros(len(xyz), np.bool_)
    if other.leaves is not None:
        near, _ = other.leaves.query(xyz, distance_upper_bound=rule.sway_m)
        explained |= np.isfinite(near)
    if other.surface is None:
        return distance, sigma, explained
    rows = np.flatnonzero(other.smooth)
    reach = 3.0 * rule.edge_m
    apart, index = other.surface.query(xyz, _NEAREST, distance_upper_bound=reach)
    for k in range(_NEAREST):
        ok = np.flatnonzero(np.isfinite(apart[:, k]))
        q = rows[index[ok, k]]
        normal = np.where(other.normal[q, 2:] < 0, -1.0, 1.0) * other.normal[q]
        side = np.where(other.normal[q, 2] < 0, -1.0, 1.0)
        over = np.einsum("ni,ni->n", normal, xyz[ok] - other.xyz[q]) + side * other.off[q]
        unsure = np.hypot(other.rough[q], rule.registration_m)
        better = np.isnan(distance[ok]) | (np.abs(over) / unsure < np.abs(distance[ok]) / sigma[ok])
        distance[ok[better]], sigma[ok[better]] = over[better], unsure[better]
    explained |= np.abs(distance) <= rule.sigmas * sigma
    return distance, sigma, explained


def _connected(keys: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
    """Number of the group of each voxel: those that touch, by faces, edges or corners."""
    pairs = cKDTree(keys.astype(np.float64)).query_pairs(1.8, output_type="ndarray")
    ones = np.ones(len(pairs), np.int8)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    return np.asarray(connected_components(graph, directed=False)[1])


def _expected(
    side: Side, left: npt.NDArray[Any], other: _Model, looked: Side, rule: Rule, keys: Any, of_point: Any
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """How many points of the other epoch each point left stands for, and whether the other looked there."""
    xyz = side.xyz[left]
    if other.plan is None:
        return np.zeros(len(left)), np.zeros(len(left), np.bool_)
    if looked.away.any():
        passes, own_passes = (_passes(keys, each, rule.edge_m) for each in (looked, side))
        held = np.bincount(of_point, minlength=len(keys))
        # of the beams that enter a voxel, so many end in it: the other epoch's would have too
        ends = held / (held + own_passes)
        return np.minimum(passes * ends / held, _MOST_EACH)[of_point], (passes > 0)[of_point]
    own = cKDTree(side.xyz[:, :2]).query_ball_point(xyz[:, :2], _AROUND_M, return_length=True)
    there = other.plan.query_ball_point(xyz[:, :2], _AROUND_M, return_length=True)
    # something of the other epoch is behind it, as seen from above
    spacing = np.sqrt(np.pi * _AROUND_M**2 / np.maximum(there, 1))
    beside, index = other.plan.query(xyz[:, :2])
    behind = (beside < 1.5 * spacing) & (other.xyz[index, 2] < xyz[:, 2])
    return np.asarray(there / np.maximum(own, 1)), behind


def _passes(keys: Any, side: Side, edge_m: float) -> npt.NDArray[np.int64]:
    """Beams of an epoch that went through voxels, shape (v,)."""
    table = np.full(1 << int(np.ceil(np.log2(max(4 * len(keys), 1 << 10)))), -1, np.int32)
    passes = np.zeros(len(keys), np.int64)
    _through(keys, side.xyz, side.away, edge_m, table, passes)
    return passes


def _extent(xyz: Array, other: _Model, rule: Rule) -> tuple[Array, float]:
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
        base = other.xyz[other.smooth]
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


@njit(cache=True, nogil=True)
def _through(keys: Any, xyz: Any, away: Any, edge_m: float, table: Any, passes: Any) -> None:  # noqa: C901 (a kernel)
    """Count the beams that went through voxels: from the echo towards the sensor, as long as they can meet one."""
    mask, per_m = len(table) - 1, 1.0 / edge_m
    packed = np.empty(len(keys), np.int64)
    low, high = np.full(3, 1 << 60), np.full(3, -(1 << 60))
    for v in range(len(keys)):
        for a in range(3):
            low[a], high[a] = min(low[a], keys[v, a]), max(high[a], keys[v, a])
        packed[v] = voxel_key(
            (keys[v, 0] + 0.5) * edge_m, (keys[v, 1] + 0.5) * edge_m, (keys[v, 2] + 0.5) * edge_m, per_m
        )
        slot = spread(packed[v]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = v
    at, step = np.empty(3, np.int64), np.empty(3, np.int64)
    following, each = np.empty(3), np.empty(3)
    for n in range(len(xyz)):
        if away[n, 0] == 0.0 and away[n, 1] == 0.0 and away[n, 2] == 0.0:
            continue
        gone = False
        for a in range(3):
            at[a] = np.int64(np.floor(xyz[n, a] * per_m))
            step[a] = 1 if away[n, a] > 0 else -1
            gone = gone or (at[a] > high[a] and step[a] > 0) or (at[a] < low[a] and step[a] < 0)
            if away[n, a] != 0.0:
                edge = (at[a] + (1 if step[a] > 0 else 0)) * edge_m
                following[a], each[a] = (edge - xyz[n, a]) / away[n, a], edge_m / abs(away[n, a])
            else:
                following[a] = each[a] = np.inf
        while not gone:
            a = (
                0
                if following[0] <= following[1] and following[0] <= following[2]
                else 1
                if following[1] <= following[2]
                else 2
            )
            if following[a] >= 1.0:
                break
            at[a] += step[a]
            following[a] += each[a]
            gone = (step[a] > 0 and at[a] > high[a]) or (step[a] < 0 and at[a] < low[a])
            key = ((at[0] & 0x1FFFFF) << 42) | ((at[1] & 0x1FFFFF) << 21) | (at[2] & 0x1FFFFF)
            slot = spread(key) & mask
            while table[slot] >= 0 and packed[table[slot]] != key:
                slot = (slot + 1) & mask
            if table[slot] >= 0:
                passes[table[slot]] += 1
