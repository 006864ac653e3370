"""Where a map may lie for its surfaces to meet the control: all shifts and turns within three sigma are tried."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from groundproc.estimation.observations.spots import (
    FORETOLD_M,
    REACH_SIGMA,
    SOUGHT_M,
    WIDEST_M,
    Placing,
    Spots,
    foretold_m,
    inverted,
)
from groundproc.estimation.observations.surfaces import ALIKE, Near
from groundproc.estimation.odometry.matching import GROUND

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

PATCH_M: Final = 1.0
"""Edge of the patches that the search goes by."""
CELLS: Final = 12
"""Steps of the search to either side, at most."""
CANDIDATES: Final = 24
SEARCHED: Final = 24
"""Most places that the search looks at; all others join it afterwards."""
RELIEF_M: Final = 0.05
"""How far a place may be from the patch of its surface."""
UNEXPLAINED: Final = 10.0
"""Misfit of a spot that is on no surface."""
BY_CHANCE: Final = 9.0
"""Two placings whose misfits differ by less are equally good."""


@dataclass(frozen=True, slots=True)
class _Patches:
    means: Array
    normals: Array
    tree: cKDTree


def _patches(seen: Near) -> _Patches:
    """Flat voxels of the map."""
    key = np.floor(seen.world_m / PATCH_M).astype(np.int64)
    _, voxel, rows = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.ravel()
    order = np.argsort(voxel, kind="stable")
    first = np.concatenate([[0], np.cumsum(rows)[:-1]])
    means = np.add.reduceat(seen.world_m[order], first, axis=0) / rows[:, None]
    off = seen.world_m[order] - np.repeat(means, rows, axis=0)
    moments = np.add.reduceat(off[:, :, None] * off[:, None, :], first, axis=0) / rows[:, None, None]
    values, vectors = np.linalg.eigh(moments)
    flat = (rows >= 6) & (values[:, 0] < 0.05**2) & (values[:, 1] > 0.06**2) & (values[:, 0] < 0.15 * values[:, 1])
    return _Patches(means[flat], vectors[flat, :, 0], cKDTree(means[flat]))


def _distances(
    patches: _Patches, places: Array, normals: Sequence[Array | None] | None, most_m: float
) -> tuple[Array, Array]:
    """Distance of places from the nearest patch across it, `most_m` where there is none, and the number of that patch."""
    if not len(patches.means):
        return np.full(len(places), most_m), np.zeros(len(places), np.int64)
    reach, number = patches.tree.query(places, k=min(6, len(patches.means)), distance_upper_bound=most_m + PATCH_M)
    reach, number = (np.asarray(found).reshape(len(places), -1) for found in (reach, number))
    known = np.isfinite(reach)
    number = np.where(known, number, 0)
    off = places[:, None] - patches.means[number]
    across = np.abs(np.einsum("nki,nki->nk", off, patches.normals[number]))
    aside = np.sqrt(np.maximum(np.square(np.where(known, reach, 0.0)) - np.square(across), 0.0))
    fits = known & (aside < 0.9 * PATCH_M)
    if normals is not None:
        for i, normal in enumerate(normals):
            if normal is not None:
                fits[i] &= np.abs(patches.normals[number[i]] @ normal) > ALIKE
    across = np.where(fits, np.minimum(across, most_m), most_m)
    best = across.argmin(axis=1)
    rows = np.arange(len(places))
    return across[rows, best], number[rows, best]


def searched(spots: Spots, seen: Near, about: Array, prior: Array) -> tuple[Placing, Flags]:
    """The placing within three sigma that explains the used spots best, and the spots whose surface is certain."""
    patches = _patches(seen)
    sure = spots.used.copy()
    while sure.any():
        chosen = np.flatnonzero(sure)
        few = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), SEARCHED)).round().astype(int)]
        found = [
            _refined(spots, patches, few, Placing(about, np.eye(3), np.zeros(3)).then(start), prior)
            for start in _starts(spots, patches, few, about, prior)
        ]
        found.sort(key=lambda each: each[0])
        best = found[0][1]
        match = _matched(spots, patches, chosen, best, 0.5)
        others = [other for misfit, other in found[1:] if misfit < found[0][0] + BY_CHANCE]
        weight = match.on / np.square(np.hypot(spots.sigma_m[chosen], RELIEF_M))
        reach = np.where(match.on, foretold_m(match.rows, weight, spots.point[chosen], inverted(prior)), 0.0)
        # one at a time: without it the others may find their places
        doubtful = (reach > FORETOLD_M) & (reach == reach.max())
        if not doubtful.any():
            doubtful = match.on & _elsewhere(match, spots, chosen, best, others)
        if not doubtful.any():
            return best, sure
        sure &= ~np.isin(spots.point, spots.point[chosen[doubtful]])
    return Placing(about, np.eye(3), np.zeros(3)), sure


def _elsewhere(
    match: "_Match", spots: Spots, chosen: npt.NDArray[np.int64], best: Placing, others: Sequence[Placing]
) -> Flags:
    """Which spots another placing, as good by chance, lays on another surface."""
    place = spots.place_m[chosen]
    found = np.zeros(len(chosen), np.bool_)
    for other in others:
        off = (other.back(place) - best.back(place)) @ best.mat.T
        found |= np.abs(np.einsum("ni,ni->n", off, match.along)) > SOUGHT_M
    return found


def _starts(spots: Spots, patches: _Patches, chosen: npt.NDArray[np.int64], about: Array, prior: Array) -> list[Array]:
    """Turns and shifts to begin from, shape (6,) each: the lowest places of the misfit on a grid of shift and heading."""
    sigma = np.sqrt(np.diag(prior))
    width = np.minimum(REACH_SIGMA * sigma[3:], WIDEST_M)
    step = max(0.4, float(width.max()) / CELLS)
    half = np.ceil(width / step).astype(int)
    arms = spots.place_m[chosen] - about
    farthest = max(float(np.linalg.norm(arms[:, :2], axis=1).max()), 1.0)
    turn_step = step / farthest
    turns = turn_step * np.arange(-20, 21)
    turns = turns[np.abs(turns) <= max(REACH_SIGMA * sigma[2], 0.5 * turn_step)]
    margin = np.ceil(np.abs(turns).max() * np.abs(arms[:, [1, 0]]) / step).astype(int)
    fields = [
        _field(patches, spots.place_m[i], spots.normals[i], half + np.append(margin[n], 0), step)
        for n, i in enumerate(chosen.tolist())
    ]
    axes = [step * np.arange(-h, h + 1) for h in half]
    east, north, up = np.meshgrid(*axes, indexing="ij")
    base = np.square(east / sigma[3]) + np.square(north / sigma[4]) + np.square(up / sigma[5])
    found: list[tuple[float, Array]] = []
    for turn in turns.tolist():
        total = base + (turn / sigma[2]) ** 2
        for n, field in enumerate(fields):
            aside = np.rint(turn * np.array([-arms[n, 1], arms[n, 0]]) / step).astype(int)
            # the map's place of a spot is the spot less turn and shift
            at = [margin[n, c] - aside[c] + np.arange(2 * half[c], -1, -1) for c in range(2)]
            total += field[np.ix_(at[0], at[1], np.arange(2 * half[2], -1, -1))]
        lowest = np.argpartition(total.ravel(), min(200, total.size - 1))[:200]
        for number in lowest.tolist():
            i, j, k = np.unravel_index(number, total.shape)
            found.append((float(total.flat[number]), np.array([0, 0, turn, axes[0][i], axes[1][j], axes[2][k]])))
    found.sort(key=lambda each: each[0])
    starts: list[Array] = []
    for _, start in found:
        if all(
            np.abs(start[3:] - other[3:]).max() > 1.5 * step or abs(start[2] - other[2]) > 1.5 * turn_step
            for other in starts
        ):
            starts.append(start)
        if len(starts) == CANDIDATES:
            break
    return starts


def _field(patches: _Patches, place: Array, normal: Array | None, half: npt.NDArray[np.int64], step: float) -> Array:
    """Misfit of a spot were it at each cell of a grid about its place."""
    axes = [step * np.arange(-h, h + 1) for h in half.tolist()]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + place
    most = 1.5 * step
    distance, _ = _distances(patches, cells, None if normal is None else [normal] * len(cells), most)
    return np.asarray(np.square(2.0 * distance / most).reshape([len(a) for a in axes]) * 2.0)


@dataclass(frozen=True, slots=True)
class _Match:
    """Spots on the nearest patches: distance from them along `along`, its derivative by turn and shift, and whether one is in reach."""

    off: Array
    along: Array
    rows: Array
    on: Flags
    distance: Array


def _matched(spots: Spots, patches: _Patches, chosen: npt.NDArray[np.int64], placing: Placing, most: float) -> _Match:
    place = spots.place_m[chosen]
    back = placing.back(place)
    distance, number = _distances(patches, back, [spots.normals[i] for i in chosen.tolist()], most)
    along = patches.normals[number] @ placing.mat.T
    off = np.einsum("ni,ni->n", back - patches.means[number], patches.normals[number])
    ground = np.abs(along[:, 2]) > GROUND
    off[ground] /= along[ground, 2]
    along[ground] = [0.0, 0.0, 1.0]
    rows = -np.concatenate([np.cross(place - placing.about_m, along), along], axis=1)
    return _Match(off, along, rows, distance < most, distance)


def _refined(
    spots: Spots, patches: _Patches, chosen: npt.NDArray[np.int64], placing: Placing, prior: Array
) -> tuple[float, Placing]:
    """Closest points to planes from a start, the reach narrowing; and the misfit at the end."""
    information, sigma = inverted(prior), np.hypot(spots.sigma_m[chosen], RELIEF_M)
    for most in (1.5, 0.8, 0.4, 0.4, 0.25, 0.25):
        match = _matched(spots, patches, chosen, placing, most)
        weight = match.on / np.square(np.maximum(sigma, 0.25 * most))
        left = match.rows.T @ (weight * match.off) + information @ placing.vector()
        normal = information + (weight[:, None] * match.rows).T @ match.rows
        placing = placing.then(-inverted(normal) @ left)
    distance = _matched(spots, patches, chosen, placing, 0.3).distance
    misfit = (
        np.minimum(np.square(distance / sigma), UNEXPLAINED).sum() + placing.vector() @ information @ placing.vector()
    )
    return float(misfit), placing
