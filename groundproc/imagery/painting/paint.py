"""One layer of images laid over a cloud, image by image: who sees what, and the best views of each point."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.errors import CaptureError
from groundproc.imagery import pictures
from groundproc.imagery.painting import block as blocks
from groundproc.imagery.painting import views as best
from groundproc.imagery.painting.block import Block, Image, Layer
from groundproc.imagery.painting.scene import Scene, Square, mapped, towards
from groundproc.imagery.painting.views import Views
from groundproc.imagery.painting.visibility import Depths, Seen, project
from groundproc.imagery.radiance import evened

Load = Callable[[Image], npt.NDArray[Any]]
"""Gives the picture of an image, shape (height, width, planes)."""

_THREADS: Final = 2
_EDGE: Final = 0.5
"""Weight at the corner of a picture, of that in its middle: lenses are worst there."""


class Painted(NamedTuple):
    """What came of it.

    Attributes
    ----------
    seen : ndarray of int64, shape (images,)
        Points that each image sees.
    failed : tuple of str
        What became of images that could not be read.
    """

    seen: npt.NDArray[np.int64]
    failed: tuple[str, ...]


def plain(block: Block) -> Load:
    """Pictures as the files have them, but for the fall of light to their corners where the rig knows it."""

    def loaded(image: Image) -> npt.NDArray[Any]:
        return evened(pictures.picture(image.path), block.rig.cameras[image.camera])

    return loaded


def room(size: int, layer: Layer, folder: Path) -> Views:
    """Empty views of so many points, in files."""
    planes, dtype = len(layer.bands), layer.dtype
    made = Views(
        mapped(folder / "image", np.uint16, (size, best.MOST)),
        mapped(folder / "weight", np.float32, (size, best.MOST)),
        mapped(folder / "value", dtype if dtype.itemsize <= 4 else np.float32, (size, best.MOST, planes)),
        mapped(folder / "total", np.uint8, (size,)),
    )
    made.image[:] = best.NOBODY
    return made


def part(views: Views, points: slice) -> Views:
    """The views of some points."""
    return Views(views.image[points], views.weight[points], views.value[points], views.total[points])


def paint(
    block: Block, layer: Layer, scene: Scene, views: Views, progress: Callable[[int], object], load: Load | None = None
) -> Painted:
    """Lay all images of a layer over the points of a scene.

    Parameters
    ----------
    block : Block
    layer : Layer
    scene : Scene
    views : Views
        Of all its points; filled.
    progress : callable
        Told of images done.
    load : callable, optional
        Default: `plain`.
    """
    load = load or plain(block)
    locks = {id(square): threading.Lock() for square in scene.squares}

    def one(number: int) -> tuple[int, str]:
        image, count = layer.images[number], 0
        try:
            shown = load(image)
        except CaptureError as error:
            return 0, str(error)
        for square, seen, weight in visible(block, image, scene):
            count += len(seen.number)
            with locks[id(square)]:
                best.insert(part(views, square.points), shown, seen, weight, number)
        progress(1)
        return count, ""

    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(_THREADS))
        running = [pool.submit(one, number) for number in range(len(layer.images))]
        stack.callback(lambda: [each.cancel() for each in running])
        counts, sentences = zip(*(each.result() for each in running), strict=True)
        return Painted(np.array(counts, np.int64), tuple(filter(None, sentences)))


def visible(block: Block, image: Image, scene: Scene) -> Iterator[tuple[Square, Seen, npt.NDArray[np.float32]]]:
    """The points that an image sees, square by square, with the weights of its view of them."""
    found = depths_of(block, image, scene)
    if found is None:
        return
    depths, looked = found
    camera = block.rig.cameras[image.camera].camera
    for square, seen in looked:
        some = depths.sees(seen, scene.surface(square), image.eye.place_m - square.centre_m)
        if len(some.number):
            yield square, some, weights(some, camera.width_px, camera.height_px)


def depths_of(block: Block, image: Image, scene: Scene) -> tuple[Depths, list[tuple[Square, Seen]]] | None:
    """The depth image of a picture, and the points that lie in it, hidden or not; None: there are none."""
    camera = block.rig.cameras[image.camera].camera
    angle = blocks.half_angle_rad(camera)
    near = towards(scene.squares, image.eye.place_m, image.axis, angle)
    looked = [(square, seen) for square in near if len((seen := _in_picture(image, scene, square, angle)).number)]
    if not looked:
        return None
    ranges = np.concatenate([seen.range_m[:: max(1, len(seen.range_m) // 1000)] for _, seen in looked])
    spacing_m = float(np.median([square.spacing_m for square, _ in looked]))
    depths = Depths(image.eye, camera.focal_px, spacing_m, float(np.median(ranges)))
    for square, seen in looked:
        depths.add(seen, scene.surface(square), image.eye.place_m - square.centre_m)
    depths.close()
    return depths, looked


def _in_picture(image: Image, scene: Scene, square: Square, half_angle_rad: float) -> Seen:
    eye = image.eye._replace(place_m=image.eye.place_m - square.centre_m)
    spans = square.spans(image.eye.place_m, image.axis, half_angle_rad)
    return project(eye, scene.xyz_m[square.points], spans)


def weights(seen: Seen, width_px: int, height_px: int) -> npt.NDArray[np.float32]:
    """Of views: near is better, and the middle of the picture."""
    out = np.empty(len(seen.number), np.float32)
    _weigh(seen, width_px, height_px, out)
    return out


@njit(cache=True, nogil=True)
def _weigh(seen: Any, width_px: int, height_px: int, out: Any) -> None:
    square = 0.25 * (width_px**2 + height_px**2)
    for i in range(len(out)):
        across, down = seen.pixel[i, 0] - 0.5 * width_px, seen.pixel[i, 1] - 0.5 * height_px
        range_m = max(seen.range_m[i], 0.1)
        out[i] = (1.0 - (1.0 - _EDGE) * (across * across + down * down) / square) / (range_m * range_m)
