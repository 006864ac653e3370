"""The octree of a COPC file: which point belongs to which node, in memory that does not grow with their number.

Every node is a cube with 128 voxels along a side. A point belongs to the first level, from the root down, at which it is the first in
its voxel, or in which all that is left of its node fits into one leaf. The root begins at the least coordinates and spans the largest
extent, as readers that know only the header expect. So points wait in squares of the ground until the extent is known; they are then
sorted into squares of the octree itself, in which voxels of all levels are nested, and which are dealt with one by one. Only where
voxels are larger than squares (areas of more than two kilometres, or squares split because they hold very much) do the topmost levels
take their points from one corner of the voxel alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.spool import Place, Records, Spool
from groundproc.numerics.voxelhash import sorted_by, spread

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
Key = tuple[int, int, int, int]
"""Level, and x, y, z of a node."""

_GROUND_BITS: Final = 14
"""Points wait in squares of 2^14 stored steps, 16 m where a step is a millimetre."""
_SQUARE_M: Final = 16.0
"""Largest side of a square of the octree."""
_ROOT_BITS: Final = 24
"""The root spans 2^24 units in each direction."""
_KEY_BITS: Final = 64
"""Of a key of Morton's curve."""
_VOXEL_BITS: Final = 7
"""128 voxels along the side of a node."""
_LEVELS: Final = _ROOT_BITS - _VOXEL_BITS
"""The deepest level, whose voxels are units."""
LEAF: Final = 30_000
"""Points that make no further level."""
_FEW: Final = 1_000
"""So few points left in a node are given to its parent."""
_LARGEST_PIECE: Final = 750_000
"""Points dealt with at once."""
_SMALLEST_BITS: Final = 4
"""A square is not split below 2^4 units."""


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
        return Cube(self._low.copy(), self._scales_m * ((1 << _ROOT_BITS) / side_m), side_m)

    def nodes(self) -> Iterator[tuple[Key, Records]]:
        """All nodes that have points, once each; the octree is empty then."""
        cube = self.cube()
        depth = min(max(int(np.ceil(np.log2(cube.side_m / _SQUARE_M))), 0), _LEVELS)
        bits = _ROOT_BITS - depth
        upper, squares = _Upper(self._dtype, self._folder), Spool(self._dtype, self._folder)
        ground = sorted(self._spool.counts, key=_morton)
        met = {place: _met(cube, place, bits) for place in ground}
        missing: dict[Place, int] = {}
        for each in met.values():
            for square in each:
                missing[square] = missing.get(square, 0) + 1
        for place in ground:
            records = self._spool.take(place)
            within = cube.within(records)
            squares.add_sorted(records, *_grouped(within[:, 0] >> bits, within[:, 1] >> bits))
            for square in met[place]:
                missing[square] -= 1
                if not missing[square] and square in squares.counts:
                    yield from _square(cube, square, squares.take(square), bits, upper)
        assert not squares.counts
        yield from upper.nodes()


class _Upper:
    """Points of nodes that are larger than a square, until all squares were dealt with."""

    def __init__(self, dtype: np.dtype[Any], folder: Path) -> None:
        self._spool = Spool(dtype, folder)
        self._keys: dict[Key, Place] = {}

    def add(self, key: Key, records: Records) -> None:
        """Keep some points of a node."""
        self._spool.add(self._keys.setdefault(key, (len(self._keys), 0)), records.copy())

    def nodes(self) -> Iterator[tuple[Key, Records]]:
        """All of them."""
        for key, place in self._keys.items():
            yield key, self._spool.take(place)


