"""A cloud takes its colours from images: each point what the images that see it agree on, and nothing where none does."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CaptureError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.dimensions import TABLE, dimension
from groundproc.cloud.rewriter import Rewriter
from groundproc.files import written_aside
from groundproc.imagery.painting.balance import gains
from groundproc.imagery.painting.block import COLOURS, Block, Layer, of_cloud
from groundproc.imagery.painting.overlay import overlays
from groundproc.imagery.painting.paint import paint, part, room
from groundproc.imagery.painting.scene import Scene, laid_out, mapped
from groundproc.imagery.painting.score import Score, score, worst
from groundproc.imagery.painting.views import Views, blend
from groundproc.imagery.radiance import TEMPERATURE, degrees_of

Progress = Callable[[str, int], object]
Array = npt.NDArray[np.float64]

VIEWS: Final = "views"
_DIFFER_K: Final = 1.0
"""What thermal images of one place differ by anyway."""


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
    overlays : Path, optional
        Folder for a picture of each camera with the points over it.
    all_classes : bool
        Noise and what moves hide what is behind them, and have a colour.
    """

    cloud: Path
    images: Path
    output: Path
    photos: Path | None = None
    least: int = 1
    crs: pyproj.CRS | None = None
    balance: bool = True
    overlays: Path | None = None
    all_classes: bool = False


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    points, coloured : int
    no_surface : int
        Of the points, noise and what moved: images are not asked about them.
    images : int
    bands : tuple of str
    held_out : mapping of str to float
        How far, rms, what the other images say of the points of each is from what it shows [percent of the full scale], by band.
    held_out_images : mapping of str to float
        The same of each image, over its bands.
    left_out : tuple of str
        Images that could not be used, and why.
    views : float
        Views of a coloured point, mean.
    overlays : tuple of str
        Pictures with the points over them.
    """

    points: int
    coloured: int
    no_surface: int
    images: int
    bands: tuple[str, ...]
    held_out: Mapping[str, float]
    held_out_images: Mapping[str, float]
    left_out: tuple[str, ...]
    views: float
    overlays: tuple[str, ...] = ()

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def colour(task: Task, progress: Progress) -> Made:
    """Colour a cloud.

    Raises
    ------
    CaptureError, ConfigError, UsageError, SourceError
    """
    cloud, block = of_cloud(task.cloud, task.images, task.photos, task.crs)
    layers, unused = _layers(block)
    with laid_out(cloud, block.site, task.output, progress, task.all_classes) as (scene, folder):
        seen = mapped(folder / "seen", np.uint8, (cloud.points,))
        laid = [_laid(task, block, layer, scene, folder / str(number), progress) for number, layer in enumerate(layers)]
        columns: dict[str, npt.NDArray[Any]] = {}
        for number, (layer, one) in enumerate(zip(layers, laid, strict=True)):
            columns |= {band: column for band, column in one.columns.items() if band not in columns}
            if number == 0 or set(layer.bands) & set(COLOURS):
                np.maximum(seen, one.total, out=seen)
        if task.least > 1:
            seen[seen < task.least] = 0
        drawn = () if task.overlays is None else overlays(task.overlays, block, layers, [o.seen for o in laid], scene)
        _write(task, cloud, columns | {VIEWS: seen}, progress)
        coloured = int(np.count_nonzero(seen))
        views = float(seen.sum(dtype=np.int64) / coloured) if coloured else 0.0
        no_surface = scene.size - scene.standing
    failed = tuple(sentence for one in laid for sentence in one.failed)
    images = sum(len(layer.images) for layer in layers) - len(failed)
    by_band = {band: value for one in reversed(laid) for band, value in one.score.bands.items()}
    by_image = {name: value for one in laid for name, value in one.score.images.items()}
    left_out = (*block.left_out, *unused, *failed)
    return Made(cloud.points, coloured, no_surface, images, tuple(columns), by_band, by_image, left_out, views, drawn)


class _Laid(NamedTuple):
    """A layer laid over the cloud: attributes and views of all points in the order of the file, points that each image sees."""

    columns: dict[str, npt.NDArray[Any]]
    total: npt.NDArray[np.uint8]
    seen: npt.NDArray[np.int64]
    score: Score
    failed: tuple[str, ...]


def _laid(task: Task, block: Block, layer: Layer, scene: Scene, place: Path, progress: Progress) -> _Laid:
    """Lay a layer over the cloud; arrays lie in a folder."""
    place.mkdir()
    views = room(scene.size, layer, place)
    painted = paint(block, layer, scene, views, lambda n: progress("images", n))
    measured = not task.balance or TEMPERATURE in layer.bands
    factor = gains(views, len(layer.images), layer.full, measured)
    total = mapped(place / "seen", np.uint8, (scene.size,))
    for square in scene.squares:
        total[scene.number[square.points]] = views.total[square.points]
    columns = _columns(block, layer, scene, views, factor, task.least, place)
    return _Laid(columns, total, painted.seen, score(layer, views, factor), painted.failed)


def _layers(block: Block) -> tuple[list[Layer], tuple[str, ...]]:
    """The layers that give attributes, colours first, and a sentence about each that gives none that another does not.

    Raises
    ------
    UsageError
        A band is called by no name of an attribute.
    """
    names = {entry.name for entry in TABLE}
    strange = next((band for layer in block.layers for band in layer.bands if band not in names), None)
    if strange is not None:
        raise UsageError(
            f"rig: band {strange!r}: expected a name of a point attribute: red, green, blue, nir, red_edge or temperature"
        )
    chosen, unused, given = [], [], set[str]()
    for layer in sorted(block.layers, key=lambda each: (not set(COLOURS) <= set(each.bands), -len(each.images))):
        if set(layer.bands) <= given:
            count = f"{len(layer.images)} images such as {layer.images[0].name}"
            unused.append(f"{count} are not used: other pictures give {', '.join(layer.bands)} already")
        else:
            chosen.append(layer)
            given |= set(layer.bands)
    return chosen, tuple(unused)


def _columns(
    block: Block, layer: Layer, scene: Scene, views: Views, factor: npt.NDArray[np.float32], least: int, folder: Path
) -> dict[str, npt.NDArray[Any]]:
    """The attributes that a layer gives, in the order of the file."""
    found = {band: mapped(folder / band, dimension(band).column, (scene.size,)) for band in layer.bands}
    if TEMPERATURE in found:
        found[TEMPERATURE][:] = np.nan  # where no image is asked
    differ = None
    if TEMPERATURE in layer.bands:
        scale, _ = degrees_of(block.rig.cameras[layer.images[0].camera].response)
        differ = _DIFFER_K / abs(scale or 1.0)
    for square in scene.squares:
        values = blend(part(views, square.points), factor, layer.full, least, differ)
        for plane, band in enumerate(layer.bands):
            found[band][scene.number[square.points]] = _scaled(block, layer, band, values[:, plane])
    return found


def _scaled(block: Block, layer: Layer, band: str, values: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
    """Numbers of pictures as the attribute has them: colours over 16 bits, temperatures in degrees."""
    if band == TEMPERATURE:
        scale, offset = degrees_of(block.rig.cameras[layer.images[0].camera].response)
        return np.asarray(scale * values + offset, np.float32)
    most = float(np.iinfo(np.uint16).max)
    with np.errstate(invalid="ignore"):
        steps = np.rint(np.clip(values / layer.full, 0.0, 1.0) * most)
    return np.where(np.isfinite(steps), steps, 0.0).astype(np.uint16)


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
    share = made.coloured / max(made.points - made.no_surface, 1)
    others = f"; {made.no_surface:,} are noise or moved, and have no colour" if made.no_surface else ""
    by_band = ", ".join(f"{band} {value:.1f} %" for band, value in made.held_out.items())
    name = worst(made.held_out_images)
    most = f"; most in {name}, {made.held_out_images[name]:.1f} %" if name else ""
    seen = f"{made.coloured:,} of {made.points - made.no_surface:,} points ({share:.1%})"
    return [
        f"{seen} are seen by {made.images} images, {made.views:.1f} each{others}",
        *(
            [f"held out, an image differs from what the others say by {by_band} of the full scale, rms{most}"]
            if by_band
            else []
        ),
    ]
