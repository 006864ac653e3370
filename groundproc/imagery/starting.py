"""First poses of images from their points alone: resection from known points, the rest one after the other from points that others see.

Where nothing is known, two images are oriented relative to each other (Nister 2004, by OpenCV) with a base of one, and the block is laid
into its coordinates later.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

LEAST_RESECTION: Final = 6
_LEAST_PAIR: Final = 12
_LEAST_ANGLE: Final = np.deg2rad(0.8)
_TOLERANCE: Final = 4e-3
"""Of a ray [rad] in RANSAC: pictures whose distortion is not yet known are off by so much."""


@dataclass(slots=True)
class Sightings:
    """Rays of measured points.

    Attributes
    ----------
    image, point : ndarray of int64, shape (n,)
    ray : ndarray, shape (n, 3)
        In the camera frame, unit.
    images, points : int
    """

    image: Ints
    point: Ints
    ray: Array
    images: int
    points: int


@dataclass(slots=True)
class Placed:
    """What has a place so far.

    Attributes
    ----------
    mat_world_camera : ndarray, shape (i, 3, 3)
    centre_m : ndarray, shape (i, 3)
    posed : ndarray of bool, shape (i,)
    points_m : ndarray, shape (p, 3)
        Not a number where unknown.
    """

    mat_world_camera: Array
    centre_m: Array
    posed: Mask
    points_m: Array


def nothing_placed(sightings: Sightings) -> Placed:
    """To begin with."""
    count = sightings.images
    return Placed(
        np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, np.bool_), np.full((sightings.points, 3), np.nan)
    )  # fmt: skip


def place_all(sightings: Sightings, placed: Placed, held: Mask, tidy: Callable[[Placed], None] | None = None) -> bool:
    """Give poses to as many images as can be; in place.

    Parameters
    ----------
    sightings : Sightings
    placed : Placed
        Poses and points that are known.
    held : ndarray of bool, shape (p,)
        Points whose places are not to be changed.
    tidy : callable, optional
        Adjusts what is placed, now and then.

    Returns
    -------
    bool
        Whether the block lies where it belongs; False: it is relative to its first pair.
    """
    absolute = True
    _intersect(sightings, placed, held)
    if not placed.posed.any() and _any_resection(sightings, placed) is None:
        if not _first_pair(sightings, placed):
            return False
        absolute = False
        _intersect(sightings, placed, held)
    since = 0
    while _any_resection(sightings, placed) is not None:
        since += 1
        _intersect(sightings, placed, held)
        if tidy is not None and since >= max(3, int(placed.posed.sum()) // 4):
            since = 0
            tidy(placed)
    return absolute


def _any_resection(sightings: Sightings, placed: Placed) -> int | None:
    """Pose the image that sees the most known points; its number, None where none can be posed."""
    known = np.asarray(np.isfinite(placed.points_m).all(axis=1))[sightings.point]
    counts = np.bincount(sightings.image[known], minlength=sightings.images)
    counts[placed.posed] = 0
    for image in np.argsort(-counts).tolist():
        if counts[image] < LEAST_RESECTION:
            return None
        if resect(sightings, placed, image, known):
            return int(image)
    return None


def resect(sightings: Sightings, placed: Placed, image: int, known: Mask) -> bool:
    """Pose one image from the known points that it sees."""
    own = known & (sightings.image == image) & (sightings.ray[:, 2] > 0.05)
    if own.sum() < LEAST_RESECTION:
        return False
    flat = np.ascontiguousarray(sightings.ray[own, :2] / sightings.ray[own, 2:])
    points = placed.points_m[sightings.point[own]]
    middle = points.mean(axis=0)
    scale = float(np.abs(points - middle).max()) or 1.0
    object_points = np.ascontiguousarray((points - middle) / scale)
    cv2.setRNGSeed(1)
    done, turn, shift, inliers = cv2.solvePnPRansac(
        object_points, flat, np.eye(3), np.zeros(4), iterationsCount=500, reprojectionError=_TOLERANCE, confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not done or inliers is None or len(inliers) < max(LEAST_RESECTION, 0.3 * len(flat)):
        return False
    chosen = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(object_points[chosen], flat[chosen], np.eye(3), np.zeros(4), turn, shift)
    mat = cv2.Rodrigues(turn)[0]
    placed.mat_world_camera[image] = mat.T
    placed.centre_m[image] = middle - scale * (mat.T @ shift[:, 0])
    placed.posed[image] = True
    return True


def _intersect(sightings: Sightings, placed: Placed, held: Mask) -> None:
    """Points that two posed images or more see under an angle that will do."""
    used = placed.posed[sightings.image]
    image, point = sightings.image[used], sightings.point[used]
    direction = np.einsum("nij,nj->ni", placed.mat_world_camera[image], sightings.ray[used])
    share = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    matrix, right = np.zeros((sightings.points, 3, 3)), np.zeros((sightings.points, 3))
    np.add.at(matrix, point, share)
    np.add.at(right, point, np.einsum("nij,nj->ni", share, placed.centre_m[image]))
    # the weakest direction of the sum of projectors is half the sum of squared angles between the rays
    wanted = ~held & (np.bincount(point, minlength=sightings.points) >= 2)
    wanted[wanted] = np.linalg.eigvalsh(matrix[wanted])[:, 0] > 0.5 * _LEAST_ANGLE**2
    found = np.full_like(placed.points_m, np.nan)
    found[wanted] = np.linalg.solve(matrix[wanted], right[wanted][:, :, None])[:, :, 0]
    ahead = np.einsum("ni,ni->n", found[point] - placed.centre_m[image], direction) > 0.0
    behind = np.zeros(sightings.points, np.bool_)
    behind[point[~ahead]] = True
    found[behind] = np.nan
    placed.points_m[~held] = found[~held]


def _first_pair(sightings: Sightings, placed: Placed) -> bool:
    """Orient the two images with the most common points that see them from two sides."""
    seen = [np.flatnonzero(sightings.image == image) for image in range(sightings.images)]
    sets = [set(sightings.point[rows].tolist()) for rows in seen]
    pairs = [(len(sets[a] & sets[b]), a, b) for a in range(sightings.images) for b in range(a) if sets[a] and sets[b]]
    best: tuple[float, int, int, Array, Array] | None = None
    for common, a, b in sorted(pairs, reverse=True)[:12]:
        if common < _LEAST_PAIR:
            break
        made = _relative(sightings, seen[a], seen[b])
        if made is not None and (best is None or made[0] * np.sqrt(common) > best[0]):
            best = made[0] * np.sqrt(common), a, b, made[1], made[2]
    if best is None:
        return False
    _, a, b, mat, shift = best
    placed.posed[[a, b]] = True
    placed.mat_world_camera[a], placed.centre_m[a] = np.eye(3), np.zeros(3)
    placed.mat_world_camera[b], placed.centre_m[b] = mat.T, -mat.T @ shift
    return True


def _relative(sightings: Sightings, first: Ints, second: Ints) -> tuple[float, Array, Array] | None:
    """Median angle of the rays [rad], rotation and direction of the base of the second image against the first."""
    _, at_first, at_second = np.intersect1d(sightings.point[first], sightings.point[second], return_indices=True)
    one, two = sightings.ray[first[at_first]], sightings.ray[second[at_second]]
    ahead = (one[:, 2] > 0.05) & (two[:, 2] > 0.05)
    flat = [np.ascontiguousarray(rays[ahead, :2] / rays[ahead, 2:]) for rays in (one, two)]
    if len(flat[0]) < _LEAST_PAIR:
        return None
    cv2.setRNGSeed(1)
    essential, inliers = cv2.findEssentialMat(flat[0], flat[1], np.eye(3), cv2.RANSAC, 0.9999, 0.5 * _TOLERANCE)
    if essential is None or essential.shape != (3, 3) or inliers is None or inliers.sum() < _LEAST_PAIR:
        return None
    count, mat, shift, _ = cv2.recoverPose(essential, flat[0], flat[1], np.eye(3), mask=inliers.copy())
    if count < max(_LEAST_PAIR, 0.5 * inliers.sum()):
        return None
    turned = two[ahead][inliers[:, 0] > 0] @ mat
    cosine = np.einsum("ni,ni->n", turned, one[ahead][inliers[:, 0] > 0])
    angle = float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return angle, np.asarray(mat, np.float64), np.asarray(shift[:, 0], np.float64)


def similarity(from_m: Array, to_m: Array) -> tuple[float, Array, Array]:
    """Scale, rotation and shift that lay points, shape (n, 3), on others in least squares (Umeyama 1991): to = s R from + t."""
    middle_from, middle_to = from_m.mean(axis=0), to_m.mean(axis=0)
    a, b = from_m - middle_from, to_m - middle_to
    u, d, v = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    mat = u @ np.diag(sign) @ v
    scale = float((d * sign).sum() / np.square(a).sum())
    return scale, mat, middle_to - scale * mat @ middle_from


def laid(placed: Placed, scale: float, mat: Array, shift_m: Array) -> None:
    """Move, turn and scale what is placed; in place."""
    placed.mat_world_camera[:] = mat @ placed.mat_world_camera
    placed.centre_m[:] = scale * placed.centre_m @ mat.T + shift_m
    placed.points_m[:] = scale * placed.points_m @ mat.T + shift_m
