"""How far the edges of a bank went back between two epochs, and what was lost and gained, by stretches along it."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.analysis.banks.axes import Axis
from groundproc.analysis.banks.edges import LOWER, UPPER, Edge
from groundproc.analysis.banks.profile import Profile, heights

Array = npt.NDArray[np.float64]

_FINE_M: Final = 0.02
_STEP: Final = 1e-4
_SIGMAS: Final = 1.96
_LEAST: Final = 3
"""Stations of a stretch."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a bank.

    Attributes
    ----------
    axis, first, last : int
        Its stations.
    retreat_m, sigma_m : ndarray, shape (2,)
        Of the upper and the lower edge, on the average, uphill; NaN where one of the epochs does not tell it.
    lost_m3, gained_m3, net_sigma_m3 : float
    line_m : ndarray, shape (n, 3)
        Earlier upper edge; lower where there is none.
    """

    axis: int
    first: int
    last: int
    retreat_m: Array
    sigma_m: Array
    lost_m3: float
    gained_m3: float
    net_sigma_m3: float
    line_m: Array

    @property
    def significant(self) -> bool:
        """Whether an edge moved, at 95 %."""
        return bool(np.nanmax(np.abs(self.retreat_m) / self.sigma_m, initial=0.0) > _SIGMAS)

    def figures(self) -> dict[str, Any]:
        """For JSON and features."""
        return {
            "retreat_m": float(self.retreat_m[UPPER]), "retreat_sigma_m": float(self.sigma_m[UPPER]),
            "foot_retreat_m": float(self.retreat_m[LOWER]), "foot_retreat_sigma_m": float(self.sigma_m[LOWER]),
            "lost_m3": self.lost_m3, "gained_m3": self.gained_m3, "volume_sigma_m3": self.net_sigma_m3,
            "significant": int(self.significant),
        }  # fmt: skip


def stretches(
    number: int,
    axis: Axis,
    profiles: tuple[list[Profile | None], list[Profile | None]],
    edges: tuple[tuple[Edge, Edge], tuple[Edge, Edge]],
    rule: tuple[float, float, Array],
) -> list[Stretch]:
    """Retreat by stretches of an axis.

    Parameters
    ----------
    number : int
        Of the axis.
    axis : Axis
    profiles : tuple of 2 lists of Profile or None
        Of the earlier and the later cloud at each station.
    edges : tuple of 2 tuples of 2 Edge
        Upper and lower edge of each.
    rule : tuple
        Step between stations, length of a stretch [m], and the covariance of laying the epochs on each other, shape (3, 3).
    """
    step_m, length_m, shared = rule
    every = max(round(length_m / step_m), 1)
    out = []
    for first in range(0, len(axis.places_m), every):
        last = min(first + every, len(axis.places_m))
        at = [n for n in range(first, last) if profiles[0][n] is not None and profiles[1][n] is not None]
        if len(at) < min(_LEAST, every):
            continue
        way = axis.downhill[first:last].mean(axis=0)
        common = float(way @ shared[:2, :2] @ way)
        moved = [_moved(edges[0][which], edges[1][which], (first, last), common) for which in (UPPER, LOWER)]
        line = next(
            (each for each in (_line(edges[0][which], axis, first, last) for which in (UPPER, LOWER)) if len(each) > 1),
            None,
        )
        if line is None:
            continue
        sums = [_areas(profiles[0][n], profiles[1][n]) for n in at]
        span = (last - first) * step_m  # stations that tell nothing are as those that do
        lost, gained = (span * float(np.mean([each[k] for each in sums])) for k in (0, 1))
        own = span**2 * float(np.mean([each[2] for each in sums])) / len(at)
        wide = float(np.mean([each[3] for each in sums]))
        drop = float(np.mean([each[4] for each in sums]))
        volume = float(np.sqrt(own + span**2 * (wide**2 * shared[2, 2] + drop**2 * common)))
        retreat, sigma = (np.array([each[k] for each in moved]) for k in (0, 1))
        out.append(Stretch(number, first, last, retreat, sigma, lost, gained, volume, line))
    return out


def _moved(a: Edge, b: Edge, between: tuple[int, int], common: float) -> tuple[float, float]:
    """Mean retreat uphill of the stations that both tell, and its sigma."""
    both, in_a, in_b = np.intersect1d(a.station, b.station, return_indices=True)
    some = (both >= between[0]) & (both < between[1])
    if not some.any():
        return np.nan, np.nan
    by = (a.across_m[in_a] - b.across_m[in_b])[some]
    variance = (a.sigma_across_m[in_a] ** 2 + b.sigma_across_m[in_b] ** 2)[some]
    return float(by.mean()), float(np.sqrt(variance.sum() / some.sum() ** 2 + common))


def _line(edge: Edge, axis: Axis, first: int, last: int) -> Array:
    return edge.places(axis)[(edge.station >= first) & (edge.station < last)]


def _areas(a: Profile | None, b: Profile | None) -> tuple[float, float, float, float, float]:
    """Area of a profile lost and gained, variance of their difference, how wide and how high what was compared is."""
    assert a is not None
    assert b is not None
    low, high = max(a.reach_m[0], b.reach_m[0]), min(a.reach_m[1], b.reach_m[1])
    s = np.arange(low, high, _FINE_M)
    by = a.heights(s) - b.heights(s)
    variance = 0.0
    for each in (a, b):
        slope = np.zeros(6)
        for k in range(6):
            more, less = each.values.copy(), each.values.copy()
            more[k] += _STEP
            less[k] -= _STEP
            slope[k] = float((heights(more, s) - heights(less, s)).sum()) * _FINE_M / (2.0 * _STEP)
        variance += float(slope @ each.covariance @ slope)
    lost, gained = float(by[by > 0].sum()) * _FINE_M, float(-by[by < 0].sum()) * _FINE_M
    return lost, gained, variance, float(high - low), max(a.drop_m, b.drop_m)
