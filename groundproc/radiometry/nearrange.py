"""What a sensor that takes out the range itself leaves of it: a gain by range, from patches of ground seen from several ranges alike.

The HDL-32E is out of focus near by, and its own table does not know each unit (R3). Only patches tell that were met at one incidence from
ranges that differ, as overlapping strips at different heights do. Where they tell no more than chance does, no gain is applied.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from groundproc.radiometry.gains import Gains, Table, gains

Array = npt.NDArray[np.float64]

BANDS: Final = 32
_STEP: Final = float(np.log(1.25))
_FIRST_M: Final = 1.0
FAR_M: Final = 10.0
"""From here on the mean gain is 1, if it is seen there: what is wrong near by is what is sought."""
_SURE: Final = 0.99
_ROUNDS: Final = 3
_FEWEST_PATCHES: Final = 20


@dataclass(frozen=True, slots=True)
class RangeGain:
    """What strengths are divided by, by range.

    Attributes
    ----------
    range_m, gain, sigma : ndarray, shape (k,)
        Of the bands that were seen; empty where none is applied.
    """

    range_m: Array
    gain: Array
    sigma: Array

    def at(self, range_m: Array) -> tuple[Array, Array]:
        """Gain and its sigma at ranges, shape (n,) each: between bands by the logarithm of the range, beyond them as at the end."""
        if not len(self.range_m):
            return np.ones(len(range_m)), np.zeros(len(range_m))
        at, known = np.log(np.maximum(range_m, 1e-3)), np.log(self.range_m)
        return np.interp(at, known, self.gain), np.interp(at, known, self.sigma)

    def tell(self) -> list[dict[str, float]]:
        """For the report."""
        return [
            {"range_m": round(float(r), 2), "gain": round(float(g), 4), "sigma": round(float(s), 4)}
            for r, g, s in zip(self.range_m, self.gain, self.sigma, strict=True)
        ]


NONE: Final = RangeGain(np.empty(0), np.empty(0), np.empty(0))


def band(range_m: Array) -> npt.NDArray[np.int64]:
    """Band of each range, shape (n,)."""
    number = np.floor(np.log(np.maximum(np.nan_to_num(range_m), _FIRST_M) / _FIRST_M) / _STEP)
    return np.minimum(number, BANDS - 1).astype(np.int64)


def middle_m(number: npt.NDArray[np.int64]) -> Array:
    """Middle of bands, shape (n,)."""
    return np.asarray(_FIRST_M * np.exp((number + 0.5) * _STEP))


def both(table: Table, of_band: npt.NDArray[np.int64]) -> tuple[Gains, RangeGain]:
    """Gains of lasers and gain by range, in turn.

    Parameters
    ----------
    table : Table
        By patch, laser and band.
    of_band : ndarray of int64, shape (n,)
        Band of each row.
    """
    found, by_range = gains(_joined(table, table.laser, np.ones(len(of_band)))), NONE
    for _ in range(_ROUNDS):
        by_range = _by_range(_joined(table, of_band, found.gain[table.laser]))
        if not len(by_range.range_m):
            break
        found = gains(_joined(table, table.laser, by_range.at(middle_m(of_band))[0]))
    return found, by_range


def _joined(table: Table, group: npt.NDArray[np.int64], divided: Array) -> Table:
    """Rows of one patch and group as one, freed of a gain."""
    keys = table.patch * 256 + group
    found, number = np.unique(keys, return_inverse=True)
    number = number.ravel()
    count, total, squares = (
        np.asarray(np.bincount(number, values, len(found)), np.float64)
        for values in (table.count.astype(np.float64), table.total / divided, table.squares / divided**2)
    )
    return Table(found // 256, found % 256, count.astype(np.int64), total, squares)


def _by_range(table: Table) -> RangeGain:
    """The gain by range of a table by patch and band; none where it is that of chance."""
    several = np.flatnonzero(np.bincount(np.unique(table.patch, return_inverse=True)[1].ravel()) > 1)
    if len(several) < _FEWEST_PATCHES:
        return NONE
    found = gains(table)
    seen = np.flatnonzero(found.seen[:BANDS])
    if len(seen) < 2:
        return NONE
    gain, sigma, range_m = found.gain[seen], found.sigma[seen], middle_m(seen)
    far = range_m >= FAR_M
    weight = sigma**-2 * (far if far.any() else 1.0)
    gain = gain / np.exp(np.sum(weight * np.log(gain)) / weight.sum())
    # the prior of a band is in its sigma: one that nothing told is at 1 and adds nothing
    if float(np.sum((np.log(gain) / sigma) ** 2)) < chi2.ppf(_SURE, len(seen) - 1):
        return NONE
    return RangeGain(range_m, gain, gain * sigma)
