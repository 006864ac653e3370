"""Strengths gathered by small patches of ground: what different lasers and strips say of the same place."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.radiometry.gains import Table
from groundproc.radiometry.nearrange import BANDS, RangeGain, middle_m

Array = npt.NDArray[np.float64]

_CELL_M: Final = 1.0
_BIN_RAD: Final = np.deg2rad(5.0)
"""Lasers are compared at the same incidence only: no natural surface is quite Lambertian."""
_MOST: Final = 400_000
"""Rows that are kept; then every other patch is let go."""
_FEWEST: Final = 5
_GOLDEN: Final = np.uint64(0x9E3779B97F4A7C15)


class _Rows:
    """Sums of values by (patch, group), thinned by patch where they become many."""

    def __init__(self, sums: int) -> None:
        self._parts: list[Array] = []
        self._sums, self._rows, self._kept = sums, 0, 0

    def add(self, patch: npt.NDArray[np.int64], group: npt.NDArray[Any], *values: Array) -> None:
        """Take values, shape (n,) each."""
        chosen = self._chosen(patch)
        patch, group, values = patch[chosen], group[chosen].astype(np.int64), tuple(v[chosen] for v in values)
        if not len(patch):
            return
        keys = np.stack([patch, group], axis=1)
        found, number = np.unique(keys, axis=0, return_inverse=True)
        number = number.ravel()
        sums = [np.bincount(number, v, len(found)) for v in (np.ones(len(patch)), *values)]
        self._parts.append(np.column_stack([found.astype(np.float64), *sums]))
        self._rows += len(found)
        while self._rows > _MOST:
            self._kept += 1
            self._parts = [part[self._chosen(part[:, 0].astype(np.int64))] for part in self._parts]
            self._rows = sum(map(len, self._parts))

    def _chosen(self, patch: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        hashed = patch.astype(np.uint64) * _GOLDEN >> np.uint64(40)
        return np.asarray(hashed & np.uint64((1 << self._kept) - 1) == 0)

    def rows(self) -> Array:
        """Patch, group, count and sums, shape (m, 3 + k): each pair once."""
        every = np.concatenate(self._parts) if self._parts else np.empty((0, 3 + self._sums))
        found, number = np.unique(every[:, :2], axis=0, return_inverse=True)
        number = number.ravel()
        sums = [np.bincount(number, every[:, k], len(found)) for k in range(2, 3 + self._sums)]
        return np.column_stack([found, *sums])


class Patches:
    """Gathers strengths by patch and laser, and by patch and strip."""

    def __init__(self) -> None:
        self._lasers, self._strips = _Rows(2), _Rows(2)

    def add(
        self, xyz_m: Array, strip: npt.NDArray[Any], strength: Array, freed: Array, band: npt.NDArray[np.int64]
    ) -> None:
        """Take echoes of strips: strengths as measured, and freed of range and incidence; with the band of their range."""
        self._strips.add(_cells(xyz_m), strip.astype(np.int64) * BANDS + band, strength, freed)

    def add_lasers(
        self, xyz_m: Array, laser: npt.NDArray[Any], incidence_rad: Array, freed: Array, band: npt.NDArray[np.int64]
    ) -> None:
        """Take single echoes from surfaces, with the band of their range."""
        step = np.minimum(incidence_rad / _BIN_RAD, 31.0).astype(np.int64)
        self._lasers.add(_cells(xyz_m) * 32 + step, laser.astype(np.int64) * BANDS + band, freed, freed**2)

    def table(self) -> tuple[Table, npt.NDArray[np.int64]]:
        """Strengths by patch, laser and band of range; and the band of each row."""
        rows = self._lasers.rows()
        patch, group, count = (rows[:, k].astype(np.int64) for k in range(3))
        return Table(patch, group // BANDS, count, rows[:, 3], rows[:, 4]), group % BANDS

    def typical(self) -> float:
        """Median of the freed strengths of patches."""
        rows = self._strips.rows()
        value = rows[:, 4] / rows[:, 2] if len(rows) else np.zeros(1)
        return float(np.median(value[value > 0])) if (value > 0).any() else 0.0

    def strips(self, by_range: RangeGain) -> list[dict[str, Any]]:
        """By how much each strip is brighter than the others where they overlap, before and after [percent].

        `..._percent` is the median of all patches, `..._cells_percent` the median of how far single ones are off.
        """
        rows = _by_strip(self._strips.rows(), by_range)
        rows = rows[rows[:, 2] >= _FEWEST]
        patch = np.unique(rows[:, 0], return_inverse=True)[1] if len(rows) else np.empty(0, np.int64)
        several = np.bincount(patch) if len(patch) else np.empty(0)
        told = []
        for strip in np.unique(rows[:, 1]):
            own = (rows[:, 1] == strip) & (several[patch] > 1)
            one: dict[str, Any] = {"strip": int(strip), "patches": int(own.sum())}
            for name, column in (("raw", 3), ("reflectance", 4)):
                mean = rows[:, column] / rows[:, 2]
                others = (np.bincount(patch, mean) - 0.0)[patch] - mean
                with np.errstate(divide="ignore", invalid="ignore"):
                    ratio = mean[own] / (others[own] / (several[patch[own]] - 1))
                ratio = ratio[np.isfinite(ratio)]
                off = 100.0 * (ratio - 1.0)
                one[f"{name}_percent"] = round(float(np.median(off)), 3) if len(off) else None
                one[f"{name}_cells_percent"] = round(float(np.median(np.abs(off))), 3) if len(off) else None
            told.append(one)
        return told


def _by_strip(rows: Array, by_range: RangeGain) -> Array:
    """Rows by patch and strip, of those by patch, strip and band: freed of the gain by range."""
    group = rows[:, 1].astype(np.int64)
    gain, _ = by_range.at(middle_m(group % BANDS))
    found, number = np.unique(np.column_stack([rows[:, 0], group // BANDS]), axis=0, return_inverse=True)
    values = (rows[:, 2], rows[:, 3], rows[:, 4] / gain)
    return np.column_stack([found, *(np.bincount(number.ravel(), each, len(found)) for each in values)])


def _cells(xyz_m: Array) -> npt.NDArray[np.int64]:
    """Number of the cell of each point; exact as a double too."""
    cell = np.floor(xyz_m[:, :2] / _CELL_M).astype(np.int64)
    return np.asarray(((cell[:, 0] & 0x3FFFFF) << 22) | (cell[:, 1] & 0x3FFFFF))
