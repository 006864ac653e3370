"""Vegetation indices: mosaics of two bands as light, put on a scale of reflectance by panels, and their normalised difference."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import UsageError
from groundproc.cloud import reader
from groundproc.cloud.rewriter import Rewriter
from groundproc.files import written_aside
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import Block, Image, Layer
from groundproc.imagery.painting.mosaic import Mosaic, mosaic
from groundproc.imagery.painting.ortho import Ground, balanced, ground
from groundproc.imagery.painting.paint import paint, part, room
from groundproc.imagery.painting.scene import mapped
from groundproc.imagery.painting.views import NOBODY, blend
from groundproc.imagery.radiance import Line, Panel, light, line, read_panels, states_exposure
from groundproc.raster import geotiff
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Window

Progress = Callable[[str, int], object]
Raster = npt.NDArray[np.float32]

INDICES: Final = {
    "ndvi": ("nir", "red"),
    "gndvi": ("nir", "green"),
    "ndre": ("nir", "red_edge"),
    "ndwi": ("green", "nir"),
    "bndvi": ("nir", "blue"),
}
"""Difference over sum of which bands."""
_BRIGHTEST: Final = 99.9
"""Percentile of light that counts as the full scale where exposures are compared."""
_FEWEST: Final = 4
"""Pixels of a panel."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    cloud, images, output : Path
    gsd_m : float
    index : str
        Of `INDICES`.
    panels : Path, optional
    draped : Path, optional
        The cloud with the index of each point.
    photos : Path, optional
    crs : pyproj.CRS, optional
    """

    cloud: Path
    images: Path
    output: Path
    gsd_m: float
    index: str = "ndvi"
    panels: Path | None = None
    draped: Path | None = None
    photos: Path | None = None
    crs: pyproj.CRS | None = None


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    index : str
    columns, rows, filled : int
    calibrated : bool
        Both bands are on a scale of reflectance.
    lines : mapping of str to Line
    median : float
    left_out, warnings : tuple of str
    """

    index: str
    columns: int
    rows: int
    filled: int
    calibrated: bool
    lines: Mapping[str, Line]
    median: float
    left_out: tuple[str, ...]
    warnings: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Source:
    """The mosaic that a band is in, and where."""

    layer: Layer
    mosaic: Mosaic
    plane: int
    factor: npt.NDArray[np.float32]

    def window(self, window: Window) -> Raster:
        return balanced(self.mosaic, self.factor, window)[..., self.plane]


def indices(task: Task, progress: Progress) -> Made:
    """Make the raster of an index, and the cloud with it.

    Raises
    ------
    CaptureError, ConfigError, UsageError, SourceError
    """
    upper, lower = INDICES[task.index]
    panels = [] if task.panels is None else read_panels(task.panels, (upper, lower))
    with ground(task.cloud, task.images, task.photos, task.crs, task.gsd_m, task.output, progress) as place:
        sources = _sources(place, (upper, lower), progress)
        lines, warnings = _lines(sources, panels)

        def block(window: Window) -> Raster:
            a, b = (_reflectance(sources[band].window(window), lines[band]) for band in (upper, lower))
            return normalised_difference(a, b)

        crs = task.crs or place.cloud.crs
        with written_aside(task.output) as aside:
            geotiff.write(aside, place.grid, crs, Band(task.index), block)
        values = [block(window) for window in place.grid.blocks(geotiff.BLOCK)]
        found = np.concatenate([each[np.isfinite(each)] for each in values])
        failed = tuple(dict.fromkeys(name for source in sources.values() for name in source.mosaic.failed))
        if task.draped is not None:
            _drape(task, place, sources, lines, progress)
        untimed = [
            ", ".join(each.bands)
            for each in {id(s.layer): s.layer for s in sources.values()}.values()
            if not _timed(each)
        ]
        warnings += tuple(
            f"images of {bands} do not say how long they were exposed (EXIF): they are brought to one exposure by what they share"
            for bands in untimed
        )
        calibrated = all(each.panels for each in lines.values())
        if not calibrated:
            warnings = (
                *warnings,
                f"{task.index} is not calibrated: no panels, so bands are compared as the cameras have them",
            )
        median = float(np.median(found)) if len(found) else float("nan")
        return Made(
            task.index, place.grid.columns, place.grid.rows, len(found), calibrated, lines, median,
            (*place.block.left_out, *failed), warnings,
        )  # fmt: skip


def normalised_difference(a: Raster, b: Raster) -> Raster:
    """(a - b) / (a + b), NaN where either is none or both are dark."""
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = np.maximum(a, 0.0), np.maximum(b, 0.0)
        return np.where(a + b > 1e-9, (a - b) / (a + b), np.nan).astype(np.float32)


