"""Tie points: SIFT in every image, matched between images that see the same ground, near the epipolar lines that the poses predict.

Sources: Lowe (2004) for features and the ratio of distances, Arandjelovic & Zisserman (2012) for the root of descriptors, Barath et al.
(2020, MAGSAC++, by OpenCV) for what is left of wrong matches.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.imagery.camera import Camera
from groundproc.imagery.pictures import gray

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

LONGEST_PX: Final = 2000
"""Images are looked at with sides of so many pixels at most; larger ones than four times that at a quarter of their size."""
MOST_FEATURES: Final = 4000
RATIO: Final = 0.8
LEAST_MATCHES: Final = 15
MOST_NEIGHBOURS: Final = 14
SIGMA_PX: Final = 0.5
"""Of a feature of the finest scale, in the pixels that were looked at."""
_FINE_SIZE: Final = 4.0
_OUTLIER_PX: Final = 2.5
_BAND_PX: Final = 3.0
_WORST_TURN_RAD: Final = np.deg2rad(6.0)
"""Attitudes less certain than this are a gimbal's word: no lines are drawn by them."""


@dataclass(frozen=True, slots=True)
class Features:
    """Features of an image.

    Attributes
    ----------
    pixel : ndarray, shape (n, 2)
        Of the file.
    ray : ndarray, shape (n, 3)
        Unit, camera frame.
    sigma_px : ndarray, shape (n,)
    descriptor : ndarray of float32, shape (n, 128)
    pixel_size : float
        Of the picture that was looked at, in pixels of the file.
    """

    pixel: Array
    ray: Array
    sigma_px: Array
    descriptor: npt.NDArray[np.float32]
    pixel_size: float


