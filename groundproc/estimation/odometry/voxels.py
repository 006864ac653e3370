"""A map of planes: second moments of the returns in each voxel of a hash that grows."""

import contextlib
import tempfile
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.parts import at_once
from groundproc.numerics.planes import add_scatter, flattest_of
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Table = npt.NDArray[np.int32]
Keys = npt.NDArray[np.int64]

COUNT, MEAN, SCATTER, NORMAL, LEVEL, FLATNESS, TILT, LONGEST, SPREAD = 0, 1, 4, 10, 13, 14, 15, 16, 19
"""Columns of a voxel: returns; their mean (3); scatter about it (6); normal, or the axis of the least spread (3); its distance from the
origin; variance along it, negative where it is no plane; variance of the normal's direction. Of what fills its voxel, as leaves do: the
axis of the largest spread (3), and the variances along the least, the middle and the largest axis (3), 0 for all others."""
COLUMNS: Final = 22
LEAST_FLATNESS_M2: Final = 1e-4
"""Returns of one ring share errors: a plane's deviation is taken to be 1 cm at least where its tilt is judged."""

FEWEST: Final = 12
"""Returns that make a plane."""
MOST_RETURNS: Final = 400.0
"""Returns that count for the direction of a normal, at most."""
FLATTEST_M: Final = 0.05
"""Deviation from a plane beyond which a voxel is none, one sigma [m]."""
NARROWEST: Final = 0.16
"""Least width of the returns across the plane's narrow side, one sigma, in voxels: a single ring on the ground is no plane."""

FEWEST_SCATTERED: Final = 20
"""Returns that tell how something fills a voxel."""
LEAST_SPREAD_M: Final = 0.06
"""Spread along every axis, one sigma, from which on that is what a voxel holds: rings on the ground are lines, and move with the sensor."""


class MapArrays(NamedTuple):
    """A `PlaneMap` as kernels take it.

    Attributes
    ----------
    table : ndarray of int32, shape (a power of two,)
        Rows of the voxels by the hashes of their keys; -1: none.
    keys : ndarray of int64, shape (rows,)
    voxels : ndarray, shape (rows, COLUMNS)
    voxel_m : float
    """

    table: Table
    keys: Keys
    voxels: Array
    voxel_m: float


