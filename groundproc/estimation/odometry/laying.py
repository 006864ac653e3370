"""One map fitted closely to another, from a start on, with six unknowns, and how many points agree.

Points are matched to planes within a narrowing reach. Ground counts by its mean normal, as everywhere: its own normals
would seem to fix the position along it.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from groundproc.estimation.odometry.surfaces import FILLED, GROUND, LOOSE, STANDING, Surfaces

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

ALIKE: Final = 0.85
"""Cosine of what normals of one plane differ by."""
GATES_M: Final = (1.5, 1.0, 0.6, 0.4, 0.3, 0.25, 0.25)
BESIDE_VOXEL_M: Final = 0.7
"""A point has to be so near to a voxel to lie on what that holds."""
ON_M: Final = 0.12
"""A point of a surface lies on the other map's so near to its plane."""
AMONG_M: Final = 0.45
"""A point of leaves lies among the other map's so near to one of them."""
KNOWN_M: Final = 1.5
"""Where the other map has anything so near, it could have shown the point."""
UNSURE_M: Final = 0.5
"""Where it has something so near of which it is not known what it is, it says nothing."""
FEWEST_ROWS: Final = 60
PLANE_SIGMA_M: Final = 0.05
FILLED_SIGMA_M: Final = 0.25
INFLATION: Final = 4.0
"""Neighbours share their errors: so much is taken off their information."""
WEAK: Final = np.array([1e2, 1e2, 1e2, 1.0, 1.0, 1.0])
"""Information on turn [1/rad^2] and shift [1/m^2] below which a step takes nothing."""


@dataclass(frozen=True, slots=True)
class Laid:
    """A map laid on another: p -> about + mat (p - about) + shift.

    Attributes
    ----------
    about_m : ndarray, shape (3,)
    mat : ndarray, shape (3, 3)
    shift_m : ndarray, shape (3,)
    covariance : ndarray, shape (6, 6)
        Of a turn about `about_m` [rad] and the shift [m].
    on, known : ndarray of bool, shape (points,)
        Points of what stands that lie on the other map, and those that it could show.
    surer : float
        By how many sigmas more points speak for this place than for any other.
    """

    about_m: Array
    mat: Array
    shift_m: Array
    covariance: Array
    on: Flags
    known: Flags
    surer: float = 0.0

    def places(self, place_m: Array) -> Array:
        """Places of the laid map on the other one, shape (n, 3)."""
        return np.asarray((place_m - self.about_m) @ self.mat.T + self.about_m + self.shift_m)

    def off(self, other: "Laid", radius_m: float) -> float:
        """How far two placings are from each other within a radius of the first one's middle [m]."""
        apart = self.places(self.about_m[None])[0] - other.places(self.about_m[None])[0]
        turn = Rotation.from_matrix(self.mat.T @ other.mat).magnitude()
        return float(np.linalg.norm(apart) + radius_m * turn)


