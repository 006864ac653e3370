"""A pattern fitted to intensities by weighted least squares, and how well it explains them.

Noise grows with brightness (for a lidar it is a share of the strength). The variance is therefore taken as linear from
dark to bright, from the residuals of a first fit. Edges that lie between points make the sum of squares rough. So the
centre and its covariance are the mean and the second moments of the posterior, by importance sampling about the
least-squares solution (Geweke 1989), and not its curvature alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.assessment.patterns import BLUR, HALF, TURN, WIDTH, Pattern, U, V

Array = npt.NDArray[np.float64]

LEAST_BLUR_M: Final = 0.005
MOST_BLUR_M: Final = 0.15
_DRAWS: Final = 600
_SEED: Final = 11
_FREEDOM: Final = 5.0
_LEAST_DRAWS: Final = 30.0
"""That have to count, of the draws, for their moments to be used."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A pattern fitted.

    Attributes
    ----------
    pattern : Pattern
    values : ndarray, shape (6,)
        Parameters of the pattern.
    covariance_m2 : ndarray, shape (2, 2)
        Of the centre.
    dark, bright : float
        Levels of intensity.
    share : ndarray, shape (n,)
        Bright share at each point.
    cost : float
        Weighted sum of squared residuals.
    weight : ndarray, shape (n,)
    told : float
        Share of the variance that is explained.
    """

    pattern: Pattern
    values: Array
    covariance_m2: Array
    dark: float
    bright: float
    share: Array
    cost: float
    weight: Array
    told: float

    def bic(self) -> float:
        """Bayesian information criterion, less a constant of the points (Schwarz 1978)."""
        count = len(self.share)
        return count * float(np.log(max(self.cost, 1e-300) / count)) + (len(self.pattern.free) + 2) * float(
            np.log(count)
        )


def fit(
    pattern: Pattern, u_m: Array, v_m: Array, value: Array, start: Array, weight: Array | None = None,
    fixed: tuple[int, ...] = (),
) -> Fit:  # fmt: skip
    """Fit a pattern from a start.

    Parameters
    ----------
    pattern : Pattern
    u_m, v_m, value : ndarray, shape (n,)
    start : ndarray, shape (6,)
    weight : ndarray, shape (n,), optional
        Of the squared residuals. Default: found from the residuals.
    fixed : tuple of int
        Parameters that stay as they are.
    """
    free = [k for k in pattern.free if k not in fixed]
    low, high = _limits(start)
    values, w = np.clip(start, low, high), np.ones(len(value)) if weight is None else weight
    for _ in range(1 if weight is not None else 3):
        root = np.sqrt(w)

        def off(some: Array, values: Array = values, w: Array = w, root: Array = root) -> Array:
            share = pattern.at(u_m, v_m, _with(values, free, some))
            dark, bright = _levels(share, value, w)
            return np.asarray(root * (value - dark - (bright - dark) * share))

        values = _with(values, free, _descended(off, values[free], low[free], high[free], _SCALE[free]))
        if weight is None:
            w = _weights(pattern.at(u_m, v_m, values), value, w)
    share = pattern.at(u_m, v_m, values)
    dark, bright = _levels(share, value, w)
    cost = float(np.sum(w * (value - dark - (bright - dark) * share) ** 2))
    mean = np.average(value, weights=w)
    told = 1.0 - cost / max(float(np.sum(w * (value - mean) ** 2)), 1e-300)
    return Fit(pattern, values, np.full((2, 2), np.nan), dark, bright, share, cost, w, told)


def _descended(off: Callable[[Array], Array], start: Array, low: Array, high: Array, scale: Array) -> Array:
    """Where the sum of squares is least, from a start and within bounds, by Levenberg and Marquardt."""
    here, residual, damping = start, off(start), 1e-2
    cost = float(residual @ residual)
    for _ in range(_STEPS):
        # towards the middle, where there is room
        step = 1e-2 * scale * np.where(here > 0.5 * (low + high), -1.0, 1.0)
        slope = np.column_stack(
            [(off(here + step * row) - residual) / step[k] for k, row in enumerate(np.eye(len(here)))]
        )
        normal, right = slope.T @ slope, -slope.T @ residual
        for _ in range(_TRIALS):
            by = np.linalg.solve(normal + damping * np.diag(scale**-2 * max(cost, 1e-12)), right)
            there = np.clip(here + by, low, high)
            again = off(there)
            if again @ again < cost:
                break
            damping *= 8.0
        else:
            return here
        gain = cost - float(again @ again)
        here, residual, cost, damping = there, again, cost - gain, max(damping * 0.2, 1e-9)
        if gain < 1e-5 * cost:
            return here
    return here


_STEPS: Final = 25
_TRIALS: Final = 6
_SCALE: Final = np.array([0.03, 0.03, 0.1, 0.05, 0.03, 0.02])


def _limits(start: Array) -> tuple[Array, Array]:
    low = start + np.array([-0.3, -0.3, -1.0, 0.0, 0.0, 0.0])
    high = start + np.array([0.3, 0.3, 1.0, 0.0, 0.0, 0.0])
    low[[HALF, WIDTH]], high[[HALF, WIDTH]] = (0.03, 0.015), (1.2, 0.8)
    low[BLUR], high[BLUR] = LEAST_BLUR_M, MOST_BLUR_M
    return low, high


def _with(values: Array, free: list[int], some: Array) -> Array:
    out = values.copy()
    out[free] = some
    return out


def _levels(share: Array, value: Array, weight: Array) -> tuple[float, float]:
    """Dark and bright that fit best: a line over the share."""
    total = weight.sum()
    mean_s, mean_v = float(weight @ share) / total, float(weight @ value) / total
    spread = float(weight @ (share - mean_s) ** 2)
    slope = float(weight @ ((share - mean_s) * (value - mean_v))) / spread if spread > 1e-12 * total else 0.0
    dark = mean_v - slope * mean_s
    return dark, dark + slope


def _weights(share: Array, value: Array, weight: Array) -> Array:
    """One over the variance, which goes linearly with the share; both ends from residuals, no less than a hundredth of each other."""
    dark, bright = _levels(share, value, weight)
    square = (value - dark - (bright - dark) * share) ** 2
    ends = np.array([_end(square, 1.0 - share), _end(square, share)])
    ends = np.maximum(ends, max(0.01 * ends.max(), 1e-12))
    return np.asarray(1.0 / (ends[0] + (ends[1] - ends[0]) * share))


def _end(square: Array, near: Array) -> float:
    """Variance at one end of the share."""
    weight = near**4
    return float(weight @ square / max(weight.sum(), 1e-12))


def placed(found: Fit, u_m: Array, v_m: Array, value: Array, fixed: tuple[int, ...] = ()) -> Fit:
    """The same with the centre as the posterior's mean, and its covariance."""
    free = [k for k in found.pattern.free if k not in fixed]
    design = np.empty((len(value), len(free) + 2))
    for column, k in enumerate(free):
        step = 1e-3 * _SCALE[k]
        low, high = found.values.copy(), found.values.copy()
        low[k], high[k] = max(low[k] - step, LEAST_BLUR_M) if k == BLUR else low[k] - step, high[k] + step
        there = found.pattern.at(u_m, v_m, high) - found.pattern.at(u_m, v_m, low)
        design[:, column] = (found.bright - found.dark) * there / (high[k] - low[k])
    design[:, -2], design[:, -1] = 1.0 - found.share, found.share
    freedom = max(len(value) - design.shape[1], 1)
    variance = float(found.cost) / freedom
    # what the points hardly tell is not told to better than its own size
    prior = np.concatenate([_SCALE[free] ** -2, np.zeros(2)]) * 0.1
    normal = (design * found.weight[:, None]).T @ design / variance + np.diag(prior)
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True)[: len(free), : len(free)], np.float64)
    centre, spread = _moments(found, free, covariance, variance, (u_m, v_m, value))
    values = found.values.copy()
    values[[U, V]] = centre
    return Fit(
        found.pattern, values, spread, found.dark, found.bright, found.share, found.cost, found.weight, found.told
    )


