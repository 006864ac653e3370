"""The surface of a cloud at a place: a plane through what lies around, robust against what does not belong to it."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.numerics import robust

Array = npt.NDArray[np.float64]

RADII_M: Final = (0.25, 0.35, 0.5, 0.75, 1.0)
"""The smallest that holds enough points is taken: the less a surface is asked to be flat, the better."""
ENOUGH: Final = 20
LEAST: Final = 4
_ROUNDS: Final = 10
_OUTLIER: Final = 3.0
_SECTORS: Final = 3
"""Of four around the place have to hold points, so that the plane is not continued beyond its edge."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A piece of surface.

    Attributes
    ----------
    height_m : float
        Of the plane at the place.
    sigma_m : float
        Of that height, from the residuals.
    slope : ndarray, shape (2,)
        Rise in x and in y [m/m].
    points, radius_m : int, float
        What it is made of.
    """

    height_m: float
    sigma_m: float
    slope: Array
    points: int
    radius_m: float


def patch_at(place_m: Array, points_m: Array) -> Patch | str:
    """The surface at a place, or why there is none.

    Parameters
    ----------
    place_m : ndarray, shape (2,) or (3,)
        x, y; a height says which of several surfaces above each other is meant (the one whose points are nearest).
    points_m : ndarray, shape (n, 3)
        Points around it, from the largest of `RADII_M` at least.
    """
    around = points_m - np.append(place_m[:2], place_m[2] if len(place_m) > 2 else 0.0)
    distance = np.hypot(around[:, 0], around[:, 1])
    if not (distance <= RADII_M[-1]).any():
        return f"no point within {RADII_M[-1]:g} m"
    for radius in RADII_M:
        near = around[distance <= radius]
        if len(near) >= ENOUGH or (radius == RADII_M[-1] and len(near) >= LEAST):
            break
    else:
        return f"{len(near)} points within {radius:g} m, expected {LEAST} or more"
    if _sectors(near) < _SECTORS:
        return f"the {len(near)} points within {radius:g} m lie to one side"
    base = place_m[2] if len(place_m) > 2 else 0.0
    height, sigma, slope, used = _plane(near)
    return Patch(height + base, sigma, slope, used, radius)


def _sectors(near: Array) -> int:
    quarter = np.floor(np.arctan2(near[:, 1], near[:, 0]) / (np.pi / 2.0)).astype(int) % 4
    return len(np.unique(quarter))


def _plane(near: Array) -> tuple[float, float, Array, int]:
    """Height at the origin with its sigma, slope, and how many points it rests on: least squares without outliers."""
    design = np.column_stack([np.ones(len(near)), near[:, :2]])
    solution = _least_absolute(design, near[:, 2])
    residual = near[:, 2] - design @ solution
    keep = np.abs(residual) <= _OUTLIER * max(robust.sigma(residual, 0.0), 1e-3)
    for _ in range(_ROUNDS):
        if keep.sum() < LEAST:
            break
        solution, *_ = np.linalg.lstsq(design[keep], near[keep, 2], rcond=None)
        residual = near[:, 2] - design @ solution
        scale = max(robust.sigma(residual[keep], 0.0), 1e-3)
        again = np.abs(residual) <= _OUTLIER * scale
        if (again == keep).all():
            break
        keep = again
    residual = near[keep, 2] - design[keep] @ solution
    freedom = max(int(keep.sum()) - 3, 1)
    normal = design[keep].T @ design[keep]
    variance = float(residual @ residual) / freedom * float(np.linalg.pinv(normal)[0, 0])
    return float(solution[0]), float(np.sqrt(variance)), solution[1:], int(keep.sum())


def _least_absolute(design: Array, values: Array) -> Array:
    """The solution with the least sum of absolute residuals, by weighted least squares: bears some outliers."""
    weight = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        solution, *_ = np.linalg.lstsq(design * root, values * root[:, 0], rcond=None)
        weight = 1.0 / np.maximum(np.abs(values - design @ solution), 1e-3)
    return np.asarray(solution)
