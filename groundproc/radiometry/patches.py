"""Strengths gathered by small patches of ground: what different lasers and strips say of the same place."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.radiometry.gains import Table
from groundproc.radiometry.nearrange import BANDS, RangeGain, middle_m

Array = npt.NDArray[np.float64]

_CELL_M: Final = 1.0
_BIN_RAD: Final = np.deg2rad(5.0)
"""Lasers are compared at the same incidence only: no natural surface is quite Lambertian."""
_FLATTEST: Final = 0.02
"""Beams that come in flatter than this cosine from the vertical count as this."""
_MOST: Final = 400_000
"""Rows that are kept; then every other patch is let go."""
_GOLDEN: Final = np.uint64(0x9E3779B97F4A7C15)


class _Rows:
    """Sums of values by (patch, group), thinned by patch where they become many."""

    def __init__(
        self, sums: int, together: Callable[[npt.NDArray[np.int64]], npt.NDArray[np.int64]] | None = None
    ) -> None:
        self._parts: list[Array] = []
        self._together = together
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
        if self._together is not None:  # patches that are let go together
            patch = self._together(patch)
        hashed = patch.astype(np.uint64) * _GOLDEN >> np.uint64(40)
        return np.asarray(hashed & np.uint64((1 << self._kept) - 1) == 0)

    def rows(self) -> Array:
        """Patch, group, count and sums, shape (m, 3 + k): each pair once."""
        every = np.concatenate(self._parts) if self._parts else np.empty((0, 3 + self._sums))
        found, number = np.unique(every[:, :2], axis=0, return_inverse=True)
        number = number.ravel()
        sums = [np.bincount(number, every[:, k], len(found)) for k in range(2, 3 + self._sums)]
        return np.column_stack([found, *sums])


@dataclass(frozen=True, slots=True)
class Seen:
    """What strips say of patches: one row for each patch, strip, kind of echo and band of range.

    Attributes
    ----------
    patch, strip, band, count : ndarray of int64, shape (n,)
    leaf : ndarray of bool, shape (n,)
        Echoes from no surface, whose incidence is not known.
    raw, freed, squares : ndarray, shape (n,)
        Sums of strengths as measured, freed of range and incidence, and of the squares of these.
    log_rise, log_squares : ndarray, shape (n,)
        Sums of the logarithm of the cosine of the angle between beam and vertical, and of its squares.
    """

    patch: npt.NDArray[np.int64]
    strip: npt.NDArray[np.int64]
    band: npt.NDArray[np.int64]
    count: npt.NDArray[np.int64]
    leaf: npt.NDArray[np.bool_]
    raw: Array
    freed: Array
    squares: Array
    log_rise: Array
    log_squares: Array

    def freed_of(self, divided: Array) -> "Seen":
        """The same, with strengths divided once more, shape (n,)."""
        return replace(self, freed=self.freed / divided, squares=self.squares / divided**2)


class Patches:
    """Gathers strengths by patch and laser, and by patch and strip."""

    def __init__(self) -> None:
        self._lasers, self._strips = _Rows(2), _Rows(5, parent)

    def add(
        self,
        xyz_m: Array,
        strip: npt.NDArray[Any],
        leaf: npt.NDArray[np.bool_],
        band: npt.NDArray[np.int64],
        values: tuple[Array, Array, Array],
    ) -> None:
        """Take echoes of strips with the band of their range.

        Values are strengths as measured, strengths freed of range and incidence, and cosines of the beams from the vertical.
        """
        strength, freed, rise = values
        group = (strip.astype(np.int64) * 2 + leaf) * BANDS + band
        log_rise = np.log(np.maximum(rise, _FLATTEST))
        self._strips.add(_cells(xyz_m), group, strength, freed, freed**2, log_rise, log_rise**2)

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

    def seen(self, by_range: RangeGain) -> Seen:
        """What strips say of patches, freed of the gain by range."""
        rows = self._strips.rows()
        patch, group, count = (rows[:, k].astype(np.int64) for k in range(3))
        kind, band = group // BANDS, group % BANDS
        found = Seen(patch, kind // 2, band, count, kind % 2 > 0, *rows[:, 3:].T)
        return found.freed_of(by_range.at(middle_m(band))[0])


def parent(patch: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Number of the cell of 4 m that a patch lies in, shape (n,)."""
    return np.asarray((patch >> 24 << 22) | ((patch & 0x3FFFFF) >> 2))


def _cells(xyz_m: Array) -> npt.NDArray[np.int64]:
    """Number of the cell of each point; exact as a double too."""
    cell = np.floor(xyz_m[:, :2] / _CELL_M).astype(np.int64)
    return np.asarray(((cell[:, 0] & 0x3FFFFF) << 22) | (cell[:, 1] & 0x3FFFFF))