def _moments(
    found: Fit, free: list[int], covariance: Array, variance: float, points: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Mean and covariance of the centre: of draws about the solution, weighted by how well they fit."""
    u_m, v_m, value = points
    rng = np.random.default_rng(_SEED)
    root = np.linalg.cholesky(2.0 * covariance + 1e-14 * np.eye(len(free)))
    normal = rng.standard_normal((_DRAWS, len(free)))
    length = np.sum(normal**2, axis=1)
    scale = rng.chisquare(_FREEDOM, _DRAWS) / _FREEDOM
    draws = found.values[free] + (normal / np.sqrt(scale)[:, None]) @ root.T
    low, high = _limits(found.values)
    allowed = ((draws >= low[free]) & (draws <= high[free])).all(axis=1)
    logs = np.full(_DRAWS, -np.inf)
    for n in np.flatnonzero(allowed):
        share = found.pattern.at(u_m, v_m, _with(found.values, free, draws[n]))
        dark, bright = _levels(share, value, found.weight)
        cost = float(np.sum(found.weight * (value - dark - (bright - dark) * share) ** 2))
        proposal = -0.5 * (_FREEDOM + len(free)) * np.log1p(length[n] / scale[n] / _FREEDOM)
        logs[n] = -0.5 * cost / variance - proposal
    places = [free.index(U), free.index(V)]
    curvature = covariance[np.ix_(places, places)]
    if not np.isfinite(logs).any():
        return found.values[[U, V]], curvature
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    if 1.0 / float(np.sum(weight**2)) < _LEAST_DRAWS:
        return found.values[[U, V]], curvature
    centre = weight @ draws[:, places]
    off = draws[:, places] - centre
    return centre, (off * weight[:, None]).T @ off


def first(values: dict[int, float]) -> Array:
    """A start, with what is not said at its usual value."""
    start = np.array([0.0, 0.0, 0.0, 0.2, 0.05, 0.03])
    for k, value in values.items():
        start[k] = value
    return start


__all__ = ["BLUR", "HALF", "TURN", "WIDTH", "Fit", "U", "V", "first", "fit", "placed"]
