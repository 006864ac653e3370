"""The images of one instant as one wide image: what a single camera would have seen from the middle of the rig.

Cameras of a rig look from places some decimetres apart. Rays of the wide image end on the surface that the lidar saw, and what is there is
looked up in every camera that sees it; so a roof near the camera fits as well as the ground behind it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from groundproc.imagery.camera import EQUIDISTANT, NONE, Camera
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import Block, Image, eye_of
from groundproc.imagery.painting.paint import depths_of
from groundproc.imagery.painting.scene import Scene
from groundproc.imagery.painting.views import MOST, NOBODY, Views, sampled
from groundproc.imagery.painting.visibility import ROLLS, Depths
from groundproc.imagery.radiance import TEMPERATURE

Array = npt.NDArray[np.float64]
Raster = npt.NDArray[np.float32]
Load = Callable[[Image], tuple[tuple[str, ...], Raster]]
"""Gives the bands of an image and its picture, shape (height, width, planes), of full scale 1."""

_FLAT_RAD: Final = np.deg2rad(52.0)
"""Half of the widest field that a central projection shows without stretching its edges fourfold; beyond it is a fish-eye."""
_MOST_PIXELS: Final = 200_000_000
_ROWS: Final = 128
"""Of the wide image in memory at once."""
_SEAM: Final = 6.0
"""Power of the weights towards the edges of pictures: seams are soft over few pixels, and what is off by one is not blurred everywhere."""
_STEP: Final = 8
"""Every so many pixels, both ways, exposures are compared."""
_BEHIND_M: Final = 0.15
_BEHIND: Final = 0.01
"""In metres and of the range, by which a place may lie behind what a camera sees there."""
_BORDER: Final = 25
"""Samples along each side of a picture by which its outline is known."""


@dataclass(frozen=True, slots=True)
class Instant:
    """Images that were taken at once.

    Attributes
    ----------
    images : tuple of Image
        Of different cameras.
    utc_ns : int
        Mean.
    """

    images: tuple[Image, ...]
    utc_ns: int


@dataclass(frozen=True, slots=True)
class Wide:
    """A camera that stands for the rig.

    Attributes
    ----------
    camera : Camera
    mat_wide_cam : dict of int to ndarray, shape (3, 3)
        By camera of the rig.
    place_wide_m : dict of int to ndarray, shape (3,)
        Projection centres of the cameras in its frame.
    spread_rad : float
        How far, rms, cameras turned against each other from one instant to the next: what their poses leave.
    """

    camera: Camera
    mat_wide_cam: dict[int, Array]
    place_wide_m: dict[int, Array]
    spread_rad: float


def instants(images: Sequence[Image], utc_ns: Sequence[int], within_s: float) -> list[Instant]:
    """Images that belong together: of cameras that are not the same, no more than so far apart in time; pairs and more."""
    order = sorted(range(len(images)), key=lambda number: (utc_ns[number], images[number].name))
    found: list[Instant] = []
    group: list[int] = []

    def close() -> None:
        if len(group) > 1:
            first_ns = utc_ns[group[0]]
            mean_ns = first_ns + round(sum(utc_ns[n] - first_ns for n in group) / len(group))
            found.append(Instant(tuple(images[n] for n in group), mean_ns))
        group.clear()

    for number in order:
        cameras = {images[n].camera for n in group}
        if group and (utc_ns[number] - utc_ns[group[0]] > within_s * 1e9 or images[number].camera in cameras):
            close()
        group.append(number)
    close()
    return found


def wide_of(block: Block, found: Sequence[Instant]) -> Wide:
    """The camera that stands for the rig: looks where its cameras look in the mean, and sees all that they see, as finely as the finest.

    Its x axis is the mean of theirs; how the cameras stand to each other is the mean of all instants.
    """
    whole = max(found, key=lambda each: len(each.images))
    base = min(image.camera for image in whole.images)
    turns: dict[int, list[Array]] = {}
    arms: dict[int, list[Array]] = {}
    for instant in found:
        first = next((image for image in instant.images if image.camera == base), None)
        if first is None:
            continue
        for image in instant.images:
            turns.setdefault(image.camera, []).append(first.eye.mat_cam_local @ image.eye.mat_cam_local.T)
            arms.setdefault(image.camera, []).append(first.eye.mat_cam_local @ (image.eye.place_m - first.eye.place_m))
    mean = {camera: nearest_rotation(np.sum(each, axis=0)) for camera, each in turns.items()}
    off = [np.linalg.norm(one - mean[camera]) ** 2 / 2.0 for camera, each in turns.items() for one in each]
    axis = np.sum([mat[:, 2] for mat in mean.values()], axis=0)
    axis /= np.linalg.norm(axis)
    right = np.sum([mat[:, 0] for mat in mean.values()], axis=0)
    if np.linalg.norm(right) < 0.5 * len(mean):  # they are turned about their axes: as the first one
        right = np.array([1.0, 0.0, 0.0])
    right -= (right @ axis) * axis
    right /= np.linalg.norm(right)
    mat_wide_base = np.stack([right, np.cross(axis, right), axis])
    middle = np.mean([np.mean(each, axis=0) for each in arms.values()], axis=0)
    mats = {camera: mat_wide_base @ mat for camera, mat in mean.items()}
    places = {camera: mat_wide_base @ (np.mean(each, axis=0) - middle) for camera, each in arms.items()}
    return Wide(_lens(block, mats), mats, places, float(np.sqrt(np.mean(off))))


def nearest_rotation(matrix: Array) -> Array:
    """The rotation nearest to a matrix, shape (3, 3)."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)


