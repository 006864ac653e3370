"""Where the map as a whole has to go for its surfaces to meet the control: a search as wide as the map may be off, then six unknowns.

A map that hangs on GNSS is metres and a degree off, and a place on a wall does not say which wall. All shifts and turns within three
sigma are tried against the patches of the map; the best of them are refined, and the one that explains most is kept. A point counts
only where others foretell which surface it lies on: alone it would find a wall somewhere. What contradicts the rest is blundered, one
point after the other (Baarda's data snooping).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from flightlog import frames
from groundproc.estimation.observations.surfaces import ALIKE, Near, Surface, surfaces
from groundproc.estimation.odometry.odometry import GROUND

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

PATCH_M: Final = 1.0
"""Edge of the patches that the search goes by."""
REACH_SIGMA: Final = 3.0
WIDEST_M: Final = 12.0
"""What the whole may be off: so many sigmas, and so far at most."""
CELLS: Final = 12
"""Steps of the search to either side, at most."""
SOUGHT_M: Final = 0.5
"""A map that cannot be farther off than this is not searched for."""
CANDIDATES: Final = 24
SEARCHED: Final = 24
"""Most places that the search looks at; all others join it afterwards."""
REJECT: Final = 4.0
"""Standardised residual of a blunder."""
RELIEF_M: Final = 0.05
"""How far a place may be from the patch of its surface."""
UNEXPLAINED: Final = 10.0
"""Misfit of a spot that is on no surface."""
BY_CHANCE: Final = 9.0
"""Two placings whose misfits differ by less are equally good."""
FORETOLD_M: Final = 1.0
"""So well, three sigma, others have to tell where the surface of a spot is."""


@dataclass(slots=True)
class Spots:
    """Places that surfaces have to go through.

    Attributes
    ----------
    point : ndarray of int64, shape (k,)
        Which control point or plane each belongs to.
    place_m : ndarray, shape (k, 3)
        Local.
    sigma_m : ndarray, shape (k,)
    normals : list of ndarray or None
    used : ndarray of bool, shape (k,)
    """

    point: npt.NDArray[np.int64]
    place_m: Array
    sigma_m: Array
    normals: list[Array | None]
    used: Flags


@dataclass(slots=True)
class Placing:
    """A turn about a point and a shift: p -> about + mat (p - about) + shift.

    Attributes
    ----------
    about_m : ndarray, shape (3,)
    mat : ndarray, shape (3, 3)
    shift_m : ndarray, shape (3,)
    """

    about_m: Array
    mat: Array
    shift_m: Array

    def vector(self) -> Array:
        """Rotation vector and shift, shape (6,)."""
        return np.concatenate([frames.quat_log(frames.quat_from_mat(self.mat[None]))[0], self.shift_m])

    def then(self, change: Array) -> "Placing":
        """With a small turn and shift, shape (6,), after it."""
        mat = _turned(change[:3])
        return Placing(self.about_m, mat @ self.mat, mat @ self.shift_m + change[3:])

    def back(self, points_m: Array) -> Array:
        """Where points of the placed map lay before."""
        return np.asarray((points_m - self.about_m - self.shift_m) @ self.mat + self.about_m)

    def as_turn(self) -> tuple[Array, Array]:
        """Matrix and shift of p -> mat p + shift."""
        return self.mat, self.about_m - self.mat @ self.about_m + self.shift_m


@dataclass(slots=True)
class Datum:
    """The placing that was found.

    Attributes
    ----------
    placing : Placing
    surfaces : list of Surface or None
        At each spot.
    active : ndarray of bool, shape (k,)
        Spots that it rests on: used, on a surface, not blundered.
    sigma_m : ndarray, shape (k,)
        Of survey and surface together; not a number where there is no surface.
    redundancy : ndarray, shape (k,)
        Part of an error of a spot that would show in its residual: 0 where nothing else knows the place, 1 where all is known.
    doubtful : ndarray of bool, shape (k,)
        Spots that were to be used but may lie on any of several surfaces.
    """

    placing: Placing
    surfaces: list[Surface | None]
    active: Flags
    sigma_m: Array
    redundancy: Array
    doubtful: Flags


def find_datum(spots: Spots, seen: Near, covariance: Array, deflation: float) -> Datum | None:
    """The placing of the map on the control; None where no spot that may be used is on a surface.

    Parameters
    ----------
    spots : Spots
    seen : Near
        Clusters in reach, on the map as it lies.
    covariance : ndarray, shape (6, 6)
        Of the map's turn about the origin and shift before.
    deflation : float
    """
    if not len(seen.index):
        return None
    if not spots.used.any():
        return _as_it_lies(spots, seen, deflation)
    about = spots.place_m[spots.used].mean(axis=0)
    prior = _about(covariance, about)
    placing, sure = Placing(about, np.eye(3), np.zeros(3)), spots.used
    searched = reach_m(spots, covariance) > SOUGHT_M
    if searched:
        placing, sure = _searched(spots, seen, about, prior)
    return _settled(spots, seen, placing, sure, prior, deflation, searched)


def _as_it_lies(spots: Spots, seen: Near, deflation: float) -> Datum | None:
    """Where nothing is to be used, only measured."""
    found = surfaces(seen, spots.place_m, spots.normals, SOUGHT_M, deflation)
    none = np.full(len(found), np.nan)
    placing = Placing(np.zeros(3), np.eye(3), np.zeros(3))
    return Datum(placing, found, np.zeros(len(found), np.bool_), none, none, np.zeros(len(found), np.bool_))


def reach_m(spots: Spots, covariance: Array) -> float:
    """How far the map may be off at the spots that are used [m]."""
    if not spots.used.any():
        return 0.0
    about = spots.place_m[spots.used].mean(axis=0)
    sigma = np.sqrt(np.diag(_about(covariance, about)))
    arm = np.linalg.norm(spots.place_m[spots.used] - about, axis=1).max()
    return float(min(REACH_SIGMA * (sigma[3:].max() + arm * sigma[:3].max()), WIDEST_M))


def _about(covariance: Array, about: Array) -> Array:
    """Covariance of turn and shift about a point, of those about the origin."""
    to = np.eye(6)
    to[3:, :3] = -_cross(about)
    return np.asarray(to @ covariance @ to.T)


# --- the search ---


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


def _searched(spots: Spots, seen: Near, about: Array, prior: Array) -> tuple[Placing, Flags]:
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
        reach = np.where(match.on, _foretold_m(match.rows, weight, spots.point[chosen], _inverse(prior)), 0.0)
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


def _foretold_m(rows: Array, weight: Array, point: npt.NDArray[np.int64], information: Array) -> Array:
    """How well, three sigma, the other points tell where the surface of each spot is, with what was known before [m], shape (k,)."""
    found = np.full(len(point), np.inf)
    for each in np.unique(point[weight > 0]):
        mine = point == each
        without = information + (rows * np.where(mine, 0.0, weight)[:, None]).T @ rows
        spread = np.einsum("ni,ij,nj->n", rows[mine], _inverse(without), rows[mine])
        found[mine] = REACH_SIGMA * np.sqrt(spread.max())
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
    information, sigma = _inverse(prior), np.hypot(spots.sigma_m[chosen], RELIEF_M)
    for most in (1.5, 0.8, 0.4, 0.4, 0.25, 0.25):
        match = _matched(spots, patches, chosen, placing, most)
        weight = match.on / np.square(np.maximum(sigma, 0.25 * most))
        left = match.rows.T @ (weight * match.off) + information @ placing.vector()
        normal = information + (weight[:, None] * match.rows).T @ match.rows
        placing = placing.then(-_inverse(normal) @ left)
    distance = _matched(spots, patches, chosen, placing, 0.3).distance
    misfit = (
        np.minimum(np.square(distance / sigma), UNEXPLAINED).sum() + placing.vector() @ information @ placing.vector()
    )
    return float(misfit), placing


# --- six unknowns ---


@dataclass(slots=True)
class _Six:
    """The linear problem of turn and shift, by the map's surfaces at the spots.

    Attributes
    ----------
    point : ndarray of int64, shape (k,)
    arm_m : ndarray, shape (k, 3)
        Spots from where the turn is about.
    rows : ndarray, shape (k, 6)
    off_m, survey_m, slope : ndarray, shape (k,)
        Distances, their sigmas of survey and surface, and what the vertical leaves out.
    information : ndarray, shape (6, 6)
        Known before.
    now : ndarray, shape (6,)
        Placing so far.
    """

    point: npt.NDArray[np.int64]
    arm_m: Array
    rows: Array
    off_m: Array
    survey_m: Array
    slope: Array
    information: Array
    now: Array

    def normal(self, active: Flags, sigma: Array) -> Array:
        """Normal matrix of what was known before and the active spots."""
        return np.asarray(self.information + (self.rows * (active / np.square(sigma))[:, None]).T @ self.rows)

    def sigmas(self, active: Flags) -> Array:
        """Sigmas of the distances: how uncertain the place along a slope is moves the surface below it."""
        covariance = _inverse(self.normal(active, self.survey_m))
        return np.asarray(
            np.hypot(self.survey_m, self.slope * np.array([_sigma_level(covariance, arm) for arm in self.arm_m]))
        )

    def change(self, active: Flags, sigma: Array) -> tuple[Array, Array]:
        """Turn and shift that fit best, shape (6,), and the variances of the distances that this leaves open, shape (k,)."""
        inverse = _inverse(self.normal(active, sigma))
        weight = active / np.square(sigma)
        found = -inverse @ (self.rows.T @ (weight * self.off_m) + self.information @ self.now)
        return found, np.einsum("ni,ij,nj->n", self.rows, inverse, self.rows)

    def agreeing(self, active: Flags, searched: bool) -> tuple[Flags, Flags]:
        """Spots that agree, and those that contradict them; after a search, only such as others foretell."""
        rejected = np.zeros(len(active), np.bool_)
        while active.any():
            sigma = self.sigmas(active)
            change, spread = self.change(active, sigma)
            left = np.maximum(np.square(sigma) - spread, 0.02 * np.square(sigma))
            standard = np.where(active, np.abs(self.off_m + self.rows @ change) / np.sqrt(left), 0.0)
            worst = int(standard.argmax())
            if standard[worst] > REJECT and len(np.unique(self.point[active])) > 1:
                rejected |= self.point == self.point[worst]
                active = active & ~rejected
                continue
            reach = _foretold_m(self.rows, active / np.square(sigma), self.point, self.information)
            if not searched or reach[active].max() < FORETOLD_M:
                break
            active = active & (reach < reach[active].max())
        return active, rejected


def _settled(
    spots: Spots, seen: Near, placing: Placing, sure: Flags, prior: Array, deflation: float, searched: bool
) -> Datum | None:
    """The placing by the map's surfaces at the spots, and which spots contradict it."""
    gate = SOUGHT_M
    for attempt in range(5):
        moved = seen.moved(placing.mat, placing.about_m, placing.shift_m)
        found = surfaces(moved, spots.place_m, spots.normals, gate, deflation)
        on = np.array([surface is not None for surface in found])
        if not on.any():
            return None
        six = _six(spots, found, placing, _inverse(prior))
        active, rejected = six.agreeing(on & sure, searched)
        sigma = six.sigmas(active)
        change, spread = six.change(active, sigma)
        placing = placing.then(change)
        gate = 0.2
        if attempt and np.abs(change[3:]).max() < 1e-3:
            break
    redundancy = np.where(on, np.where(active, np.clip(1.0 - spread / np.square(sigma), 0.0, 1.0), 1.0), np.nan)
    doubtful = spots.used & on & ~active & ~rejected
    return Datum(placing, found, active, np.where(on, sigma, np.nan), redundancy, doubtful)


