"""Voxels with the moments of their points, found by key in a hash table; and how kernels take them.

Memory follows what is used: arrays have room for the most that there may be, and take memory where they are touched only; the table grows.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.memory import untouched
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Ints = npt.NDArray[np.int32]
Single = npt.NDArray[np.float32]

MASK: Final = 0x1FFFFF
"""A coordinate of a voxel in its key: 21 bits."""
_BEGIN: Final = 1 << 16
"""Slots of an empty table."""
_SLOTS: Final = 2
"""At least so many for each voxel."""


class Voxels(NamedTuple):
    """Voxels in the order in which they were met, as kernels take them; arrays are longer than what is used.

    Attributes
    ----------
    key : ndarray of int64, shape (n,)
    many : ndarray of int32, shape (n,)
        Points.
    sums : ndarray of float32, shape (n, 10)
        How many points the sums are of; sums of x, y, z, xx, xy, xz, yy, yz, zz from the middle of the voxel [m, m^2].
    when_ms : ndarray of int32, shape (n, 2)
        First and last time of a point, from the begin of the stretch.
    looks : ndarray of int32, shape (n,)
        How often it was hit, what comes within `surroundings.LOOK_MS` counted once.
    farthest_m : ndarray of float32, shape (n,)
        Largest range of a point.
    seen : ndarray of float32, shape (n, 3)
        Sum of the directions of the beams that hit it.
    normal : ndarray of float32, shape (n, 3)
        Unit vector; zero where there is no plane.
    """

    key: Times
    many: Ints
    sums: Single
    when_ms: Ints
    looks: Ints
    farthest_m: Single
    seen: Single
    normal: Single

    @classmethod
    def empty(cls, size: int) -> "Voxels":
        """Room for so many, all zero."""
        return cls(
            untouched(size, np.int64), untouched(size, np.int32), untouched((size, 10), np.float32),
            untouched((size, 2), np.int32), untouched(size, np.int32), untouched(size, np.float32), untouched((size, 3), np.float32),
            untouched((size, 3), np.float32),
        )  # fmt: skip

    def with_planes_only(self) -> "Voxels":
        """Without what tells only whether something moved: the other arrays are empty, and their memory is free."""
        return self._replace(
            **{name: getattr(self, name)[:0].copy() for name in ("many", "when_ms", "looks", "farthest_m", "seen")}
        )


class VoxelMap:
    """Voxels of one edge.

    Parameters
    ----------
    edge_m : float
    room : int
        Voxels that there may be at most.

    Attributes
    ----------
    voxels : Voxels
    used : int
        How many there are.
    table : ndarray of int32, shape (2^k,)
        Their numbers by key, for `find`; -1 where there is none.
    """

    def __init__(self, edge_m: float, room: int) -> None:
        self.edge_m = edge_m
        self.voxels = Voxels.empty(room)
        self.used = 0
        self.table = np.full(_BEGIN, -1, np.int32)

    def of(self, xyz_m: Array) -> Ints:
        """Number of the voxel of each point, shape (n,); -1: of none."""
        out = np.empty(len(xyz_m), np.int32)
        _find(xyz_m, self.edge_m, self.table, self.voxels.key, out)
        return out

    def make_room(self, more: int) -> None:
        """See that so many more voxels fit."""
        size = len(self.voxels.key)
        if self.used + more > size:
            grown = Voxels.empty(max(self.used + more, 2 * size))
            for name, old in self.voxels._asdict().items():
                getattr(grown, name)[: self.used] = old[: self.used]
            self.voxels = grown
        slots = len(self.table)
        while slots < _SLOTS * (self.used + more):
            slots *= 2
        if slots > len(self.table):
            self.table = np.full(slots, -1, np.int32)
            _fill_table(self.voxels.key, self.used, self.table)


@njit(cache=True, nogil=True, inline="always")
def find(key: Any, table: Any, keys: Any) -> Any:
    """Number of a voxel by its key; -1 where it is not there."""
    mask = len(table) - 1
    slot = spread(key) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return table[slot]


@njit(cache=True, nogil=True, inline="always")
def place_of(key: Any, table: Any, keys: Any, used: int) -> Any:
    """Number of a voxel, which is the next one where it is new."""
    mask = len(table) - 1
    slot = spread(key) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    if table[slot] < 0:
        table[slot], keys[used] = used, key
    return table[slot]


@njit(cache=True, nogil=True, inline="always")
def beside(key: Any, i: int, j: int, k: int) -> Any:
    """Key of the voxel so many voxels away."""
    x, y, z = (key >> 42) + i, (key >> 21) + j, key + k
    return ((x & MASK) << 42) | ((y & MASK) << 21) | (z & MASK)


@njit(cache=True, nogil=True, inline="always")
def signed(part: Any) -> Any:
    """A coordinate of 21 bits as a number."""
    part = part & MASK
    return part - (MASK + 1) if part > MASK >> 1 else part


@njit(cache=True, nogil=True, inline="always")
def middle_of(key: Any, edge_m: float) -> Any:
    """Middle of a voxel: three numbers."""
    return (
        (signed(key >> 42) + 0.5) * edge_m,
        (signed(key >> 21) + 0.5) * edge_m,
        (signed(key) + 0.5) * edge_m,
    )


@njit(cache=True, nogil=True)
def _fill_table(keys: Any, used: int, table: Any) -> None:
    mask = len(table) - 1
    for v in range(used):
        slot = spread(keys[v]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = v


@njit(cache=True, nogil=True)
def _find(xyz: Any, edge_m: float, table: Any, keys: Any, out: Any) -> None:
    per_m = 1.0 / edge_m
    for n in range(len(xyz)):
        out[n] = find(voxel_key(xyz[n, 0], xyz[n, 1], xyz[n, 2], per_m), table, keys)
