"""A layer of images laid on a surface seen from straight above: true to place, each pixel from one image, and said which.

Of the images that see a pixel the nearest wins that has it near its middle, where leaning and vignetting are least. A house is taken from
one image as a whole where one sees it all: seams then run over the ground.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.imagery.painting.block import Block, Image, Layer
from groundproc.imagery.painting.paint import Load, depths_of, plain, room, weights
from groundproc.imagery.painting.scene import Scene, localised, mapped
from groundproc.imagery.painting.surface import Surface
from groundproc.imagery.painting.views import NOBODY, Views, insert, sampled
from groundproc.imagery.painting.visibility import Depths, Eye, Seen, project
from groundproc.imagery.painting.visibility import Surface as Known
from groundproc.raster.grid import Grid, Window

SIDE: Final = 512
"""Pixels of a tile."""
_WHOLE: Final = 0.95
"""Share of an object that an image must see to give all of it; its edges are hidden by noise."""
_ROUGH_M: Final = 0.03
_SAMPLED: Final = 16
"""Every so many pixels, both ways, exposures are compared."""

Progress = Callable[[int], object]


@dataclass(frozen=True, slots=True)
class Mosaic:
    """What each pixel shows, and who shows it.

    Attributes
    ----------
    grid : Grid
    value : ndarray, shape (rows, columns, planes)
        As the pictures have it; 0 where nobody sees.
    image : ndarray of uint16, shape (rows, columns)
        Number of the image in its layer; `NOBODY` where none sees.
    shared : Views
        What several images show of some of the pixels: what exposures are compared by.
    failed : tuple of str
        Pictures that could not be read.
    """

    grid: Grid
    value: npt.NDArray[Any]
    image: npt.NDArray[np.uint16]
    shared: Views
    failed: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Tile:
    """Pixels of a part of the grid that have a surface; `sample` numbers some of them, the others are -1."""

    rows: npt.NDArray[np.intp]
    columns: npt.NDArray[np.intp]
    part: npt.NDArray[np.int32]
    sample: npt.NDArray[np.int64]
    known: Known
    centre_m: npt.NDArray[np.float64]
    radius_m: float


def mosaic(
    block: Block,
    layer: Layer,
    scene: Scene,
    surface: Surface,
    grid: Grid,
    folder: Path,
    progress: Progress,
    load: Load | None = None,
) -> Mosaic:
    """Lay a layer on a surface.

    Parameters
    ----------
    block : Block
    layer : Layer
    scene : Scene
        What may stand before it.
    surface : Surface
    grid : Grid
        Of the mosaic.
    folder : Path
        For its arrays.
    progress : callable
        Told of images done, twice for those that give whole objects.
    load : callable, optional
        Gives the picture of an image, shape (height, width, planes). Default: `plain`.
    """
    load = load or plain(block)
    shape = (grid.rows, grid.columns)
    best = mapped(folder / "best", np.float32, shape)
    image = mapped(folder / "shows", np.uint16, shape)
    value = mapped(folder / "shown", layer.dtype, (*shape, len(layer.bands)))
    image[:] = NOBODY
    tiles = list(_tiles(block, scene, surface, grid, folder))
    samples = max((int(tile.sample.max(initial=-1)) for tile in tiles), default=-1) + 1
    shared = room(samples, layer, folder)
    sees = np.zeros((surface.parts + 1, len(layer.images), 2))
    size = np.zeros(surface.parts + 1)
    for tile in tiles:
        size += np.bincount(tile.part, minlength=surface.parts + 1)
    failed = []
    for number, one in enumerate(layer.images):
        try:
            shown = load(one)
        except CaptureError as error:
            failed.append(str(error))
            continue
        for tile, seen, weight in _seen(block, one, scene, tiles):
            rows, columns, part = tile.rows[seen.number], tile.columns[seen.number], tile.part[seen.number]
            sees[:, number, 0] += np.bincount(part, minlength=len(sees))
            sees[:, number, 1] += np.bincount(part, weight, minlength=len(sees))
            some = np.flatnonzero(tile.sample[seen.number] >= 0)
            sample = Seen(tile.sample[seen.number[some]], seen.pixel[some], seen.range_m[some])
            insert(shared, shown, sample, weight[some], number)
            better = weight > best[rows, columns]
            _take(better, rows, columns, number, shown, seen, (image, value))
            best[rows[better], columns[better]] = weight[better]
        progress(1)
    _give_whole(block, layer, scene, tiles, _chosen(sees, size), (image, value), progress, load)
    return Mosaic(grid, value, image, shared, tuple(failed))


def _take(
    chosen: npt.NDArray[np.bool_], rows: Any, columns: Any, number: int, shown: Any, seen: Seen, out: tuple[Any, Any]
) -> None:
    """Give chosen pixels what a picture shows."""
    image, value = out
    image[rows[chosen], columns[chosen]] = number
    value[rows[chosen], columns[chosen]] = sampled(shown, seen.pixel[chosen]).astype(value.dtype)


def _chosen(sees: npt.NDArray[np.float64], size: npt.NDArray[np.float64]) -> dict[int, int]:
    """The image of each object that one sees whole: the one that sees it best."""
    found = {}
    for part in range(1, len(size)):
        whole = sees[part, :, 0] >= _WHOLE * size[part]
        if size[part] and whole.any():
            found[part] = int(np.argmax(np.where(whole, sees[part, :, 1], 0.0)))
    return found


def _give_whole(
    block: Block,
    layer: Layer,
    scene: Scene,
    tiles: list[_Tile],
    chosen: dict[int, int],
    out: Any,
    progress: Progress,
    load: Load,
) -> None:
    """Take objects from their images."""
    for number in sorted(set(chosen.values())):
        parts = np.array([part for part, image in chosen.items() if image == number], np.int32)
        having = [tile for tile in tiles if np.isin(parts, tile.part).any()]
        one = layer.images[number]
        shown = load(one)
        for tile, seen, _ in _seen(block, one, scene, having):
            own = np.isin(tile.part[seen.number], parts)
            _take(own, tile.rows[seen.number], tile.columns[seen.number], number, shown, seen, out)
        progress(1)


def _tiles(block: Block, scene: Scene, surface: Surface, grid: Grid, folder: Path) -> Iterator[_Tile]:
    """All pixels that have a surface; their arrays lie in files."""
    spacing = np.float32(np.median([square.spacing_m for square in scene.squares]))
    samples = 0
    for window in grid.blocks(SIDE):
        rows, columns = (index.ravel() for index in np.mgrid[: window.rows, : window.columns])
        height, part, normal = surface.at(*_centres(grid, window, rows, columns))
        there = np.flatnonzero(np.isfinite(height))
        if not len(there):
            continue
        rows, columns = rows[there], columns[there]
        east, north = _centres(grid, window, rows, columns)
        places = np.stack([east, north, height[there]], axis=1)
        corner = np.floor(places.min(axis=0))
        local = localised(block.site, corner, places - corner)
        centre = 0.5 * (local.min(axis=0) + local.max(axis=0))
        local -= centre
        sample = np.where((rows % _SAMPLED == 0) & (columns % _SAMPLED == 0), 0, -1)
        sample[sample == 0] = np.arange(samples, samples := samples + int(np.count_nonzero(sample == 0)))
        top = grid.row + grid.rows - window.row - window.rows
        name = f"{window.column}_{window.row}"
        kept = [
            _kept(folder / f"{name}_{number}.npy", array)
            for number, array in enumerate(
                (
                    rows + top,
                    columns + window.column - grid.column,
                    part[there],
                    sample,
                    local.astype(np.float32),
                    normal[there],
                )
            )
        ]
        flat = np.broadcast_to(spacing, len(there)), np.broadcast_to(np.float32(_ROUGH_M), len(there))
        none = np.zeros(len(there), np.float32)
        known = Known(kept[4], np.ascontiguousarray(flat[0]), kept[5], np.ascontiguousarray(flat[1]), none)
        radius_m = float(np.sqrt((local**2).sum(axis=1).max()))
        yield _Tile(kept[0], kept[1], kept[2], kept[3], known, centre, radius_m)


def _kept(path: Path, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """An array that lies in a file."""
    np.save(path, array)
    return np.asarray(np.load(path, mmap_mode="r"))


def _centres(grid: Grid, window: Window, rows: Any, columns: Any) -> tuple[Any, Any]:
    """Easting and northing of pixels of a window."""
    north = (window.row + window.rows - 0.5 - rows) * grid.cell_m
    return (window.column + 0.5 + columns) * grid.cell_m, north


def _seen(
    block: Block, image: Image, scene: Scene, tiles: list[_Tile]
) -> Iterator[tuple[_Tile, Seen, npt.NDArray[np.float32]]]:
    """The pixels of tiles that an image sees, with its weights."""
    found = depths_of(block, image, scene)
    if found is None:
        return
    depths: Depths = found[0]
    camera = block.rig.cameras[image.camera].camera
    for tile in tiles:
        way = tile.centre_m - image.eye.place_m
        if way @ image.axis + tile.radius_m < 0.0:
            continue
        eye = image.eye._replace(place_m=image.eye.place_m - tile.centre_m)
        seen = project(eye, tile.known.xyz_m)
        if not len(seen.number):
            continue
        some = depths.sees(seen, tile.known, eye.place_m)
        if len(some.number):
            yield tile, some, _from_above(eye, tile, some) * weights(some, camera.width_px, camera.height_px)


def _from_above(eye: Eye, tile: _Tile, seen: Seen) -> npt.NDArray[np.float32]:
    """Square of the cosine of the angle to the plumb line: a mosaic is better of what looks straight down."""
    up = eye.place_m[2] - tile.known.xyz_m[seen.number, 2]
    return np.asarray((up / np.maximum(seen.range_m, 0.1)) ** 2, np.float32)
