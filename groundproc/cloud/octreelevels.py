"""Level and node of each point of a square of an octree: one way down Morton's curve, from the root to the last leaf."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.voxelhash import spread

Numbers = npt.NDArray[np.int64]

ROOT_BITS: Final = 24
"""The root spans 2^24 units in each direction."""
VOXEL_BITS: Final = 7
"""128 voxels along the side of a node."""
LEVELS: Final = ROOT_BITS - VOXEL_BITS
"""The deepest level, whose voxels are units."""
LEAF: Final = 30_000
"""Points that make no further level."""
_KEY_BITS: Final = 64
"""Of a key of Morton's curve."""
_FEW: Final = 1_000
"""So few points left in a node are given to its parent."""


@njit(cache=True, nogil=True)
def _node(within: Any, n: int, shift: int) -> Any:
    """Number of the node of a point: 17 bits for each axis."""
    x, y, z = within[n, 0] >> shift, within[n, 1] >> shift, within[n, 2] >> shift
    return x | y << LEVELS | z << 2 * LEVELS


def key_of(level: int, node: int) -> tuple[int, int, int, int]:
    """Level, and x, y, z, of a node by its number."""
    mask = (1 << LEVELS) - 1
    return level, node & mask, node >> LEVELS & mask, node >> 2 * LEVELS


def levels(within: Numbers, bits: int, skipped: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int8], Numbers]:
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
    fine = max(-((_KEY_BITS - ROOT_BITS - 2 * bits) // 3), 0)
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
        key[n] = (np.uint64(z >> bits) << above if bits < ROOT_BITS else np.uint64(0)) | curve


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
    left, deepest = len(key), LEVELS - fine
    for depth in range(deepest + 1):
        shift = ROOT_BITS - depth  # of a node of this level
        if skipped[depth]:
            continue
        if shift <= bits:  # nodes lie within the square: small remainders need no further level
            left = _close(within, along, left, (depth, _cut(shift, bits, fine), depth == deepest), level, node)
        if left == 0:
            return
        cut = _cut(shift - VOXEL_BITS, bits, fine)
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
    shift = ROOT_BITS - depth
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
def numbered(level: Any, node: Any) -> Any:
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
