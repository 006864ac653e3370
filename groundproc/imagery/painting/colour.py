"""A cloud takes its colours from images: each point what the images that see it agree on, and nothing where none does."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CaptureError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.dimensions import TABLE, dimension
from groundproc.cloud.rewriter import Rewriter
from groundproc.files import written_aside
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import Block, Layer, load
from groundproc.imagery.painting.paint import paint, part, room
from groundproc.imagery.painting.scene import Scene, mapped
from groundproc.imagery.painting.views import NOBODY, Views, blend

Progress = Callable[[str, int], object]
Array = npt.NDArray[np.float64]

VIEWS: Final = "views"
TEMPERATURE: Final = "temperature"
_HELD_OUT: Final = 50_000
"""Points that the score is made of."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    cloud : Path
    images : Path
        Folder with poses.csv and rig.yaml.
    output : Path
    photos : Path, optional
        Folder of the pictures, where they lie elsewhere.
    least : int
        Images that must see a point.
    crs : pyproj.CRS, optional
        Of the cloud, where it does not say.
    balance : bool
        Bring the images to one exposure.
    """

    cloud: Path
    images: Path
    output: Path
    photos: Path | None = None
    least: int = 1
    crs: pyproj.CRS | None = None
    balance: bool = True


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    points, coloured : int
    images : int
    bands : tuple of str
    held_out : mapping of str to float
        How far, rms, what the other views of a point say is from what each view shows [percent of the full scale], by band.
    left_out : tuple of str
        Images that could not be used, and why.
    views : float
        Views of a coloured point, mean.
    """

    points: int
    coloured: int
    images: int
    bands: tuple[str, ...]
    held_out: Mapping[str, float]
    left_out: tuple[str, ...]
    views: float

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def colour(task: Task, progress: Progress) -> Made:
    """Colour a cloud.

    Raises
    ------
    CaptureError, ConfigError, UsageError, SourceError
    """
    cloud = reader.look(task.cloud)
    block = load(task.images, task.photos, task.crs or cloud.horizontal, task.cloud)
    _check_bands(block)
    with tempfile.TemporaryDirectory(prefix=".swath-colour-", dir=_beside(task.output)) as scratch:
        folder = Path(scratch)
        scene = Scene(cloud, block.site, folder, lambda n: progress("reading", n))
        columns: dict[str, npt.NDArray[Any]] = {}
        held_out: dict[str, float] = {}
        failed: tuple[str, ...] = ()
        seen = mapped(folder / "seen", np.uint8, (cloud.points,))
        for number, layer in enumerate(block.layers):
            place = folder / str(number)
            place.mkdir()
            views = room(cloud.points, layer, place)
            failed += paint(block, layer, scene, views, lambda n: progress("images", n))
            factor = gains(
                views, len(layer.images), layer.full, measured=not task.balance or TEMPERATURE in layer.bands
            )
            columns |= _columns(block, layer, scene, views, factor, task.least, place)
            held_out |= _held_out(layer, views, factor)
            if number == 0 or set(layer.bands) & {"red", "green", "blue"}:
                for square in scene.squares:
                    numbers = scene.number[square.points]
                    seen[numbers] = np.maximum(seen[numbers], views.total[square.points])
        if task.least > 1:
            seen[seen < task.least] = 0
        _write(task, cloud, columns | {VIEWS: seen}, progress)
        coloured = int(np.count_nonzero(seen))
        total = float(seen.sum(dtype=np.int64) / coloured) if coloured else 0.0
    images = sum(len(layer.images) for layer in block.layers) - len(failed)
    bands = tuple(dict.fromkeys(band for layer in block.layers for band in layer.bands))
    return Made(cloud.points, coloured, images, bands, held_out, (*block.left_out, *failed), total)


def _beside(output: Path) -> Path:
    """The nearest folder above the output that is there."""
    return next(folder for folder in output.resolve().parents if folder.is_dir())


