"""What lies around each point: the points of a stretch of flight in voxels, with their moments, and the plane that each voxel lies in.

A voxel's plane is that of the cube of a metre around it, or of half a metre, or its own: the first that is flat and passes through its
points. Beside an edge it is that of a flat neighbour; where points are sparse that of the cube of four metres. What no plane fits has
none: leaves, wires, single points.
"""

import functools
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.voxels import MASK, VoxelMap, Voxels, beside, find, middle_of, place_of, signed
from groundproc.machine.readahead import InOrder
from groundproc.numerics.planes import flattest

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Ints = npt.NDArray[np.int32]
Single = npt.NDArray[np.float32]

EDGE_M: Final = 0.25
_FIRST: Final = (2, 1)
_LAST: Final = (3, 4)
"""Levels of larger voxels, each of twice the edge of the one before, that are asked for a plane, in this order: before the voxel itself and
its neighbours are, and after them."""
MOST: Final = 2_000_000
"""Voxels of a stretch of flight: some 440 MB while their planes are found."""
_PIECE: Final = 1 << 19
"""Room for those of the piece that is one too many; there is more where it takes more."""
_SOME: Final = 1 << 16
"""Points, or voxels, between which the table may grow."""
LOOK_MS: Final = 50
"""Shots of one voxel within so long are one look: they are of one revolution, and err together."""
MOST_POINTS: Final = 4096
"""Points of a voxel that its moments are made of: a hover adds nothing more."""
_FLAT_M: Final = 0.03
_FLAT_SHARE: Final = 0.03
"""RMS off the plane of what counts as flat: the sensor's noise and that of a path that knows where it is, and so much of the edge."""
_FEWEST: Final = 6
_SLOPE: Final = 0.04
"""Points of a plane; and how well they must tell its slope [rad], one sigma."""
_NEAR_M: Final = 0.05
"""How far off a plane the points of a voxel may lie that it is said of."""


class Level(NamedTuple):
    """Voxels of a larger edge, and in which of them each small one is: ndarray of int32, shape (used,)."""

    cubes: VoxelMap
    parent: Ints


