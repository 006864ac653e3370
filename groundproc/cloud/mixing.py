"""Echoes that are mixed of two surfaces: a point lies between two surfaces that its beam meets within the length of a pulse.

The voxels beside each step of the beam are asked for their planes. Most have none, so voxels with a plane are bits of cubes of 2 m: an
empty row costs no look-up.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.surroundings import Surroundings, has_plane
from groundproc.cloud.voxels import MASK, Voxels, find, middle_of, place_of, signed

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]

REACH_M: Final = 0.6
"""Surfaces nearer to each other than this give one echo, in between (FOI-R--4045--SE, appendix B)."""
OFF_M: Final = 0.05
"""A mixed echo lies so far from both."""
_SLOTS: Final = 2
"""Of the table, for each cube, at least."""


class _Planes(NamedTuple):
    """The voxels with a plane, as kernels take them.

    Attributes
    ----------
    table, voxels, edge_m
        Of the surroundings.
    cube_table : ndarray of int32, shape (2^k,)
    cube_keys : ndarray of int64, shape (cubes,)
        Of the cubes of eight voxels along a side that hold one.
    bits : ndarray of uint8, shape (cubes, 8, 8)
        By a voxel's place within its cube on the first and the second axis: a bit for each on the third.
    """

    table: Ints
    voxels: Voxels
    edge_m: float
    cube_table: Ints
    cube_keys: npt.NDArray[np.int64]
    bits: npt.NDArray[np.uint8]


class Mixing:
    """Tells mixed echoes of a stretch of flight whose planes are known.

    Parameters
    ----------
    around : Surroundings
    """

    def __init__(self, around: Surroundings) -> None:
        keys = around.voxels.key[: around.used]
        flat = keys[(around.voxels.normal[: around.used] != 0.0).any(axis=1)]
        slots = 1 << int(np.ceil(np.log2(max(_SLOTS * len(flat), 2))))
        table, cubes = np.full(slots, -1, np.int32), np.empty(len(flat), np.int64)
        cube = np.empty(len(flat), np.int32)
        used = int(_cubes(flat, table, cubes, cube))
        bits = np.zeros((used, 8, 8), np.uint8)
        _mark(flat, cube, bits)
        self._planes = _Planes(around.table, around.voxels, around.edge_m, table, cubes[:used].copy(), bits)

    def of(self, xyz_m: Array, origins_m: Array, voxel: Ints) -> Bytes:
        """1 where a point is mixed, shape (n,), by points and places of the sensor, shape (n, 3), and the voxels of the points."""
        out = np.zeros(len(xyz_m), np.uint8)
        _mixed(xyz_m, origins_m, voxel, self._planes, out)
        return out


@njit(cache=True, nogil=True)
def _cubes(keys: Any, table: Any, cubes: Any, cube: Any) -> int:
    """Number the cubes of voxels by their keys; gives how many there are."""
    used = 0
    for n in range(len(keys)):
        key = keys[n]
        i, j, k = signed(key >> 42) >> 3, signed(key >> 21) >> 3, signed(key) >> 3
        w = place_of(((i & MASK) << 42) | ((j & MASK) << 21) | (k & MASK), table, cubes, used)
        if w == used:
            used += 1
        cube[n] = w
    return used


@njit(cache=True, nogil=True)
def _mark(keys: Any, cube: Any, bits: Any) -> None:
    for n in range(len(keys)):
        i, j, k = (keys[n] >> 42) & 7, (keys[n] >> 21) & 7, keys[n] & 7
        bits[cube[n], i, j] |= np.uint8(1 << k)


@njit(cache=True, nogil=True, inline="always")
def _along_to_plane(voxels: Voxels, w: int, edge_m: float, ray: Any) -> Any:
    """Distance along a ray, six numbers, to the plane of a voxel.

    Numbers, and no rows of arrays: for each row that it takes numba counts a reference, at three times the cost of the rest.
    """
    ox, oy, oz, ux, uy, uz = ray
    cx, cy, cz = middle_of(voxels.key[w], edge_m)
    s, n = voxels.sums, voxels.normal
    slope = n[w, 0] * ux + n[w, 1] * uy + n[w, 2] * uz
    if abs(slope) < 0.05:
        return -1.0
    top = n[w, 0] * (cx + s[w, 1] / s[w, 0] - ox)
    top += n[w, 1] * (cy + s[w, 2] / s[w, 0] - oy)
    top += n[w, 2] * (cz + s[w, 3] / s[w, 0] - oz)
    return top / slope


@njit(cache=True, nogil=True)
def _flat_around(i: Any, j: Any, k: Any, planes: _Planes, out: Any) -> Any:
    """Fill in the numbers of the voxels with a plane at and around one, by its place in voxels; gives how many."""
    many = 0
    for a in range((i - 1) >> 3, ((i + 1) >> 3) + 1):
        for b in range((j - 1) >> 3, ((j + 1) >> 3) + 1):
            for c in range((k - 1) >> 3, ((k + 1) >> 3) + 1):
                w = find(((a & MASK) << 42) | ((b & MASK) << 21) | (c & MASK), planes.cube_table, planes.cube_keys)
                if w < 0:
                    continue
                for x in range(max(i - 1, a << 3), min(i + 1, (a << 3) + 7) + 1):
                    for y in range(max(j - 1, b << 3), min(j + 1, (b << 3) + 7) + 1):
                        row = np.int64(planes.bits[w, x & 7, y & 7])
                        if row == 0:
                            continue
                        for z in range(max(k - 1, c << 3), min(k + 1, (c << 3) + 7) + 1):
                            if row >> (z & 7) & 1:
                                key = ((x & MASK) << 42) | ((y & MASK) << 21) | (z & MASK)
                                out[many] = find(key, planes.table, planes.voxels.key)
                                many += 1
    return many


@njit(cache=True, nogil=True)
def _between(ray: Any, length: float, planes: _Planes, neighbours: Any) -> Any:
    """Whether a ray meets a surface before and another behind a length, no farther from each other than a pulse is long.

    A beam is wide, so what is in the voxel beside it counts. `neighbours` is room for 27 numbers.
    """
    ox, oy, oz, ux, uy, uz = ray
    edge_m = planes.edge_m
    per_m = 1.0 / edge_m
    steps = int(np.ceil(REACH_M / edge_m))
    nearer, beyond = -np.inf, np.inf
    for each in range(
        2 * steps + 1
    ):  # from the point outwards: most have a surface through them, which ends the search
        step = (each + 1) // 2 if each % 2 else -(each // 2)
        at = length + step * edge_m
        i = np.int64(np.floor((ox + at * ux) * per_m))
        j = np.int64(np.floor((oy + at * uy) * per_m))
        k = np.int64(np.floor((oz + at * uz) * per_m))
        for n in range(_flat_around(i, j, k, planes, neighbours)):
            met = _along_to_plane(planes.voxels, neighbours[n], edge_m, ray)
            if abs(met - at) > edge_m:
                continue
            if abs(met - length) <= OFF_M:
                return False  # a surface passes through the point
            if met < length:
                nearer = max(nearer, met)
            else:
                beyond = min(beyond, met)
    return beyond - nearer < REACH_M + 2.0 * OFF_M


@njit(cache=True, nogil=True)
def _mixed(xyz: Any, origin: Any, voxel: Any, planes: _Planes, out: Any) -> None:
    voxels, neighbours = planes.voxels, np.empty(27, np.int64)
    for n in range(len(xyz)):
        ox, oy, oz = origin[n, 0], origin[n, 1], origin[n, 2]
        ux, uy, uz = xyz[n, 0] - ox, xyz[n, 1] - oy, xyz[n, 2] - oz
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        if length < REACH_M:
            continue
        ray = ox, oy, oz, ux / length, uy / length, uz / length
        v = voxel[n]
        if has_plane(voxels.normal, v) and abs(_along_to_plane(voxels, v, planes.edge_m, ray) - length) < OFF_M:
            continue
        out[n] = _between(ray, length, planes, neighbours)
