"""Distances of clusters from the planes of their voxels, as rows for the adjustment.

Unlike within one flight, strips may lie decimetres apart to begin with. So a plane's direction and flatness come from the scatter within
each strip, pooled: strips that do not lie on each other yet do not make a surface thick.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.estimation.observations.planes import CUT, HUBER, TILT_PRIOR, Rows
from groundproc.numerics.rotations import flattest
from groundproc.numerics.voxelhash import voxel_key
from groundproc.strips.correction import Correction

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NOISE_M: Final = 0.03
"""Noise of a point before the scatter of the clusters tells, one sigma [m]; counts as much as four points."""
ROUGHNESS_M: Final = 0.01
"""Roughness of surfaces before their residuals tell, one sigma of a cluster [m]."""
CONTROL: Final = -2
"""Strip of a control point."""
MOST_INTERVALS_SEEN: Final = 24
"""Intervals between knots from which one voxel is taken to be seen, at most."""
_ROW_CAP: Final = 20.0
"""Points of a cluster that count for the direction of a plane, at most: a stop over one place must not outweigh a pass."""


@dataclass(slots=True)
class Bordered:
    """Rows, and what they say about constants.

    Attributes
    ----------
    rows : Rows
        By the splines.
    constants : ndarray, shape (n, m)
        Columns of the constants.
    projected : ndarray, shape (n, m)
        The same, weighted, with the planes taken out.
    names : dict of str to slice
    deflation : float
    """

    rows: Rows
    constants: Array
    projected: Array
    names: dict[str, slice]

    def normal(self) -> Array:
        """Lower triangle of the normal matrix of splines and constants, planes taken out, shape (path + m, path + m)."""
        rows = self.rows
        size, wide = (rows.intervals + 3) * 6, self.constants.shape[1]
        out = np.zeros((size + wide, size + wide))
        _normal(rows.first, rows.knot, rows.weights, rows.jacobian, rows.plane, rows.weight, rows.inverse, out)
        for k in range(wide):
            out[size + k, :size] = replace(rows, residual_m=self.constants[:, k]).gradient()
        out[size:, size:] = self.constants.T @ self.projected
        return out

    def right(self, value: Array) -> Array:
        """Half a gradient for distances, shape (n,), by splines and constants."""
        by_splines = replace(self.rows, residual_m=value).gradient()
        return np.concatenate([by_splines, self.projected.T @ value])


def bordered(
    clusters: npt.NDArray[np.void], correction: Correction, voxel_m: float, roughness_m: float, cut: bool, constants: list[str],
    control_sigma_m: Array,
) -> Bordered | None:  # fmt: skip
    """Put clusters into voxels where the correction places them, find the planes, and linearise; None where there is no plane.

    Parameters
    ----------
    clusters : ndarray of clusters.CLUSTER
    correction : Correction
    voxel_m : float
    roughness_m : float
        What surfaces may depart from planes in such voxels, one sigma.
    cut : bool
        Whether what lies far off its plane is dropped.
    constants : list of str
        Names of the constants that are unknown: "boresight_rad", "lever_m", "shift_m".
    control_sigma_m : ndarray, shape (n,)
        Of control points; 0 for clusters.
    """
    time_ns, quat = np.ascontiguousarray(clusters["time_ns"]), clusters["quat"].astype(np.float64)
    move, arm = correction.moved(time_ns, clusters["arm"].astype(np.float64), quat)
    fixed = control_sigma_m > 0
    move[fixed] = 0.0
    world = clusters["place"] + move
    knot, weights = correction.located(time_ns)
    order, first = _by_voxel(world, voxel_m)
    strip, count = np.ascontiguousarray(clusters["strip"]), np.ascontiguousarray(clusters["count"])
    scatter = np.ascontiguousarray(clusters["scatter"])
    normals, means = np.empty((len(first) - 1, 3)), np.empty((len(first) - 1, 3))
    good = np.zeros(len(first) - 1, np.bool_)
    _planes(first, order, world, scatter, count, strip, knot, voxel_m, normals, means, good)
    if not good.any():
        return None
    size = np.diff(first)
    kept = order[np.repeat(good, size)]
    starts = np.concatenate([[0], np.cumsum(size[good])]).astype(np.int64)
    kept, starts = _thinned(starts, kept, knot, strip)
    n = len(kept)
    jacobian, plane = np.empty((n, 6), np.float32), np.empty((n, 2), np.float32)
    weight, residual, inverse = np.empty(n), np.empty(n), np.empty((len(starts) - 1, 6))
    _linearise(
        starts, kept, world, arm, scatter, count, control_sigma_m, normals[good], means[good], voxel_m, roughness_m, cut,
        jacobian, plane, weight, residual, inverse,
    )  # fmt: skip
    rows = Rows(
        starts, knot[kept], weights[kept], jacobian, plane, weight, residual, inverse, kept, correction.intervals
    )
    return _with_constants(rows, quat[kept], constants)


def _with_constants(rows: Rows, quat: Array, constants: list[str]) -> Bordered:
    mats = frames.mat_from_quat(quat).astype(np.float32)
    columns: list[Array] = []
    names: dict[str, slice] = {}
    for name in constants:
        part = rows.jacobian[:, :3] if name == "boresight_rad" else rows.jacobian[:, 3:]
        names[name] = slice(3 * len(columns), 3 * len(columns) + 3)
        columns.append(part.astype(np.float64) if name == "shift_m" else np.einsum("ni,nij->nj", part, mats))
    together = np.concatenate(columns, axis=1).astype(np.float64) if columns else np.zeros((len(rows), 0))
    return Bordered(rows, together, _projected(rows, together), names)


def _projected(rows: Rows, value: Array) -> Array:
    """Weighted values, shape (n, m), with the best plane of each voxel taken out."""
    first, size = rows.first[:-1], np.diff(rows.first)
    base = np.stack([np.ones(len(rows)), rows.plane[:, 0], rows.plane[:, 1]], axis=1)
    out = np.empty_like(value)
    q = rows.inverse
    mats = np.stack([q[:, 0], q[:, 1], q[:, 2], q[:, 1], q[:, 3], q[:, 4], q[:, 2], q[:, 4], q[:, 5]], axis=1)
    for k in range(value.shape[1]):
        weighted = rows.weight * value[:, k]
        sums = np.add.reduceat(weighted[:, None] * base, first)
        best = np.einsum("nij,nj->ni", mats.reshape(-1, 3, 3), sums)
        out[:, k] = rows.weight * (value[:, k] - np.einsum("ni,ni->n", base, np.repeat(best, size, axis=0)))
    return out


def _by_voxel(world: Array, voxel_m: float) -> tuple[Ints, Ints]:
    """Order of the clusters by voxel, those of a voxel in order of time, and where each voxel begins."""
    keys = np.empty(len(world), np.int64)
    _voxels(world, voxel_m, keys)
    order = np.argsort(keys, kind="stable")
    new = np.flatnonzero(np.diff(keys[order])) + 1
    return order, np.concatenate([[0], new, [len(order)]]).astype(np.int64)


@njit(cache=True, nogil=True)
def _voxels(world: Any, voxel_m: float, keys: Any) -> None:
    for n in range(len(world)):
        keys[n] = voxel_key(world[n, 0], world[n, 1], world[n, 2], 1.0 / voxel_m)


@njit(cache=True, nogil=True)
def _planes(
    first: Any, order: Any, world: Any, scatter: Any, counts: Any, strip: Any, knot: Any, voxel_m: float, normals: Any, means: Any,
    good: Any,
) -> None:  # fmt: skip
    """Plane of each voxel that has one and is seen at two times or more: mean, normal."""
    s = np.empty(6)
    for v in range(len(first) - 1):
        if first[v + 1] - first[v] < 3:
            continue
        s[:] = 0.0
        whole, x, y, z = 0.0, 0.0, 0.0, 0.0
        low_knot, high_knot = 1 << 30, -1
        at = first[v]
        while at < first[v + 1]:
            # clusters are in order of time, so those of a strip follow each other
            end = at
            total, a, b, c = 0.0, 0.0, 0.0, 0.0
            while end < first[v + 1] and strip[order[end]] == strip[order[at]]:
                n = order[end]
                w = min(np.float64(counts[n]), _ROW_CAP)
                total += w
                a += w * world[n, 0]
                b += w * world[n, 1]
                c += w * world[n, 2]
                low_knot, high_knot = min(low_knot, knot[n]), max(high_knot, knot[n])
                end += 1
            whole, x, y, z = whole + total, x + a, y + b, z + c
            a, b, c = a / total, b / total, c / total
            for k in range(at, end):
                n = order[k]
                w = min(np.float64(counts[n]), _ROW_CAP)
                inside = w / counts[n]
                dx, dy, dz = world[n, 0] - a, world[n, 1] - b, world[n, 2] - c
                s[0] += inside * scatter[n, 0] + w * dx * dx
                s[1] += inside * scatter[n, 1] + w * dx * dy
                s[2] += inside * scatter[n, 2] + w * dx * dz
                s[3] += inside * scatter[n, 3] + w * dy * dy
                s[4] += inside * scatter[n, 4] + w * dy * dz
                s[5] += inside * scatter[n, 5] + w * dz * dz
            at = end
        if whole < 12.0 or high_knot == low_knot:
            continue
        s /= whole
        low, middle = flattest(s[0], s[1], s[2], s[3], s[4], s[5], normals[v])
        means[v, 0], means[v, 1], means[v, 2] = x / whole, y / whole, z / whole
        good[v] = low < (0.04 + 0.02 * voxel_m) ** 2 and middle > (0.12 * voxel_m) ** 2 and low < 0.15 * middle


@njit(cache=True, nogil=True)
def _thinned(first: Any, rows: Any, knot: Any, strip: Any) -> Any:
    """Rows of at most `MOST_INTERVALS_SEEN` intervals of each voxel, evenly chosen: a hover sees the same voxels all the time.

    Control points are kept, in whatever interval they stand.
    """
    out, starts, count = np.empty(len(rows), np.int64), np.empty(len(first), np.int64), 0
    for v in range(len(first) - 1):
        starts[v] = count
        distinct = 0
        for i in range(first[v], first[v + 1]):
            distinct += i == first[v] or knot[rows[i]] != knot[rows[i - 1]]
        stride, number = (distinct + MOST_INTERVALS_SEEN - 1) // MOST_INTERVALS_SEEN, -1
        for i in range(first[v], first[v + 1]):
            number += i == first[v] or knot[rows[i]] != knot[rows[i - 1]]
            if (number + v) % stride == 0 or strip[rows[i]] == CONTROL:
                out[count] = rows[i]
                count += 1
    starts[-1] = count
    return out[:count], starts


@njit(cache=True, nogil=True)
def _normal(
    first: Any, knot: Any, weights: Any, jacobian: Any, plane: Any, weight: Any, inverse: Any, out: Any
) -> None:
    """Lower triangle of the normal matrix of the splines: that for known planes, less what finding the planes costs."""
    most = 4 * (MOST_INTERVALS_SEEN + 1)
    coefficients, sums = np.empty(most, np.int64), np.empty((most, 6, 3))
    for v in range(len(first) - 1):
        used = 0
        for i in range(first[v], first[v + 1]):
            k = np.int64(knot[i])
            # rows are in order of time: what this interval adds to the coefficients comes last
            new = k if used == 0 else max(coefficients[used - 1] + 1, k)
            for one in range(new, k + 4):
                coefficients[used] = one
                sums[used] = 0.0
                used += 1
            at = used - 1
            while coefficients[at] != k:
                at -= 1
            _add_row(weights[i], jacobian[i], plane[i], weight[i], sums[at : at + 4], out[6 * k : 6 * k + 24, 6 * k :])
        _take_planes(coefficients[:used], sums, inverse[v], out)


@njit(cache=True, nogil=True)
def _add_row(weights: Any, jacobian: Any, plane: Any, weight: float, sums: Any, out: Any) -> None:
    """Add a row's products with itself, below the diagonal, and with the plane's three columns."""
    for j in range(4):
        for c in range(6):
            value = weight * weights[j] * jacobian[c]
            sums[j, c, 0] += value
            sums[j, c, 1] += value * plane[0]
            sums[j, c, 2] += value * plane[1]
            for m in range(j + 1):
                for d in range(6):
                    out[6 * j + c, 6 * m + d] += value * weights[m] * jacobian[d]


@njit(cache=True, nogil=True)
def _take_planes(coefficients: Any, sums: Any, q: Any, out: Any) -> None:
    """Take off what finding a voxel's plane costs."""
    for one in range(len(coefficients)):
        for c in range(6):
            s = sums[one, c]
            x = q[0] * s[0] + q[1] * s[1] + q[2] * s[2]
            y = q[1] * s[0] + q[3] * s[1] + q[4] * s[2]
            z = q[2] * s[0] + q[4] * s[1] + q[5] * s[2]
            here = out[coefficients[one] * 6 + c]
            for other in range(one + 1):
                place = coefficients[other] * 6
                for d in range(6):
                    t = sums[other, d]
                    here[place + d] -= x * t[0] + y * t[1] + z * t[2]


