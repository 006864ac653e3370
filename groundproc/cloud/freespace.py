"""Free space: where beams passed, though at another time something was hit there.

A beam says of every voxel up to its echo that it was open. That alone proves little: half of a voxel may be open, and a wire leaves
most beams alone. So a beam counts against a voxel only

- where it passed through the midst of the points there, nearer to their mean than they scatter;
- where it was no farther from the sensor than the farthest beam that was answered there: what is thin is seen from near only;
- where it looked as the beams did that were answered (45 deg): a pane answers straight on, and lets others through;
- where it went on for more than a pulse can blur, and than a grazing beam skims.

Beams of one revolution are one look. The rays are taken from the sensor to the echo, through cubes of 2 m, and where something lies in one
through its voxels: the cost is linear in the length of the beams.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.surroundings import LOOK_MS, Surroundings, Voxels, find, middle_of
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Ints = npt.NDArray[np.int32]

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
"""Cubes of 2 m."""
_FARTHER: Final = 1.05

BEFORE, BETWEEN, AFTER, SAME = range(4)


class Evidence(NamedTuple):
    """What beams passed through each voxel, as kernels take it.

    Attributes
    ----------
    open_looks : ndarray of int32, shape (n, 4)
        Looks through it before it was first hit, between hits, after it was last hit; and those at which it was hit too.
    last_ms, hit_ms : ndarray of int32, shape (n,)
        Time of the last one, and of the last hit.
    """

    open_looks: Ints
    last_ms: Ints
    hit_ms: Ints

    @classmethod
    def none(cls, size: int) -> "Evidence":
        """No beam yet."""
        never = np.full(size, -(1 << 30), np.int32)
        return cls(np.zeros((size, 4), np.int32), never, never.copy())


class _Maps(NamedTuple):
    """The voxels and the cubes that they lie in."""

    table: Ints
    voxels: Voxels
    edge_m: float
    cube_table: Ints
    cube_keys: Times
    cube_m: float


class _Rays(NamedTuple):
    """Beams: echoes and places of the sensor, shape (n, 3), times since the begin, incidences, voxels of the echoes, shape (n,)."""

    xyz_m: Array
    origin_m: Array
    time_ms: Times
    incidence_deg: npt.NDArray[np.float32]
    voxel: Ints


def look_along(
    around: Surroundings,
    evidence: Evidence,
    xyz_m: Array,
    origins_m: Array,
    time_ns: Times,
    incidence_deg: npt.NDArray[np.float32],
    voxel: Ints,
) -> None:
    """Add what the beams of points, shape (n, 3), that lie in voxels, shape (n,), say of all voxels; in the order of time."""
    cubes = around.levels[_LEVEL]
    maps = _Maps(around.table, around.voxels, around.edge_m, cubes.table, cubes.voxels.key, cubes.edge_m)
    rays = _Rays(xyz_m, origins_m, around.elapsed_ms(time_ns), incidence_deg, voxel)
    _look(rays, maps, evidence)


@njit(cache=True, nogil=True)
def _look(rays: _Rays, maps: _Maps, evidence: Evidence) -> None:
    unit = np.empty(3)
    for n in range(len(rays.xyz_m)):
        _note_hit(evidence, rays.voxel[n], rays.time_ms[n])
        if n % EVERY:
            continue
        square = 0.0
        for a in range(3):
            unit[a] = rays.xyz_m[n, a] - rays.origin_m[n, a]
            square += unit[a] * unit[a]
        length = np.sqrt(square)
        if length < BEGIN_M + BEYOND_M:
            continue
        for a in range(3):
            unit[a] /= length
        slant = np.float64(rays.incidence_deg[n])
        cosine = 0.2 if np.isnan(slant) else max(np.cos(np.deg2rad(slant)), 0.02)
        end = length - max(BEYOND_M, SKIMS_M / cosine)
        if end > BEGIN_M:
            _through_cubes(rays.origin_m[n], unit, end, rays.time_ms[n], maps, evidence)


@njit(cache=True, nogil=True, inline="always")
def _next_wall(place: float, way: float, edge_m: float) -> Any:
    """How far along the ray the next wall of a grid is, on one axis, and from wall to wall."""
    if abs(way) < 1e-9:
        return np.inf, np.inf
    cell = np.floor(place / edge_m)
    wall = (cell + 1.0 if way > 0.0 else cell) * edge_m
    return (wall - place) / way, edge_m / abs(way)


@njit(cache=True, nogil=True)
def _through_cubes(origin: Any, unit: Any, end: float, now_ms: int, maps: _Maps, evidence: Evidence) -> None:
    """Go along a ray from cube to cube (Amanatides and Woo 1987), and through the voxels of those that hold something."""
    x, y, z = (origin[0] + BEGIN_M * unit[0], origin[1] + BEGIN_M * unit[1], origin[2] + BEGIN_M * unit[2])
    next_x, step_x = _next_wall(x, unit[0], maps.cube_m)
    next_y, step_y = _next_wall(y, unit[1], maps.cube_m)
    next_z, step_z = _next_wall(z, unit[2], maps.cube_m)
    at, far = 0.0, end - BEGIN_M
    while at < far:
        out = min(next_x, next_y, next_z, far)
        middle = 0.5 * (at + out)
        key = voxel_key(x + middle * unit[0], y + middle * unit[1], z + middle * unit[2], 1.0 / maps.cube_m)
        if find(key, maps.cube_table, maps.cube_keys) >= 0:
            _through_voxels(origin, unit, BEGIN_M + at, BEGIN_M + out, now_ms, maps, evidence)
        at = out
        if next_x <= out:
            next_x += step_x
        if next_y <= out:
            next_y += step_y
        if next_z <= out:
            next_z += step_z


@njit(cache=True, nogil=True)
def _through_voxels(
    origin: Any, unit: Any, begin: float, end: float, now_ms: int, maps: _Maps, evidence: Evidence
) -> None:
    x, y, z = (origin[0] + begin * unit[0], origin[1] + begin * unit[1], origin[2] + begin * unit[2])
    next_x, step_x = _next_wall(x, unit[0], maps.edge_m)
    next_y, step_y = _next_wall(y, unit[1], maps.edge_m)
    next_z, step_z = _next_wall(z, unit[2], maps.edge_m)
    at, far = 0.0, end - begin
    while at < far:
        out = min(next_x, next_y, next_z, far)
        middle = 0.5 * (at + out)
        key = voxel_key(x + middle * unit[0], y + middle * unit[1], z + middle * unit[2], 1.0 / maps.edge_m)
        v = find(key, maps.table, maps.voxels.key)
        if v >= 0 and now_ms - evidence.last_ms[v] >= LOOK_MS and _contradicts(origin, unit, maps, v):
            _note(maps.voxels, evidence, v, now_ms)
        at = out
        if next_x <= out:
            next_x += step_x
        if next_y <= out:
            next_y += step_y
        if next_z <= out:
            next_z += step_z


@njit(cache=True, nogil=True, inline="always")
def _note_hit(evidence: Evidence, v: Any, now_ms: Any) -> None:
    """A hit: if there was a look through the voxel just now, that was of something that hides only a part of it."""
    if now_ms - evidence.hit_ms[v] >= LOOK_MS and now_ms - evidence.last_ms[v] < LOOK_MS:
        evidence.open_looks[v, SAME] += 1
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
    evidence.open_looks[v, when] += 1
    evidence.last_ms[v] = now_ms


@njit(cache=True, nogil=True, inline="always")
def _contradicts(origin: Any, unit: Any, maps: _Maps, v: int) -> Any:
    """Whether a beam that passes a voxel says that what was hit there is not there."""
    s, seen = maps.voxels.sums[v], maps.voxels.seen[v]
    alike = unit[0] * seen[0] + unit[1] * seen[1] + unit[2] * seen[2]
    length = np.sqrt(seen[0] * seen[0] + seen[1] * seen[1] + seen[2] * seen[2])
    if alike < _ALIKE * length:
        return False
    n = s[0]
    mx, my, mz = s[1] / n, s[2] / n, s[3] / n
    cx, cy, cz = middle_of(maps.voxels.key[v], maps.edge_m)
    wx, wy, wz = cx + mx - origin[0], cy + my - origin[1], cz + mz - origin[2]
    along = wx * unit[0] + wy * unit[1] + wz * unit[2]
    if along > _FARTHER * maps.voxels.farthest_m[v]:
        return False
    dx, dy, dz = wx - along * unit[0], wy - along * unit[1], wz - along * unit[2]
    square = dx * dx + dy * dy + dz * dz
    if square < _NOISE_M2:
        return True
    inverse = 1.0 / np.sqrt(square)
    dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
    spread = (
        dx * (dx * (s[4] / n - mx * mx) + 2.0 * dy * (s[5] / n - mx * my) + 2.0 * dz * (s[6] / n - mx * mz))
        + dy * (dy * (s[7] / n - my * my) + 2.0 * dz * (s[8] / n - my * mz))
        + dz * dz * (s[9] / n - mz * mz)
    )
    return square < max(spread, 0.0) + _NOISE_M2
