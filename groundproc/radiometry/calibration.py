"""The calibration constant of a flight, from the echoes within targets of known reflectance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError
from groundproc.numerics.robust import sigma

Array = npt.NDArray[np.float64]

FEWEST: Final = 5
"""Echoes of a target that is used."""
_OUTSIDE: Final = 4.0
"""Echoes farther than so many sigmas from the median of their target are of something else."""
_STEEPEST_RAD: Final = np.deg2rad(75.0)


@dataclass(frozen=True, slots=True)
class Echoes:
    """Echoes within one target.

    Attributes
    ----------
    id : str
    strength : ndarray, shape (n,)
        Linear, corrected for the gain of the laser.
    expected : ndarray, shape (n,)
        What it is of for c_cal = 1: reflectance x eta x cos a, over R^2 where the strength falls by it.
    incidence_rad : ndarray, shape (n,)
    incidence_sigma_rad : ndarray, shape (n,)
    quantum : float
        Step of the strength.
    """

    id: str
    strength: Array
    expected: Array
    incidence_rad: Array
    incidence_sigma_rad: Array
    quantum: float


@dataclass(frozen=True, slots=True)
class Constant:
    """c_cal from one target.

    Attributes
    ----------
    id : str
    echoes : int
    c_cal, sigma : float
    incidence_deg : float
        Mean.
    """

    id: str
    echoes: int
    c_cal: float
    sigma: float
    incidence_deg: float


def constant_of(echoes: Echoes) -> Constant | None:
    """c_cal from one target; None: too few echoes.

    The sum of what is expected over the sum of the strengths: counts are whole numbers, and single ratios of dark targets would lean.
    """
    keep = (echoes.incidence_rad < _STEEPEST_RAD) & (echoes.expected > 0.0) & np.isfinite(echoes.strength)
    if keep.sum() < FEWEST:
        return None
    ratio = echoes.strength[keep] / echoes.expected[keep]
    middle = np.median(ratio)
    scatter = max(sigma(ratio), 1e-9 * float(middle))
    # a target that stands over other ground, or with something on it: leave out what differs grossly
    rows = np.flatnonzero(keep)[np.abs(ratio - middle) <= max(_OUTSIDE * scatter, 0.1 * float(middle))]
    strength, expected = echoes.strength[rows], echoes.expected[rows]
    if len(rows) < FEWEST or strength.sum() <= 0.0:
        return None
    c_cal = float(expected.sum() / strength.sum())
    residual = strength - expected / c_cal
    noise = float(np.sqrt(np.sum(residual**2) / (len(rows) - 1) * len(rows))) / float(strength.sum())
    # rounding of counts does not average out over echoes that are all alike
    step = (
        echoes.quantum
        / np.sqrt(12.0)
        / float(strength.mean())
        * min(1.0, echoes.quantum / max(float(strength.std()), 1e-12) / 4.0)
    )
    tilt = float(np.mean(np.tan(echoes.incidence_rad[rows]) * np.nan_to_num(echoes.incidence_sigma_rad[rows])))
    unsure = c_cal * float(np.sqrt(noise**2 + step**2 + tilt**2))
    return Constant(echoes.id, len(rows), c_cal, unsure, float(np.rad2deg(echoes.incidence_rad[rows].mean())))


def combine(constants: Sequence[Constant]) -> tuple[float, float]:
    """c_cal of all targets and its sigma: weighted, with the scatter between targets as DerSimonian and Laird (1986) have it.

    Raises
    ------
    CoverageError
        There is none.
    """
    if not constants:
        raise CoverageError(f"not one target has {FEWEST} echoes or more within it")
    value = np.array([each.c_cal for each in constants])
    variance = np.array([each.sigma for each in constants]) ** 2
    weight = 1.0 / variance
    mean = float(np.sum(weight * value) / weight.sum())
    freedom = len(value) - 1
    between = 0.0
    if freedom:
        spread = float(np.sum(weight * (value - mean) ** 2))
        room = float(weight.sum() - np.sum(weight**2) / weight.sum())
        between = max((spread - freedom) / room, 0.0)
    weight = 1.0 / (variance + between)
    return float(np.sum(weight * value) / weight.sum()), float(weight.sum() ** -0.5)
