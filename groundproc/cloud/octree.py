"""The octree of a COPC file: which point belongs to which node, in memory that does not grow with their number.

Every node is a cube with 128 voxels along a side. A point belongs to the first level, from the root down, at which it is the first in
its voxel, or in which all that is left of its node fits into one leaf. The root begins at the least coordinates and spans the largest
extent, as readers that know only the header expect. So points wait in squares of the ground until the extent is known; they are then
sorted into squares of the octree itself, in which voxels of all levels are nested, and which are dealt with one by one. A square that
holds very much is counted first, and written once more in as many parts as it takes. Only where voxels are larger than squares or parts
(areas of more than two kilometres, places flown over for long) do the topmost levels take their points from one corner of the voxel alone.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.octreelevels import LEVELS, ROOT_BITS, VOXEL_BITS, key_of, levels, numbered
from groundproc.cloud.octreeparts import Square, cells_of, count_cells, parts_of
from groundproc.cloud.spool import Place, Records, Spool, joined
from groundproc.numerics.voxelhash import sorted_by

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
Key = tuple[int, int, int, int]
"""Level, and x, y, z of a node."""

_GROUND_BITS: Final = 14
"""Points wait in squares of 2^14 stored steps, 16 m where a step is a millimetre."""
_SQUARE_M: Final = 16.0
"""Largest side of a square of the octree."""
_LARGEST_PIECE: Final = 750_000
"""Points dealt with at once."""
_SMALLEST_BITS: Final = VOXEL_BITS
"""A square is not parted below a node of the deepest level, a millimetre or two where the root is 200 m wide."""
_SPREAD: Final = 12
"""Levels, from the deepest up, that share what such a square has too much."""
MOST: Final = 4_000_000
"""Points of a node: readers unpack it whole."""


@dataclass(frozen=True, slots=True)
class Cube:
    """The root node.

    Attributes
    ----------
    corner : ndarray of int64, shape (3,)
        Least X, Y, Z in stored steps.
    units : ndarray, shape (3,)
        Units of the octree in one stored step of each axis.
    side_m : float
    """

    corner: Numbers
    units: Array
    side_m: float

    def within(self, records: Records) -> Numbers:
        """Units from the corner, shape (n, 3)."""
        out = np.empty((len(records), 3), np.int64)
        _within(records["X"], records["Y"], records["Z"], self.corner, self.units, out)
        return out


class CrowdError(Exception):
    """So many points lie within the smallest square that no node can take them.

    Attributes
    ----------
    count : int
        Points of one node.
    steps : tuple of int
        X, Y, Z of one of them in stored steps.
    """

    def __init__(self, count: int, steps: tuple[int, int, int]) -> None:
        super().__init__(f"{count} points at {steps}")
        self.count, self.steps = count, steps


class Octree:
    """Takes records of LAS points in any order, and gives them by node.

    Parameters
    ----------
    dtype : numpy.dtype
        With fields X, Y, Z.
    scales_m : ndarray, shape (3,)
        One stored step of each axis.
    folder : Path
        For temporary files.
    """

    def __init__(self, dtype: np.dtype[Any], scales_m: Array, folder: Path) -> None:
        self._dtype, self._scales_m, self._folder = dtype, np.asarray(scales_m, np.float64), folder
        self._spool = Spool(dtype, folder)
        self._low = np.full(3, np.iinfo(np.int64).max)
        self._high = np.full(3, np.iinfo(np.int64).min)

    def add(self, records: Records) -> None:
        """Take records, shape (n,); the array may be used again."""
        if not len(records):
            return
        ground = np.empty((len(records), 2), np.int64)
        _ground(records["X"], records["Y"], records["Z"], self._low, self._high, ground)
        self._spool.add_sorted(records, *_grouped(ground[:, 0], ground[:, 1]))

    def cube(self) -> Cube:
        """The root."""
        side_m = float(np.maximum((self._high - self._low) * self._scales_m, self._scales_m).max())
        return Cube(self._low.copy(), self._scales_m * ((1 << ROOT_BITS) / side_m), side_m)

    def nodes(self) -> Iterator[tuple[Key, Records]]:
        """All nodes that have points, once each; the octree is empty then.

        Raises
        ------
        CrowdError
            A node would hold more than `MOST` points.
        """
        cube = self.cube()
        depth = min(max(int(np.ceil(np.log2(cube.side_m / _SQUARE_M))), 0), LEVELS)
        bits = ROOT_BITS - depth
        upper, squares = _Upper(self._dtype, self._folder), Spool(self._dtype, self._folder)
        ground = sorted(self._spool.counts, key=_morton)
        met = {place: _met(cube, place, bits) for place in ground}
        missing: dict[Place, int] = {}
        for each in met.values():
            for square in each:
                missing[square] = missing.get(square, 0) + 1
        for place in ground:
            for records in self._spool.pieces(place):
                within = cube.within(records)
                squares.add_sorted(records, *_grouped(within[:, 0] >> bits, within[:, 1] >> bits))
                del records, within  # the next piece takes their memory
            for square in met[place]:
                missing[square] -= 1
                if not missing[square] and square in squares.counts:
                    yield from self._square(cube, Square(square, bits), squares, square, upper)
        assert not squares.counts
        yield from upper.nodes()

    def _square(
        self, cube: Cube, square: Square, spool: Spool, place: Place, upper: "_Upper"
    ) -> Iterator[tuple[Key, Records]]:
        """Nodes that lie within a square, whose records wait at a place of a spool; points of larger ones are kept for later."""
        if spool.counts[place] <= _LARGEST_PIECE:
            yield from _nodes(cube, square, spool.take(place), upper)
            return
        if square.bits <= _SMALLEST_BITS:
            for turn, records in enumerate(_batches(spool.pieces(place))):
                upper.add_crowd(*_levels(cube, square, records), records, turn % _SPREAD)
            return
        counts, low = cells_of(square, _SMALLEST_BITS)
        for records in spool.look(place):
            count_cells(cube.within(records), low, counts)
        parts, part = parts_of(square, counts, _LARGEST_PIECE)
        parted = Spool(self._dtype, self._folder)
        for records in spool.pieces(place):
            within = cube.within(records)
            number = part[(within[:, 1] >> low.bits) - low.place[1], (within[:, 0] >> low.bits) - low.place[0]]
            del within
            parted.add_sorted(records, number, [(each, 0) for each in range(len(parts))])
            del records, number
        for each, smaller in enumerate(parts):
            yield from self._square(cube, smaller, parted, (each, 0), upper)


class _Upper:
    """Points of nodes that are larger than a square, until all squares were dealt with."""

    def __init__(self, dtype: np.dtype[Any], folder: Path) -> None:
        self._spool = Spool(dtype, folder)
        self._keys: dict[Key, Place] = {}

    def add(self, key: Key, records: Records) -> None:
        """Keep some points of a node."""
        self._spool.add(self._keys.setdefault(key, (len(self._keys), 0)), records.copy())

    def add_crowd(self, level: npt.NDArray[np.int8], node: Numbers, records: Records, up: int) -> None:
        """Keep the points of a square that is not parted; those of the deepest level so many levels up, where others' are not."""
        number, found = numbered(level, node)
        order, first = sorted_by(number, len(found))
        records = records.take(order)
        for each, (depth, which) in enumerate(found.tolist()):
            key = key_of(depth, which)
            if depth == LEVELS:
                key = (depth - up, key[1] >> up, key[2] >> up, key[3] >> up)
            self.add(key, records[first[each] : first[each + 1]])

    def nodes(self) -> Iterator[tuple[Key, Records]]:
        """All of them."""
        for key, place in self._keys.items():
            if self._spool.counts[place] > MOST:
                one = next(self._spool.look(place))[0]
                raise CrowdError(self._spool.counts[place], (int(one["X"]), int(one["Y"]), int(one["Z"])))
            yield key, self._spool.take(place)


