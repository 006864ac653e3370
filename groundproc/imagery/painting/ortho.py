"""Ortho mosaics: the ground as it lies on the map, from many images, on the surface that the lidar saw."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import UsageError
from groundproc.cloud import reader
from groundproc.files import written_aside
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import COLOURS, Block, Layer, of_cloud
from groundproc.imagery.painting.mosaic import Mosaic, mosaic
from groundproc.imagery.painting.scene import Scene, laid_out
from groundproc.imagery.painting.surface import Surface, surface_of
from groundproc.imagery.painting.views import NOBODY
from groundproc.imagery.radiance import TEMPERATURE, degrees_of
from groundproc.raster import geotiff
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window, checked_cell

Progress = Callable[[str, int], object]

SUFFIXES: Final = (".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    cloud, images, output : Path
        `images`: folder with poses.csv and rig.yaml.
    gsd_m : float
        Size of a pixel on the ground.
    photos : Path, optional
    bands : tuple of str, optional
        Which layer; default: the colours, or the only one.
    crs : pyproj.CRS, optional
    balance : bool
    all_classes : bool
        Noise and what moves stand too.
    """

    cloud: Path
    images: Path
    output: Path
    gsd_m: float
    photos: Path | None = None
    bands: tuple[str, ...] = ()
    crs: pyproj.CRS | None = None
    balance: bool = True
    all_classes: bool = False

    @property
    def sources(self) -> Path:
        """The second raster: which image made each pixel."""
        return self.output.with_name(f"{self.output.stem}_images{self.output.suffix}")


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    columns, rows, filled : int
    images : tuple of str
        By their number in the second raster, which counts from 1; those that show something and those that do not.
    bands, left_out : tuple of str
    """

    columns: int
    rows: int
    filled: int
    images: tuple[str, ...]
    bands: tuple[str, ...]
    left_out: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Ground:
    """What mosaics of one place are made on."""

    cloud: reader.Cloud
    block: Block
    scene: Scene
    surface: Surface
    grid: Grid
    folder: Path


@contextmanager
def ground(
    cloud: Path,
    images: Path,
    photos: Path | None,
    crs: pyproj.CRS | None,
    gsd_m: float,
    beside: Path,
    progress: Progress,
    all_classes: bool,
) -> Iterator[Ground]:
    """Get ready for mosaics with pixels of a size; the scratch folder lies beside the output, and goes when this is left."""
    checked_cell(gsd_m)
    look, block = of_cloud(cloud, images, photos, crs)
    with laid_out(look, block.site, beside, progress, all_classes) as (scene, folder):
        spacing_m = float(np.median([square.spacing_m for square in scene.squares]))
        surface = surface_of(look, spacing_m, gsd_m, all_classes)
        yield Ground(look, block, scene, surface, _fine(surface.grid, gsd_m), folder)


def ortho(task: Task, progress: Progress) -> Made:
    """Make an ortho mosaic.

    Raises
    ------
    CaptureError, ConfigError, UsageError, SourceError
    """
    with ground(
        task.cloud, task.images, task.photos, task.crs, task.gsd_m, task.output, progress, task.all_classes
    ) as place:
        layer = _layer(place.block, task.bands)
        block = place.block
        made = mosaic(
            block, layer, place.scene, place.surface, place.grid, place.folder, lambda n: progress("images", n)
        )
        factor = gains(made.shared, len(layer.images), layer.full, not task.balance or TEMPERATURE in layer.bands)
        crs = task.crs or place.cloud.crs
        with written_aside(task.output) as aside, written_aside(task.sources) as other:
            bands = [_band(block, layer, name) for name in layer.bands]
            geotiff.write(aside, made.grid, crs, bands, lambda window: _shown(made, layer, factor, window))
            source = Band("image", dtype="uint16", no_data=0, resampling="nearest")
            geotiff.write(other, made.grid, crs, source, lambda window: _number(made, window))
        filled = int(np.count_nonzero(made.image != NOBODY))
        names = tuple(image.name for image in layer.images)
        return Made(made.grid.columns, made.grid.rows, filled, names, layer.bands, (*block.left_out, *made.failed))


def _fine(grid: Grid, gsd_m: float) -> Grid:
    """The same area with other cells, on whole multiples of them."""
    column, row = int(np.floor(grid.west_m / gsd_m)), int(np.floor(grid.row * grid.cell_m / gsd_m))
    right = int(np.ceil((grid.west_m + grid.columns * grid.cell_m) / gsd_m))
    top = int(np.ceil(grid.north_m / gsd_m))
    return Grid(column, row, right - column, top - row, gsd_m)


def _layer(block: Block, bands: Sequence[str]) -> Layer:
    """The layer asked for."""
    known = [layer.bands for layer in block.layers]
    wanted = tuple(bands) or (COLOURS if COLOURS in known else known[0] if len(known) == 1 else ())
    for layer in block.layers:
        if layer.bands == wanted:
            return layer
    listed = "; ".join(", ".join(names) for names in known)
    asked = f"bands {', '.join(wanted)}" if wanted else "no bands"
    raise UsageError(f"--bands: {asked} found, expected those of one kind of pictures: {listed}")


def _band(block: Block, layer: Layer, name: str) -> Band:
    """Of the raster; of temperatures it says how numbers become degrees."""
    band = Band(name, dtype=_dtype(layer).name, no_data=0)
    if name != TEMPERATURE:
        return band
    scale, offset = degrees_of(block.rig.cameras[layer.images[0].camera].response)
    return replace(band, unit="degC", scale=scale, offset=offset)


def _dtype(layer: Layer) -> np.dtype[Any]:
    """Of the raster: as the pictures, but no number of no size that rasters have."""
    return layer.dtype if layer.dtype.itemsize <= 4 else np.dtype(np.float32)


def _part(mosaic: Mosaic, window: Window) -> tuple[slice, slice]:
    """Rows and columns of a window."""
    grid = mosaic.grid
    top = grid.row + grid.rows - window.row - window.rows
    left = window.column - grid.column
    return slice(top, top + window.rows), slice(left, left + window.columns)


def balanced(mosaic: Mosaic, factor: npt.NDArray[np.float32], window: Window) -> npt.NDArray[np.float32]:
    """Values at one exposure, shape (rows, columns, planes); NaN where nobody sees."""
    part = _part(mosaic, window)
    image = mosaic.image[part]
    there = image != NOBODY
    values = mosaic.value[part] * factor[np.where(there, image, 0)]
    return np.where(there[..., None], values, np.nan).astype(np.float32)


def _shown(mosaic: Mosaic, layer: Layer, factor: npt.NDArray[np.float32], window: Window) -> npt.NDArray[Any]:
    """What is written: as the pictures have it, 0 for nothing and 1 for black."""
    values = balanced(mosaic, factor, window)
    if layer.dtype.kind == "f":
        return np.nan_to_num(values)
    return np.where(np.isfinite(values), np.clip(np.rint(values), 1.0, layer.full), 0.0)


def _number(mosaic: Mosaic, window: Window) -> npt.NDArray[Any]:
    image = mosaic.image[_part(mosaic, window)]
    return np.where(image == NOBODY, 0, image + 1)