def _lens(block: Block, mats: dict[int, Array]) -> Camera:
    """A lens whose picture holds the outlines of all pictures."""
    rays = np.concatenate([_outline(block.rig.cameras[camera].camera) @ mat.T for camera, mat in mats.items()])
    focal = max(block.rig.cameras[camera].camera.focal_px for camera in mats)
    angle = np.arccos(np.clip(rays[:, 2], -1.0, 1.0))
    model = NONE if angle.max() <= _FLAT_RAD else EQUIDISTANT
    across = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-12)
    reach = np.tan(angle) if model == NONE else angle
    place = rays[:, :2] / across[:, None] * reach[:, None]
    low, high = place.min(axis=0), place.max(axis=0)
    focal = min(focal, float(np.sqrt(_MOST_PIXELS / np.prod(high - low))))
    width, height = np.ceil(focal * (high - low)).astype(int).tolist()
    centre = -focal * low - 0.5
    return Camera(max(width, 1), max(height, 1), focal, (float(centre[0]), float(centre[1])), model)


def _outline(camera: Camera) -> Array:
    """Unit rays of the edge of a picture as far as its lens reaches, shape (n, 3)."""
    across = np.linspace(-0.5, camera.width_px - 0.5, _BORDER)
    down = np.linspace(-0.5, camera.height_px - 0.5, _BORDER)
    sides = [(u, v) for u in across for v in (down[0], down[-1])] + [
        (u, v) for u in (across[0], across[-1]) for v in down
    ]
    rays, reached = camera.unproject(np.array(sides))
    return rays[reached]


def posed(wide: Wide, instant: Instant) -> tuple[Array, Array]:
    """Where the wide camera was: local frame from camera, shape (3, 3), and place, shape (3,); the mean of what its images say."""
    known = [image for image in instant.images if image.camera in wide.mat_wide_cam]
    mat = nearest_rotation(
        np.sum([image.eye.mat_cam_local.T @ wide.mat_wide_cam[image.camera].T for image in known], axis=0)
    )
    place = np.mean([image.eye.place_m - mat @ wide.place_wide_m[image.camera] for image in known], axis=0)
    return mat, np.asarray(place)


@dataclass(frozen=True, slots=True)
class _Source:
    """An image that gives part of the wide one."""

    image: Image
    camera: Camera
    bands: tuple[str, ...]
    shown: Raster
    depths: Depths | None


def merged(
    block: Block, scene: Scene, wide: Wide, instant: Instant, bands: Sequence[str], load: Load, balance: bool
) -> Raster:
    """The wide image of an instant, shape (height, width, bands), of full scale 1; NaN where no camera sees.

    Raises
    ------
    CaptureError
        A picture cannot be read.
    """
    mat, place_m = posed(wide, instant)
    eye = eye_of(wide.camera, mat, place_m)
    own = Image("", instant.images[0].path, instant.images[0].camera, eye)
    ranges = _ranges(block, scene, wide.camera, own)
    sources = []
    for image in instant.images:
        found = depths_of(block, image, scene)
        camera = block.rig.cameras[image.camera].camera
        sources.append(_Source(image, camera, *load(image), None if found is None else found[0]))
    factor = _factors(wide.camera, sources, bands, (mat, place_m), ranges) if balance else {}
    out = np.full((wide.camera.height_px, wide.camera.width_px, len(bands)), np.nan, np.float32)
    for top in range(0, wide.camera.height_px, _ROWS):
        rows = np.arange(top, min(top + _ROWS, wide.camera.height_px))
        points = _points(wide.camera, rows, np.arange(wide.camera.width_px), (mat, place_m), ranges)
        value, weight = np.zeros((len(points), len(bands))), np.zeros((len(points), len(bands)))
        for number, source in enumerate(sources):
            _add(source, points, bands, factor.get(number), value, weight)
        with np.errstate(invalid="ignore"):
            part = np.where(weight > 0.0, value / np.where(weight > 0.0, weight, 1.0), np.nan)
        out[rows] = part.reshape(len(rows), -1, len(bands))
    return out


