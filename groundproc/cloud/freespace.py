"""Free space: where beams passed, though at another time something was hit there.

A beam says of every voxel up to its echo that it was open. That alone proves little: half of a voxel may be open, and a wire leaves
most beams alone. So a beam counts against a voxel only

- where it passed through the midst of the points there, nearer to their mean than they scatter;
- where it was no farther from the sensor than the farthest beam that was answered there: what is thin is seen from near only;
- where it looked as the beams did that were answered (45 deg): a pane answers straight on, and lets others through;
- where it went on for more than a pulse can blur, and than a grazing beam skims.

Beams of one revolution are one look. The rays are taken from the sensor to the echo, through cubes of 2 m, and where something lies in one
through its voxels: the cost is linear in the length of the beams. Each cube has 512 bits that say which of its voxels hold points, so that
an empty one costs no look-up. Threads share the cubes between them: each goes along all rays, and into its own cubes only. One core is left
to make the next piece of rays: going along them once is cheaper than twice.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.surroundings import LOOK_MS, Surroundings, slant_deg
from groundproc.cloud.voxels import Voxels, find, middle_of, signed
from groundproc.machine.system import cores
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Ints = npt.NDArray[np.int32]
Looks = npt.NDArray[np.int16]

EVERY: Final = 5
"""Of so many shots one is looked along; no multiple of the lasers, so that each has its turn."""
BEGIN_M: Final = 1.0
BEYOND_M: Final = 0.6
"""How far a beam must go on behind what it passed: what two surfaces must be apart to give two echoes (FOI-R--4045--SE, appendix B)."""
SKIMS_M: Final = 0.15
"""A beam that meets a surface at a slant is so near to it before it ends: it must go on by that much more than its foot needs."""
APART_MS: Final = 150
"""A look so near to the first or the last hit tells nothing of before and after."""
_ALIKE: Final = np.cos(np.deg2rad(45.0))
_NOISE_M2: Final = 0.02**2
_LEVEL: Final = 3
"""Cubes of 2 m: 8 voxels along a side."""
_MOST_THREADS: Final = 4
"""More would go along the same rays for too little."""
_FARTHER: Final = 1.05

_MOST_LOOKS: Final = (1 << 15) - 1

BEFORE, BETWEEN, AFTER, SAME = range(4)


class Evidence(NamedTuple):
    """What beams passed through each voxel, as kernels take it.

    Attributes
    ----------
    open_looks : ndarray of int16, shape (n, 4)
        Looks through it before it was first hit, between hits, after it was last hit; and those at which it was hit too. Half an hour of
        looking without end fills it, and more is not counted.
    last_ms, hit_ms : ndarray of int32, shape (n,)
        Time of the last one, and of the last hit.
    """

    open_looks: Looks
    last_ms: Ints
    hit_ms: Ints

    @classmethod
    def none(cls, size: int) -> "Evidence":
        """No beam yet."""
        never = np.full(size, -(1 << 30), np.int32)
        return cls(np.zeros((size, 4), np.int16), never, never.copy())


class _Maps(NamedTuple):
    """The voxels and the cubes that they lie in.

    Attributes
    ----------
    full : ndarray of uint64, shape (cubes, 8)
        A bit for each voxel of a cube that holds points.
    part : ndarray of uint8, shape (voxels,)
        Which thread a voxel belongs to.
    cube_part : ndarray of uint8, shape (cubes,)
    """

    table: Ints
    voxels: Voxels
    edge_m: float
    cube_table: Ints
    cube_keys: Times
    cube_m: float
    full: npt.NDArray[np.uint64]
    part: npt.NDArray[np.uint8]
    cube_part: npt.NDArray[np.uint8]


class _Rays(NamedTuple):
    """Beams: echoes and places of the sensor, shape (n, 3), times since the begin and voxels of the echoes, shape (n,)."""

    xyz_m: Array
    origin_m: Array
    time_ms: Times
    voxel: Ints


class Lookout:
    """Looks along the beams of a stretch of flight whose planes are known.

    Parameters
    ----------
    around : Surroundings

    Attributes
    ----------
    evidence : Evidence
        What was seen so far.
    """

    def __init__(self, around: Surroundings) -> None:
        self._around, self.evidence = around, Evidence.none(around.used)
        self._threads = max(min(cores() - 1, _MOST_THREADS), 1)
        cubes, parent = around.levels[_LEVEL]
        full, cube_part = np.zeros((cubes.used, 8), np.uint64), np.empty(cubes.used, np.uint8)
        part = np.empty(around.used, np.uint8)
        _share(around.voxels.key, parent, cubes.voxels.key, self._threads, full, cube_part, part)
        self._maps = _Maps(
            around.table,
            around.voxels,
            around.edge_m,
            cubes.table,
            cubes.voxels.key,
            cubes.edge_m,
            full,
            part,
            cube_part,
        )

    def look_along(self, xyz_m: Array, origins_m: Array, time_ns: Times, voxel: Ints) -> None:
        """Add what the beams of points, shape (n, 3), that lie in voxels, shape (n,), say of all voxels; in the order of time."""
        rays = _Rays(xyz_m, origins_m, self._around.elapsed_ms(time_ns), voxel)
        if self._threads == 1:
            _look(rays, self._maps, self.evidence, 0)
            return
        with ThreadPoolExecutor(self._threads) as pool:
            for done in [pool.submit(_look, rays, self._maps, self.evidence, each) for each in range(self._threads)]:
                done.result()


@njit(cache=True, nogil=True)
def _share(keys: Any, parent: Any, cube_keys: Any, parts: int, full: Any, cube_part: Any, part: Any) -> None:
    """Fill in which voxels of each cube hold points, and which thread cubes and voxels belong to."""
    for w in range(len(cube_part)):
        cube_part[w] = spread(cube_keys[w]) % parts
    for v in range(len(part)):
        w, bit = parent[v], _bit(keys[v] >> 42, keys[v] >> 21, keys[v])
        full[w, bit >> 6] |= np.uint64(1) << np.uint64(bit & 63)
        part[v] = cube_part[w]


@njit(cache=True, nogil=True, inline="always")
def _bit(i: Any, j: Any, k: Any) -> Any:
    """Number of a voxel within its cube, by its place in voxels."""
    return (i & 7) << 6 | (j & 7) << 3 | (k & 7)


@njit(cache=True, nogil=True, inline="always")
def _key(i: Any, j: Any, k: Any) -> Any:
    """Key of a voxel by its place in voxels."""
    return ((i & 0x1FFFFF) << 42) | ((j & 0x1FFFFF) << 21) | (k & 0x1FFFFF)


@njit(cache=True, nogil=True)
def _look(rays: _Rays, maps: _Maps, evidence: Evidence, part: int) -> None:
    for n in range(len(rays.xyz_m)):
        if maps.part[rays.voxel[n]] == part:
            _note_hit(evidence, rays.voxel[n], rays.time_ms[n])
        if n % EVERY:
            continue
        ox, oy, oz = rays.origin_m[n, 0], rays.origin_m[n, 1], rays.origin_m[n, 2]
        ux, uy, uz = rays.xyz_m[n, 0] - ox, rays.xyz_m[n, 1] - oy, rays.xyz_m[n, 2] - oz
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        if length < BEGIN_M + BEYOND_M:
            continue
        slant = np.float64(slant_deg(rays.xyz_m, rays.origin_m, n, maps.voxels.normal, rays.voxel[n]))
        cosine = 0.2 if np.isnan(slant) else max(np.cos(np.deg2rad(slant)), 0.02)
        end = length - max(BEYOND_M, SKIMS_M / cosine)
        if end > BEGIN_M:
            ray = ox, oy, oz, ux / length, uy / length, uz / length
            _through_cubes(ray, end, rays.time_ms[n], maps, evidence, part)


@njit(cache=True, nogil=True, inline="always")
def _next_wall(place: float, way: float, edge_m: float) -> Any:
    """How far along the ray the next wall of a grid is, on one axis, and from wall to wall."""
    if abs(way) < 1e-9:
        return np.inf, np.inf
    cell = np.floor(place / edge_m)
    wall = (cell + 1.0 if way > 0.0 else cell) * edge_m
    return (wall - place) / way, edge_m / abs(way)


@njit(cache=True, nogil=True, inline="always")
def _through_cubes(ray: Any, end: float, now_ms: int, maps: _Maps, evidence: Evidence, part: int) -> None:
    """Go along a ray from cube to cube (Amanatides and Woo 1987), and through the voxels of those that hold something.

    A ray is six numbers: of a row of an array numba counts references. And what takes many arrays is inlined: numba hands over each.
    """
    ox, oy, oz, ux, uy, uz = ray
    x, y, z = ox + BEGIN_M * ux, oy + BEGIN_M * uy, oz + BEGIN_M * uz
    next_x, step_x = _next_wall(x, ux, maps.cube_m)
    next_y, step_y = _next_wall(y, uy, maps.cube_m)
    next_z, step_z = _next_wall(z, uz, maps.cube_m)
    at, far = 0.0, end - BEGIN_M
    while at < far:
        out = min(next_x, next_y, next_z, far)
        middle = 0.5 * (at + out)
        key = voxel_key(x + middle * ux, y + middle * uy, z + middle * uz, 1.0 / maps.cube_m)
        w = find(key, maps.cube_table, maps.cube_keys)
        if w >= 0 and maps.cube_part[w] == part:
            _through_voxels(ray, (BEGIN_M + at, BEGIN_M + out), now_ms, maps, evidence, w)
        at = out
        if next_x <= out:
            next_x += step_x
        if next_y <= out:
            next_y += step_y
        if next_z <= out:
            next_z += step_z


@njit(cache=True, nogil=True, inline="always")
def _through_voxels(ray: Any, between: Any, now_ms: int, maps: _Maps, evidence: Evidence, cube: int) -> None:
    """Go along a ray from voxel to voxel of one cube."""
    begin, end = between
    ox, oy, oz, ux, uy, uz = ray
    key = maps.cube_keys[cube]
    cube_i, cube_j, cube_k = signed(key >> 42), signed(key >> 21), signed(key)
    per_m = 1.0 / maps.edge_m
    x, y, z = ox + begin * ux, oy + begin * uy, oz + begin * uz
    next_x, step_x = _next_wall(x, ux, maps.edge_m)
    next_y, step_y = _next_wall(y, uy, maps.edge_m)
    next_z, step_z = _next_wall(z, uz, maps.edge_m)
    at, far = 0.0, end - begin
    while at < far:
        out = min(next_x, next_y, next_z, far)
        middle = 0.5 * (at + out)
        i = np.int64(np.floor((x + middle * ux) * per_m))
        j = np.int64(np.floor((y + middle * uy) * per_m))
        k = np.int64(np.floor((z + middle * uz) * per_m))
        bit = _bit(i, j, k)
        # rounding may put a piece of no length into a neighbour, which another thread may have
        inside = i >> 3 == cube_i and j >> 3 == cube_j and k >> 3 == cube_k
        if inside and maps.full[cube, bit >> 6] >> np.uint64(bit & 63) & np.uint64(1):
            v = find(_key(i, j, k), maps.table, maps.voxels.key)
            if now_ms - evidence.last_ms[v] >= LOOK_MS and _contradicts(ray, maps.voxels, maps.edge_m, v):
                _note(maps.voxels, evidence, v, now_ms)
        at = out
        if next_x <= out:
            next_x += step_x
        if next_y <= out:
            next_y += step_y
        if next_z <= out:
            next_z += step_z


@njit(cache=True, nogil=True, inline="always")
def _count(looks: Any, v: Any, when: int) -> None:
    if looks[v, when] < _MOST_LOOKS:
        looks[v, when] += 1


@njit(cache=True, nogil=True, inline="always")
def _note_hit(evidence: Evidence, v: Any, now_ms: Any) -> None:
    """A hit: if there was a look through the voxel just now, that was of something that hides only a part of it."""
    if now_ms - evidence.hit_ms[v] >= LOOK_MS and now_ms - evidence.last_ms[v] < LOOK_MS:
        _count(evidence.open_looks, v, SAME)
    evidence.hit_ms[v] = now_ms


@njit(cache=True, nogil=True, inline="always")
def _note(voxels: Voxels, evidence: Evidence, v: int, now_ms: int) -> None:
    """A look through a voxel."""
    first, last = voxels.when_ms[v, 0], voxels.when_ms[v, 1]
    if now_ms - evidence.hit_ms[v] < LOOK_MS:
        when = SAME
    elif now_ms < first - APART_MS:
        when = BEFORE
    else:
        when = AFTER if now_ms > last + APART_MS else BETWEEN
    _count(evidence.open_looks, v, when)
    evidence.last_ms[v] = now_ms


@njit(cache=True, nogil=True, inline="always")
def _contradicts(ray: Any, voxels: Voxels, edge_m: float, v: Any) -> Any:
    """Whether a beam that passes a voxel says that what was hit there is not there."""
    ox, oy, oz, ux, uy, uz = ray
    seen_x, seen_y, seen_z = voxels.seen[v, 0], voxels.seen[v, 1], voxels.seen[v, 2]
    alike = ux * seen_x + uy * seen_y + uz * seen_z
    length = np.sqrt(seen_x * seen_x + seen_y * seen_y + seen_z * seen_z)
    if alike < _ALIKE * length:
        return False
    s, n = voxels.sums, voxels.sums[v, 0]
    mx, my, mz = s[v, 1] / n, s[v, 2] / n, s[v, 3] / n
    cx, cy, cz = middle_of(voxels.key[v], edge_m)
    wx, wy, wz = cx + mx - ox, cy + my - oy, cz + mz - oz
    along = wx * ux + wy * uy + wz * uz
    if along > _FARTHER * voxels.farthest_m[v]:
        return False
    dx, dy, dz = wx - along * ux, wy - along * uy, wz - along * uz
    square = dx * dx + dy * dy + dz * dz
    if square < _NOISE_M2:
        return True
    inverse = 1.0 / np.sqrt(square)
    dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
    spread = (
        dx * (dx * (s[v, 4] / n - mx * mx) + 2.0 * dy * (s[v, 5] / n - mx * my) + 2.0 * dz * (s[v, 6] / n - mx * mz))
        + dy * (dy * (s[v, 7] / n - my * my) + 2.0 * dz * (s[v, 8] / n - my * mz))
        + dz * dz * (s[v, 9] / n - mz * mz)
    )
    return square < max(spread, 0.0) + _NOISE_M2
