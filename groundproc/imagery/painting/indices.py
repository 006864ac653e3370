"""Vegetation indices: mosaics of two bands as light, put on a scale of reflectance, and their normalised difference.

The scale is that of panels, of the light on the ground as a sensor on the roof measured it, or of the lidar's own reflectance.
"""

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
from groundproc.imagery.irradiance import lit
from groundproc.imagery.lidarreference import BY as BY_LIDAR
from groundproc.imagery.lidarreference import GREY, GREY_SIGMA, NEAR
from groundproc.imagery.lidarreference import lines as by_lidar
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import Block, Image, Layer
from groundproc.imagery.painting.mosaic import Mosaic, mosaic
from groundproc.imagery.painting.ortho import Ground, balanced, ground
from groundproc.imagery.painting.paint import paint, part, room
from groundproc.imagery.painting.scene import mapped
from groundproc.imagery.painting.views import NOBODY, blend
from groundproc.imagery.radiance import PANELS, Line, Panel, exposed, light, line, read_panels, states_exposure
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
IRRADIANCE: Final = "irradiance"
REFERENCES: Final = (PANELS, IRRADIANCE, BY_LIDAR)
"""In the order in which they are taken."""
REFLECTANCE: Final = "reflectance"
"""Attribute of the points that `swath reflectance` gives."""


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
    reference : str, optional
        Of `REFERENCES`; default: the first that there is.
    all_classes : bool
        Noise and what moves stand too.
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
    reference: str | None = None
    all_classes: bool = False


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

    @property
    def by(self) -> str:
        """What it is calibrated by, in words."""
        names = " and ".join(dict.fromkeys(line.by for line in self.lines.values() if line.by))
        panels = max(line.panels for line in self.lines.values())
        return f"by {panels} panels" if names == PANELS else f"by {names}"


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
    with ground(
        task.cloud, task.images, task.photos, task.crs, task.gsd_m, task.output, progress, task.all_classes
    ) as place:
        roof = _roof([_layer_with(place.block, band) for band in (upper, lower)])
        sources = _sources(place, (upper, lower), roof, progress)
        lines, warnings, points = _referenced(task, place, sources, panels, roof, progress)

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
            points = points or _on_points(place, sources, roof, progress)
            _drape(task, place, points, lines, progress)
        untimed = [
            ", ".join(each.bands)
            for each in {id(s.layer): s.layer for s in sources.values()}.values()
            if not _timed(each)
        ]
        warnings += tuple(
            f"images of {bands} do not say how long they were exposed (EXIF): they are brought to one exposure by what they share"
            for bands in untimed
        )
        calibrated = all(each.by for each in lines.values())
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


@dataclass(frozen=True, slots=True)
class _Roof:
    """What the sensor on the roof says: by what the light of each picture is multiplied, and whether bands then compare."""

    factor: Mapping[Path, float]
    compares: bool


def _roof(layers: Sequence[Layer]) -> _Roof:
    """Of pictures that all say how they were exposed and how the ground was lit; else nothing."""
    paths = [image.path for layer in {id(each): each for each in layers}.values() for image in layer.images]
    said = [lit(path, *exposed(path)[:2]) if states_exposure(path) else None for path in paths]
    known = [each for each in said if each is not None]
    if not known or len(known) < len(paths):
        return _Roof({}, False)
    usual = float(np.median([each.irradiance for each in known]))
    factor = np.array([each.factor for each in known])
    compares = bool(np.isfinite(factor).all())
    factor = factor / np.median(factor) if compares else np.ones(len(known))
    share = [usual / each.irradiance for each in known]
    return _Roof(dict(zip(paths, (factor * share).tolist(), strict=True)), compares)


