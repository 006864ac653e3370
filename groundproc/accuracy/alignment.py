"""The one rigid motion that is free when an estimated trajectory is compared with the true one: no scale, no change with time.

Source: the least-squares solution of Kabsch (1976), Horn (1987) and Umeyama (1991) by singular values, without Umeyama's scale.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

LEAST_SPREAD_M: Final = 1.0
"""RMS spread of the positions in their second direction from which on they alone fix the rotation; a line or a hover does not."""
ARM_M: Final = 10.0
"""Where they do not, each pose also stands for the ends of arms of this length along its axes: about the range of a point."""


@dataclass(frozen=True, slots=True)
class Rigid:
    """A rigid motion: p -> mat p + shift.

    Attributes
    ----------
    mat : ndarray, shape (3, 3)
    shift_m : ndarray, shape (3,)
    by_attitude : bool
        The positions alone did not fix the rotation, and the attitudes took part.
    """

    mat: Array
    shift_m: Array
    by_attitude: bool = False

    @classmethod
    def identity(cls) -> "Rigid":
        """No motion."""
        return cls(np.eye(3), np.zeros(3))

    def points(self, points_m: Array) -> Array:
        """Moved points, shape (n, 3)."""
        out = np.empty((len(points_m), 3))
        _move(points_m, self.mat, self.shift_m, out)
        return out

    def turned(self, mats: Array) -> Array:
        """Turned attitudes "local from body", shape (n, 3, 3)."""
        return np.asarray(self.mat @ mats)


def best_rigid(estimated_m: Array, true_m: Array) -> Rigid:
    """The motion that brings points, shape (n, 3), closest to others in the sense of least squares."""
    middle, target = estimated_m.mean(axis=0), true_m.mean(axis=0)
    left, _, right = np.linalg.svd((true_m - target).T @ (estimated_m - middle))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    mat = left @ mirror @ right
    return Rigid(mat, target - mat @ middle)


def align(position_m: Array, mats: Array, true_position_m: Array, true_mats: Array) -> Rigid:
    """The motion that brings estimated poses closest to the true ones.

    Positions alone where they span a plane; else the ends of arms along the axes of each pose as well, because along a straight line
    or in a hover positions leave the rotation open.

    Parameters
    ----------
    position_m, true_position_m : ndarray, shape (n, 3)
    mats, true_mats : ndarray, shape (n, 3, 3)
        Column matrices "local from body".
    """
    centred = true_position_m - true_position_m.mean(axis=0)
    spread_m = np.linalg.svd(centred, compute_uv=False)[1] / np.sqrt(len(centred))
    if spread_m >= LEAST_SPREAD_M:
        return best_rigid(position_m, true_position_m)
    found = best_rigid(_with_arms(position_m, mats), _with_arms(true_position_m, true_mats))
    return Rigid(found.mat, found.shift_m, by_attitude=True)


def _with_arms(position_m: Array, mats: Array) -> Array:
    """Positions, and the ends of the arms both ways along each axis, shape (7 n, 3)."""
    axes = ARM_M * np.swapaxes(mats, 1, 2)
    ends = [position_m[:, None], position_m[:, None] + axes, position_m[:, None] - axes]
    return np.concatenate(ends, axis=1).reshape(-1, 3)


@njit(cache=True, nogil=True)
def _move(points: Any, mat: Any, shift: Any, out: Any) -> None:
    """A matrix product of millions of rows by 3 x 3: a library for large matrices takes ten times as long on a busy machine."""
    for i in range(len(points)):
        for axis in range(3):
            out[i, axis] = (
                mat[axis, 0] * points[i, 0] + mat[axis, 1] * points[i, 1] + mat[axis, 2] * points[i, 2] + shift[axis]
            )
