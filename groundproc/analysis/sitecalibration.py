"""Site calibration: local coordinates of a building site from points known in both.

In plan a similarity (shift, turn, scale), in height a shift and, with four points or more, a tilt about two axes: as survey controllers
have it. The residual of each point is told, and what it would be off by if it had not been used.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CoverageError

Array = npt.NDArray[np.float64]

FEWEST: Final = 3
"""Two fit whatever they are: no residual would tell a wrong one."""
TILTED: Final = 4
_LARGEST_PPM: Final = 10_000.0
_NARROW: Final = 1e-3
"""Of the length of the control, its width, from which on a tilt is told."""


@dataclass(frozen=True, slots=True)
class Site:
    """A calibration.

    Attributes
    ----------
    about_m, to_m : ndarray, shape (3,)
        Middle of the control on the map, and where it comes to lie.
    turn_rad, scale : float
        Anticlockwise, from map to site; map times scale is site.
    tilt : ndarray, shape (2,)
        Rise of site heights over map heights, along x and y of the map [m/m].
    residual_m, left_out_m : ndarray, shape (n, 3)
        Site less what is made of the map; the same of each point without it. Not a number where nothing is left without it.
    """

    about_m: Array
    to_m: Array
    turn_rad: float
    scale: float
    tilt: Array
    residual_m: Array
    left_out_m: Array

    def move(self, places: Array) -> Array:
        """Site coordinates of places on the map, shape (n, 3)."""
        return _moved(self.about_m, self.to_m, (self.turn_rad, self.scale), self.tilt, places)

    def told(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "about_m": self.about_m.tolist(), "to_m": self.to_m.tolist(), "turn_deg": float(np.rad2deg(self.turn_rad)),
            "scale_ppm": 1e6 * (self.scale - 1.0), "tilt_mm_per_m": (1e3 * self.tilt).tolist(),
            "rmse_m": np.sqrt(np.mean(self.residual_m**2, axis=0)).tolist(),
        }  # fmt: skip


def calibrated(map_m: Array, site_m: Array) -> Site:
    """Fit by least squares.

    Parameters
    ----------
    map_m, site_m : ndarray, shape (n, 3)
        The same points in both.

    Raises
    ------
    CoverageError
        They are too few, at one place, or of different scales.
    """
    if len(map_m) < FEWEST:
        raise CoverageError(
            f"site calibration: {len(map_m)} points, expected {FEWEST} or more, so that residuals tell a wrong one"
        )
    found = _fitted(map_m, site_m)
    residual = site_m - _moved(*found, map_m)
    left_out = np.full(residual.shape, np.nan)
    for n in range(len(map_m)):
        rest = np.arange(len(map_m)) != n
        if rest.sum() >= FEWEST:
            left_out[n] = (site_m[n] - _moved(*_fitted(map_m[rest], site_m[rest]), map_m[n : n + 1]))[0]
    about, to, (turn, scale), tilt = found
    return Site(about, to, turn, scale, tilt, residual, left_out)


def _fitted(map_m: Array, site_m: Array) -> tuple[Array, Array, tuple[float, float], Array]:
    about, to = map_m.mean(axis=0), site_m.mean(axis=0)
    a, b = map_m - about, site_m - to
    square = float(np.sum(a[:, :2] ** 2))
    if square < 1e-6:
        raise CoverageError("site calibration: all points lie at one place, expected some around the site")
    cosine = float(np.sum(a[:, :2] * b[:, :2])) / square
    sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) / square
    scale = float(np.hypot(cosine, sine))
    if abs(scale - 1.0) * 1e6 > _LARGEST_PPM:
        raise CoverageError(
            f"site calibration: a scale of {scale:.6f}, expected 1 to within {_LARGEST_PPM / 1e4:g} %: are both in metres, and are the "
            "columns x, y, z of the map, then x, y, z of the site?"
        )
    tilt = np.zeros(2)
    length = np.linalg.svd(a[:, :2], compute_uv=False)
    if len(a) >= TILTED and length[1] > _NARROW * length[0]:
        tilt = np.linalg.lstsq(a[:, :2], b[:, 2] - a[:, 2], rcond=None)[0]
    return about, to, (float(np.arctan2(sine, cosine)), scale), tilt


def _moved(about_m: Array, to_m: Array, plan: tuple[float, float], tilt: Array, places: Array) -> Array:
    turn, scale = plan
    x, y, z = (places - about_m).T
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    return np.column_stack([c * x - s * y, s * x + c * y, z + tilt[0] * x + tilt[1] * y]) + to_m
