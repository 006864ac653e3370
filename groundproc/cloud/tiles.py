"""Clouds of any size in squares of ground that fit into memory, each with the points around it; and values that come back in order.

What looks at neighbours works square by square: points wait on the disk, sorted by square, those near an edge in the neighbouring
squares too. What was found of each point goes to a temporary file by the number of the point, and is read from it in the order in
which the points came.
"""

import math
import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.cloud.spool import Place, Spool
from groundproc.machine.system import take_disk
from groundproc.numerics.voxelhash import sorted_by

Array = npt.NDArray[np.float64]

AT_ONCE: Final = 1_000_000
"""Points that a square is to hold, on the average."""
_WIDEST_M: Final = 1000.0
"""Rasters of a square follow its side, also where a thin cloud or a corridor fills little of it."""
_LEAST_HALOS: Final = 8.0
"""Sides of a square in halos, at least: so that not many points lie in several."""


@dataclass(frozen=True, slots=True)
class Tile:
    """Points of a square and around it.

    Attributes
    ----------
    xyz_m : ndarray, shape (n, 3)
    number : ndarray of int64, shape (n,)
        Of each point, counted from 0 as they were added.
    core : ndarray of bool, shape (n,)
        Those of the square itself; each point is core in one square.
    columns : mapping of str to ndarray, shape (n,)
        What else was given of them.
    """

    xyz_m: Array
    number: npt.NDArray[np.int64]
    core: npt.NDArray[np.bool_]
    columns: Mapping[str, npt.NDArray[Any]]


def side_for(points: int, low_m: Sequence[float], high_m: Sequence[float], halo_m: float) -> float:
    """Side of squares that hold `AT_ONCE` points on the average, of a cloud between two corners [m]."""
    area = max((high_m[0] - low_m[0]) * (high_m[1] - low_m[1]), 1.0)
    return max(min(math.sqrt(area * AT_ONCE / max(points, 1)), _WIDEST_M), _LEAST_HALOS * halo_m)


class Tiles:
    """Takes points, and gives them square by square.

    Parameters
    ----------
    folder : Path
        For a temporary file; it has no name, and is gone when this is.
    columns : mapping of str to dtype
        What is kept of each point besides its place.
    side_m, halo_m : float
        Of the squares, and how far around them points are given too.
    """

    def __init__(self, folder: Path, columns: Mapping[str, Any], side_m: float, halo_m: float) -> None:
        assert 0.0 <= 2.0 * halo_m <= side_m, (halo_m, side_m)
        self._names = tuple(columns)
        self._side_m, self._halo_m = side_m, halo_m
        fields = [("xyz", "f8", (3,)), ("number", "i8"), ("core", "?"), *((k, np.dtype(v)) for k, v in columns.items())]
        self._dtype = np.dtype(fields)
        self._spool = Spool(self._dtype, folder)
        self.points = 0
        """How many were added."""

    def add(self, xyz_m: Array, columns: Mapping[str, npt.NDArray[Any]] | None = None) -> None:
        """Take points, shape (n, 3), and their columns, shape (n,) each."""
        records = np.empty(len(xyz_m), self._dtype)
        records["xyz"], records["core"] = xyz_m, True
        records["number"] = self.points + np.arange(len(xyz_m))
        for name in self._names:
            records[name] = (columns or {})[name]
        self.points += len(xyz_m)
        place = xyz_m[:, :2] / self._side_m
        square = np.floor(place).astype(np.int64)
        self._add(records, square)
        if self._halo_m:
            within, halo = place - square, self._halo_m / self._side_m
            step = (within > 1.0 - halo).astype(np.int64) - (within < halo)
            for some, by in ((step[:, 0] != 0, (1, 0)), (step[:, 1] != 0, (0, 1)), ((step != 0).all(axis=1), (1, 1))):
                if some.any():
                    beside = records[some]
                    beside["core"] = False
                    self._add(beside, square[some] + step[some] * by)

    def __iter__(self) -> Iterator[Tile]:
        """All squares that hold points of their own; each can be had once."""
        while self._spool.counts:
            records = self._spool.take(next(iter(self._spool.counts)))
            if records["core"].any():
                columns = {name: np.ascontiguousarray(records[name]) for name in self._names}
                yield Tile(
                    np.ascontiguousarray(records["xyz"]), np.ascontiguousarray(records["number"]),
                    np.ascontiguousarray(records["core"]), columns,
                )  # fmt: skip

    def _add(self, records: npt.NDArray[np.void], square: npt.NDArray[np.int64]) -> None:
        if not len(records):
            return
        low = square.min(axis=0)
        width = int(square[:, 1].max() - low[1]) + 1
        keys, number = np.unique((square[:, 0] - low[0]) * width + square[:, 1] - low[1], return_inverse=True)
        places: list[Place] = [(int(key // width + low[0]), int(key % width + low[1])) for key in keys]
        if len(places) == 1:
            self._spool.add(places[0], records)
            return
        order, first = sorted_by(number.astype(np.int32), len(places))
        for each, where in enumerate(places):
            self._spool.add(where, records[order[first[each] : first[each + 1]]])


class Found:
    """Values of all points, on the disk, by number.

    Parameters
    ----------
    folder : Path
        For a temporary file without a name.
    columns : mapping of str to dtype
    points : int
    """

    def __init__(self, folder: Path, columns: Mapping[str, Any], points: int) -> None:
        files = {name: tempfile.TemporaryFile(dir=folder) for name in columns}  # noqa: SIM115 (open as long as this lives)
        for file in files.values():
            weakref.finalize(self, file.close)
        for name, dtype in columns.items():
            take_disk(files[name].fileno(), max(points, 1) * np.dtype(dtype).itemsize)
        self._arrays = {
            name: np.memmap(files[name], np.dtype(dtype), "r+", shape=(max(points, 1),))
            for name, dtype in columns.items()
        }

    def put(self, number: npt.NDArray[np.int64], values: Mapping[str, npt.NDArray[Any]]) -> None:
        """Keep values of some points."""
        for name, each in values.items():
            self._arrays[name][number] = each

    def take(self, start: int, count: int) -> dict[str, npt.NDArray[Any]]:
        """Values of points from a number on."""
        return {name: np.array(each[start : start + count]) for name, each in self._arrays.items()}