def features_of(path: Path, camera: Camera, longest_px: int = LONGEST_PX) -> Features:
    """SIFT features of an image, spread over it.

    Raises
    ------
    CaptureError
        It cannot be read, or is of another size than the camera.
    """
    plane, size = gray(path, max(longest_px, max(camera.width_px, camera.height_px) // 4))
    # without precise upscaling OpenCV's features lie a quarter of a pixel off
    sift = cv2.SIFT.create(
        nfeatures=0, contrastThreshold=0.02, edgeThreshold=12.0, sigma=1.6, enable_precise_upscale=True
    )
    points, descriptors = sift.detectAndCompute(plane, None)
    if descriptors is None or len(points) == 0:
        raise CaptureError(f"{path}: has no features: is it blank or out of focus?")
    place = np.array([point.pt for point in points], np.float64)
    extent = np.array([point.size for point in points], np.float64)
    response = np.array([point.response for point in points], np.float64)
    # one feature has several orientations where its surroundings are ambiguous: the strongest stands first
    _, first = np.unique(place, axis=0, return_index=True)
    chosen = _spread(place[first], response[first], plane.shape, MOST_FEATURES)
    kept = first[chosen]
    root = np.asarray(descriptors, np.float32)[kept]
    root = np.sqrt(root / np.maximum(root.sum(axis=1, keepdims=True), 1e-9))
    pixel = (place[kept] + 0.5) * size - 0.5
    ray, reached = camera.unproject(pixel)
    sigma = SIGMA_PX * size * np.maximum(1.0, extent[kept] / _FINE_SIZE)
    return Features(pixel[reached], ray[reached], sigma[reached], root[reached].astype(np.float32), size)


def _spread(place: Array, response: Array, shape: tuple[int, ...], most: int) -> Ints:
    """The strongest features of each cell of a grid, so many in all."""
    order = np.argsort(-response, kind="stable")
    if len(order) <= most:
        return np.asarray(order)
    across = max(1, round(np.sqrt(most / 20.0)))
    cell = (place[order] / np.array([shape[1], shape[0]]) * across).astype(np.int64).clip(0, across - 1)
    key = cell[:, 1] * across + cell[:, 0]
    by_cell = np.argsort(key, kind="stable")
    starts = np.searchsorted(key[by_cell], np.arange(across * across))
    rank = np.empty(len(order), np.int64)
    rank[by_cell] = np.arange(len(order)) - starts[key[by_cell]]
    return np.asarray(order[np.argsort(rank, kind="stable")[:most]])


@dataclass(frozen=True, slots=True)
class Views:
    """What is known of the poses before matching.

    Attributes
    ----------
    place_m : ndarray, shape (i, 3)
        Projection centres, local.
    mat_local_camera : ndarray, shape (i, 3, 3)
    posed : ndarray of bool, shape (i,)
    turn_sigma_rad, place_sigma_m : ndarray, shape (i,)
    ground_m : float
        Height of the ground; not a number where unknown.
    """

    place_m: Array
    mat_local_camera: Array
    posed: Mask
    turn_sigma_rad: Array
    place_sigma_m: Array
    ground_m: float


def pairs_of(views: Views, cameras: list[Camera]) -> list[tuple[int, int]]:
    """Images that see common ground: by their footprints where poses are known, else all of few and neighbours of many."""
    count = len(cameras)
    every = [(a, b) for a in range(count) for b in range(a + 1, count)]
    if not views.posed.all() or not np.isfinite(views.ground_m):
        return every if count <= 60 else [(a, b) for a, b in every if b - a <= MOST_NEIGHBOURS]
    share = np.zeros((count, count))
    grids = [_footprint(views, cameras[a], a) for a in range(count)]
    for a, b in every:
        share[a, b] = share[b, a] = min(_seen(views, cameras[b], b, grids[a]), _seen(views, cameras[a], a, grids[b]))
    best = np.argsort(-share, axis=1)[:, :MOST_NEIGHBOURS]
    near = np.zeros_like(share, np.bool_)
    np.put_along_axis(near, best, True, axis=1)
    return [(a, b) for a, b in every if share[a, b] >= 0.1 and (near[a, b] or near[b, a])]


def _footprint(views: Views, camera: Camera, image: int) -> Array:
    """Places on the ground that an image sees, on a grid over it, shape (n, 3)."""
    axes = [np.linspace(0.02, 0.98, 7) * size for size in (camera.width_px, camera.height_px)]
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays, reached = camera.unproject(pixels)
    looks = rays[reached] @ views.mat_local_camera[image].T
    below = views.ground_m - views.place_m[image, 2]
    down = looks[:, 2] < -0.05
    return np.asarray(views.place_m[image] + looks[down] * (below / looks[down, 2])[:, None])


def _seen(views: Views, camera: Camera, image: int, places: Array) -> float:
    """Share of places that an image sees, give or take what its pose may be off."""
    if not len(places):
        return 0.0
    pixels, _ = camera.project((places - views.place_m[image]) @ views.mat_local_camera[image])
    margin = 3.0 * views.turn_sigma_rad[image] * camera.focal_px
    margin += 3.0 * views.place_sigma_m[image] * camera.focal_px / max(views.place_m[image, 2] - views.ground_m, 1.0)
    return float(camera.holds(pixels, -min(margin, 0.2 * camera.width_px)).mean())


def band_rad(views: Views, a: int, b: int) -> float:
    """Half the width of the band about an epipolar line [rad]: three sigmas of what two poses may be off; infinite if unknown."""
    if not (views.posed[a] and views.posed[b]):
        return np.inf
    base = float(np.linalg.norm(views.place_m[a] - views.place_m[b]))
    turn = np.hypot(views.turn_sigma_rad[a], views.turn_sigma_rad[b])
    if turn > _WORST_TURN_RAD:
        return np.inf
    aside = np.hypot(views.place_sigma_m[a], views.place_sigma_m[b]) / max(base, 1e-6)
    return float(3.0 * np.hypot(turn, min(aside, 1.0))) if base > 0.01 else np.inf


def matched(a: Features, b: Features, mats: tuple[Array, Array], base: Array, band: float) -> Ints:
    """Matches of two images, shape (n, 2): mutual, distinct among what lies in the band, and of one epipolar geometry.

    Parameters
    ----------
    a, b : Features
    mats : tuple of ndarray
        Local from camera of both.
    base : ndarray, shape (3,)
        From one projection centre to the other, local.
    band : float
        Half its width [rad]; infinite where nothing is known.
    """
    alike = a.descriptor @ b.descriptor.T
    pixel_rad = 1.0 / max(_focal(a), 1.0)
    width = band + _BAND_PX * pixel_rad
    if np.isfinite(width) and width < 0.5:
        towards = base / np.linalg.norm(base)
        normal = np.cross(a.ray @ mats[0].T, towards)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        off = normal.astype(np.float32) @ (b.ray @ mats[1].T).T.astype(np.float32)
        alike[np.abs(off) > width] = -1.0
    found = _distinct(alike)
    return found[_consistent(a, b, found)] if len(found) >= LEAST_MATCHES else found[:0]


def _focal(one: Features) -> float:
    """Pixels of the file a radian, by the features themselves, over the size of the pixels that were looked at."""
    if len(one.pixel) < 2:
        return 1000.0
    i, j = int(np.argmin(one.pixel[:, 0])), int(np.argmax(one.pixel[:, 0]))
    angle = np.arccos(np.clip(one.ray[i] @ one.ray[j], -1.0, 1.0))
    return float(np.linalg.norm(one.pixel[i] - one.pixel[j]) / max(angle, 1e-6) / one.pixel_size)


def _distinct(alike: npt.NDArray[np.float32]) -> Ints:
    """Mutual nearest neighbours whose distance is less than RATIO of that to the second, both ways."""
    rows = np.arange(len(alike))
    best = alike.argmax(axis=1)
    top = alike[rows, best]
    back = alike.argmax(axis=0)
    second = alike.copy()
    second[rows, best] = -1.0
    next_best = second.max(axis=1)
    # of unit vectors the squared distance is 2 - 2 cos
    good = (back[best] == rows) & (top > 0.6) & ((1.0 - top) < RATIO**2 * (1.0 - next_best))
    return np.stack([rows[good], best[good]], axis=1)


def _consistent(a: Features, b: Features, found: Ints) -> Mask:
    """Which matches are of one epipolar geometry."""
    flat = [
        one.ray[found[:, side], :2] / np.maximum(one.ray[found[:, side], 2:], 0.05) for side, one in enumerate((a, b))
    ]
    scale = _focal(a)
    cv2.setRNGSeed(1)
    try:
        matrix, inside = cv2.findFundamentalMat(
            np.ascontiguousarray(flat[0] * scale),
            np.ascontiguousarray(flat[1] * scale),
            cv2.USAC_MAGSAC,
            _OUTLIER_PX,
            0.9999,
            5000,
        )
    except cv2.error:
        matrix, inside = None, None
    if matrix is None or inside is None or inside.sum() < LEAST_MATCHES:
        return np.zeros(len(found), np.bool_)
    return np.asarray(inside[:, 0] > 0)


def match_all(
    features: list[Features | None], views: Views, pairs: list[tuple[int, int]], told: Callable[[int], None]
) -> Iterator[tuple[int, int, Ints]]:
    """Matches of all pairs, two at a time."""

    def work(pair: tuple[int, int]) -> tuple[int, int, Ints]:
        a, b = pair
        one, two = features[a], features[b]
        if one is None or two is None:
            return a, b, np.empty((0, 2), np.int64)
        mats = views.mat_local_camera[a], views.mat_local_camera[b]
        return a, b, matched(one, two, mats, views.place_m[b] - views.place_m[a], band_rad(views, a, b))

    with ThreadPoolExecutor(2) as pool:
        for done in pool.map(work, pairs):
            told(1)
            yield done