@njit(cache=True, nogil=True)
def _linearise(
    first: Any, rows: Any, world: Any, arm: Any, scatter: Any, counts: Any, control: Any, normals: Any, means: Any, voxel_m: float,
    roughness_m: float, cut: bool, jacobian: Any, plane: Any, weight: Any, residual: Any, inverse: Any,
) -> None:  # fmt: skip
    variance = np.empty(len(rows))
    for v in range(len(first) - 1):
        nx, ny, nz = normals[v]
        # any two directions along the plane
        if abs(nz) < 0.9:
            length = np.sqrt(nx * nx + ny * ny)
            ax, ay, az = -ny / length, nx / length, 0.0
        else:
            length = np.sqrt(ny * ny + nz * nz)
            ax, ay, az = 0.0, nz / length, -ny / length
        bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        across, spare = 4.0 * NOISE_M**2, 4.0
        for i in range(first[v], first[v + 1]):
            n = rows[i]
            dx, dy, dz = world[n, 0] - means[v, 0], world[n, 1] - means[v, 1], world[n, 2] - means[v, 2]
            residual[i] = nx * dx + ny * dy + nz * dz
            plane[i, 0] = (ax * dx + ay * dy + az * dz) / voxel_m
            plane[i, 1] = (bx * dx + by * dy + bz * dz) / voxel_m
            x, y, z = arm[n, 0], arm[n, 1], arm[n, 2]
            moves = 0.0 if control[n] > 0.0 else 1.0
            jacobian[i, 0], jacobian[i, 1] = moves * (y * nz - z * ny), moves * (z * nx - x * nz)
            jacobian[i, 2] = moves * (x * ny - y * nx)
            jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = moves * nx, moves * ny, moves * nz
            t = scatter[n]
            across += (
                nx * (t[0] * nx + 2 * t[1] * ny + 2 * t[2] * nz) + ny * (t[3] * ny + 2 * t[4] * nz) + nz * t[5] * nz
            )
            spare += counts[n] - 1
        noise = across / spare
        for i in range(first[v], first[v + 1]):
            n = rows[i]
            variance[i] = control[n] ** 2 if control[n] > 0.0 else noise / counts[n]
        here = slice(first[v], first[v + 1])
        _weigh(plane[here], variance[here], residual[here], roughness_m**2, cut, voxel_m, weight[here], inverse[v])


