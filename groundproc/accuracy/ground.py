"""Differences of the ground between passes: models of 5 cm cells, of revolution after revolution and of strip against strip.

A cell belongs to the true echo, and each of its two models is the mean height of the points whose echoes lie in it: a trajectory is
judged by the heights that it gives to the same piece of ground, and grass is as rough for it as for the truth.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Keys = npt.NDArray[np.int64]

CELL_M: Final = 0.05
LEVEL: Final = 0.95
"""Vertical component of a normal from which on a surface is ground."""
STRIP_NS: Final = 10_000_000_000
"""Points of so long a time are a strip; strips are compared when another one lies between."""


def cell_keys(hits_m: Array, surface: npt.NDArray[np.integer[Any]]) -> Keys:
    """A number for each cell of each surface, shape (n,)."""
    east, north = (np.floor(hits_m[:, axis] / CELL_M).astype(np.int64) % (1 << 23) for axis in (0, 1))
    return np.asarray((surface.astype(np.int64) << 46) + (east << 23) + north)


class Cells:
    """Mean heights of cells: keys in growing order, number of points, sums of heights of each set, shape (cells, sets)."""

    def __init__(self, keys: Keys, count: Array, sums: Array) -> None:
        self.keys, self.count, self.sums = keys, count, sums

    @classmethod
    def of(cls, keys: Keys, heights_m: Array) -> "Cells":
        """Cells of points, shapes (n,) and (n, sets)."""
        return cls._gathered(keys, np.ones(len(keys)), heights_m)

    @classmethod
    def joined(cls, parts: "list[Cells]") -> "Cells":
        """The cells of several."""
        return cls._gathered(
            np.concatenate([part.keys for part in parts]),
            np.concatenate([part.count for part in parts]),
            np.concatenate([part.sums for part in parts]),
        )

    @classmethod
    def _gathered(cls, keys: Keys, count: Array, sums: Array) -> "Cells":
        found, group = np.unique(keys, return_inverse=True)
        columns = [np.bincount(group, column, len(found)) for column in sums.T]
        return cls(found, np.asarray(np.bincount(group, count, len(found)), np.float64), np.stack(columns, axis=1))

    def chosen(self, which: npt.NDArray[Any]) -> "Cells":
        """Some of the cells."""
        return Cells(self.keys[which], self.count[which], self.sums[which])

    @property
    def heights_m(self) -> Array:
        """Mean heights, shape (cells, sets)."""
        return np.asarray(self.sums / self.count[:, None])


class Difference:
    """Running sum of squared height differences, set by set."""

    def __init__(self, sets: int) -> None:
        self.squares, self.cells = np.zeros(sets), 0

    def add(self, one: Cells, other: Cells) -> None:
        """Compare the cells that both have."""
        _, at, there = np.intersect1d(one.keys, other.keys, assume_unique=True, return_indices=True)
        self.squares += np.square(one.heights_m[at] - other.heights_m[there]).sum(axis=0)
        self.cells += len(at)

    def rms_m(self) -> Array:
        """RMS difference of each set, shape (sets,); not a number where nothing was compared."""
        return np.asarray(np.sqrt(self.squares / self.cells)) if self.cells else np.full(len(self.squares), np.nan)


class Ground:
    """Takes points in order of time; keeps one revolution, one strip, and the last visit of each cell.

    Parameters
    ----------
    sets : int
        How many clouds of the same echoes are compared.
    """

    def __init__(self, sets: int) -> None:
        self.revolutions, self.strips = Difference(sets), Difference(sets)
        self._sets = sets
        self._number, self._strip = -1, -1
        self._open: list[Cells] = []
        self._last: Cells | None = None
        self._parts: list[Cells] = []
        self._seen: dict[int, Cells] = {}

    def add(self, keys: Keys, heights_m: Array, revolution: Keys, time_ns: npt.NDArray[np.int64]) -> None:
        """Add points.

        Parameters
        ----------
        keys : ndarray of int64, shape (n,)
            Of their cells.
        heights_m : ndarray, shape (n, sets)
        revolution : ndarray of int64, shape (n,)
            Running number, growing.
        time_ns : ndarray of int64, shape (n,)
        """
        cuts = np.flatnonzero(np.diff(revolution)) + 1
        for part in np.split(np.arange(len(keys)), cuts):
            if not len(part):
                continue
            number, strip = int(revolution[part[0]]), int(time_ns[part[0]] // STRIP_NS)
            if number != self._number:
                self._close_revolution()
                if strip != self._strip:
                    self._close_strip()
                if number != self._number + 1:
                    self._last = None
                self._number, self._strip = number, strip
            self._open.append(Cells.of(keys[part], heights_m[part]))

    def finish(self) -> None:
        """Take the last revolution and strip in."""
        self._close_revolution()
        self._close_strip()

    def _close_revolution(self) -> None:
        if not self._open:
            return
        cells, self._open = Cells.joined(self._open), []
        if self._last is not None:
            self.revolutions.add(self._last, cells)
        self._last = cells
        self._parts.append(cells)

    def _close_strip(self) -> None:
        if not self._parts:
            return
        cells, self._parts = Cells.joined(self._parts), []
        for strip, seen in list(self._seen.items()):
            if strip >= self._strip - 1:  # the strip just before: neighbours, not passes
                continue
            self.strips.add(seen, cells)
        for strip, seen in list(self._seen.items()):  # of each cell the last visit is kept
            left = seen.chosen(~np.isin(seen.keys, cells.keys, assume_unique=True))
            if len(left.keys):
                self._seen[strip] = left
            else:
                del self._seen[strip]
        self._seen[self._strip] = cells
