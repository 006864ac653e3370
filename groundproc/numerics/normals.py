"""Normals of a cloud's surfaces, each with its sigma: the widest patch around a point that is still as flat as its narrowest.

A normal from few neighbours is noise: 2 cm of range noise over 10 cm is 10 degrees. A normal from many runs over edges. So planes are
fitted to cubes of several sizes, by the second moments of small voxels, which add up. A point takes the plane whose normal is known
best, among those nearby that it lies on and that are not rougher than the smoothest of them: beside an edge, that is a plane of its own
side. A point in leaves lies on none.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.planes import flattest
from groundproc.numerics.voxelhash import around, numbered, row_by_row, table_for

Array = npt.NDArray[np.float64]

EDGES_M: Final = (0.15, 0.3, 0.6, 1.2, 2.4)
"""Edges of voxels; a plane is fitted to 3 x 3 x 3 of them."""
HALO_M: Final = 4.0 * EDGES_M[-1]
"""How far from a point others may decide on its normal."""
_CELL_M: Final = 1.0
"""Of the ground; points are sorted by it, so that neighbours lie near each other in memory."""
FEWEST: Final = 12
"""Points of a plane."""
_ON: Final = 3.0
"""A point within so many times the roughness lies on a plane."""
_SURE: Final = 2.5
"""Sigmas of the roughness by which a plane may seem rougher than the smoothest."""
_LEAST_M: Final = 0.001
"""Roughness below that of stored coordinates is none."""
_FLAT: Final = 0.15
"""Largest share of the middle by the least second moment."""


class Normals(NamedTuple):
    """Of each point; not a number where it lies on no surface.

    Attributes
    ----------
    normal : ndarray, shape (n, 3)
        Unit vectors of either sign.
    sigma_rad : ndarray, shape (n,)
        Of the tilt about the less known axis.
    roughness_m : ndarray, shape (n,)
        Scatter of the patch about its plane.
    off_m : ndarray, shape (n,)
        Of the point from the plane, along the normal.
    """

    normal: Array
    sigma_rad: Array
    roughness_m: Array
    off_m: Array


class _Level(NamedTuple):
    voxel: npt.NDArray[np.int32]
    near: npt.NDArray[np.int32]
    normal: Array
    mean: Array
    rough: Array
    held: Array
    sigma: Array


def normals(
    xyz_m: Array, edges_m: tuple[float, ...] = EDGES_M, of: npt.NDArray[np.int64] | slice = slice(None)
) -> Normals:
    """Normals of the points of a piece of a cloud.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    edges_m : tuple of float
        Edges of the voxels of each level, ascending.
    of : ndarray of int64, shape (m,), or slice
        Points whose normals are asked for; all of them make the planes.

    Returns
    -------
    Normals
        Of m points.
    """
    if not len(xyz_m):
        return Normals(np.empty((0, 3)), *(np.empty(0) for _ in range(3)))
    order = row_by_row(xyz_m, _CELL_M)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    place = place[of]
    back = np.argsort(place)
    rows = place[back]
    local = xyz_m.take(order, axis=0)
    local -= np.floor(local.min(axis=0))
    levels = [_level(local, edge) for edge in edges_m]
    levels = [level._replace(voxel=level.voxel[rows]) for level in levels]
    asked = local[rows]
    found = Normals(np.full((len(asked), 3), np.nan), *(np.full(len(asked), np.nan) for _ in range(3)))
    limit = np.full(len(asked), np.inf)
    for level in levels:
        _limits(asked, level, limit)
    for level in levels:
        _choose(asked, level, limit, found)
    return Normals(*(_put_back(each, back) for each in found))


def _put_back(values: Array, back: npt.NDArray[np.int64]) -> Array:
    out = np.empty_like(values)
    out[back] = values
    return out


def _level(xyz_m: Array, edge_m: float) -> _Level:
    table = table_for(2 * len(xyz_m))
    voxel, keys, voxels = numbered(xyz_m, 1.0 / edge_m, table)
    moments = np.zeros((voxels, 10))
    _gather(xyz_m, voxel, moments)
    near = np.full((voxels, 27), -1, np.int32)
    _neighbours(keys[:voxels], table, near)
    level = _Level(
        voxel, near, np.empty((voxels, 3)), np.empty((voxels, 3)), np.full(voxels, np.inf), np.zeros(voxels),
        np.full(voxels, np.inf),
    )  # fmt: skip
    _fit(moments, level)
    return level


@njit(cache=True, nogil=True)
def _gather(xyz: Any, voxel: Any, moments: Any) -> None:
    """Number, mean and second moments about it of the points of each voxel (Welford 1962)."""
    for i in range(len(xyz)):
        m = moments[voxel[i]]
        m[0] += 1.0
        dx, dy, dz = xyz[i, 0] - m[1], xyz[i, 1] - m[2], xyz[i, 2] - m[3]
        m[1] += dx / m[0]
        m[2] += dy / m[0]
        m[3] += dz / m[0]
        share = (m[0] - 1.0) / m[0]
        m[4] += share * dx * dx
        m[5] += share * dx * dy
        m[6] += share * dx * dz
        m[7] += share * dy * dy
        m[8] += share * dy * dz
        m[9] += share * dz * dz


@njit(cache=True, nogil=True)
def _neighbours(keys: Any, table: Any, near: Any) -> None:
    """Numbers of the 27 voxels at and around each; -1: holds no point."""
    for v in range(len(keys)):
        around(keys, table, v, near[v])


@njit(cache=True, nogil=True)
def _fit(moments: Any, level: Any) -> None:
    """The plane of each 3 x 3 x 3 voxels, where there is one."""
    s, normal = np.empty(6), np.empty(3)
    for v in range(len(moments)):
        n, x, y, z = 0.0, 0.0, 0.0, 0.0
        for k in range(27):
            w = level.near[v, k]
            if w >= 0:
                m = moments[w]
                n, x, y, z = n + m[0], x + m[0] * m[1], y + m[0] * m[2], z + m[0] * m[3]
        level.mean[v, 0], level.mean[v, 1], level.mean[v, 2] = x / n, y / n, z / n
        if n < FEWEST:
            continue
        s[:] = 0.0
        for k in range(27):
            w = level.near[v, k]
            if w >= 0:
                m = moments[w]
                a, b, c = m[1] - x / n, m[2] - y / n, m[3] - z / n
                s[0] += m[4] + m[0] * a * a
                s[1] += m[5] + m[0] * a * b
                s[2] += m[6] + m[0] * a * c
                s[3] += m[7] + m[0] * b * b
                s[4] += m[8] + m[0] * b * c
                s[5] += m[9] + m[0] * c * c
        low, middle = flattest(s[0], s[1], s[2], s[3], s[4], s[5], normal)
        low = max(low, 0.0)
        if low > _FLAT * middle:
            continue
        level.normal[v] = normal
        level.rough[v] = max(np.sqrt(low / (n - 3.0)), _LEAST_M)
        level.held[v] = n
        level.sigma[v] = level.rough[v] / np.sqrt(middle)


@njit(cache=True, nogil=True, inline="always")
def _off(xyz: Any, i: int, level: Any, v: int) -> Any:
    """Distance of a point from a plane in its roughness."""
    n, m = level.normal[v], level.mean[v]
    return abs(n[0] * (xyz[i, 0] - m[0]) + n[1] * (xyz[i, 1] - m[1]) + n[2] * (xyz[i, 2] - m[2])) / level.rough[v]


@njit(cache=True, nogil=True)
def _limits(xyz: Any, level: Any, limit: Any) -> None:
    """The least upper bound of the roughness of a plane that each point lies on."""
    for i in range(len(xyz)):
        v = level.voxel[i]
        for k in range(27):
            w = level.near[v, k]
            if w >= 0 and level.held[w] > 0.0:
                bound = level.rough[w] * (1.0 + _SURE / np.sqrt(2.0 * level.held[w]))
                if bound < limit[i] and _off(xyz, i, level, w) <= _ON:
                    limit[i] = bound


@njit(cache=True, nogil=True)
def _choose(xyz: Any, level: Any, limit: Any, found: Any) -> None:
    """The plane of a level that tells each point's normal best, where it is better than what was found."""
    for i in range(len(xyz)):
        v, best, least = level.voxel[i], -1, found.sigma_rad[i]
        for k in range(27):
            w = level.near[v, k]
            if w < 0 or level.held[w] == 0.0 or level.rough[w] > limit[i] + _LEAST_M:
                continue
            if level.sigma[w] >= least or _off(xyz, i, level, w) > _ON:  # nothing is less than NaN, nor not less
                continue
            best, least = w, level.sigma[w]
        if best >= 0:
            n, m = level.normal[best], level.mean[best]
            found.normal[i] = n
            found.sigma_rad[i], found.roughness_m[i] = level.sigma[best], level.rough[best]
            found.off_m[i] = n[0] * (xyz[i, 0] - m[0]) + n[1] * (xyz[i, 1] - m[1]) + n[2] * (xyz[i, 2] - m[2])
