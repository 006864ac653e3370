"""Textures of charts from images: each texel takes what the images that see it agree on, as a point of a cloud does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from flightlog.errors import CaptureError
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import Block, Layer
from groundproc.imagery.painting.charts import Chart
from groundproc.imagery.painting.paint import depths_of, plain, room, weights
from groundproc.imagery.painting.scene import Scene, localised
from groundproc.imagery.painting.views import MOST, NOBODY, Views, blend, insert
from groundproc.imagery.painting.visibility import Seen, Surface, project

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

UNSEEN: Final = 128
"""Grey of texels that no image sees."""
_ROUGH_M: Final = 0.03
_LEAST: Final = 0.05
"""Of the cosine to the normal: what is seen from the side counts little, and not nothing."""
_LITTLE: Final = 0.25
"""Of the best view's weight: one that may show its place twice as far off has no say."""
_EVERY: Final = 37
"""Of the texels, one in so many tells exposures."""


@dataclass(frozen=True, slots=True)
class _Texels:
    """Texels of a chart in the local frame, and what images show of them."""

    known: Surface
    centre_m: Array
    radius_m: float
    views: Views


@dataclass(frozen=True, slots=True)
class Textured:
    """Textures and what became of them.

    Attributes
    ----------
    pictures : list of ndarray of uint8, shape (height, width, 3)
        One a chart.
    texels, seen : int
    failed : tuple of str
        Images that could not be read.
    """

    pictures: list[Picture]
    texels: int
    seen: int
    failed: tuple[str, ...]


def textured(
    block: Block,
    layer: Layer,
    scene: Scene,
    made: Sequence[Chart],
    cell_m: float,
    folder: Path,
    balance: bool,
    progress: Callable[[int], object],
) -> Textured:
    """Paint charts.

    Parameters
    ----------
    block : Block
    layer : Layer
        Of three planes: red, green, blue.
    scene : Scene
        What may stand before them.
    made : sequence of Chart
    cell_m : float
        Of the surface that they are of: walls stand nowhere more exactly.
    folder : Path
        For arrays.
    balance : bool
    progress : callable
        Told of images done.
    """
    spacing_m = float(np.median([square.spacing_m for square in scene.squares]))
    texels = [
        _texels(block, layer, chart, (spacing_m, cell_m), folder / str(number)) for number, chart in enumerate(made)
    ]
    failed, load = [], plain(block)
    for number, image in enumerate(layer.images):
        found = depths_of(block, image, scene)
        if found is None:
            continue
        try:
            shown = load(image)
        except CaptureError as error:
            failed.append(str(error))
            continue
        camera = block.rig.cameras[image.camera].camera
        for each in texels:
            way = each.centre_m - image.eye.place_m
            if way @ image.axis + each.radius_m < 0.0:
                continue
            eye = image.eye._replace(place_m=-way)
            seen = found[0].sees(project(eye, each.known.xyz_m), each.known, eye.place_m)
            if len(seen.number):
                weight = weights(seen, camera.width_px, camera.height_px) * _facing(
                    each.known, seen, eye.place_m, camera.focal_px
                )
                insert(each.views, shown, seen, weight.astype(np.float32), number)
        progress(1)
    factor = gains(_sampled([each.views for each in texels]), len(layer.images), layer.full, measured=not balance)
    pictures = [
        _picture(chart, blend(each.views, factor, layer.full, 1, little=_LITTLE) * (255.0 / layer.full))
        for chart, each in zip(made, texels, strict=True)
    ]
    total = sum(int(np.count_nonzero(each.views.total)) for each in texels)
    return Textured(pictures, sum(len(chart.texel) for chart in made), total, tuple(failed))


def _texels(block: Block, layer: Layer, chart: Chart, sizes_m: tuple[float, float], folder: Path) -> _Texels:
    folder.mkdir()
    spacing_m, cell_m = sizes_m
    corner = np.floor(chart.place_m.min(axis=0))
    local = localised(block.site, corner, chart.place_m - corner)
    centre = 0.5 * (local.min(axis=0) + local.max(axis=0))
    local -= centre
    count = len(local)
    rough = 0.5 * cell_m if chart.steep else _ROUGH_M
    known = Surface(
        local.astype(np.float32), np.full(count, spacing_m, np.float32), chart.normal.astype(np.float32),
        np.full(count, rough, np.float32), np.zeros(count, np.float32),
    )  # fmt: skip
    return _Texels(known, centre, float(np.sqrt((local**2).sum(axis=1).max())), room(count, layer, folder))


def _facing(known: Surface, seen: Seen, place_m: Array, focal_px: float) -> npt.NDArray[np.float64]:
    """What a view of a texel weighs by the angle that it is seen at: as one over the square of how far off it may show its place.

    That is a pixel, drawn out over the surface, and how exactly the surface lies where it is, drawn out more: a wall that is off by half a
    cell shows the ground at its foot to who looks down along it.
    """
    way = place_m - known.xyz_m[seen.number]
    cosine = (way * known.normal[seen.number]).sum(axis=1) / np.maximum(seen.range_m, 1e-6)
    square = np.clip(cosine, _LEAST, 1.0) ** 2
    pixels = known.rough_m[seen.number] * focal_px / np.maximum(seen.range_m, 1e-6)
    return np.asarray(square / (1.0 + (1.0 - square) * pixels**2))


def _sampled(views: Sequence[Views]) -> Views:
    """Some of all texels."""
    if not views:
        return Views(
            np.full((0, MOST), NOBODY), np.zeros((0, MOST), np.float32), np.zeros((0, MOST, 3)), np.zeros(0, np.uint8)
        )
    parts: list[Any] = [np.concatenate([each[field][::_EVERY] for each in views]) for field in range(4)]
    return Views(*parts)


def _picture(chart: Chart, values: npt.NDArray[np.float32]) -> Picture:
    """The texture of a chart; what no triangle shows is as its nearest texel, so that no edge mixes with another colour."""
    wide, high = chart.size_px
    out = np.full((high, wide, 3), UNSEEN, np.uint8)
    shown = np.zeros((high, wide), np.bool_)
    seen = np.isfinite(values).all(axis=1)
    column, row = chart.texel.T
    out[row[seen], column[seen]] = np.clip(np.rint(values[seen]), 0.0, 255.0)
    shown[row, column] = True
    if not shown.all():
        _, places = ndimage.distance_transform_edt(~shown, return_indices=True)
        out = out[tuple(places)]
    return out
