"""Rotations of the project: the equation of its source, attitudes of an autopilot, quaternions.

All functions take scalars or arrays and broadcast. Angles are in radians; matrices have shape (..., 3, 3),
quaternions (..., 4), scalar first. The source (FOI-R--4045--SE) writes row vectors, p_b = p_a @ R(g, a, b).
Matrices called mat_ab here are in column form, and R for a step from a to b equals mat_ba.T.
"""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
Angle: TypeAlias = float | Array


def rotation(yaw: Angle, pitch: Angle, roll: Angle) -> Array:
    """R(g, a, b) = R_roll(b about y) R_pitch(a about x) R_yaw(g about z) for row vectors, shape (..., 3, 3).

    Source: Larsson & Tulldahl, FOI-R--4045--SE (2014), the matrix of step 1. Positive yaw is counter-clockwise seen from above,
    positive pitch lifts the forward axis, positive roll lowers the right side.
    """
    yaw, pitch, roll = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (yaw, pitch, roll)))
    cg, sg, ca, sa, cb, sb = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rows = [
        [cg * cb - sg * sa * sb, cb * sg + cg * sa * sb, -ca * sb],
        [-ca * sg, cg * ca, sa],
        [cg * sb + cb * sg * sa, sg * sb - cg * cb * sa, ca * cb],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def mat_local_ins(heading: Angle, pitch: Angle, roll: Angle) -> Array:
    """Column matrix "local from ins" of an autopilot's attitude, shape (..., 3, 3).

    Heading clockwise from true north, pitch nose up, roll right wing down, as MAVLink's ATTITUDE states them: the matrix of step 3
    of the source, transposed.
    """
    return np.swapaxes(rotation(-np.asarray(heading), pitch, roll), -1, -2)


def attitude_of(mat_local_ins: Array) -> tuple[Array, Array, Array]:
    """Heading (0 to below 2 pi), pitch and roll [rad] of a column matrix "local from ins"; the inverse of `mat_local_ins`."""
    m = np.asarray(mat_local_ins)
    heading = np.arctan2(m[..., 0, 1], m[..., 1, 1]) % (2 * np.pi)
    heading = heading * (heading < 2 * np.pi)  # the remainder of a tiny negative angle rounds up to the full turn
    pitch = np.arcsin(np.clip(m[..., 2, 1], -1.0, 1.0))
    roll = np.arctan2(-m[..., 2, 0], m[..., 2, 2])
    return heading, pitch, roll


def quat_from_mat(mat: Array) -> Array:
    """Unit quaternion of a rotation matrix, shape (..., 4), scalar first and not negative.

    Takes the largest of the four components first (Shepperd 1978), so that it is exact for every rotation.
    """
    m = np.asarray(mat)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], axis=-1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = np.stack(
        [
            np.stack([squares[..., 0], a, b, c], axis=-1),
            np.stack([a, squares[..., 1], d, e], axis=-1),
            np.stack([b, d, squares[..., 2], f], axis=-1),
            np.stack([c, e, f, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)
    quat = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.asarray(np.where(quat[..., :1] < 0, -quat, quat))


def mat_from_quat(quat: Array) -> Array:
    """Rotation matrix of a unit quaternion, shape (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quat), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quat_multiply(left: Array, right: Array) -> Array:
    """Hamilton product: the rotation `right` followed by `left`, shape (..., 4)."""
    lw, lx, ly, lz = np.moveaxis(np.asarray(left), -1, 0)
    rw, rx, ry, rz = np.moveaxis(np.asarray(right), -1, 0)
    return np.stack(
        [
            lw * rw - lx * rx - ly * ry - lz * rz,
            lw * rx + lx * rw + ly * rz - lz * ry,
            lw * ry - lx * rz + ly * rw + lz * rx,
            lw * rz + lx * ry - ly * rx + lz * rw,
        ],
        axis=-1,
    )


def quat_inverse(quat: Array) -> Array:
    """The opposite rotation, shape (..., 4)."""
    return np.asarray(quat * np.array([1.0, -1.0, -1.0, -1.0]))


def quat_exp(rotation_vector: Array) -> Array:
    """Unit quaternion of a rotation vector [rad], shape (..., 4)."""
    v = np.asarray(rotation_vector, np.float64)
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), v * np.sinc(half / np.pi) / 2], axis=-1)


def quat_log(quat: Array) -> Array:
    """Rotation vector [rad] of a unit quaternion, the short way round, shape (..., 3)."""
    q = np.asarray(quat, np.float64)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    return np.asarray(q[..., 1:] * 2 * np.where(sine > 1e-12, half / np.maximum(sine, 1e-12), 1.0))


def ins_from_frd(vector: Array) -> Array:
    """Forward-right-down to right-forward-up, or NED to ENU, shape (..., 3): swap the first two, negate the third."""
    v = np.asarray(vector)
    return np.stack([v[..., 1], v[..., 0], -v[..., 2]], axis=-1)
