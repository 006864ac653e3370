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
from groundproc.files import written_aside
from groundproc.raster import geotiff
from groundproc.raster.grid import Window
from groundproc.raster.kinds import Gathering, Kind, derive, kind, needed

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
    cell_m : float
    crs : str or None
        EPSG code in place of what the clouds state.
    """

    inputs: Sequence[Path]
    output: Path
    what: str
    statistic: str | None
    cell_m: float
    crs: str | None = None


@dataclass(frozen=True, slots=True)
class Made:
    """The raster that came of it, and what a person ought to know."""

    columns: int
    rows: int
    cell_m: float
    warnings: tuple[str, ...]


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
    clouds = [reader.look(path) for path in task.inputs]
    crs, warnings = common_crs(clouds, task.crs)
    for cloud in clouds:
        missing = [name for name in needed(chosen) if name not in cloud.columns]
        if missing:
            raise UsageError(f"{cloud.path}: has no {missing[0]}, but {', '.join(cloud.columns)}")
    gathering = Gathering(chosen, task.cell_m, task.output.parent)
    with written_aside(task.output) as aside:
        for cloud in clouds:
            for chunk in reader.chunks(cloud, columns=needed(chosen)):
                gathering.add(chunk.points)
                progress(len(chunk.points))
        gathering.write(aside, crs)
    with geotiff.opened(task.output) as made:
        return Made(made.grid.columns, made.grid.rows, made.grid.cell_m, warnings)


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
