"""The compass model: yaw trim as a smooth function of the compass heading, learnt from several runs for later ones.

Source: FOI-R--4045--SE (2014) plots yaw trims over heading for seven runs and takes a curve through them. Here the
curve is a constant and some harmonics. Iron that turns with the compass gives one period in a turn, iron that is
magnetised by the Earth two (as in the compensation of ships' compasses). The covariance comes from the scatter of runs
and headings.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import config
from flightlog.config import option
from flightlog.errors import LogError
from groundproc.files import written_aside
from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

BINS: Final = 36
"""Sectors of heading; a run gives one value for each that it went through: its trims there are not independent of each other."""
PRIOR_DEG: Final = 15.0
"""What the first harmonic is before anything is known, one sigma [deg]; the others less with the square of their order. Holds them where
few headings were seen: four streets at right angles cannot tell the second from nothing."""
LEAST_SCATTER_DEG: Final = 0.1
"""No run is believed to be better than this [deg]."""
GRID: Final = 72
INVERTED: Final = 9
"""Headings at which a curve over the true heading is turned into one over the compass's, and its terms: four harmonics hold what two of 10
deg become to 0.05 deg."""
HUBER: Final = 1.5
ROUNDS: Final = 10


@dataclass(frozen=True, slots=True)
class CompassCurve:
    """What is to be added to the compass' heading."""

    coefficients_deg: tuple[float, ...] = option(
        (0.0,), "constant, then sine and cosine of the heading, of twice the heading, ... [deg]"
    )
    covariance_deg2: tuple[tuple[float, ...], ...] = option(((0.0,),), "of the coefficients [deg^2]")
    scatter_deg: float = option(0.0, "of single runs about the curve, one sigma [deg]", minimum=0)
    runs: int = option(0, "runs it was learnt from", minimum=0)
    seen: float = option(0.0, "share of all headings that were seen", minimum=0, maximum=1)

    def __post_init__(self) -> None:
        size = len(self.coefficients_deg)
        if size % 2 == 0:
            raise ValueError(f"{size} coefficients found, expected an odd number: a constant and pairs")
        if len(self.covariance_deg2) != size or any(len(row) != size for row in self.covariance_deg2):
            raise ValueError(f"a covariance that is not {size} x {size} found, expected one for {size} coefficients")

    def trim_rad(self, heading_rad: Array) -> Array:
        """Yaw trim at compass headings, shape (n,)."""
        design = _design(np.asarray(heading_rad), len(self.coefficients_deg))
        return np.asarray(np.deg2rad(design @ np.array(self.coefficients_deg)))

    def sigma_rad(self, heading_rad: Array) -> Array:
        """One sigma of that: of the curve and of a single run about it, shape (n,)."""
        design = _design(np.asarray(heading_rad), len(self.coefficients_deg))
        variance = np.einsum("ni,ij,nj->n", design, np.array(self.covariance_deg2), design)
        return np.asarray(np.deg2rad(np.sqrt(np.maximum(variance, 0.0) + self.scatter_deg**2)))


@dataclass(frozen=True, slots=True)
class Run:
    """Yaw trims of a run.

    Attributes
    ----------
    heading_rad : ndarray, shape (n,)
        As the compass had it.
    trim_rad : ndarray, shape (n,)
        In all, that of a curve it began with included.
    """

    heading_rad: Array
    trim_rad: Array


