"""Rotations and small symmetric matrices inside numba kernels; the conventions are those of `flightlog.frames`."""

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, inline="always")
def quat_multiply(p: Any, q: Any, out: Any) -> None:
    """Product of two quaternions (w, x, y, z); `out` may be one of them."""
    w = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    x = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    y = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    z = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]
    out[0], out[1], out[2], out[3] = w, x, y, z


@njit(cache=True, nogil=True)
def quat_turned(q: Any, x: float, y: float, z: float, out: Any) -> None:
    """Attitude q turned on by the rotation vector (x, y, z) in its body, q exp(v), and normalised."""
    square = 0.25 * (x * x + y * y + z * z)
    if square < 0.01:
        w = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
        factor = 0.5 * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0))))
    else:
        half = np.sqrt(square)
        w, factor = np.cos(half), 0.5 * np.sin(half) / half
    x, y, z = factor * x, factor * y, factor * z
    a = q[0] * w - q[1] * x - q[2] * y - q[3] * z
    b = q[0] * x + q[1] * w + q[2] * z - q[3] * y
    c = q[0] * y - q[1] * z + q[2] * w + q[3] * x
    d = q[0] * z + q[1] * y - q[2] * x + q[3] * w
    norm = 1.0 / np.sqrt(a * a + b * b + c * c + d * d)
    out[0], out[1], out[2], out[3] = norm * a, norm * b, norm * c, norm * d


@njit(cache=True, nogil=True)
def quat_difference(p: Any, q: Any, out: Any) -> None:
    """Rotation vector from attitude p to attitude q in the body of p: log(p^-1 q), the short way."""
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = p[0] * q[2] + p[1] * q[3] - p[2] * q[0] - p[3] * q[1]
    z = p[0] * q[3] - p[1] * q[2] + p[2] * q[1] - p[3] * q[0]
    sine = np.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, abs(w)) / sine
    if w < 0.0:
        factor = -factor
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@njit(cache=True, nogil=True)
def mat_of_quat(q: Any, out: Any) -> None:
    """Column matrix of a unit quaternion, shape (3, 3)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@njit(cache=True, nogil=True)
def flattest(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, normal: Any) -> Any:
    """Smallest and middle eigenvalue of a symmetric 3 x 3 matrix; `normal` takes the unit eigenvector of the smallest.

    By Cardano's formula, and the vector as the longest cross product of two rows of A - l I.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    p = np.sqrt(max((a * a + b * b + c * c + 2.0 * off) / 6.0, 1e-60))
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    ratio = min(max(0.5 * det / (p * p * p), -1.0), 1.0)
    angle = np.arccos(ratio) / 3.0
    largest = mean + 2.0 * p * np.cos(angle)
    smallest = mean + 2.0 * p * np.cos(angle + 2.0943951023931953)
    middle = 3.0 * mean - largest - smallest
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    s0 = x0 * x0 + y0 * y0 + z0 * z0
    s1 = x1 * x1 + y1 * y1 + z1 * z1
    s2 = x2 * x2 + y2 * y2 + z2 * z2
    if s0 >= s1 and s0 >= s2:
        x, y, z, s = x0, y0, z0, s0
    elif s1 >= s2:
        x, y, z, s = x1, y1, z1, s1
    else:
        x, y, z, s = x2, y2, z2, s2
    if s <= 0.0:
        normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    else:
        s = 1.0 / np.sqrt(s)
        normal[0], normal[1], normal[2] = x * s, y * s, z * s
    return smallest, middle


@njit(cache=True, nogil=True, inline="always")
def unit_vector(v: Any) -> None:
    """Scale a vector of three to length one, in place; nothing stays nothing."""
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if length > 0.0:
        for i in range(3):
            v[i] /= length