def _referenced(
    task: Task, place: Ground, sources: Mapping[str, _Source], panels: Sequence[Panel], roof: _Roof, progress: Progress
) -> tuple[dict[str, Line], tuple[str, ...], dict[str, Raster] | None]:
    """The lines of the bands by the first reference that there is, what is to be said of it, and the light of points where it was needed.

    Raises
    ------
    UsageError
        There is none of the kind that is asked for.
    """
    asked = REFERENCES if task.reference is None else (task.reference,)
    lines, warnings = _lines(sources, panels)
    if PANELS in asked and all(each.by for each in lines.values()):
        return lines, warnings, None
    if IRRADIANCE in asked and roof.compares:
        return {band: Line(by=IRRADIANCE) for band in sources}, warnings, None
    if BY_LIDAR in asked and REFLECTANCE in place.cloud.columns and NEAR in sources:
        points = _on_points(place, sources, roof, progress)
        found = by_lidar({band: values.astype(np.float64) for band, values in points.items()}, _reflectances(place))
        if found is not None:
            others = " and ".join(band for band in found if band != NEAR)
            told = (
                f"{others} is put on the lidar's scale by the greyest ground, taken to reflect {GREY:g} of it (sigma {GREY_SIGMA:g}); "
                "without any asphalt, concrete or gravel the index is too low"
            )
            return found, (*warnings, told), points
    if task.reference is not None:
        raise UsageError(f"--reference {task.reference}: {_LACKING[task.reference]}")
    why = "no panels, no irradiance that compares between bands, no reflectance of the lidar"
    told = f"{task.index} is not calibrated: {why}, so bands are compared as the cameras have them"
    return lines, (*warnings, told), None


_LACKING: Final = {
    PANELS: "no panel is seen in both bands; expected --panels with some that images see",
    IRRADIANCE: "the pictures do not say (XMP) both how the ground was lit and how the maker's bands compare, or not how they were exposed",
    BY_LIDAR: "expected a cloud with reflectance (`swath reflectance`), and pictures with near infrared that see 200 points and more",
}


def _reflectances(place: Ground) -> npt.NDArray[np.float64]:
    """The lidar's reflectance of all points, in the order of the file."""
    parts = [chunk.points.columns[REFLECTANCE] for chunk in reader.chunks(place.cloud, columns=(REFLECTANCE,))]
    return np.concatenate(parts).astype(np.float64)


def _sources(place: Ground, bands: Sequence[str], roof: _Roof, progress: Progress) -> dict[str, _Source]:
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
                lambda n: progress("images", n), _loader(place.block, roof),
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


def _loader(block: Block, roof: _Roof) -> Callable[[Image], npt.NDArray[Any]]:
    def loaded(image: Image) -> npt.NDArray[Any]:
        return light(image.path, block.rig.cameras[image.camera]) * np.float32(roof.factor.get(image.path, 1.0))

    return loaded


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


def _on_points(place: Ground, sources: Mapping[str, _Source], roof: _Roof, progress: Progress) -> dict[str, Raster]:
    """The light of each point by band, in the order of the file; NaN where no image sees."""
    bands: dict[str, Raster] = {}
    for band, source in sources.items():
        bright = replace(source.layer, dtype=np.dtype(np.float32))
        folder = place.folder / f"points_{band}"
        folder.mkdir()
        views = room(place.scene.size, bright, folder)
        paint(place.block, bright, place.scene, views, lambda n: progress("points", n), _loader(place.block, roof))
        bands[band] = mapped(folder / "band", np.float32, (place.scene.size,))
        bands[band][:] = np.nan  # noise and what moves are seen by nobody
        for square in place.scene.squares:
            values = blend(part(views, square.points), source.factor, 1.0, 1)[:, source.plane]
            bands[band][place.scene.number[square.points]] = values
    return bands


def _drape(
    task: Task, place: Ground, points: Mapping[str, Raster], lines: Mapping[str, Line], progress: Progress
) -> None:
    """The cloud with the index of each point that images of both bands see."""
    upper, lower = INDICES[task.index]
    assert task.draped is not None
    done = 0
    with (
        written_aside(task.draped) as aside,
        Rewriter(place.cloud, aside, compressed=task.draped.suffix.lower() == ".laz", added=("ndvi",)) as new,
    ):
        for chunk in reader.chunks(place.cloud, columns=()):
            some = slice(done, done + len(chunk.record))
            a, b = (_reflectance(points[band][some], lines[band]) for band in (upper, lower))
            new.write(chunk.record, columns={"ndvi": normalised_difference(a, b)})
            done = some.stop
            progress("writing", len(chunk.record))
