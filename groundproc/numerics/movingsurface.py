"""Moving least squares: where the surface around each point passes it, by robust quadrics at the scale that the points themselves choose.

Around a point the heights of its fellows over its own tangent plane are fitted by a quadric, nearer ones with more weight (Levin 1998),
with bisquare weights by distance from the fit. Only points whose own surface lies alike take part, so nothing is taken from behind an edge
(in the spirit of Oztireli et al. 2009). The radius grows while what it tells agrees with what all smaller radii told, each within its
sigma: the intersection of confidence intervals (Goldenshluger and Nemirovski 1997), which stops where the surface is no quadric any more.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.normals import Normals
from groundproc.numerics.planes import axes_along
from groundproc.numerics.voxelhash import assign, sorted_by, spread

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

RATIO: Final = 1.6
"""From one radius to the next."""
RADII: Final = 4
SMOOTHED, NO_SURFACE, ROUGH, TOO_FEW, TOO_FAR = range(5)
"""What became of a point."""
_PER_VOXEL: Final = 32
"""Points of a voxel that take part, at most: some hundred lie within a radius then, and more would make it slower and not better."""
_FEWEST: Final = 18
"""Points of a quadric: three for each of its six numbers."""
_BISQUARE: Final = 4.685
"""Beyond so many sigmas a point has no weight: 95 % efficient where errors are normal (Beaton and Tukey 1974)."""
_STRANGERS: Final = 0.15
"""Where more of the points around lie on no even surface, as leaves and blades do, those that seem to may be of the same kind."""
_GAMMA: Final = 2.0
"""Half the width of a confidence interval in sigmas."""
_ENOUGH: Final = 0.33
"""A surface known to this share of the noise needs no more points."""
_LEAST_GAIN: Final = 0.7
"""One known no better than this share of the noise is not worth a move."""
_ALIKE_RAD: Final = 0.26
"""By how much the surfaces of two points may differ beyond what their sigmas explain."""
_TURNS: Final = 3
"""Of the fit: with wide weights from the plane, then with those of the quadric."""
_SINGULAR: Final = 1e-9


class Fitted(NamedTuple):
    """Of each point; not a number where `state` is not `SMOOTHED`.

    Attributes
    ----------
    off_m : ndarray, shape (n,)
        Way to the surface along the point's normal.
    sigma_m : ndarray, shape (n,)
        Of the surface there.
    radius_m : ndarray, shape (n,)
        That told it.
    state : ndarray of uint8, shape (n,)
    """

    off_m: Array
    sigma_m: Array
    radius_m: Array
    state: npt.NDArray[np.uint8]


class _Grid(NamedTuple):
    key: Ints
    table: npt.NDArray[np.int32]
    first: Ints
    order: Ints


class _Points(NamedTuple):
    xyz: Array
    normal: Array
    tilt: Array
    off: Array
    even: npt.NDArray[np.bool_]
    noise: float


class _Interval(NamedTuple):
    low: Array
    high: Array
    open: npt.NDArray[np.bool_]


def fitted(xyz_m: Array, lies: Normals, sigma_m: float, roughest_m: float, radius_m: float, wanted: Ints) -> Fitted:
    """Surfaces around some points of a piece of a cloud.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    lies : Normals
        Of these points; one without a normal says nothing of surfaces.
    sigma_m : float
        Noise of the cloud along normals.
    roughest_m : float
        Patches rougher than this are no surface.
    radius_m : float
        The least one.
    wanted : ndarray of int64, shape (k,)
        Points that are asked for.

    Returns
    -------
    Fitted
        Of the points wanted, shape (k,).
    """
    count = len(wanted)
    made = Fitted(
        np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan), np.full(count, TOO_FEW, np.uint8)
    )
    known = np.isfinite(lies.sigma_rad)
    made.state[~known[wanted]] = NO_SURFACE
    made.state[known[wanted] & (lies.roughness_m[wanted] > roughest_m)] = ROUGH
    if not (made.state == TOO_FEW).any():
        return made
    local = np.ascontiguousarray(xyz_m - np.floor(xyz_m.min(axis=0)))
    even = known & (lies.roughness_m <= roughest_m)
    points = _Points(local, lies.normal, lies.sigma_rad, lies.off_m, even, sigma_m)
    still = _Interval(np.full(count, -np.inf), np.full(count, np.inf), made.state == TOO_FEW)
    for step in range(RADII):
        radius = radius_m * RATIO**step
        _grow(points, _grid(local, radius), radius, wanted, still, made)
    return made


def _grid(xyz: Array, edge_m: float) -> _Grid:
    """Points by voxel, of each no more than take part."""
    voxel, voxels = assign(xyz, edge_m)
    order, first = sorted_by(voxel, voxels)
    kept, thin = _thinned(order, first, _PER_VOXEL)
    size = 1 << int(np.ceil(np.log2(max(4 * voxels, 1 << 8))))
    key, table = np.empty(voxels, np.int64), np.full(size, -1, np.int32)
    _enter(xyz, order, first, 1.0 / edge_m, key, table)
    return _Grid(key, table, thin, kept)


@njit(cache=True, nogil=True)
def _thinned(order: Any, first: Any, most: int) -> Any:
    """Of each voxel so many points that its number is at most `most`: those that come first by a hash of their number."""
    kept, thin, at = np.empty(len(order), np.int64), np.empty(len(first), np.int64), 0
    for v in range(len(first) - 1):
        thin[v] = at
        held = first[v + 1] - first[v]
        share = np.int64(min(1.0, most / max(held, 1)) * 2147483648.0)
        for k in range(first[v], first[v + 1]):
            if spread(order[k] * 2654435761 + 1) < share and at - thin[v] < most:
                kept[at] = order[k]
                at += 1
    thin[len(first) - 1] = at
    return kept[:at], thin


@njit(cache=True, nogil=True, inline="always")
def _key(i: Any, j: Any, k: Any) -> Any:
    return ((i & 0x1FFFFF) << 42) | ((j & 0x1FFFFF) << 21) | (k & 0x1FFFFF)


@njit(cache=True, nogil=True)
def _enter(xyz: Any, order: Any, first: Any, per_m: float, key: Any, table: Any) -> None:
    mask = len(table) - 1
    for v in range(len(key)):
        p = xyz[order[first[v]]]
        key[v] = _key(
            np.int64(np.floor(p[0] * per_m)), np.int64(np.floor(p[1] * per_m)), np.int64(np.floor(p[2] * per_m))
        )
        slot = spread(key[v]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = v


@njit(cache=True, nogil=True)
def _grow(points: Any, grid: Any, radius: float, wanted: Any, still: Any, made: Any) -> None:
    """Fit with one radius more where the smaller ones left it open."""
    near, fit = np.empty((27 * _PER_VOXEL, 4)), np.empty(2)
    for row in range(len(wanted)):
        if not still.open[row]:
            continue
        i = wanted[row]
        held, rough = _around(points, grid, i, radius, near)
        if rough > _STRANGERS * (held + rough):
            still.open[row] = False
            if made.state[row] == TOO_FEW:
                made.state[row] = ROUGH
            continue
        if held < _FEWEST or not _quadric(near[:held], points.noise, -points.off[i], fit):
            continue
        sigma = fit[1]
        low, high = max(still.low[row], fit[0] - _GAMMA * sigma), min(still.high[row], fit[0] + _GAMMA * sigma)
        if low > high:  # what more points say is another surface
            still.open[row] = False
            continue
        still.low[row], still.high[row] = low, high
        if sigma <= _LEAST_GAIN * points.noise:
            made.off_m[row], made.sigma_m[row], made.radius_m[row] = fit[0], sigma, radius
            made.state[row] = SMOOTHED
        still.open[row] = sigma > _ENOUGH * points.noise


@njit(cache=True, nogil=True)
def _around(points: Any, grid: Any, i: int, radius: float, near: Any) -> Any:
    """Places of the fellows of a point on its tangent plane in radii, their heights over it [m], and the weight of their nearness.

    Gives how many there are, and how many points beside them lie on no even surface.
    """
    p, n = points.xyz[i], points.normal[i]
    ax, ay, az, bx, by, bz = axes_along(n[0], n[1], n[2])
    per_m, mask, held, rough = 1.0 / radius, len(grid.table) - 1, 0, 0
    x, y, z = np.int64(np.floor(p[0] * per_m)), np.int64(np.floor(p[1] * per_m)), np.int64(np.floor(p[2] * per_m))
    tallest = 2.0 * _BISQUARE * points.noise
    for cell in range(27):
        key = _key(x + cell // 9 - 1, y + cell // 3 % 3 - 1, z + cell % 3 - 1)
        slot = spread(key) & mask
        while grid.table[slot] >= 0 and grid.key[grid.table[slot]] != key:
            slot = (slot + 1) & mask
        v = grid.table[slot]
        if v < 0:
            continue
        for k in range(grid.first[v], grid.first[v + 1]):
            j = grid.order[k]
            dx, dy, dz = points.xyz[j, 0] - p[0], points.xyz[j, 1] - p[1], points.xyz[j, 2] - p[2]
            up = dx * n[0] + dy * n[1] + dz * n[2]
            if abs(up + points.off[i]) > tallest:
                continue
            u, w = (dx * ax + dy * ay + dz * az) * per_m, (dx * bx + dy * by + dz * bz) * per_m
            square = u * u + w * w
            if square >= 1.0:
                continue
            if not points.even[j]:
                rough += 1
                continue
            m = points.normal[j]
            cosine = min(abs(m[0] * n[0] + m[1] * n[1] + m[2] * n[2]), 1.0)
            alike = _ALIKE_RAD + 2.0 * np.sqrt(points.tilt[i] ** 2 + points.tilt[j] ** 2)
            if cosine > np.cos(min(alike, 1.5)):
                near[held, 0], near[held, 1], near[held, 2], near[held, 3] = u, w, up, (1.0 - square) ** 2
                held += 1
    return held, rough


@njit(cache=True, nogil=True)
def _quadric(near: Any, noise: float, begin: float, fit: Any) -> bool:
    """Height of the robust quadric at the point, and its sigma; False: these points hold none."""
    surface = (begin, 0.0, 0.0, 0.0, 0.0, 0.0)
    matrix, right = np.empty((6, 6)), np.empty(6)
    for turn in range(_TURNS):
        _gathered(near, surface, _BISQUARE * noise * (2.0 if turn == 0 else 1.0), matrix, right)
        if not _factorised(matrix):
            return False
        _solve(matrix, right)
        surface = (right[0], right[1], right[2], right[3], right[4], right[5])
    # what the height at the point makes of the errors of the heights around: the weights once more
    right[:] = 0.0
    right[0] = 1.0
    _solve(matrix, right)
    inverse = (right[0], right[1], right[2], right[3], right[4], right[5])
    gain, square, total, held = 0.0, 0.0, 0.0, 0
    for k in range(len(near)):
        u, w = near[k, 0], near[k, 1]
        off = near[k, 2] - _height(surface, u, w)
        weight = _weight(near[k, 3], off, _BISQUARE * noise)
        if weight > 0.0:
            gain += (weight * _height(inverse, u, w)) ** 2
            square += weight * off * off
            total += weight
            held += 1
    if held < _FEWEST:
        return False
    scatter = np.sqrt(square / total * held / (held - 6.0))
    fit[0], fit[1] = surface[0], np.sqrt(gain) * max(scatter, noise)
    return True


@njit(cache=True, nogil=True, inline="always")
def _height(surface: Any, u: float, w: float) -> Any:
    return surface[0] + surface[1] * u + surface[2] * w + surface[3] * u * u + surface[4] * u * w + surface[5] * w * w


@njit(cache=True, nogil=True, inline="always")
def _weight(nearness: float, off: float, reach: float) -> Any:
    """Weight of a fellow by nearness and by its distance from the surface."""
    share = 1.0 - (off / reach) ** 2
    return nearness * share * share if share > 0.0 else 0.0


@njit(cache=True, nogil=True, fastmath=True)
def _gathered(near: Any, surface: Any, reach: float, matrix: Any, right: Any) -> None:
    """Normal equations of the quadric, lower half: sums of the powers of both coordinates up to the fourth, and of these with heights."""
    s00 = s10 = s01 = s20 = s11 = s02 = s30 = s21 = s12 = s03 = s40 = s31 = s22 = s13 = s04 = 0.0
    r0 = r1 = r2 = r3 = r4 = r5 = 0.0
    for k in range(len(near)):
        u, w, up = near[k, 0], near[k, 1], near[k, 2]
        weight = _weight(near[k, 3], up - _height(surface, u, w), reach)
        uu, uw, ww = u * u, u * w, w * w
        a, b, c = weight * uu, weight * uw, weight * ww
        s00, s10, s01 = s00 + weight, s10 + weight * u, s01 + weight * w
        s20, s11, s02 = s20 + a, s11 + b, s02 + c
        s30, s21, s12, s03 = s30 + a * u, s21 + a * w, s12 + b * w, s03 + c * w
        s40, s31, s22, s13, s04 = s40 + a * uu, s31 + a * uw, s22 + a * ww, s13 + b * ww, s04 + c * ww
        r0, r1, r2 = r0 + weight * up, r1 + weight * u * up, r2 + weight * w * up
        r3, r4, r5 = r3 + a * up, r4 + b * up, r5 + c * up
    matrix[0, 0] = s00
    matrix[1, 0], matrix[1, 1] = s10, s20
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = s01, s11, s02
    matrix[3, 0], matrix[3, 1], matrix[3, 2], matrix[3, 3] = s20, s30, s21, s40
    matrix[4, 0], matrix[4, 1], matrix[4, 2], matrix[4, 3], matrix[4, 4] = s11, s21, s12, s31, s22
    matrix[5, 0], matrix[5, 1], matrix[5, 2], matrix[5, 3] = s02, s12, s03, s22
    matrix[5, 4], matrix[5, 5] = s13, s04
    right[0], right[1], right[2], right[3], right[4], right[5] = r0, r1, r2, r3, r4, r5


@njit(cache=True, nogil=True)
def _factorised(matrix: Any) -> bool:
    """Cholesky's factor in place of the lower half; False: near singular."""
    for a in range(6):
        whole = matrix[a, a]
        for b in range(a):
            whole -= matrix[a, b] ** 2
        if not whole > _SINGULAR * max(matrix[0, 0], 1e-12):
            return False
        matrix[a, a] = np.sqrt(whole)
        for c in range(a + 1, 6):
            part = matrix[c, a]
            for b in range(a):
                part -= matrix[c, b] * matrix[a, b]
            matrix[c, a] = part / matrix[a, a]
    return True


@njit(cache=True, nogil=True)
def _solve(factor: Any, right: Any) -> None:
    """Solve in place by Cholesky's factor."""
    for a in range(6):
        for b in range(a):
            right[a] -= factor[a, b] * right[b]
        right[a] /= factor[a, a]
    for a in range(5, -1, -1):
        for b in range(a + 1, 6):
            right[a] -= factor[b, a] * right[b]
        right[a] /= factor[a, a]