def _levels(cube: Cube, square: Square, records: Records) -> tuple[npt.NDArray[np.int8], Numbers]:
    """Level and node of each record of a square."""
    return levels(cube.within(records), square.bits, _skipped(square.place, square.bits))


def _nodes(cube: Cube, square: Square, records: Records, upper: _Upper) -> Iterator[tuple[Key, Records]]:
    """Nodes that lie within a square; points of larger ones are kept for later."""
    number, found = numbered(*_levels(cube, square, records))
    order, first = sorted_by(number, len(found))
    records = records.take(order)
    for each, (level, node) in enumerate(found.tolist()):
        key, some = key_of(level, node), records[first[each] : first[each + 1]]
        if ROOT_BITS - level <= square.bits:
            yield key, some
        else:
            upper.add(key, some)


def _batches(pieces: Iterable[Records]) -> Iterator[Records]:
    """The records in pieces as large as can be dealt with at once."""
    waiting: list[Records] = []
    room = _LARGEST_PIECE
    for piece in pieces:
        while len(piece):
            waiting.append(piece[:room])
            piece, room = piece[room:], room - len(waiting[-1])
            if not room:
                yield joined(waiting)
                waiting, room = [], _LARGEST_PIECE
    if waiting:
        yield joined(waiting)


def _met(cube: Cube, place: Place, bits: int) -> list[Place]:
    """Squares of the octree that a square of the ground may have points in."""
    ranges = []
    for axis in (0, 1):
        steps = np.array([place[axis] << _GROUND_BITS, ((place[axis] + 1) << _GROUND_BITS) - 1]) - cube.corner[axis]
        units = np.clip((steps * cube.units[axis]).astype(np.int64), 0, (1 << ROOT_BITS) - 1) >> bits
        ranges.append(range(int(units[0]), int(units[1]) + 1))
    return [(x, y) for y in ranges[1] for x in ranges[0]]


