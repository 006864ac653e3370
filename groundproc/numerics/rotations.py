"""Rotations inside numba kernels; the conventions are those of `flightlog.frames`.

Quaternions are (w, x, y, z), shape (4,); rotation vectors are in rad, shape (3,). Every function writes its last argument, `out`.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]


@njit(cache=True, nogil=True, inline="always")
def quat_times(p: Array, w: float, x: float, y: float, z: float, out: Array) -> None:
    """Product of a quaternion p and another, given by its components; `out` may be p."""
    a = p[0] * w - p[1] * x - p[2] * y - p[3] * z
    b = p[0] * x + p[1] * w + p[2] * z - p[3] * y
    c = p[0] * y - p[1] * z + p[2] * w + p[3] * x
    d = p[0] * z + p[1] * y - p[2] * x + p[3] * w
    out[0], out[1], out[2], out[3] = a, b, c, d


@njit(cache=True, nogil=True, inline="always")
def quat_multiply(p: Array, q: Array, out: Array) -> None:
    """Product of two quaternions; `out` may be one of them."""
    quat_times(p, q[0], q[1], q[2], q[3], out)


@njit(cache=True, nogil=True)
def quat_turned(q: Array, x: float, y: float, z: float, out: Array) -> None:
    """Attitude q turned on by the rotation vector (x, y, z) in its body, q exp(v), and normalised."""
    square = 0.25 * (x * x + y * y + z * z)
    if square < 0.01:
        w = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
        factor = 0.5 * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0))))
    else:
        half = np.sqrt(square)
        w, factor = np.cos(half), 0.5 * np.sin(half) / half
    quat_times(q, w, factor * x, factor * y, factor * z, out)
    norm = 1.0 / np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    out[0], out[1], out[2], out[3] = norm * out[0], norm * out[1], norm * out[2], norm * out[3]


@njit(cache=True, nogil=True)
def quat_difference(p: Array, q: Array, out: Array) -> None:
    """Rotation vector from attitude p to attitude q in the body of p: log(p^-1 q), the short way."""
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = p[0] * q[2] + p[1] * q[3] - p[2] * q[0] - p[3] * q[1]
    z = p[0] * q[3] - p[1] * q[2] + p[2] * q[1] - p[3] * q[0]
    _log(w, x, y, z, out)


@njit(cache=True, nogil=True)
def quat_turned_by(q: Array, vector: Array, share: float, out: Array) -> None:
    """Attitude q turned on by a share of a rotation vector in its body: q exp(share vector). Any angle; not normalised."""
    x, y, z = 0.5 * share * vector[0], 0.5 * share * vector[1], 0.5 * share * vector[2]
    half = np.sqrt(x * x + y * y + z * z)
    factor = 1.0 - half * half / 6.0 if half < 1e-4 else np.sin(half) / half
    quat_times(q, np.cos(half), factor * x, factor * y, factor * z, out)


@njit(cache=True, nogil=True)
def quat_difference_outside(q: Array, r: Array, out: Array) -> None:
    """Rotation vector in the outer frame from attitude r to attitude q: log(q r^-1), the short way."""
    w = q[0] * r[0] + q[1] * r[1] + q[2] * r[2] + q[3] * r[3]
    x = -q[0] * r[1] + q[1] * r[0] - q[2] * r[3] + q[3] * r[2]
    y = -q[0] * r[2] + q[1] * r[3] + q[2] * r[0] - q[3] * r[1]
    z = -q[0] * r[3] - q[1] * r[2] + q[2] * r[1] + q[3] * r[0]
    _log(w, x, y, z, out)


@njit(cache=True, nogil=True, inline="always")
def _log(w: float, x: float, y: float, z: float, out: Array) -> None:
    """Rotation vector of a unit quaternion, the short way."""
    sine = np.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, abs(w)) / sine
    if w < 0.0:
        factor = -factor
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@njit(cache=True, nogil=True)
def mat_of_quat(q: Array, out: Array) -> None:
    """Column matrix of a unit quaternion, shape (3, 3)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@njit(cache=True, nogil=True, inline="always")
def unit_vector(v: Array) -> None:
    """Scale a vector of three to length one, in place; nothing stays nothing."""
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if length > 0.0:
        for i in range(3):
            v[i] /= length


@njit(cache=True, nogil=True, inline="always")
def rotated(q: Array, v: Array, out: Array) -> None:
    """A vector of the body on the outer axes: v + 2 w (u x v) + 2 u x (u x v) with q = (w, u)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    a, b, c = y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]
    out[0] = v[0] + 2.0 * (w * a + y * c - z * b)
    out[1] = v[1] + 2.0 * (w * b + z * a - x * c)
    out[2] = v[2] + 2.0 * (w * c + x * b - y * a)


@njit(cache=True, nogil=True, inline="always")
def moved_by_turn(v: Array, x: Array, out: Array) -> None:
    """By how much the rotation vector v moves a point: exp(v) x - x (Rodrigues)."""
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if square < 1e-6:
        sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = np.sqrt(square)
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    a, b, c = v[1] * x[2] - v[2] * x[1], v[2] * x[0] - v[0] * x[2], v[0] * x[1] - v[1] * x[0]
    out[0] = sine * a + cosine * (v[1] * c - v[2] * b)
    out[1] = sine * b + cosine * (v[2] * a - v[0] * c)
    out[2] = sine * c + cosine * (v[0] * b - v[1] * a)
