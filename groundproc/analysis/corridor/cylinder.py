"""A cylinder through points on a part of its surface."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics.robust import cauchy, sigma

Array = npt.NDArray[np.float64]

_STEPS: Final = 30
_SMALLEST_M: Final = 0.02
_LEAST_SCATTER_M: Final = 0.001


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A piece of a cylinder.

    Attributes
    ----------
    middle_m, along : ndarray, shape (3,)
        A place of its axis amid its points, and the axis' unit vector.
    radius_m : float
    start_m, end_m : float
        Of its points along the axis, from the middle.
    rms_m : float
        Of the points off its surface.
    sigma_axis_m, sigma_radius_m : float
        Of the middle in height, and of the radius.
    arc_rad : float
        How much of its circumference its points span.
    points : int
    """

    middle_m: Array
    along: Array
    radius_m: float
    start_m: float
    end_m: float
    rms_m: float
    sigma_axis_m: float
    sigma_radius_m: float
    arc_rad: float
    points: int

    @property
    def ends(self) -> Array:
        """Of its axis, shape (2, 3)."""
        return self.middle_m + np.array([self.start_m, self.end_m])[:, None] * self.along

    def off(self, xyz_m: Array) -> Array:
        """Distance of places from its surface, outwards positive, shape (n,)."""
        d = xyz_m - self.middle_m
        return np.asarray(np.linalg.norm(d - (d @ self.along)[:, None] * self.along, axis=1) - self.radius_m)


def cylinder(xyz_m: Array, along: Array) -> Cylinder | None:
    """Fit one by robust least squares; None where nothing comes of it.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    along : ndarray, shape (3,)
        About its axis, a unit vector that is not upright.
    """
    about = xyz_m.mean(axis=0)
    p = xyz_m - about
    u, v = _across(along)
    start = _circle(p @ u, p @ v)
    if start is None:
        return None
    # unknowns: middle across (u, v), turn of the axis towards u and v, radius
    unknowns = np.array([start[0], start[1], 0.0, 0.0, start[2]])
    inverse: Array = np.eye(5)
    left: Array = np.zeros(len(p))
    for _ in range(_STEPS):
        left, rows = _rows(p, along, u, v, unknowns)
        scatter = max(sigma(left), _LEAST_SCATTER_M)
        weight = cauchy(left / (2.0 * scatter))
        hessian = (rows * weight[:, None]).T @ rows + 1e-9 * np.eye(5)
        step = -np.linalg.solve(hessian, (rows * weight[:, None]).T @ left)
        unknowns = unknowns + np.clip(step, -0.3, 0.3)
        inverse = np.asarray(np.linalg.inv(hessian) * scatter**2, np.float64)
        if not np.isfinite(unknowns).all() or abs(unknowns[4]) > 100.0:
            return None
        if np.abs(step).max() < 1e-6:
            break
    if unknowns[4] < _SMALLEST_M:
        return None
    axis = along + unknowns[2] * u + unknowns[3] * v
    axis /= np.linalg.norm(axis)
    middle = unknowns[0] * u + unknowns[1] * v
    reach = (p - middle) @ axis
    return Cylinder(
        about + middle, axis, float(unknowns[4]), float(np.percentile(reach, 1)), float(np.percentile(reach, 99)),
        float(np.sqrt(np.mean(np.clip(left, -0.3, 0.3) ** 2))), float(np.sqrt(inverse[1, 1])), float(np.sqrt(inverse[4, 4])),
        _arc(p - middle, axis), len(p),
    )  # fmt: skip


def _across(along: Array) -> tuple[Array, Array]:
    """Unit vectors across an axis, the second as upright as can be."""
    u = np.cross(along, (0.0, 0.0, 1.0))
    u /= np.linalg.norm(u)
    return u, np.cross(u, along)


def _circle(x: Array, y: Array) -> tuple[float, float, float] | None:
    """Middle and radius of a circle, algebraically (Kåsa 1976)."""
    rows = np.column_stack([2.0 * x, 2.0 * y, np.ones(len(x))])
    found, _, rank, _ = np.linalg.lstsq(rows, x * x + y * y, rcond=None)
    square = found[2] + found[0] ** 2 + found[1] ** 2
    if rank < 3 or not np.isfinite(square) or square <= 0.0:
        return None
    return float(found[0]), float(found[1]), float(np.sqrt(square))


def _rows(p: Array, along: Array, u: Array, v: Array, unknowns: Array) -> tuple[Array, Array]:
    """Residuals and their derivatives, shape (n,) and (n, 5)."""
    s = p @ along
    a = p @ u - unknowns[0] - s * unknowns[2]
    b = p @ v - unknowns[1] - s * unknowns[3]
    away = np.maximum(np.hypot(a, b), 1e-9)
    ca, cb = a / away, b / away
    return away - unknowns[4], np.column_stack([-ca, -cb, -ca * s, -cb * s, -np.ones(len(p))])


def _arc(d: Array, axis: Array) -> float:
    """Span of the directions in which points lie about an axis."""
    u, v = _across(axis)
    angle = np.sort(np.arctan2(d @ v, d @ u))
    gaps = np.diff(np.append(angle, angle[0] + 2.0 * np.pi))
    return float(2.0 * np.pi - gaps.max())