def _square(cube: Cube, place: Place, records: Records, bits: int, upper: _Upper) -> Iterator[tuple[Key, Records]]:
    """Nodes that lie within a square of 2^bits units; points of larger ones are kept for later."""
    within = cube.within(records)
    if len(records) > _LARGEST_PIECE and bits > _SMALLEST_BITS:
        number, places = _grouped(within[:, 0] >> bits - 1, within[:, 1] >> bits - 1)
        order, first = sorted_by(number, len(places))
        del within
        for each, part in enumerate(places):
            yield from _square(cube, part, records.take(order[first[each] : first[each + 1]]), bits - 1, upper)
        return
    number, found = _numbered(*_levels(within, bits, _skipped(place, bits)))
    order, first = sorted_by(number, len(found))
    records = records.take(order)
    for each, (level, node) in enumerate(found.tolist()):
        key, some = _key(level, node), records[first[each] : first[each + 1]]
        if _ROOT_BITS - level <= bits:
            yield key, some
        else:
            upper.add(key, some)


def _met(cube: Cube, place: Place, bits: int) -> list[Place]:
    """Squares of the octree that a square of the ground may have points in."""
    ranges = []
    for axis in (0, 1):
        steps = np.array([place[axis] << _GROUND_BITS, ((place[axis] + 1) << _GROUND_BITS) - 1]) - cube.corner[axis]
        units = np.clip((steps * cube.units[axis]).astype(np.int64), 0, (1 << _ROOT_BITS) - 1) >> bits
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
    beyond = _ROOT_BITS - np.arange(_LEVELS + 1) - _VOXEL_BITS - bits
    mask = (1 << np.maximum(beyond, 0)) - 1
    return np.asarray(((place[0] & mask) | (place[1] & mask)) != 0)


def _key(level: int, node: int) -> Key:
    mask = (1 << _LEVELS) - 1
    return level, node & mask, node >> _LEVELS & mask, node >> 2 * _LEVELS


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
    last = float((1 << _ROOT_BITS) - 1)
    for n in range(len(x)):
        out[n, 0] = np.int64(min((np.int64(x[n]) - corner[0]) * units[0], last))
        out[n, 1] = np.int64(min((np.int64(y[n]) - corner[1]) * units[1], last))
        out[n, 2] = np.int64(min((np.int64(z[n]) - corner[2]) * units[2], last))


@njit(cache=True, nogil=True)
def _node(within: Any, n: int, shift: int) -> Any:
    """Number of the node of a point: 17 bits for each axis."""
    x, y, z = within[n, 0] >> shift, within[n, 1] >> shift, within[n, 2] >> shift
    return x | y << _LEVELS | z << 2 * _LEVELS


