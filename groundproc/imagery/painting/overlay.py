"""The lidar over a photograph: points that it sees, in colours of their height, on its grey. Whether both agree is seen at edges."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.files import make_folder, written_aside
from groundproc.imagery import pictures
from groundproc.imagery.painting.block import Block, Image, Layer
from groundproc.imagery.painting.paint import visible
from groundproc.imagery.painting.scene import Scene

Picture = npt.NDArray[np.uint8]

_LONGEST_PX: Final = 1600
"""Side of an overlay; larger pictures are made smaller."""
_APART_PX: Final = 4
"""A point is drawn for each square so wide, the nearest: the picture stays to be seen between them."""
_SPAN: Final = (2.0, 98.0)
"""Percentiles between which grey and colours span."""
_DIM: Final = 0.75


def overlays(
    folder: Path, block: Block, layers: Sequence[Layer], seen: Sequence[npt.NDArray[np.int64]], scene: Scene
) -> tuple[str, ...]:
    """Write a picture for each camera: of its image that sees most points. Gives the names of the files.

    Parameters
    ----------
    folder : Path
    block : Block
    layers : sequence of Layer
    seen : sequence of ndarray
        Points that each image of each layer sees.
    scene : Scene
    """
    best: dict[int, tuple[int, Image]] = {}
    for layer, counts in zip(layers, seen, strict=True):
        for image, count in zip(layer.images, counts.tolist(), strict=True):
            if count > best.get(image.camera, (0, image))[0]:
                best[image.camera] = (count, image)
    make_folder(folder)
    names = []
    for camera, (_, image) in sorted(best.items()):
        try:
            shown = pictures.picture(image.path)
        except CaptureError:
            continue  # it was named when it was laid on the points
        name = f"{block.rig.cameras[camera].name}.png"
        with written_aside(folder / name) as aside:
            _write(aside, drawn(shown, *_points(block, image, scene)))
        names.append(name)
    return tuple(names)


def _write(path: Path, picture: Picture) -> None:
    done, coded = cv2.imencode(".png", picture[..., ::-1])
    assert done
    path.write_bytes(coded.tobytes())


def _points(block: Block, image: Image, scene: Scene) -> tuple[npt.NDArray[np.float64], ...]:
    """Pixels, ranges and heights of the points that an image sees."""
    found = [
        (seen.pixel, seen.range_m, scene.xyz_m[square.points][seen.number, 2] + square.centre_m[2])
        for square, seen, _ in visible(block, image, scene)
    ]
    pixel, range_m, height_m = zip(*found, strict=True)
    return np.concatenate(pixel).astype(np.float64), np.concatenate(range_m), np.concatenate(height_m)


def drawn(
    shown: npt.NDArray[Any],
    pixel: npt.NDArray[np.float64],
    range_m: npt.NDArray[np.float64],
    height_m: npt.NDArray[np.float64],
) -> Picture:
    """The overlay, shape (height, width, 3): red, green, blue.

    Parameters
    ----------
    shown : ndarray, shape (height, width, planes)
    pixel : ndarray, shape (n, 2)
        Where points are in the picture.
    range_m, height_m : ndarray, shape (n,)
    """
    scale = min(1.0, _LONGEST_PX / max(shown.shape[:2]))
    size = max(1, round(shown.shape[1] * scale)), max(1, round(shown.shape[0] * scale))
    grey = cv2.resize(np.ascontiguousarray(shown.mean(axis=2), np.float32), size, interpolation=cv2.INTER_AREA)
    out = np.repeat((_DIM * _spanned(grey))[..., None], 3, axis=2).astype(np.uint8)
    place = np.clip(np.floor((pixel + 0.5) * scale).astype(np.int64), 0, np.array(size) - 1)
    cell = place // _APART_PX
    key = cell[:, 1] * (size[0] // _APART_PX + 1) + cell[:, 0]
    order = np.lexsort((range_m, key))
    first = order[np.unique(key[order], return_index=True)[1]]
    colours = cv2.applyColorMap(_spanned(height_m[first]).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    for down in range(2):
        for right in range(2):
            rows, columns = place[first, 1] + down, place[first, 0] + right
            inside = (rows < size[1]) & (columns < size[0])
            out[rows[inside], columns[inside]] = colours[inside]
    return out


def _spanned(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """From 0 to 255 between the usual lowest and highest."""
    low, high = np.percentile(values, _SPAN)
    return np.asarray(np.clip((values - low) * (255.0 / max(high - low, 1e-9)), 0.0, 255.0))
