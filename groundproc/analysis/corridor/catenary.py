"""The curve of a hanging wire: z = low + a (cosh((s - s0) / a) - 1) above a straight line in plan."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

Array = npt.NDArray[np.float64]

_FLATTEST_M: Final = 1e5
"""Parameter a of a wire that is as good as straight."""
_SCALE_M: Final = 0.08
"""Residuals beyond count less (soft L1): insulators, birds, the next wire."""


@dataclass(frozen=True, slots=True)
class Catenary:
    """A wire.

    Attributes
    ----------
    origin_m, along : ndarray, shape (2,)
        A place of the line in plan, and its unit vector.
    start_m, end_m : float
        Of the wire along that.
    a_m, middle_m, low_m : float
        Parameter, where it hangs lowest, and how high that is.
    rms_m : float
        Of the points off the curve, across and in height.
    points : int
    """

    origin_m: Array
    along: Array
    start_m: float
    end_m: float
    a_m: float
    middle_m: float
    low_m: float
    rms_m: float
    points: int

    @property
    def length_m(self) -> float:
        """In plan."""
        return self.end_m - self.start_m

    @property
    def middle_of(self) -> float:
        """Half way along."""
        return 0.5 * (self.start_m + self.end_m)

    def height(self, s_m: Array) -> Array:
        """Height at places along it."""
        # of a very flat one cosh - 1 is the difference of like numbers: by the half argument
        half = np.sinh((s_m - self.middle_m) / (2.0 * self.a_m))
        return np.asarray(self.low_m + 2.0 * self.a_m * half**2)

    def local(self, xyz_m: Array) -> tuple[Array, Array, Array]:
        """Along, to the left, and above the curve, of points, shape (n,) each."""
        d = xyz_m[:, :2] - self.origin_m
        s = d @ self.along
        return s, d @ np.array([-self.along[1], self.along[0]]), xyz_m[:, 2] - self.height(s)

    def tangent(self, s_m: float) -> Array:
        """Unit vector along it, shape (3,)."""
        way = np.append(self.along, np.sinh((s_m - self.middle_m) / self.a_m))
        return np.asarray(way / np.linalg.norm(way))

    def places(self, step_m: float) -> Array:
        """Vertices from end to end at most a step apart in plan, shape (n, 3)."""
        s = np.linspace(self.start_m, self.end_m, max(int(np.ceil(self.length_m / step_m)), 1) + 1)
        return np.column_stack([self.origin_m + s[:, None] * self.along, self.height(s)])

    def along_plan(self, beyond_m: float = 0.0) -> Array:
        """Places in plan so far beyond its ends, shape (2, 2)."""
        ends = np.array([self.start_m - beyond_m, self.end_m + beyond_m])
        return np.asarray(self.origin_m + ends[:, None] * self.along)

    def between(self, start_m: float, end_m: float) -> "Catenary":
        """The same curve between other ends."""
        return Catenary(
            self.origin_m, self.along, start_m, end_m, self.a_m, self.middle_m, self.low_m, self.rms_m, self.points
        )

    @property
    def sag_m(self) -> float:
        """Greatest vertical distance below the chord."""
        s = np.linspace(self.start_m, self.end_m, 401)
        z = self.height(s)
        chord = z[0] + (z[-1] - z[0]) * (s - s[0]) / max(s[-1] - s[0], 1e-9)
        return float(max((chord - z).max(), 0.0))


def fitted(xyz_m: Array) -> Catenary:
    """The wire through some points: a line in plan, and the curve above it, both robust.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3), n > 3
    """
    origin, along = _line(xyz_m[:, :2])
    d = xyz_m[:, :2] - origin
    s, off = d @ along, d @ np.array([-along[1], along[0]])
    origin_s = 0.5 * (s.min() + s.max())
    half = max(np.ptp(s) / 2.0, 1.0)
    z0 = float(np.median(xyz_m[:, 2]))
    u, v = (s - origin_s) / half, xyz_m[:, 2] - z0
    design = np.stack([np.ones_like(u), u, u * u], axis=1)

    def residual(x: Array) -> Array:
        return np.asarray(design @ x - v)

    start = np.linalg.lstsq(design, v, rcond=None)[0]
    bend = least_squares(residual, start, loss="soft_l1", f_scale=_SCALE_M).x
    curve = max(2.0 * bend[2] / half**2, 1.0 / _FLATTEST_M)
    a = 1.0 / curve
    middle = origin_s - a * np.arcsinh(bend[1] / half)
    low = z0 + bend[0] - 2.0 * a * np.sinh((origin_s - middle) / (2.0 * a)) ** 2

    def hanging(x: Array) -> Array:
        a_m = 1.0 / max(float(x[0]), 1.0 / _FLATTEST_M)
        at = 2.0 * np.sinh((origin_s - x[1]) / (2.0 * a_m)) ** 2 * a_m
        return np.asarray(x[2] + 2.0 * a_m * np.sinh((s - x[1]) / (2.0 * a_m)) ** 2 - at - xyz_m[:, 2])

    if a < 0.5 * _FLATTEST_M:
        found = least_squares(
            hanging, [1.0 / a, middle, z0 + bend[0]], loss="soft_l1", f_scale=_SCALE_M, x_scale=[1e-4, 1.0, 0.1]
        )
        a, middle = 1.0 / max(float(found.x[0]), 1.0 / _FLATTEST_M), float(found.x[1])
        low = float(found.x[2]) - 2.0 * a * np.sinh((origin_s - middle) / (2.0 * a)) ** 2
    wire = Catenary(origin, along, float(s.min()), float(s.max()), float(a), float(middle), float(low), 0.0, len(xyz_m))
    _, _, up = wire.local(xyz_m)
    # the median of a squared distance in a plane is ln 2 of its mean; a few points of something else do not count
    rms = float(np.sqrt(np.median(off**2 + up**2) / np.log(2.0)))
    return Catenary(origin, along, wire.start_m, wire.end_m, wire.a_m, wire.middle_m, wire.low_m, rms, len(xyz_m))


def _line(xy_m: Array) -> tuple[Array, Array]:
    """Robust straight line in plan: place and unit vector."""
    weight = np.ones(len(xy_m))
    for _ in range(6):
        origin = np.average(xy_m, axis=0, weights=weight)
        d = xy_m - origin
        _, vectors = np.linalg.eigh((weight[:, None] * d).T @ d)
        along = vectors[:, -1]
        off = d @ np.array([-along[1], along[0]])
        weight = 1.0 / (1.0 + (off / _SCALE_M) ** 2)
    return origin, along
