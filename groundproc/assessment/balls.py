"""Spheres as targets: balls on a rod or on the ground, by their shape alone.

Points off the ground are held against spheres through four of them; the one that holds most is fitted by orthogonal distances. It is a
target only if what lies there is this sphere: its points see enough of it, nearly all points around lie on it, it is as thin as the noise
lets it be, and no plane or rod is as good.
"""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.assessment.target import SEARCH_M, SPHERE, Target

Array = npt.NDArray[np.float64]

RADII_M: Final = (0.05, 0.4)
_FEWEST: Final = 15
_TRIALS: Final = 2000
_ROUNDS: Final = 15
_THIN_M: Final = 0.03
"""Scatter of the points about a ball, at most: twice the noise of a range of this class of sensors."""
_OF_ALL: Final = 0.75
"""Of the points within one and a half radii that lie on the sphere."""
_BETTER: Final = 6.0
_RIM_M: Final = 0.045
"""Nearer to its outline than half a footprint, an echo is of the ball and of the ground behind it."""
_FOOTPRINT_M: Final = 0.005
"""By so much, one sigma, the echo of a footprint on a curved surface is off its middle."""
_RADIUS_M: Final = 0.01
_WHOLE_M: Final = 0.02
"""The same of the height of a ball of unknown size: of its cap, which hardly tells height from radius, and with the outline, where echoes
of ball and ground together make it seem larger and lower."""
_SHARP_M: Final = 0.02


def find(place_m: Array, xyz_m: Array, on_ground: npt.NDArray[np.bool_], size_m: float | None) -> Target | None:
    """A ball near a surveyed point.

    Parameters
    ----------
    place_m : ndarray, shape (3,)
    xyz_m : ndarray, shape (n, 3)
    on_ground : ndarray of bool, shape (n,)
        Points of the largest plane, which are not of a ball.
    size_m : float or None
        Known diameter.
    """
    local = xyz_m - place_m
    free = local[~on_ground]
    free = free[np.linalg.norm(free, axis=1) <= SEARCH_M + RADII_M[1]]
    if len(free) < _FEWEST:
        return None
    guess = _guess(free, size_m)
    if guess is None:
        return None
    known = size_m is not None
    for rim_m, allowance_m in ((_RIM_M, _FOOTPRINT_M if known else _RADIUS_M), (0.0, _WHOLE_M)):
        found = _ball(free, guess, known, rim_m)
        if found is not None and np.linalg.norm(found.centre_m) <= SEARCH_M:
            allowance = np.diag([_FOOTPRINT_M, _FOOTPRINT_M, allowance_m]) ** 2
            return replace(found, centre_m=found.centre_m + place_m, covariance_m2=found.covariance_m2 + allowance)
    return None


def _ball(free: Array, guess: tuple[Array, float], known: bool, rim_m: float) -> Target | None:
    """A ball fitted from a guess to what lies inside its outline by so much."""
    centre, radius = guess
    for _ in range(6):
        on = np.abs(np.linalg.norm(free - centre, axis=1) - radius) <= 2.5 * _THIN_M
        cap = on & (np.hypot(*(free - centre)[:, :2].T) <= max(radius - rim_m, 0.75 * radius))
        if cap.sum() < _FEWEST - 5 or on.sum() < _FEWEST:
            return None
        centre, radius, covariance, scatter = _fitted(free[cap], centre, radius, known)
    if not _is_ball(free, on, centre, radius, scatter, covariance):
        return None
    return Target(SPHERE, centre, covariance, 2.0 * radius, int(cap.sum()), float("nan"))


def _guess(points: Array, size_m: float | None) -> tuple[Array, float] | None:
    """Sphere through four points that holds most of all."""
    rng = np.random.default_rng(0)
    four = points[rng.integers(0, len(points), (_TRIALS, 4))]
    matrix = 2.0 * (four[:, 1:] - four[:, :1])
    right = np.sum(four[:, 1:] ** 2 - four[:, :1] ** 2, axis=2)
    good = np.abs(np.linalg.det(matrix)) > 1e-6
    if not good.any():
        return None
    centre = np.linalg.solve(matrix[good], right[good][..., None])[..., 0]
    radius = np.linalg.norm(four[good, 0] - centre, axis=1)
    low, high = RADII_M if size_m is None else (0.35 * size_m, 0.65 * size_m)
    right_size = (radius >= low) & (radius <= high) & (np.linalg.norm(centre, axis=1) <= SEARCH_M)
    if not right_size.any():
        return None
    centre, radius = (
        centre[right_size],
        radius[right_size] if size_m is None else np.full(right_size.sum(), size_m / 2.0),
    )
    held = [
        int((np.abs(np.linalg.norm(points - c, axis=1) - r) <= _THIN_M).sum())
        for c, r in zip(centre, radius, strict=True)
    ]
    best = int(np.argmax(held))
    return (centre[best], float(radius[best])) if held[best] >= _FEWEST - 5 else None


