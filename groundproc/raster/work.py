"""From cloud files to a raster file, and from heights to what follows from them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyproj

from flightlog.errors import UsageError
from groundproc import geodesy
from groundproc.cloud import reader
from groundproc.cloud.sameness import agreed_crs
from groundproc.cloud.selection import SURFACES, Selection
from groundproc.files import written_aside
from groundproc.raster import geotiff, linedifference, tiles
from groundproc.raster.grid import Window
from groundproc.raster.kinds import Gathered, Kind, derive, gathering, kind, needed

SUFFIXES: Final = (".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    inputs : sequence of Path
        Clouds, or one raster of heights.
    output : Path
    what, statistic : str
        See `kinds.kind`.
    cell_m : float or None
        None: as the kind has it.
    crs : str or None
        EPSG code in place of what the clouds state.
    all_classes : bool
        Noise and what moves count too.
    tile_m : float or None
        Side of tiles: `output` is a folder then.
    force : bool
        Write over what is in that folder.
    """

    inputs: Sequence[Path]
    output: Path
    what: str
    statistic: str | None
    cell_m: float | None = None
    crs: str | None = None
    all_classes: bool = False
    tile_m: float | None = None
    force: bool = False


@dataclass(frozen=True, slots=True)
class Made:
    """The raster that came of it, and what a person ought to know."""

    columns: int
    rows: int
    cell_m: float
    warnings: tuple[str, ...]
    left_out: int = 0


def work(task: Task, progress: Callable[[int], object]) -> Made:
    """Make the raster; `progress` is told of points done.

    Raises
    ------
    UsageError, SourceError, CaptureError, CoverageError, GeodesyError
        What is asked for is not possible, or a file is not as it should be.
    """
    chosen = kind(task.what, task.statistic)
    if task.inputs[0].suffix.lower() in SUFFIXES:
        return _of_heights(task, chosen)
    choices = () if task.all_classes else (SURFACES,)
    clouds = [reader.look(path, *choices) for path in task.inputs]
    crs, warnings = common_crs(clouds, task.crs)
    for cloud in clouds:
        missing = [name for name in needed(chosen) if name not in cloud.columns]
        if missing:
            raise UsageError(f"{cloud.path}: has no {missing[0]}, but {', '.join(cloud.columns)}")
    if task.tile_m is not None:
        with tiles.claimed(task.output, task.force) as aside:
            gathered, left = _gathered(task, chosen, clouds, aside, progress)
            grid = tiles.write(aside, chosen.name, gathered, crs, task.tile_m)
    else:
        with written_aside(task.output) as aside:
            gathered, left = _gathered(task, chosen, clouds, task.output.parent, progress)
            gathered.write(aside, crs)
        with geotiff.opened(task.output) as made:
            grid = made.grid
    return Made(grid.columns, grid.rows, grid.cell_m, warnings, left)


def _gathered(
    task: Task, chosen: Kind, clouds: Sequence[reader.Cloud], folder: Path, progress: Callable[[int], object]
) -> tuple[Gathered, int]:
    """All points of the clouds that count, and how many do not."""
    found = gathering(chosen, chosen.cell_m if task.cell_m is None else task.cell_m, folder)
    left = 0
    for cloud in clouds:
        selection = Selection(cloud.choices)
        for chunk in reader.chunks(cloud, columns=needed(chosen), selection=selection):
            found.add(chunk.points)
            progress(len(chunk.points))
        left += sum(selection.left_out.values())
    if isinstance(found, linedifference.Gathering):
        found.expect_overlap(task.output)
    return found, left


def common_crs(clouds: Sequence[reader.Cloud], code: str | None) -> tuple[pyproj.CRS | None, tuple[str, ...]]:
    """The CRS of some clouds, and a warning where it is not known.

    Raises
    ------
    GeodesyError
        They differ, or the code is no projected CRS.
    """
    if code is not None:
        return geodesy.projected_crs(code), ()
    crs = agreed_crs(clouds)
    if crs is None:
        return None, (f"{clouds[0].path} states no CRS, and so the raster states none; --crs EPSG says which it is",)
    return crs, ()


def _of_heights(task: Task, chosen: Kind) -> Made:
    """A raster that follows from the heights of another."""
    if task.tile_m is not None:
        raise UsageError(f"{task.inputs[0]}: is a raster; tiles are made of clouds")
    if chosen.derived is None or len(task.inputs) > 1:
        raise UsageError(
            f"{task.inputs[0]}: is a raster; hillshade, local-relief or sky-view can be made of one, with --what"
        )
    how = chosen.derived
    with geotiff.opened(task.inputs[0]) as source, written_aside(task.output) as aside:
        grid = source.grid

        def block(window: Window) -> np.ndarray:
            return derive(how, source.window, window, grid.cell_m)

        geotiff.write(aside, grid, source.crs, chosen.band, block)
        return Made(grid.columns, grid.rows, grid.cell_m, ())