def _levels(within: Numbers, bits: int, skipped: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int8], Numbers]:
    """Level and node of each point of a square, shape (n,) each.

    Sorted along Morton's curve the points of a voxel stand beside each other at every level: each level is one run over those that are
    left.

    Parameters
    ----------
    within : ndarray of int64, shape (n, 3)
        Units from the corner of the root.
    bits : int
        The square spans 2^bits units.
    skipped : ndarray of bool
        Levels at which the square gives nothing.
    """
    # squares of clouds narrower than 256 m have more bits than a key: their deepest levels would tell points 0.03 mm apart
    fine = max(-((_KEY_BITS - _ROOT_BITS - 2 * bits) // 3), 0)
    key = np.empty(len(within), np.uint64)
    _along_curve(within, bits, fine, key)
    order = np.argsort(key)
    level, node = np.empty(len(within), np.int8), np.empty(len(within), np.int64)
    _descend(within, (key[order], order), (bits, fine), skipped, level, node)
    return level, node


@njit(cache=True, nogil=True)
def _along_curve(within: Any, bits: int, fine: int, key: Any) -> None:
    """Keys of Morton's curve in a square, without so many of the lowest bits; what of the height is above the square's side comes first."""
    inside, above = (1 << bits) - 1, np.uint64(3 * (bits - fine))
    for n in range(len(within)):
        x, y, z = (within[n, 0] & inside) >> fine, (within[n, 1] & inside) >> fine, within[n, 2]
        curve = _apart(x) | _apart(y) << np.uint64(1) | _apart((z & inside) >> fine) << np.uint64(2)
        key[n] = (np.uint64(z >> bits) << above if bits < _ROOT_BITS else np.uint64(0)) | curve


@njit(cache=True, nogil=True, inline="always")
def _apart(value: Any) -> Any:
    """The 21 lowest bits, each three places from the next."""
    out = np.uint64(value)
    out = (out | out << np.uint64(32)) & np.uint64(0x001F00000000FFFF)
    out = (out | out << np.uint64(16)) & np.uint64(0x001F0000FF0000FF)
    out = (out | out << np.uint64(8)) & np.uint64(0x100F00F00F00F00F)
    out = (out | out << np.uint64(4)) & np.uint64(0x10C30C30C30C30C3)
    return (out | out << np.uint64(2)) & np.uint64(0x1249249249249249)


@njit(cache=True, nogil=True, inline="always")
def _cut(shift: int, bits: int, fine: int) -> Any:
    """By how many bits a key is shifted so that what is left tells cubes of 2^shift units."""
    return np.uint64(3 * (min(shift, bits) - fine) + max(shift - bits, 0))


@njit(cache=True, nogil=True)
def _descend(within: Any, along: Any, resolution: Any, skipped: Any, level: Any, node: Any) -> None:
    """Fill in level and node, from the root down; `along`, sorted keys and the points' numbers, is written over."""
    key, order = along
    bits, fine = resolution
    left, deepest = len(key), _LEVELS - fine
    for depth in range(deepest + 1):
        shift = _ROOT_BITS - depth  # of a node of this level
        if skipped[depth]:
            continue
        if shift <= bits:  # nodes lie within the square: small remainders need no further level
            left = _close(within, along, left, (depth, _cut(shift, bits, fine), depth == deepest), level, node)
        if left == 0:
            return
        cut = _cut(shift - _VOXEL_BITS, bits, fine)
        begin, kept = 0, 0
        while begin < left:
            end, first = begin + 1, begin
            while end < left and key[end] >> cut == key[begin] >> cut:
                if order[end] < order[first]:
                    first = end
                end += 1
            level[order[first]], node[order[first]] = depth, _node(within, order[first], shift)
            for m in range(begin, end):
                if m != first:
                    key[kept], order[kept] = key[m], order[m]
                    kept += 1
            begin = end
        left = kept


@njit(cache=True, nogil=True)
def _close(within: Any, along: Any, left: int, at: Any, level: Any, node: Any) -> int:
    """Give nodes that are small enough all that is left of their points: a handful goes to the parent; how many points are left then."""
    key, order = along
    depth, cut, last = at
    shift = _ROOT_BITS - depth
    begin, kept = 0, 0
    while begin < left:
        end = begin + 1
        while end < left and key[end] >> cut == key[begin] >> cut:
            end += 1
        up = 1 if end - begin <= _FEW and depth > 0 else 0
        if up or end - begin <= LEAF or last:
            found = _node(within, order[begin], shift + up)
            for m in range(begin, end):
                level[order[m]], node[order[m]] = depth - up, found
        else:
            for m in range(begin, end):
                key[kept], order[kept] = key[m], order[m]
                kept += 1
        begin = end
    return kept


@njit(cache=True, nogil=True)
def _numbered(level: Any, node: Any) -> Any:
    """Number of the node of each point, and level and node of each number, shape (m, 2)."""
    n = len(level)
    size = 1
    while size < 2 * n:
        size *= 2
    table, number, found, count = np.full(size, -1, np.int32), np.empty(n, np.int32), np.empty((n, 2), np.int64), 0
    for i in range(n):
        slot = spread(node[i] * 32 + level[i]) & (size - 1)
        while table[slot] >= 0 and (found[table[slot], 0] != level[i] or found[table[slot], 1] != node[i]):
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = count
            found[count, 0], found[count, 1] = level[i], node[i]
            count += 1
        number[i] = table[slot]
    return number, found[:count]
