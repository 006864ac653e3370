"""From cloud files to a raster file, and from heights to what follows from them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import UsageError
from groundproc import geodesy
from groundproc.cloud import reader
from groundproc.cloud.metres import METRES, Metres, agreed_metres, flat, metres_in
from groundproc.cloud.sameness import agreed_crs
from groundproc.cloud.selection import SURFACES, Selection
from groundproc.files import written_aside
from groundproc.raster import geotiff, linedifference, tiles
from groundproc.raster.grid import Grid, Window
from groundproc.raster.kinds import Gathered, Kind, derive, gathering, kind, needed
from groundproc.raster.strays import Accompanied

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
        Noise, what moves and points that are alone count too.
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
    """The raster that came of it, and what a person ought to know.

    Attributes
    ----------
    columns, rows : int
    cell_m : float
    warnings : tuple of str
    left_out : int
        Points of noise and of what moves.
    alone : int
        Points that nothing is near, left out of a surface.
    """

    columns: int
    rows: int
    cell_m: float
    warnings: tuple[str, ...]
    left_out: int = 0
    alone: int = 0


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
    unit = METRES if task.crs is not None else agreed_metres(clouds)
    for cloud in clouds:
        missing = [name for name in needed(chosen) if name not in cloud.columns]
        if missing:
            raise UsageError(f"{cloud.path}: has no {missing[0]}, but {', '.join(cloud.columns)}")
    if task.tile_m is not None:
        with tiles.claimed(task.output, task.force) as aside:
            gathered, *left = _gathered(task, chosen, clouds, unit, aside, progress)
            grid = tiles.write(aside, chosen.name, InUnit(gathered, chosen, unit), crs, task.tile_m / unit.across)
    else:
        with written_aside(task.output) as aside:
            gathered, *left = _gathered(task, chosen, clouds, unit, task.output.parent, progress)
            made = InUnit(gathered, chosen, unit)
            whole, block = made.made(task.output)
            geotiff.write(aside, whole, crs, made.band, block)
        with geotiff.opened(task.output) as there:
            grid = there.grid
    return Made(grid.columns, grid.rows, grid.cell_m * unit.across, warnings, *left)


class InUnit:
    """A raster that was gathered in metres, with its cells and heights in the unit of the CRS.

    Parameters
    ----------
    gathered : Gathered
    kind : Kind
    unit : Metres
    """

    def __init__(self, gathered: Gathered, kind: Kind, unit: Metres) -> None:
        self._gathered, self._unit = gathered, unit
        self._heights = not unit.plain and kind.column == "z" and kind.band.unit == "m" and kind.derived is None

    @property
    def band(self) -> geotiff.Band:
        """What the raster holds."""
        return replace(self._gathered.band, unit="") if self._heights else self._gathered.band

    def made(self, path: Path) -> tuple[Grid, Callable[[Window], npt.NDArray[Any]]]:
        """See `Gathering`."""
        grid, block = self._gathered.made(path)
        if self._unit.plain:
            return grid, block
        up = np.float32(self._unit.up if self._heights else 1.0)
        return Grid.of_window(grid, grid.cell_m / self._unit.across), lambda window: block(window) / up


def _gathered(
    task: Task,
    chosen: Kind,
    clouds: Sequence[reader.Cloud],
    unit: Metres,
    folder: Path,
    progress: Callable[[int], object],
) -> tuple[Gathered, int, int]:
    """All points of the clouds that count, in metres; how many do not by their class, and how many are alone."""
    found = gathering(chosen, chosen.cell_m if task.cell_m is None else task.cell_m, folder)
    near = Accompanied(found.add) if chosen.of_surface and not task.all_classes else None
    left = 0
    for cloud in clouds:
        selection = Selection(cloud.choices)
        for chunk in reader.chunks(cloud, columns=needed(chosen), selection=selection):
            points = chunk.points if unit.plain else replace(chunk.points, xyz_m=unit.of(chunk.points.xyz_m))
            (found if near is None else near).add(points)
            progress(len(chunk.points))
        left += sum(selection.left_out.values())
    alone = 0 if near is None else near.finish()
    if isinstance(found, linedifference.Gathering):
        found.expect_overlap(task.output)
    return found, left, alone


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
        flat(task.inputs[0], source.crs)
        unit = metres_in(source.crs)

        def heights(window: Window) -> npt.NDArray[np.float32]:
            return source.window(window) * np.float32(unit.up)

        def block(window: Window) -> npt.NDArray[Any]:
            return derive(how, heights, window, grid.cell_m * unit.across)

        geotiff.write(aside, grid, source.crs, chosen.band, block)
        return Made(grid.columns, grid.rows, grid.cell_m * unit.across, ())