class Target:
    """A map to be laid on: each kind by itself, all of it, and the ground's mean normal.

    Parameters
    ----------
    other : Surfaces
    """

    def __init__(self, other: Surfaces) -> None:
        self._parts = tuple(other.of(other.kind == kind) for kind in (GROUND, STANDING, FILLED, LOOSE))
        self._trees = tuple(cKDTree(part.place_m) for part in self._parts)
        self._whole = cKDTree(other.place_m)
        ground = self._parts[GROUND].normal
        up = (ground * np.sign(ground[:, 2:])).sum(axis=0) if len(ground) else np.array([0.0, 0.0, 1.0])
        self._up = up / np.linalg.norm(up)

    def closest(self, mine: Surfaces, about_m: Array, start: Array) -> Laid | None:
        """A map laid on this one from a start on: shift [m] and heading [rad], shape (4,); None where next to nothing is met."""
        mat = _matrix(np.array([0.0, 0.0, start[3]]))
        shift, arm = start[:3].copy(), mine.place_m - about_m
        information = np.zeros((6, 6))
        for gate_m in GATES_M:
            moved = Surfaces(arm @ mat.T + about_m + shift, mine.normal @ mat.T, mine.kind)
            rows, off, weight = self._rows(moved, about_m + shift, gate_m)
            if len(off) < FEWEST_ROWS:
                return None
            information = (rows * weight[:, None]).T @ rows
            change = _array(-np.linalg.solve(information + np.diag(WEAK), rows.T @ (weight * off)))
            mat, shift = _array(_matrix(change[:3]) @ mat), shift + change[3:]
        covariance = _array(np.linalg.inv(information / INFLATION + 1e-6 * np.eye(6)))
        on, known = self.agreement(Surfaces(arm @ mat.T + about_m + shift, mine.normal @ mat.T, mine.kind))
        return Laid(about_m, mat, shift, covariance, on, known)

    def _rows(self, moved: Surfaces, about_m: Array, gate_m: float) -> tuple[Array, Array, Array]:
        """Rows by turn and shift, distances, and weights [1/m^2]."""
        rows, offs, weights = [np.zeros((0, 6))], [np.zeros(0)], [np.zeros(0)]
        for kind in (GROUND, STANDING, FILLED):
            own, nearest = self._met(moved, kind, max(gate_m, BESIDE_VOXEL_M))
            between = moved.place_m[own] - self._parts[kind].place_m[nearest]
            sigma_m = max(FILLED_SIGMA_M if kind == FILLED else PLANE_SIGMA_M, 0.25 * gate_m)
            for way, off in self._distances(kind, nearest, between):
                inside = np.abs(off) < gate_m
                arm = moved.place_m[own] - about_m
                rows.append(np.concatenate([np.cross(arm, way), way], axis=1)[inside])
                offs.append(off[inside])
                weights.append(1.0 / (sigma_m**2 + np.square(off[inside])))
        return np.concatenate(rows), np.concatenate(offs), np.concatenate(weights)

    def _met(self, moved: Surfaces, kind: int, reach_m: float) -> tuple[Ints, Ints]:
        """Points of a kind that have their like in reach, and which."""
        own = np.flatnonzero(moved.kind == kind)
        apart, nearest = self._nearest(self._trees[kind], moved.place_m[own], reach_m)
        own, nearest = own[np.isfinite(apart)], nearest[np.isfinite(apart)]
        if kind == STANDING:
            alike = np.abs((moved.normal[own] * self._parts[kind].normal[nearest]).sum(axis=1)) > ALIKE
            own, nearest = own[alike], nearest[alike]
        return own, nearest

    def _distances(self, kind: int, nearest: Ints, between: Array) -> list[tuple[Array, Array]]:
        """Directions that points of a kind are held along, and their distances."""
        if kind == FILLED:
            return [(np.broadcast_to(way, between.shape), between @ way) for way in np.eye(3)]
        along = self._parts[kind].normal[nearest]
        if kind == STANDING:
            return [(along, (along * between).sum(axis=1))]
        # along the ground's mean normal, but from the plane that is there
        along = along * np.sign(along @ self._up)[:, None]
        return [(np.broadcast_to(self._up, between.shape), (along * between).sum(axis=1))]

    def agreement(self, moved: Surfaces) -> tuple[Flags, Flags]:
        """Which points of what stands lie on their like, and which could."""
        on, known = np.zeros(len(moved), np.bool_), np.zeros(len(moved), np.bool_)
        own, nearest = self._met(moved, STANDING, BESIDE_VOXEL_M)
        between = moved.place_m[own] - self._parts[STANDING].place_m[nearest]
        on[own] = np.abs((self._parts[STANDING].normal[nearest] * between).sum(axis=1)) < ON_M
        on[self._met(moved, FILLED, AMONG_M)[0]] = True
        own = np.flatnonzero(np.isin(moved.kind, (STANDING, FILLED)))
        apart, _ = self._nearest(self._whole, moved.place_m[own], KNOWN_M)
        unsure, _ = self._nearest(self._trees[LOOSE], moved.place_m[own], UNSURE_M)
        known[own] = on[own] | (np.isfinite(apart) & ~np.isfinite(unsure))
        return on, known

    @staticmethod
    def _nearest(tree: cKDTree, place_m: Array, reach_m: float) -> tuple[Array, Ints]:
        """Distance of the nearest, infinite where none is in reach, and its number."""
        apart, number = tree.query(place_m, distance_upper_bound=reach_m)
        return np.asarray(apart, np.float64), np.asarray(number, np.int64)


def _matrix(turn: Array) -> Array:
    """Matrix of a rotation vector."""
    return _array(Rotation.from_rotvec(turn).as_matrix())


def _array(values: Any) -> Array:
    return np.asarray(values, np.float64)