def _ranges(block: Block, scene: Scene, camera: Camera, own: Image) -> Raster:
    """Distance to the surface for each pixel of a coarse picture of the wide camera, gaps closed by their neighbours."""
    rig = replace(block.rig, cameras=tuple(replace(one, camera=camera) for one in block.rig.cameras))
    found = depths_of(replace(block, rig=rig), own, scene)
    if found is None:
        return np.full((1, 1), np.float32(np.inf))
    nearest = found[0].nearest
    empty = ~np.isfinite(nearest)
    _, places = ndimage.distance_transform_edt(empty, return_indices=True)
    # through a gap between points single pixels show what is behind
    return np.asarray(ndimage.median_filter(nearest[tuple(places)], 3))


def _points(camera: Camera, rows: Any, columns: Any, pose: tuple[Array, Array], ranges: Raster) -> Array:
    """Places on the surface of pixels of the wide image, shape (n, 3), in the local frame; NaN beyond its lens."""
    mat, place_m = pose
    u, v = (each.ravel().astype(np.float64) for each in np.meshgrid(columns, rows))
    rays, _ = camera.unproject(np.stack([u, v], axis=1))
    down, right = ranges.shape[0] / (camera.height_px + 1.0), ranges.shape[1] / (camera.width_px + 1.0)
    row = np.clip(((v + 0.5) * down).astype(np.int64), 0, ranges.shape[0] - 1)
    column = np.clip(((u + 0.5) * right).astype(np.int64), 0, ranges.shape[1] - 1)
    return np.asarray(place_m + (rays @ mat.T) * ranges[row, column][:, None])


def _looked_up(source: _Source, points: Array) -> tuple[npt.NDArray[np.intp], Array, Array]:
    """Which points a source sees, what it shows there, shape (k, planes), and with what weight."""
    eye = source.image.eye
    size = np.array([source.camera.width_px, source.camera.height_px])
    way = points - eye.place_m
    pixel, inside = source.camera.project(way @ eye.mat_cam_local.T)
    for _ in range(ROLLS if eye.row_m.any() else 0):
        rows = np.nan_to_num(pixel[:, 1:] - source.camera.middle_row_px)
        pixel, inside = source.camera.project(
            (way - np.clip(rows, -size[1], size[1]) * eye.row_m) @ eye.mat_cam_local.T
        )
    inside &= np.isfinite(pixel).all(axis=1)
    if source.depths is not None:
        distance = np.linalg.norm(way, axis=1)
        near = source.depths.at(np.where(inside[:, None], pixel, 0.0))
        inside &= distance - near <= _BEHIND_M + _BEHIND * distance
    some = np.flatnonzero(inside)
    edge = np.minimum(pixel[some] + 0.5, size - 0.5 - pixel[some]).clip(1e-3) / (0.5 * size)
    return some, sampled(source.shown, pixel[some].astype(np.float32)), np.prod(np.minimum(edge, 1.0), axis=1) ** _SEAM


def _add(
    source: _Source, points: Array, bands: Sequence[str], factor: Array | None, value: Array, weight: Array
) -> None:
    """Add what a source shows to sums over sources, shape (n, bands) each."""
    some, shown, share = _looked_up(source, points)
    for plane, band in enumerate(source.bands):
        at = list(bands).index(band)
        gain = 1.0 if factor is None else factor[at]
        value[some, at] += share * gain * shown[:, plane]
        weight[some, at] += share


def _factors(
    camera: Camera, sources: Sequence[_Source], bands: Sequence[str], pose: tuple[Array, Array], ranges: Raster
) -> dict[int, Array]:
    """What brings the sources to one exposure, by number: a factor for each band."""
    rows, columns = np.arange(0, camera.height_px, _STEP), np.arange(0, camera.width_px, _STEP)
    points = _points(camera, rows, columns, pose, ranges)
    out = {number: np.ones(len(bands)) for number in range(len(sources))}
    looked = [_looked_up(source, points) for source in sources]
    for at, band in enumerate(bands):
        if band == TEMPERATURE:
            continue  # measured: warmer pictures are of warmer things
        having = [number for number, source in enumerate(sources) if band in source.bands]
        views = Views(
            np.full((len(points), MOST), NOBODY), np.zeros((len(points), MOST), np.float32),
            np.zeros((len(points), MOST, 1), np.float32), np.zeros(len(points), np.uint8),
        )  # fmt: skip
        for number in having:
            some, shown, _ = looked[number]
            free = some[views.total[some] < MOST]
            place = views.total[free]
            views.image[free, place] = number
            plane = sources[number].bands.index(band)
            views.value[free, place, 0] = shown[views.total[some] < MOST, plane]
            views.total[free] += 1
        found = gains(views, len(sources), 1.0)[:, 0]
        level = np.exp(np.mean(np.log(found[having])))
        for number in having:
            out[number][at] = found[number] / level
    return out
