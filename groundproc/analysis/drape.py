"""Rasters of other sensors draped over a cloud: temperatures, bands, and materials by their spectra.

A raster shows what is uppermost. So a point takes its value only if it is near the top of its cell; what lies under a
crown or a roof gets none, unless all points are asked for. The cloud is read three times: for the tops, square by
square for the values, and to be written anew. Memory: 4 bytes for each cell, and a square of a million points with the
raster there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CoverageError, GeodesyError, UsageError
from groundproc.analysis.spectra import Library, read_library, wavelengths
from groundproc.cloud import reader
from groundproc.cloud.dimensions import dimension
from groundproc.cloud.metres import Raster, metres_of, unstated
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.tiles import Found, Tiles, side_for
from groundproc.files import written_aside
from groundproc.raster.bands import Bands, opened_bands
from groundproc.raster.cells import Cells

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

NAMES: Final = ("temperature", "ndvi", "reflectance", "red", "green", "blue", "nir", "red_edge")
"""Attributes that a band may become."""
SPECTRAL: Final = ("spectral_class", "spectral_angle")
TOP_M: Final = 0.5
MAX_ANGLE_DEG: Final = 6.0
_CELL_M: Final = 0.5


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath drape`.

    Attributes
    ----------
    cloud, raster, output : Path
    names : sequence of str
        Attribute of each band; empty where only spectra are asked for.
    spectra : Path or None
    max_angle_deg : float
    top_m : float or None
        None: all points take a value.
    """

    cloud: Path
    raster: Path
    output: Path
    names: Sequence[str] = ()
    spectra: Path | None = None
    max_angle_deg: float = MAX_ANGLE_DEG
    top_m: float | None = TOP_M


@dataclass(slots=True)
class Made:
    """What came of it."""

    points: int
    bands: int
    draped: int = 0
    below: int = 0
    outside: int = 0
    materials: dict[str, int] = field(default_factory=dict)
    unlike: int = 0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "points": self.points, "bands": self.bands, "draped": self.draped, "below_the_top": self.below,
            "outside_or_without_value": self.outside, "materials": self.materials, "unlike_all": self.unlike,
            "warnings": self.warnings,
        }  # fmt: skip


def work(task: Task, progress: Progress) -> Made:
    """Drape, and write the cloud; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file is not as it should be, or they have no place in common.
    """
    cloud = reader.look(task.cloud)
    with opened_bands(task.raster) as bands, written_aside(task.output) as aside:
        library = _library(task, bands)
        _check_names(task, bands)
        made = Made(cloud.points, bands.count, warnings=unstated(cloud, Raster(task.raster, bands.crs)))
        if library is not None:
            made.materials = dict.fromkeys(library.names, 0)
        added = (*task.names, *(SPECTRAL if library is not None else ()))
        found = _sampled(task, cloud, bands, library, made, progress)
        if not made.draped:
            raise CoverageError(
                f"{task.raster}: not one point of {task.cloud} lies on a cell with a value; are they of one place?"
            )
        at = 0
        with Rewriter(cloud, aside, task.output.suffix.lower() != ".las", added) as out:
            for chunk in reader.chunks(cloud, columns=()):
                out.write(chunk.record, columns=found.take(at, len(chunk.points)))
                at += len(chunk.points)
                progress(len(chunk.points))
    return made


def _library(task: Task, bands: Bands) -> Library | None:
    if task.spectra is None:
        return None
    if bands.count < 3:
        raise UsageError(
            f"{task.raster}: has {bands.count} bands, expected 3 or more to tell materials by their spectra"
        )
    return read_library(task.spectra, bands.count, wavelengths(bands.file.descriptions))


def _check_names(task: Task, bands: Bands) -> None:
    if not task.names and task.spectra is None:
        raise UsageError(
            f"{task.raster}: what its {bands.count} bands become is not said; expected --spectra, or --as with one of "
            f"{', '.join(NAMES)} for each"
        )
    if task.names and len(task.names) != bands.count and task.spectra is None:
        raise UsageError(
            f"--as {','.join(task.names)}: {len(task.names)} names found, expected {bands.count}, one for each band"
        )
    for name in task.names:
        if name not in NAMES or list(task.names).count(name) > 1:
            raise UsageError(f"--as {name}: expected some of {', '.join(NAMES)}, each once")