def _six(spots: Spots, found: Sequence[Surface | None], placing: Placing, information: Array) -> _Six:
    """The problem at a placing; rows are zero where there is no surface."""
    count = len(found)
    arm = spots.place_m - placing.about_m
    rows, off, sigma, slope = np.zeros((count, 6)), np.zeros(count), np.ones(count), np.zeros(count)
    for i, surface in enumerate(found):
        if surface is not None:
            rows[i] = -np.concatenate([np.cross(arm[i], surface.along), surface.along])
            off[i], slope[i] = surface.distance_m, surface.slope
            sigma[i] = np.hypot(spots.sigma_m[i], surface.sigma_m)
    return _Six(spots.point, arm, rows, off, sigma, slope, information, placing.vector())


def _sigma_level(covariance: Array, arm: Array) -> float:
    """Largest sigma, east and north, of a place at an arm from where turn and shift are counted."""
    rows = np.concatenate([-_cross(arm)[:2], np.eye(3)[:2]], axis=1)
    return float(np.sqrt(np.linalg.eigvalsh(rows @ covariance @ rows.T)[-1]))


def _inverse(matrix: Array) -> Array:
    found: Array = np.asarray(np.linalg.inv(matrix), np.float64)
    return found


def _cross(v: Array) -> Array:
    """Matrix [v]x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _turned(vector: Array) -> Array:
    return np.asarray(frames.mat_from_quat(frames.quat_exp(vector[None]))[0])
