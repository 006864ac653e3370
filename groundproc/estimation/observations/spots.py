"""Places that surfaces of the map have to go through, and where the map is laid for that."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

REACH_SIGMA: Final = 3.0
WIDEST_M: Final = 12.0
"""What the whole may be off: so many sigmas, and so far at most."""
SOUGHT_M: Final = 0.5
"""A map that cannot be farther off than this is not searched for."""
FORETOLD_M: Final = 1.0
"""How well, three sigma, the other spots have to predict the surface of a spot."""


@dataclass(slots=True)
class Spots:
    """Places that surfaces have to go through.

    Attributes
    ----------
    point : ndarray of int64, shape (k,)
        Which control point or plane each belongs to.
    place_m : ndarray, shape (k, 3)
        Local.
    sigma_m : ndarray, shape (k,)
    normals : list of ndarray or None
    used : ndarray of bool, shape (k,)
    """

    point: npt.NDArray[np.int64]
    place_m: Array
    sigma_m: Array
    normals: list[Array | None]
    used: Flags


@dataclass(slots=True)
class Placing:
    """A turn about a point and a shift: p -> about + mat (p - about) + shift.

    Attributes
    ----------
    about_m : ndarray, shape (3,)
    mat : ndarray, shape (3, 3)
    shift_m : ndarray, shape (3,)
    """

    about_m: Array
    mat: Array
    shift_m: Array

    def vector(self) -> Array:
        """Rotation vector and shift, shape (6,)."""
        return np.concatenate([frames.quat_log(frames.quat_from_mat(self.mat[None]))[0], self.shift_m])

    def then(self, change: Array) -> "Placing":
        """With a small turn and shift, shape (6,), after it."""
        mat = turned(change[:3])
        return Placing(self.about_m, mat @ self.mat, mat @ self.shift_m + change[3:])

    def back(self, points_m: Array) -> Array:
        """Where points of the placed map lay before."""
        return np.asarray((points_m - self.about_m - self.shift_m) @ self.mat + self.about_m)

    def as_turn(self) -> tuple[Array, Array]:
        """Matrix and shift of p -> mat p + shift."""
        return self.mat, self.about_m - self.mat @ self.about_m + self.shift_m


def foretold_m(rows: Array, weight: Array, point: npt.NDArray[np.int64], information: Array) -> Array:
    """How well, three sigma, the other points tell where the surface of each spot is, with what was known before [m], shape (k,)."""
    found = np.full(len(point), np.inf)
    for each in np.unique(point[weight > 0]):
        mine = point == each
        without = information + (rows * np.where(mine, 0.0, weight)[:, None]).T @ rows
        spread = np.einsum("ni,ij,nj->n", rows[mine], inverted(without), rows[mine])
        found[mine] = REACH_SIGMA * np.sqrt(spread.max())
    return found


def inverted(matrix: Array) -> Array:
    """Inverse of a matrix."""
    found: Array = np.asarray(np.linalg.inv(matrix), np.float64)
    return found


def cross(v: Array) -> Array:
    """Matrix [v]x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def turned(vector: Array) -> Array:
    """Matrix of a rotation vector."""
    return np.asarray(frames.mat_from_quat(frames.quat_exp(vector[None]))[0])
