"""Edges of banks: at each station of an axis a profile of one cloud, and what profiles of neighbours say of each other."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from groundproc.analysis.banks.axes import Axis
from groundproc.analysis.banks.profile import Profile
from groundproc.numerics.robust import MAD_TO_SIGMA

Array = npt.NDArray[np.float64]

_LAG_M: Final = 2.0
"""Profiles so far apart tell what edges scatter by beyond what each of them says of itself: waves longer than a profile."""
_STRAY: Final = 6.0
_STRAY_M: Final = 0.3
"""An edge so far from those of its neighbours, in their scatter and in metres, is of something else: a trunk, a boat."""
_GAP: Final = 3
"""Stations without an edge that a line goes on over."""
UPPER, LOWER = 0, 1


@dataclass(frozen=True, slots=True)
class Edge:
    """An edge along an axis.

    Attributes
    ----------
    station : ndarray of int64, shape (n,)
        Of the axis.
    across_m, height_m : ndarray, shape (n,)
        Way downhill from the axis, and height.
    sigma_across_m, sigma_height_m : ndarray, shape (n,)
    """

    station: npt.NDArray[np.int64]
    across_m: Array
    height_m: Array
    sigma_across_m: Array
    sigma_height_m: Array

    def places(self, axis: Axis) -> Array:
        """In space, shape (n, 3)."""
        xy = axis.places_m[self.station] + self.across_m[:, None] * axis.downhill[self.station]
        return np.column_stack([xy, self.height_m])

    def parts(self) -> list[npt.NDArray[np.int64]]:
        """Rows of unbroken lines of two places and more."""
        cuts = np.flatnonzero(np.diff(self.station) > _GAP) + 1
        return [rows for rows in np.split(np.arange(len(self.station)), cuts) if len(rows) > 1]


def edge(profiles: list[Profile | None], which: int, step_m: float) -> Edge:
    """One edge of the profiles of an axis; `which` is UPPER or LOWER."""
    at = np.array(
        [n for n, each in enumerate(profiles) if each is not None and (each.upper, each.lower)[which]], np.int64
    )
    told = [each for n in at for each in [profiles[n]] if each is not None]
    value = np.array([each.values[2 * which : 2 * which + 2] for each in told]).reshape(-1, 2)
    sigma = np.array([each.sigmas()[which] for each in told]).reshape(-1, 2)
    for column in range(2):  # first by the way across, then by the height
        keep = _kept(value[:, column], sigma[:, column])
        at, value, sigma = at[keep], value[keep], sigma[keep]
    lag = max(round(_LAG_M / step_m), 1)
    for column in range(2):
        sigma[:, column] = np.hypot(sigma[:, column], scatter(at, value[:, column], lag))
    return Edge(at, value[:, 0], value[:, 1], sigma[:, 0], sigma[:, 1])


def _kept(value: Array, sigma: Array) -> npt.NDArray[np.bool_]:
    if len(value) < 5:
        return np.ones(len(value), np.bool_)
    off = np.abs(value - median_filter(value, 5, mode="nearest"))
    usual = np.hypot(MAD_TO_SIGMA * float(np.median(off)), sigma)
    return np.asarray(off <= np.maximum(_STRAY * usual, _STRAY_M))


def scatter(station: npt.NDArray[np.int64], value: Array, lag: int) -> float:
    """What single values along an axis scatter by, by second differences over so many stations: a bend of the line takes no part."""
    if len(station) < 2 * lag + 3:
        return 0.0
    whole = np.full(int(station[-1]) + 1, np.nan)
    whole[station] = value
    bend = whole[2 * lag :] - 2.0 * whole[lag:-lag] + whole[: -2 * lag]
    bend = bend[np.isfinite(bend)]
    return float(MAD_TO_SIGMA * np.median(np.abs(bend)) / np.sqrt(6.0)) if len(bend) >= 3 else 0.0