def _grouped(x: npt.NDArray[Any], y: npt.NDArray[Any]) -> tuple[npt.NDArray[np.int32], list[Place]]:
    """Number of the place of each point, and the places."""
    low_x, low_y = int(x.min()), int(y.min())
    width = int(x.max()) - low_x + 1
    keys = (y.astype(np.int64) - low_y) * width + (x.astype(np.int64) - low_x)
    table = int(keys.max()) + 1
    if table <= 1 << 22:
        seen = np.zeros(table, np.int32)
        seen[keys] = 1
        found = np.flatnonzero(seen)
        seen[found] = np.arange(len(found), dtype=np.int32)
        number = seen[keys]
    else:
        found, inverse = np.unique(keys, return_inverse=True)
        number = inverse.astype(np.int32)
    return number, [(int(key) % width + low_x, int(key) // width + low_y) for key in found]


def _skipped(place: Place, bits: int) -> npt.NDArray[np.bool_]:
    """Levels at which a square gives no point, because its voxel is larger and takes its points from another square."""
    beyond = ROOT_BITS - np.arange(LEVELS + 1) - VOXEL_BITS - bits
    mask = (1 << np.maximum(beyond, 0)) - 1
    return np.asarray(((place[0] & mask) | (place[1] & mask)) != 0)


def _morton(place: Place) -> int:
    """Order of squares in which neighbours lie near each other."""
    x, y = place[0] + (1 << 31), place[1] + (1 << 31)
    return sum((x >> bit & 1) << 2 * bit | (y >> bit & 1) << 2 * bit + 1 for bit in range(33))


@njit(cache=True, nogil=True)
def _ground(x: Any, y: Any, z: Any, low: Any, high: Any, out: Any) -> None:
    """Fill in the squares of the ground, shape (n, 2), and widen the limits, shape (3,)."""
    for n in range(len(x)):
        for axis, stored in ((0, x[n]), (1, y[n]), (2, z[n])):
            low[axis], high[axis] = min(low[axis], stored), max(high[axis], stored)
        out[n, 0], out[n, 1] = x[n] >> _GROUND_BITS, y[n] >> _GROUND_BITS


@njit(cache=True, nogil=True)
def _within(x: Any, y: Any, z: Any, corner: Any, units: Any, out: Any) -> None:
    """Units from the corner of the root, none beyond its other end."""
    last = float((1 << ROOT_BITS) - 1)
    for n in range(len(x)):
        out[n, 0] = np.int64(min((np.int64(x[n]) - corner[0]) * units[0], last))
        out[n, 1] = np.int64(min((np.int64(y[n]) - corner[1]) * units[1], last))
        out[n, 2] = np.int64(min((np.int64(z[n]) - corner[2]) * units[2], last))
