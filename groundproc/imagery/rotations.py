"""Rotations as photogrammetry writes them, and as cameras mean them."""

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FLIP: Final = np.diag([1.0, -1.0, -1.0])
"""From the camera's x right, y down, z forward to photogrammetry's x right, y up, z backwards, and back."""
STRAIGHT_DOWN: Final = FLIP
"""mat_cam_ins of a camera that looks down, its upper edge ahead."""


def mat_world_camera(omega_rad: Array, phi_rad: Array, kappa_rad: Array) -> Array:
    """Column matrix world from camera (x right, y down, z forward), shape (n, 3, 3), of photogrammetric angles, shape (n,).

    Rx(omega) Ry(phi) Rz(kappa) with the camera's y up and z backwards (Kraus, Photogrammetry, 2nd ed., section 2.1.1).
    """
    so, co, sp, cp, sk, ck = (
        f(np.asarray(a, np.float64)) for a in (omega_rad, phi_rad, kappa_rad) for f in (np.sin, np.cos)
    )
    rows = (
        (cp * ck, -cp * sk, sp),
        (co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp),
        (so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp),
    )
    up = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return np.asarray(up @ FLIP)


def photogrammetric(mat_world_camera: Array) -> tuple[Array, Array, Array]:
    """Omega, phi, kappa [rad], shape (n,) each, of matrices, shape (n, 3, 3); the inverse of `mat_world_camera`."""
    up = mat_world_camera @ FLIP
    omega = np.arctan2(-up[..., 1, 2], up[..., 2, 2])
    phi = np.arcsin(np.clip(up[..., 0, 2], -1.0, 1.0))
    kappa = np.arctan2(-up[..., 0, 1], up[..., 0, 0])
    return omega, phi, kappa


def turn_by_angles(omega_rad: Array, phi_rad: Array) -> Array:
    """Small turns about the world's axes by changes of omega, phi and kappa: matrices, shape (n, 3, 3).

    The columns are the axes that the three angles turn about: x, y turned by omega, z turned by omega and phi.
    """
    so, co, sp, cp = np.sin(omega_rad), np.cos(omega_rad), np.sin(phi_rad), np.cos(phi_rad)
    zero, one = np.zeros_like(so), np.ones_like(so)
    columns = ((one, zero, zero), (zero, co, so), (sp, -so * cp, co * cp))
    return np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)


def mat_of_vector(vector_rad: Array) -> Array:
    """Matrices of rotation vectors, shape (n, 3), by Rodrigues' formula, shape (n, 3, 3)."""
    vector = np.asarray(vector_rad, np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    k = cross_matrix(vector)
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + sine * k + cosine * (k @ k))


def cross_matrix(vector: Array) -> Array:
    """Matrices whose product is the cross product with vectors, shape (n, 3), from the left."""
    x, y, z = np.moveaxis(np.asarray(vector, np.float64), -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