def _check_bands(block: Block) -> None:
    """Refuse bands that no attribute of points is called by, and layers that give one band twice.

    Raises
    ------
    UsageError
    """
    names = {entry.name for entry in TABLE}
    for layer in block.layers:
        for band in layer.bands:
            if band not in names:
                raise UsageError(
                    f"rig: band {band!r}: expected a name of a point attribute: red, green, blue, nir, red_edge or temperature"
                )
    kinds = [layer.bands for layer in block.layers]
    twice = {band for bands in set(kinds) for band in bands if sum(band in other for other in set(kinds)) > 1}
    if twice or len(kinds) != len(set(kinds)):
        band = min(twice) if twice else kinds[0][0]
        raise UsageError(f"rig: band {band!r} comes of two kinds of pictures; expected one: choose cameras by the rig")


def _columns(
    block: Block, layer: Layer, scene: Scene, views: Views, factor: npt.NDArray[np.float32], least: int, folder: Path
) -> dict[str, npt.NDArray[Any]]:
    """The attributes that a layer gives, in the order of the file."""
    found = {band: mapped(folder / band, dimension(band).column, (scene.size,)) for band in layer.bands}
    for square in scene.squares:
        values = blend(part(views, square.points), factor, layer.full, least)
        for plane, band in enumerate(layer.bands):
            found[band][scene.number[square.points]] = _scaled(block, layer, band, values[:, plane])
    return found


def _scaled(block: Block, layer: Layer, band: str, values: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
    """Numbers of pictures as the attribute has them: colours over 16 bits, temperatures in degrees."""
    if band == TEMPERATURE:
        scale, offset = response_of(block.rig.cameras[layer.images[0].camera].response)
        return np.asarray(scale * values + offset, np.float32)
    most = float(np.iinfo(np.uint16).max)
    with np.errstate(invalid="ignore"):
        steps = np.rint(np.clip(values / layer.full, 0.0, 1.0) * most)
    return np.where(np.isfinite(steps), steps, 0.0).astype(np.uint16)


def response_of(response: Any) -> tuple[float, float]:
    """Scale and offset of `response: {scale: S, offset: O}`: degrees Celsius are S times the number plus O.

    Raises
    ------
    UsageError
    """
    if response is None:
        return 1.0, 0.0
    try:
        return float(response.get("scale", 1.0)), float(response.get("offset", 0.0))
    except (AttributeError, TypeError, ValueError):
        raise UsageError(f"rig: response: {response!r} found, expected {{scale: S, offset: O}}") from None


def _held_out(layer: Layer, views: Views, factor: npt.NDArray[np.float32]) -> dict[str, float]:
    """For each band, how well the others of its views tell what a view shows."""
    several = np.flatnonzero(views.total >= 2)
    if not len(several):
        return {}
    several = several[:: max(1, len(several) // _HELD_OUT)]
    image, value = views.image[several], np.asarray(views.value[several], np.float64)
    there = image != NOBODY
    balanced = value * np.where(there[..., None], factor[np.where(there, image, 0)], 0.0)
    others = there.sum(axis=1) - 1
    told = (balanced.sum(axis=1, keepdims=True) - balanced) / np.maximum(others, 1)[:, None, None]
    off = np.where(there[..., None], told - balanced, np.nan) / layer.full * 100.0
    return {band: float(np.sqrt(np.nanmean(off[:, :, plane] ** 2))) for plane, band in enumerate(layer.bands)}


def _write(task: Task, cloud: reader.Cloud, columns: Mapping[str, npt.NDArray[Any]], progress: Progress) -> None:
    """The cloud with its colours."""
    compressed = task.output.suffix.lower() == ".laz"
    done = 0
    with (
        written_aside(task.output) as aside,
        Rewriter(cloud, aside, compressed=compressed, added=columns) as new,
    ):
        for chunk in reader.chunks(cloud, columns=()):
            some = slice(done, done + len(chunk.record))
            new.write(chunk.record, columns={name: values[some] for name, values in columns.items()})
            done = some.stop
            progress("writing", len(chunk.record))
    if done != cloud.points:
        raise CaptureError(f"{cloud.path}: changed while it was read")


def sentences(made: Made) -> Sequence[str]:
    """For people."""
    share = made.coloured / made.points
    score = ", ".join(f"{band} {value:.1f} %" for band, value in made.held_out.items())
    return [
        f"{made.coloured:,} of {made.points:,} points ({share:.1%}) are seen by {made.images} images, {made.views:.1f} each",
        *([f"held-out views differ by {score} of the full scale, rms"] if score else []),
    ]