def _sampled(
    task: Task, cloud: reader.Cloud, bands: Bands, library: Library | None, made: Made, progress: Progress
) -> Found:
    """What each point becomes."""
    across = _across(task, cloud, bands)
    metres = metres_of(cloud)
    tops, low, high = Cells(_CELL_M, {"max"}), np.full(2, np.inf), np.full(2, -np.inf)
    for chunk in reader.chunks(cloud, columns=()):
        xyz = np.ascontiguousarray(metres.of(chunk.points.xyz_m))
        tops.add(xyz, xyz[:, 2])
        low, high = np.minimum(low, xyz[:, :2].min(axis=0)), np.maximum(high, xyz[:, :2].max(axis=0))
        progress(len(xyz))
    tiles = Tiles(task.output.parent, {}, side_for(cloud.points, low.tolist(), high.tolist(), 0.0), 0.0)
    for chunk in reader.chunks(cloud, columns=()):
        tiles.add(np.ascontiguousarray(metres.of(chunk.points.xyz_m)))
        progress(len(chunk.points))
    names = [*task.names, *(SPECTRAL if library is not None else ())]
    found = Found(task.output.parent, {name: dimension(name).column for name in names}, cloud.points)
    for tile in tiles:
        values = bands.at(across(metres.back(tile.xyz_m)[:, :2]))
        hidden = np.zeros(len(values), np.bool_) if task.top_m is None else ~_uppermost(tile.xyz_m, tops, task.top_m)
        made.below += int(hidden.sum())
        values[hidden] = np.nan
        good = np.isfinite(values).all(axis=1)
        made.draped += int(good.sum())
        made.outside += int((~good & ~hidden).sum())
        columns = {name: _as(name, values[:, band]) for band, name in enumerate(task.names)}
        if library is not None:
            columns |= _classed(library, values, task.max_angle_deg, made)
        found.put(tile.number, columns)
    return found


def _across(task: Task, cloud: reader.Cloud, bands: Bands) -> Callable[[Array], Array]:
    """From the CRS of the cloud to that of the raster."""
    crs = cloud.horizontal
    if crs is None or bands.crs is None or crs.equals(bands.crs, ignore_axis_order=True):
        return lambda xy: xy
    transformer = pyproj.Transformer.from_crs(crs, bands.crs, always_xy=True)

    def into(xy: Array) -> Array:
        out = np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))
        if not np.isfinite(out).all():
            raise GeodesyError(
                f"{task.cloud}: points in {crs.name} have no place in {bands.crs.name if bands.crs else ''}"
            )
        return out

    return into


def _uppermost(xyz: Array, tops: Cells, top_m: float) -> npt.NDArray[np.bool_]:
    """Points near the top of their cell, shape (n,)."""
    return np.asarray(xyz[:, 2] > tops.at(xyz, "max") - top_m)


def _as(name: str, values: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
    """A band as the column of an attribute; whole numbers have 0 where there is no value."""
    column = dimension(name).column
    if column.kind == "f":
        return values.astype(column)
    largest = np.iinfo(column).max
    return np.asarray(np.clip(np.nan_to_num(np.rint(values), nan=0.0), 0, largest)).astype(column)


def _classed(
    library: Library, values: npt.NDArray[np.float32], max_angle_deg: float, made: Made
) -> dict[str, npt.NDArray[Any]]:
    """Material and angle of each point."""
    best, angle = library.nearest(values.astype(np.float64))
    angle_deg = np.rad2deg(angle)
    like = (best >= 0) & (np.nan_to_num(angle_deg, nan=np.inf) <= max_angle_deg)
    made.unlike += int(((best >= 0) & ~like).sum())
    for number, name in enumerate(library.names):
        made.materials[name] += int((like & (best == number)).sum())
    return {
        "spectral_class": np.where(like, best + 1, 0).astype(np.uint8),
        "spectral_angle": angle_deg.astype(np.float32),
    }