class PlaneMap:
    """Voxels, found by their keys.

    Parameters
    ----------
    voxel_m : float
    """

    def __init__(self, voxel_m: float) -> None:
        self.voxel_m = voxel_m
        self.table = np.full(1 << 17, -1, np.int32)
        self.keys = np.empty(1 << 16, np.int64)
        self.voxels = np.zeros((1 << 16, COLUMNS))
        self.count = 0

    def insert(self, world_m: Array, clusters: npt.NDArray[np.void], most: float, judged: bool = True) -> None:
        """Add clusters whose means lie at `world_m`, shape (m, 3); a voxel forgets beyond `most` returns.

        Where they are not `judged`, what the voxels hold by then is not looked at: `judge` does so when all are in.
        """
        if self.count + len(world_m) > len(self.keys) or 2 * (self.count + len(world_m)) > len(self.table):
            self._grow()
        self.count = _insert(self.arrays, self.count, world_m, clusters["scatter"], clusters["count"], (most, judged))

    def judge(self) -> None:
        """Find planes, and what fills its voxel instead, in all voxels."""

        def some(part: int) -> None:
            _judge_all(self.voxels, part * self.count // 2, (part + 1) * self.count // 2, self.voxel_m)

        at_once(some, 2)

    @property
    def arrays(self) -> MapArrays:
        """What the kernels take."""
        return MapArrays(self.table, self.keys, self.voxels, self.voxel_m)

    def forget_beyond(self, centre_m: Array, distance_m: float) -> None:
        """Drop what lies farther away than a distance: bounds the memory of a long flight."""
        rows = self.voxels[: self.count]
        kept = np.square(rows[:, MEAN : MEAN + 3] - centre_m).sum(axis=1) < distance_m**2
        count = int(kept.sum())
        self.keys[:count], self.voxels[:count] = self.keys[: self.count][kept], rows[kept]
        self.count = count
        self._index()

    @contextlib.contextmanager
    def set_aside(self) -> Iterator[None]:
        """Have the voxels, a hundred megabytes, in a file while nobody asks for them; where a file has no room, they stay."""
        count, rows = self.count, len(self.voxels)
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(tempfile.TemporaryFile())
                file.write(self.voxels[:count].data)
                file.seek(0)
            except OSError:
                yield
                return
            self.voxels = np.empty((0, COLUMNS))
            try:
                yield
            finally:
                self.voxels = np.empty((rows, COLUMNS))
                file.readinto(self.voxels[:count].data)

    def _grow(self) -> None:
        self.keys = np.concatenate([self.keys, np.empty_like(self.keys)])
        voxels = np.empty((2 * len(self.voxels), COLUMNS))  # what is not written takes no memory yet
        voxels[: self.count] = self.voxels[: self.count]
        self.voxels = voxels
        self.table = np.empty(2 * len(self.table), np.int32)
        self._index()

    def _index(self) -> None:
        self.table[:] = -1
        _index(self.table, self.keys, self.count)


@njit(cache=True, nogil=True)
def _index(table: Table, keys: Keys, count: int) -> None:
    mask = len(table) - 1
    for row in range(count):
        slot = spread(keys[row]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = row


@njit(cache=True, nogil=True, inline="always")
def find(table: Table, keys: Keys, key: int) -> Any:
    """Row of a voxel, -1 where there is none."""
    mask = len(table) - 1
    slot = spread(key) & mask
    while table[slot] >= 0:
        if keys[table[slot]] == key:
            return table[slot]
        slot = (slot + 1) & mask
    return -1


@njit(cache=True, nogil=True)
def _insert(
    planes: MapArrays, count: int, world: Array, scatter: npt.NDArray[np.float32], counts: npt.NDArray[np.int32],
    how: tuple[float, bool],
) -> int:  # fmt: skip
    """`how`: returns that a voxel remembers, and whether it is judged."""
    table, keys, voxels, voxel_m = planes
    most, judged = how
    mask, per_m = len(table) - 1, 1.0 / voxel_m
    normal, longest = np.empty(3), np.empty(3)
    for n in range(len(world)):
        key = voxel_key(world[n, 0], world[n, 1], world[n, 2], per_m)
        slot = spread(key) & mask
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & mask
        row = table[slot]
        if row < 0:
            row = count
            table[slot], keys[row] = row, key
            voxels[row] = 0.0
            count += 1
        v = voxels[row]
        before = v[COUNT]
        if before > most:
            for c in range(SCATTER, SCATTER + 6):
                v[c] *= most / before
            before = most
        added = np.float64(counts[n])
        total = before + added
        dx, dy, dz = world[n, 0] - v[MEAN], world[n, 1] - v[MEAN + 1], world[n, 2] - v[MEAN + 2]
        share = added / total
        weight = before * share
        v[COUNT] = total
        v[MEAN] += share * dx
        v[MEAN + 1] += share * dy
        v[MEAN + 2] += share * dz
        add_scatter(v[SCATTER : SCATTER + 6], 1.0, scatter[n], weight, (dx, dy, dz))
        if judged:
            _judge(v, voxel_m, normal, longest)
    return count


@njit(cache=True, nogil=True)
def _judge_all(voxels: Array, begin: int, end: int, voxel_m: float) -> None:
    normal, longest = np.empty(3), np.empty(3)
    for row in range(begin, end):
        _judge(voxels[row], voxel_m, normal, longest)


@njit(cache=True, nogil=True)
def _judge(v: Array, voxel_m: float, normal: Array, longest: Array) -> None:
    """Find what a voxel holds, from its moments; working memory (3,), (3,)."""
    total = v[COUNT]
    v[FLATNESS], v[SPREAD] = -1.0, 0.0
    if total < FEWEST:
        return
    s = 1.0 / total
    low, middle = flattest_of(v[SCATTER : SCATTER + 6], s, normal)
    if low < FLATTEST_M**2 and middle > (NARROWEST * voxel_m) ** 2 and low < 0.2 * middle:
        v[NORMAL], v[NORMAL + 1], v[NORMAL + 2] = normal[0], normal[1], normal[2]
        v[LEVEL] = normal[0] * v[MEAN] + normal[1] * v[MEAN + 1] + normal[2] * v[MEAN + 2]
        v[FLATNESS] = max(low, 0.0)
        v[TILT] = max(low, LEAST_FLATNESS_M2) / (0.25 * min(total, MOST_RETURNS) * middle)
    elif low > LEAST_SPREAD_M**2 and total >= FEWEST_SCATTERED:
        largest, _ = flattest_of(v[SCATTER : SCATTER + 6], -s, longest)
        for c in range(3):
            v[NORMAL + c], v[LONGEST + c] = normal[c], longest[c]
        v[SPREAD], v[SPREAD + 1], v[SPREAD + 2] = low, middle, -largest