@njit(cache=True, nogil=True)
def _weigh(
    plane: Any, variance: Any, residual: Any, rough: float, cut: bool, voxel_m: float, weight: Any, inverse: Any
) -> None:
    """Weights of a voxel's rows: by noise, by what the residuals show beyond it, and less where they are far off."""
    count = len(residual)
    least, d, a, b = 0.25 * rough, 0.0, 0.0, 0.0
    for attempt in range(3):
        for i in range(count):
            weight[i] = 1.0 / (variance[i] + rough)
            ratio = abs(residual[i] - d - a * plane[i, 0] - b * plane[i, 1]) * np.sqrt(weight[i])
            if cut and attempt == 2 and ratio > CUT:
                weight[i] = 0.0
            elif attempt > 0 and ratio > HUBER:
                weight[i] *= HUBER / ratio
        d, a, b = _plane(plane, weight, residual, voxel_m, inverse)
        if attempt == 0:
            squares = 16.0 * least
            for i in range(count):
                off = residual[i] - d - a * plane[i, 0] - b * plane[i, 1]
                squares += min(off * off, 25.0 * (variance[i] + rough)) - variance[i]
            rough = max(squares / (max(count - 3, 0) + 4.0), least)


@njit(cache=True, nogil=True)
def _plane(plane: Any, weight: Any, residual: Any, voxel_m: float, inverse: Any) -> Any:
    """Offset and tilts of the best plane; `inverse` takes the inverse of its normal matrix."""
    prior = (voxel_m * TILT_PRIOR) ** -2.0
    n00, n01, n02, n11, n12, n22 = 1e-6, 0.0, 0.0, prior, 0.0, prior
    r0, r1, r2 = 0.0, 0.0, 0.0
    for i in range(len(weight)):
        w, a, b = weight[i], np.float64(plane[i, 0]), np.float64(plane[i, 1])
        n00 += w
        n01 += w * a
        n02 += w * b
        n11 += w * a * a
        n12 += w * a * b
        n22 += w * b * b
        r0 += w * residual[i]
        r1 += w * residual[i] * a
        r2 += w * residual[i] * b
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    det = n00 * c00 + n01 * c01 + n02 * c02
    inverse[0], inverse[1], inverse[2] = c00 / det, c01 / det, c02 / det
    inverse[3] = (n00 * n22 - n02 * n02) / det
    inverse[4] = (n01 * n02 - n00 * n12) / det
    inverse[5] = (n00 * n11 - n01 * n01) / det
    return (
        inverse[0] * r0 + inverse[1] * r1 + inverse[2] * r2,
        inverse[1] * r0 + inverse[3] * r1 + inverse[4] * r2,
        inverse[2] * r0 + inverse[4] * r1 + inverse[5] * r2,
    )