class Surroundings(VoxelMap):
    """The voxels of a stretch of flight.

    Parameters
    ----------
    edge_m : float

    Attributes
    ----------
    levels : dict of int to Level
        The larger ones that are asked for, by level, when the planes are found: level k has 2^k times the edge.
    """

    def __init__(self, edge_m: float = EDGE_M) -> None:
        super().__init__(edge_m, MOST + _PIECE)
        self.begin_ns: int | None = None
        self.levels: dict[int, Level] = {}
        self._beside = InOrder()

    @property
    def full(self) -> bool:
        """Whether the stretch of flight is to end here."""
        return self.used > MOST

    def add(self, xyz_m: Array, time_ns: Times, origins_m: Array) -> Ints:
        """Take points, shape (n, 3), with their times and the places of the sensor; gives the voxel of each, as `of` does, shape (n,).

        Their voxels are found here, and their sums taken by a thread beside, in their order; `settle` waits for it.
        """
        if self.begin_ns is None:
            self.begin_ns = int(time_ns[0])
        elapsed_ms = self.elapsed_ms(time_ns)
        self.settle()  # points of one piece wait, and no more
        voxels = np.empty(len(xyz_m), np.int32)
        for begin in range(0, len(xyz_m), _SOME):
            some = slice(begin, begin + _SOME)
            if self.used + _SOME > len(self.voxels.key):
                self.settle()  # the sums are about to be copied
            self.make_room(len(xyz_m[some]))
            self.used = int(_number(xyz_m[some], self.edge_m, self.table, self.voxels.key, self.used, voxels[some]))
            seen = xyz_m[some], elapsed_ms[some], origins_m[some]
            self._beside.do(functools.partial(_add, *seen, voxels[some], self.edge_m, self.voxels))
        return voxels

    def settle(self) -> None:
        """Wait until all points that were given are in the sums."""
        self._beside.wait()

    def elapsed_ms(self, time_ns: Times) -> Times:
        """Times since the begin of the stretch."""
        return np.asarray((time_ns - (self.begin_ns or 0)) // 1_000_000)

    def find_planes(self) -> None:
        """Find the plane of each voxel: all points are there."""
        self.settle()
        levels = {1: self._larger(self, None)}
        levels[2] = self._larger(*levels[1])
        for each in (self, levels[1].cubes, levels[2].cubes):
            _planes(each.voxels, each.used, each.edge_m)
        found = np.zeros((self.used, 3), np.float32)
        for number in _FIRST:
            self._take(levels[number], found)
        del levels[1]  # nothing else asks for it, and the others take its memory
        self._take(Level(self, np.arange(self.used, dtype=np.int32)), found)
        self.voxels.normal[: self.used] = found
        del found
        _borrow(self.table, self.voxels, self.used, self.edge_m)
        for number in _LAST:
            levels[number] = self._larger(*levels[number - 1])
            cubes = levels[number].cubes
            _planes(cubes.voxels, cubes.used, cubes.edge_m)
            self._take(levels[number], self.voxels.normal[: self.used])
        self.levels = levels

    def incidence_deg(self, xyz_m: Array, origins_m: Array, voxel: Ints) -> Single:
        """Angle between beam and normal of each point, shape (n,); not-a-number without a plane."""
        out = np.empty(len(xyz_m), np.float32)
        _incidence(xyz_m, origins_m, voxel, self.voxels.normal, out)
        return out

    def keep_planes_only(self) -> None:
        """Give back what only classes are made of."""
        self.levels = {}
        self.voxels = self.voxels.with_planes_only()

    @staticmethod
    def _larger(below: VoxelMap, parent: Ints | None) -> Level:
        """The voxels of twice the edge; and in which of them each of the smallest is, by what it is in below them."""
        larger = VoxelMap(2.0 * below.edge_m, below.used)
        above = np.empty(below.used, np.int32)
        for begin in range(0, below.used, _SOME):
            some = begin, min(begin + _SOME, below.used)
            larger.make_room(min(some[1] - begin, below.used - larger.used))
            larger.used = int(_join(below.voxels, below.edge_m, some, larger.table, larger.voxels, larger.used, above))
        return Level(larger, above if parent is None else above[parent])

    def _take(self, level: Level, normal: Single) -> None:
        """Give voxels without a plane, in `normal`, shape (used, 3), that of the voxel they are in, if it passes through their points."""
        cubes = level.cubes
        _take(self.voxels, self.edge_m, level.parent, cubes.voxels, cubes.edge_m, normal)


@njit(cache=True, nogil=True)
def _number(xyz: Any, edge_m: float, table: Any, keys: Any, used: int, voxel: Any) -> int:
    """Say which voxel each point is in, new ones among them; gives how many there are. Cache misses of one run beside those of others."""
    per_m = 1.0 / edge_m
    for n in range(len(xyz)):
        i, j, k = np.floor(xyz[n, 0] * per_m), np.floor(xyz[n, 1] * per_m), np.floor(xyz[n, 2] * per_m)
        key = ((np.int64(i) & MASK) << 42) | ((np.int64(j) & MASK) << 21) | (np.int64(k) & MASK)
        v = place_of(key, table, keys, used)
        if v == used:
            used += 1
        voxel[n] = v
    return used


@njit(cache=True, nogil=True)
def _add(xyz: Any, time_ms: Any, origin: Any, voxel: Any, edge_m: float, voxels: Voxels) -> None:
    """Add points to the sums of their voxels."""
    many, sums, when = voxels.many, voxels.sums, voxels.when_ms
    per_m = 1.0 / edge_m
    for n in range(len(xyz)):
        i, j, k = np.floor(xyz[n, 0] * per_m), np.floor(xyz[n, 1] * per_m), np.floor(xyz[n, 2] * per_m)
        v = voxel[n]
        if many[v] == 0:
            when[v, 0], when[v, 1] = time_ms[n], time_ms[n] - LOOK_MS
        many[v] += 1
        if time_ms[n] - when[v, 1] >= LOOK_MS:
            voxels.looks[v] += 1
        when[v, 1] = time_ms[n]
        if many[v] <= MOST_POINTS:
            a, b, c = xyz[n, 0] - origin[n, 0], xyz[n, 1] - origin[n, 1], xyz[n, 2] - origin[n, 2]
            square = a * a + b * b + c * c
            inverse = 1.0 / np.sqrt(max(square, 1e-12))
            voxels.farthest_m[v] = max(voxels.farthest_m[v], square * inverse)
            voxels.seen[v, 0] += a * inverse
            voxels.seen[v, 1] += b * inverse
            voxels.seen[v, 2] += c * inverse
            x = np.float32(xyz[n, 0] - (i + 0.5) * edge_m)
            y = np.float32(xyz[n, 1] - (j + 0.5) * edge_m)
            z = np.float32(xyz[n, 2] - (k + 0.5) * edge_m)
            s = sums[v]
            s[0] += 1.0
            s[1] += x
            s[2] += y
            s[3] += z
            s[4] += x * x
            s[5] += x * y
            s[6] += x * z
            s[7] += y * y
            s[8] += y * z
            s[9] += z * z


@njit(cache=True, nogil=True, inline="always")
def _add_moved(total: Any, s: Any, x: float, y: float, z: float) -> None:
    """Add sums whose middle lies (x, y, z) away to others, shape (10,)."""
    n = s[0]
    total[0] += n
    total[1] += s[1] + n * x
    total[2] += s[2] + n * y
    total[3] += s[3] + n * z
    total[4] += s[4] + 2.0 * x * s[1] + n * x * x
    total[5] += s[5] + x * s[2] + y * s[1] + n * x * y
    total[6] += s[6] + x * s[3] + z * s[1] + n * x * z
    total[7] += s[7] + 2.0 * y * s[2] + n * y * y
    total[8] += s[8] + y * s[3] + z * s[2] + n * y * z
    total[9] += s[9] + 2.0 * z * s[3] + n * z * z


@njit(cache=True, nogil=True)
def _join(voxels: Voxels, edge_m: float, some: Any, table: Any, larger: Voxels, found: int, parent: Any) -> int:
    """Add the sums of some small voxels, begin and end, to those of twice the edge, say which each is in; gives how many there are."""
    for v in range(some[0], some[1]):
        key = voxels.key[v]
        i, j, k = signed(key >> 42) >> 1, signed(key >> 21) >> 1, signed(key) >> 1
        above = ((i & MASK) << 42) | ((j & MASK) << 21) | (k & MASK)
        w = place_of(above, table, larger.key, found)
        if w == found:
            found += 1
        parent[v] = w
        x, y, z = middle_of(key, edge_m)
        a, b, c = middle_of(above, 2.0 * edge_m)
        _add_moved(larger.sums[w], voxels.sums[v], x - a, y - b, z - c)
        larger.many[w] += voxels.many[v]
    return found


@njit(cache=True, nogil=True, inline="always")
def _fit(s: Any, most_m: float, edge_m: float, normal: Any) -> Any:
    """Whether sums are of something flat; `normal` takes its normal."""
    n = s[0]
    x, y, z = s[1] / n, s[2] / n, s[3] / n
    low, middle = flattest(
        s[4] / n - x * x,
        s[5] / n - x * y,
        s[6] / n - x * z,
        s[7] / n - y * y,
        s[8] / n - y * z,
        s[9] / n - z * z,
        normal,
    )
    return low < most_m * most_m and low < min(_SLOPE * _SLOPE * n, 0.1) * middle and middle > (0.12 * edge_m) ** 2


@njit(cache=True, nogil=True)
def _planes(voxels: Voxels, used: int, edge_m: float) -> None:
    """Find the normal of the voxels that are flat."""
    normal = np.empty(3)
    for v in range(used):
        s = voxels.sums[v]
        good = s[0] >= _FEWEST and _fit(s, _FLAT_M + _FLAT_SHARE * edge_m, edge_m, normal)
        for a in range(3):
            voxels.normal[v, a] = normal[a] if good else 0.0


@njit(cache=True, nogil=True, inline="always")
def has_plane(normal: Any, v: int) -> Any:
    """Whether a normal was found."""
    return normal[v, 0] != 0.0 or normal[v, 1] != 0.0 or normal[v, 2] != 0.0


@njit(cache=True, nogil=True, inline="always")
def off_plane(voxels: Voxels, v: int, edge_m: float, others: Voxels, w: int, others_edge_m: float) -> Any:
    """How far the mean of a voxel is off the plane of another, perhaps larger one [m]."""
    x, y, z = middle_of(voxels.key[v], edge_m)
    a, b, c = middle_of(others.key[w], others_edge_m)
    s, t, n = voxels.sums[v], others.sums[w], others.normal[w]
    away = n[0] * (x - a + s[1] / s[0] - t[1] / t[0])
    away += n[1] * (y - b + s[2] / s[0] - t[2] / t[0])
    away += n[2] * (z - c + s[3] / s[0] - t[3] / t[0])
    return abs(away)


@njit(cache=True, nogil=True)
def _take(voxels: Voxels, edge_m: float, parent: Any, larger: Voxels, larger_edge_m: float, normal: Any) -> None:
    """Give voxels without a plane that of the voxel they are in, if it passes through their points; fills `normal`, shape (used, 3)."""
    for v in range(len(parent)):
        w = parent[v]
        if has_plane(normal, v) or not has_plane(larger.normal, w):
            continue
        if off_plane(voxels, v, edge_m, larger, w, larger_edge_m) < _NEAR_M:
            for a in range(3):
                normal[v, a] = larger.normal[w, a]


@njit(cache=True, nogil=True)
def _borrow(table: Any, voxels: Voxels, used: int, edge_m: float) -> None:
    """Give voxels without a plane that of the neighbour which passes nearest to their mean."""
    keys, normal = voxels.key, voxels.normal
    chosen = np.full(used, -1, np.int32)
    for v in range(used):
        if has_plane(normal, v):
            continue
        least = _NEAR_M
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    w = find(beside(keys[v], i, j, k), table, keys)
                    if w >= 0 and has_plane(normal, w):
                        off = off_plane(voxels, v, edge_m, voxels, w, edge_m)
                        if off < least:
                            least, chosen[v] = off, w
    for v in range(used):
        if chosen[v] >= 0:
            normal[v] = normal[chosen[v]]


@njit(cache=True, nogil=True, inline="always")
def slant_deg(xyz: Any, origin: Any, n: Any, normal: Any, v: Any) -> Any:
    """Angle between the beam of point n and the normal of its voxel v, in single precision; not-a-number without a plane."""
    if v < 0 or not has_plane(normal, v):
        return np.float32(np.nan)
    square, along = 0.0, 0.0
    for a in range(3):
        way = xyz[n, a] - origin[n, a]
        square += way * way
        along += way * normal[v, a]
    return np.float32(np.rad2deg(np.arccos(min(abs(along) / np.sqrt(max(square, 1e-12)), 1.0))))


@njit(cache=True, nogil=True)
def _incidence(xyz: Any, origin: Any, voxel: Any, normal: Any, out: Any) -> None:
    for n in range(len(xyz)):
        out[n] = slant_deg(xyz, origin, n, normal, voxel[n])
