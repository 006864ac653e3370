"""Where the map as a whole has to go for its surfaces to meet the control: a wide search, then six unknowns.

A map that depends on GNSS is off by metres and a degree, and a place on a wall does not say which wall. All shifts and
turns within three sigma are tried against the patches of the map; the best of them are refined, and the one that
explains most points is kept. A point counts only where others predict which surface it lies on, because alone it would
find a wall somewhere. A point that contradicts the rest is left out as a blunder, one after the other (Baarda's data
snooping).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.observations.search import searched
from groundproc.estimation.observations.spots import (
    FORETOLD_M,
    REACH_SIGMA,
    SOUGHT_M,
    WIDEST_M,
    Placing,
    Spots,
    cross,
    foretold_m,
    inverted,
)
from groundproc.estimation.observations.surfaces import Near, Surface, surfaces

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

REJECT: Final = 4.0
"""Standardised residual of a blunder."""


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
    wide = reach_m(spots, covariance) > SOUGHT_M
    if wide:
        placing, sure = searched(spots, seen, about, prior)
    return _settled(spots, seen, placing, sure, prior, deflation, wide)


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
    to[3:, :3] = -cross(about)
    return np.asarray(to @ covariance @ to.T)


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

    point: Ints
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
        covariance = inverted(self.normal(active, self.survey_m))
        return np.asarray(
            np.hypot(self.survey_m, self.slope * np.array([_sigma_level(covariance, arm) for arm in self.arm_m]))
        )

    def change(self, active: Flags, sigma: Array) -> tuple[Array, Array]:
        """Turn and shift that fit best, shape (6,), and the variances of the distances that this leaves open, shape (k,)."""
        inverse = inverted(self.normal(active, sigma))
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
            reach = foretold_m(self.rows, active / np.square(sigma), self.point, self.information)
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
        six = _six(spots, found, placing, inverted(prior))
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
    rows = np.concatenate([-cross(arm)[:2], np.eye(3)[:2]], axis=1)
    return float(np.sqrt(np.linalg.eigvalsh(rows @ covariance @ rows.T)[-1]))