def fit_compass(runs: Sequence[Run], harmonics: int = 2) -> CompassCurve:
    """A curve through the yaw trims of several runs, robust against runs and headings that went wrong (Huber).

    Parameters
    ----------
    runs : sequence of Run
        Settled trims only.
    harmonics : int
        1: what turns with the compass; 2: what the Earth magnetises as well; no more than the data bear.

    Raises
    ------
    LogError
        No run has a trim.
    """
    parts = [_sectors(run) for run in runs]
    heading = np.concatenate([np.empty(0), *(part[0] for part in parts)])
    observed = np.concatenate([np.empty(0), *(part[1] for part in parts)])
    if len(heading) == 0:
        raise LogError(
            "compass: no run has settled yaw trims; a vehicle has to move past something that stands upright"
        )
    size = 1 + 2 * harmonics
    design = _design(heading, size)
    orders = np.repeat(np.arange(1, harmonics + 1), 2)
    prior = np.diag(np.concatenate([[0.0], (orders**2 / PRIOR_DEG) ** 2]))
    weight, scatter = np.ones(len(observed)), 1.0
    coefficients = np.zeros(size)
    for _ in range(ROUNDS):
        normal = design.T @ (weight[:, None] * design) / scatter**2 + prior
        coefficients = np.linalg.solve(normal, design.T @ (weight * observed) / scatter**2)
        residual = observed - design @ coefficients
        freedom = max(weight.sum() - min(size, len(observed) - 1), 1.0)
        scatter = max(float(np.sqrt((weight * residual**2).sum() / freedom)), LEAST_SCATTER_DEG)
        weight = robust.huber(np.abs(residual), HUBER * scatter)
    covariance = np.linalg.inv(design.T @ (weight[:, None] * design) / scatter**2 + prior)
    seen = len(np.unique(sector_of(heading))) / BINS
    rows = tuple(tuple(row) for row in covariance.tolist())
    return CompassCurve(tuple(coefficients.tolist()), rows, scatter, len(runs), seen)


def curve_of_errors(
    error_rad: Array, covariance: Array, scatter_deg: float, runs: int, seen: npt.NDArray[np.bool_]
) -> CompassCurve:
    """The curve that takes an error away which is known over the true heading.

    Parameters
    ----------
    error_rad : ndarray, shape (5,)
        Stated less true heading: constant, sine and cosine of the true heading, and of twice that.
    covariance : ndarray, shape (5, 5)
        Of these [rad^2].
    scatter_deg : float
        Of single runs about it.
    runs : int
    seen : ndarray of bool, shape (BINS,)
        Sectors of the stated heading that were flown.
    """
    true = 2.0 * np.pi * np.arange(GRID) / GRID
    errors = _design(true, len(error_rad))

    def coefficients(curve: Array) -> Array:
        off = errors @ curve
        return np.asarray(np.linalg.lstsq(_design(true + off, INVERTED), -off, rcond=None)[0], np.float64)

    step = 1e-4
    by_error = np.stack(
        [
            (coefficients(error_rad + s) - coefficients(error_rad - s)) / (2.0 * step)
            for s in step * np.eye(len(error_rad))
        ],
        axis=1,
    )
    square = np.rad2deg(1.0) ** 2 * (by_error @ covariance @ by_error.T)
    rows = tuple(tuple(row) for row in (0.5 * (square + square.T)).tolist())
    values = tuple(np.rad2deg(coefficients(error_rad)).tolist())
    return CompassCurve(values, rows, max(scatter_deg, LEAST_SCATTER_DEG), runs, float(np.mean(seen)))


def sector_of(heading_rad: Array) -> npt.NDArray[np.int64]:
    """Number of the sector that headings lie in, shape (n,)."""
    return np.minimum((np.asarray(heading_rad) % (2 * np.pi) / (2 * np.pi) * BINS).astype(np.int64), BINS - 1)


def _sectors(run: Run) -> tuple[Array, Array]:
    """Mean heading [rad] and median trim [deg] in each sector of heading that a run went through."""
    heading = np.asarray(run.heading_rad) % (2 * np.pi)
    trim_deg = np.rad2deg((np.asarray(run.trim_rad) + np.pi) % (2 * np.pi) - np.pi)
    sector = sector_of(heading)
    chosen = np.unique(sector)
    return (
        np.array([heading[sector == i].mean() for i in chosen]),
        np.array([np.median(trim_deg[sector == i]) for i in chosen]),
    )


def _design(heading_rad: Array, size: int) -> Array:
    """Constant, sines and cosines at headings: shape (n, size)."""
    columns = [np.ones(len(heading_rad))]
    for order in range(1, size // 2 + 1):
        columns += [np.sin(order * heading_rad), np.cos(order * heading_rad)]
    return np.stack(columns, axis=1)


def write_compass(path: Path, curve: CompassCurve, head: str = "") -> None:
    """Write compass.yaml; `head` stands above the values."""
    with written_aside(path) as aside:
        aside.write_text(head + config.dump(curve), encoding="utf-8")


def read_compass(path: Path) -> CompassCurve:
    """Read compass.yaml; ConfigError where it is not one."""
    return config.load(path, CompassCurve)