def _sources(place: Ground, bands: Sequence[str], progress: Progress) -> dict[str, _Source]:
    """Mosaics of light that hold the bands; one that holds both is made once."""
    made: dict[int, tuple[Mosaic, npt.NDArray[np.float32]]] = {}
    found = {}
    for band in bands:
        layer = _layer_with(place.block, band)
        if id(layer) not in made:
            folder = place.folder / f"light{len(made)}"
            folder.mkdir()
            bright = replace(layer, dtype=np.dtype(np.float32))
            laid = mosaic(
                place.block, bright, place.scene, place.surface, place.grid, folder,
                lambda n: progress("images", n), _loader(place.block),
            )  # fmt: skip
            made[id(layer)] = laid, _factors(layer, laid)
        found[band] = _Source(layer, made[id(layer)][0], layer.bands.index(band), made[id(layer)][1])
    return found


def _timed(layer: Layer) -> bool:
    """Whether all images say how long they were exposed: then their light can be compared."""
    return all(states_exposure(image.path) for image in layer.images)


def _factors(layer: Layer, laid: Mosaic) -> npt.NDArray[np.float32]:
    """What brings the light of images to one exposure: 1 where they say how they were exposed, else what they share tells."""
    value, there = laid.shared.value, laid.shared.image != NOBODY
    if _timed(layer) or not there.any():
        return np.ones((len(layer.images), len(layer.bands)), np.float32)
    return gains(laid.shared, len(layer.images), float(np.percentile(value[there], _BRIGHTEST)))


def _loader(block: Block) -> Callable[[Image], npt.NDArray[Any]]:
    return lambda image: light(image.path, block.rig.cameras[image.camera])


def _layer_with(block: Block, band: str) -> Layer:
    """Pictures that have a band.

    Raises
    ------
    UsageError
    """
    having = [layer for layer in block.layers if band in layer.bands]
    if not having:
        known = ", ".join(sorted({name for layer in block.layers for name in layer.bands}))
        raise UsageError(
            f"no picture has band {band}, the bands are {known}; `bands:` of a camera in rig.yaml names its planes"
        )
    # a camera made for one band sees it better than a filter array beside others
    return min(having, key=lambda layer: len(layer.bands))


def _lines(sources: Mapping[str, _Source], panels: Sequence[Panel]) -> tuple[dict[str, Line], tuple[str, ...]]:
    """The line of each band, and what is to be said of panels that were not seen."""
    lines, unseen = {}, []
    for band, source in sources.items():
        found, known = [], []
        for panel in panels:
            if band not in panel.reflectance:
                continue
            value = _on_panel(source, panel)
            if value is None:
                unseen.append(panel.name)
            else:
                found.append(value)
                known.append(panel.reflectance[band])
        lines[band] = line(np.array(found), np.array(known))
    return lines, tuple(f"panel {name}: no image sees it" for name in dict.fromkeys(unseen))


def _on_panel(source: _Source, panel: Panel) -> float | None:
    """The light of a panel: the median of its pixels."""
    grid = source.mosaic.grid
    x, y = panel.place_m[:2] / grid.cell_m
    reach = panel.radius_m / grid.cell_m
    low = np.floor(np.array([x, y]) - reach).astype(int)
    side = int(np.ceil(2.0 * reach)) + 2
    left, bottom = max(int(low[0]), grid.column), max(int(low[1]), grid.row)
    right, top = min(int(low[0]) + side, grid.column + grid.columns), min(int(low[1]) + side, grid.row + grid.rows)
    if right <= left or top <= bottom:
        return None
    values = source.window(Window(left, bottom, right - left, top - bottom))
    column, row = np.arange(left, right) + 0.5 - x, np.arange(bottom, top)[::-1] + 0.5 - y
    inside = np.hypot(column[None, :], row[:, None]) <= reach
    chosen = values[inside & np.isfinite(values)]
    return float(np.median(chosen)) if len(chosen) >= _FEWEST else None


def _reflectance(values: Raster, line: Line) -> Raster:
    return np.asarray(line.gain * values + line.offset, np.float32)


def _drape(
    task: Task, place: Ground, sources: Mapping[str, _Source], lines: Mapping[str, Line], progress: Progress
) -> None:
    """The cloud with the index of each point that images of both bands see."""
    bands: dict[str, Raster] = {}
    for band, source in sources.items():
        layer = source.layer
        bright = replace(layer, dtype=np.dtype(np.float32))
        folder = place.folder / f"points_{band}"
        folder.mkdir()
        views = room(place.scene.size, bright, folder)
        paint(place.block, bright, place.scene, views, lambda n: progress("points", n), _loader(place.block))
        bands[band] = mapped(folder / "band", np.float32, (place.scene.size,))
        for square in place.scene.squares:
            values = blend(part(views, square.points), source.factor, 1.0, 1)[:, source.plane]
            bands[band][place.scene.number[square.points]] = _reflectance(values, lines[band])
    upper, lower = INDICES[task.index]
    assert task.draped is not None
    done = 0
    with (
        written_aside(task.draped) as aside,
        Rewriter(place.cloud, aside, compressed=task.draped.suffix.lower() == ".laz", added=("ndvi",)) as new,
    ):
        for chunk in reader.chunks(place.cloud, columns=()):
            some = slice(done, done + len(chunk.record))
            new.write(chunk.record, columns={"ndvi": normalised_difference(bands[upper][some], bands[lower][some])})
            done = some.stop