def _fitted(points: Array, centre: Array, radius: float, known: bool) -> tuple[Array, float, Array, float]:
    """Least squares of the distances from a sphere: centre, radius, covariance of the centre, scatter."""
    free = 3 if known else 4
    for _ in range(_ROUNDS):
        way = points - centre
        distance = np.linalg.norm(way, axis=1)
        left = distance - radius
        design = np.column_stack([-way / distance[:, None], -np.ones(len(points))])[:, :free]
        weight = 1.0 / (1.0 + (left / _THIN_M) ** 2)
        normal = (design * weight[:, None]).T @ design
        step = -np.linalg.lstsq(normal, (design * weight[:, None]).T @ left, rcond=None)[0]
        centre = centre + step[:3]
        radius = radius if known else radius + float(step[3])
        if np.abs(step).max() < 1e-6:
            break
    left = np.linalg.norm(points - centre, axis=1) - radius
    variance = float(np.sum(weight * left**2)) / max(float(weight.sum()) - free, 1.0)
    meat = (design * (weight * left)[:, None]).T @ (design * (weight * left)[:, None])
    inverse = np.linalg.pinv(normal, hermitian=True)
    covariance = np.maximum(1.0, len(points) / max(len(points) - free, 1)) * inverse @ meat @ inverse
    return centre, radius, covariance[:3, :3], float(np.sqrt(variance))


def _is_ball(
    points: Array, on: npt.NDArray[np.bool_], centre: Array, radius: float, scatter: float, covariance: Array
) -> bool:
    way = points - centre
    around = np.linalg.norm(way, axis=1) <= 1.5 * radius
    if not RADII_M[0] <= radius <= RADII_M[1] or scatter > _THIN_M or on.sum() < _FEWEST:
        return False
    if (around & on).sum() < _OF_ALL * around.sum() or np.sqrt(np.diag(covariance).max()) > _SHARP_M:
        return False
    unit = way[on] / np.linalg.norm(way[on], axis=1)[:, None]
    quarter = np.unique(np.floor(np.arctan2(unit[:, 1], unit[:, 0]) / (np.pi / 2.0)).astype(int))
    # the cap and the shoulders are seen, on three sides at least
    if len(quarter) < 3 or unit[:, 2].max() < 0.7 or np.percentile(unit[:, 2], 20) > 0.75:
        return False
    count, cost = int(on.sum()), float(np.sum((np.linalg.norm(way[on], axis=1) - radius) ** 2))
    own = count * np.log(cost / count) + 4 * np.log(count)
    return bool(own + _BETTER < _rivals(way[on]))


def _rivals(points: Array) -> float:
    """The least BIC of a plane, and of a rod, of some points about their middle."""
    count = len(points)
    off = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(off, full_matrices=False)
    plane = count * np.log(max(spread[2] ** 2, 1e-12) / count) + 3 * np.log(count)
    best = float(plane)
    for axis in axes:
        side = off - np.outer(off @ axis, axis)
        _, _, two = np.linalg.svd(side, full_matrices=False)
        flat = side @ two[:2].T
        design = np.column_stack([flat, np.ones(count)])
        solution, *_ = np.linalg.lstsq(design, np.sum(flat**2, axis=1), rcond=None)
        radius = np.sqrt(max(solution[2] + solution[0] ** 2 / 4 + solution[1] ** 2 / 4, 1e-6))
        left = np.linalg.norm(flat - solution[:2] / 2.0, axis=1) - radius
        best = min(best, float(count * np.log(max(float(left @ left), 1e-12) / count) + 5 * np.log(count)))
    return best
