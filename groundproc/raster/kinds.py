"""What a raster of points can show, by name: the value of a point, the statistic of a cell, and what is derived of it."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud.dimensions import TABLE
from groundproc.cloud.points import Points
from groundproc.raster import geotiff, linedifference, relief
from groundproc.raster.cells import STATISTICS, Cells
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window, checked_cell
from groundproc.raster.medians import Medians

Values = npt.NDArray[Any]
Source = Callable[[Window], npt.NDArray[np.float32]]

CELL_M: Final = 0.25
GAP_M: Final = 1.0
"""Shading bridges gaps of the surface up to so far from a height."""
ALL_STATISTICS: Final = (*STATISTICS, "median")


@dataclass(frozen=True, slots=True)
class Derived:
    """How a raster follows from heights.

    Attributes
    ----------
    make : callable
        Of heights, shape (rows, columns) with NaN, and the cell size [m].
    margin_m : float
        How far around a cell the result looks.
    """

    make: Callable[[npt.NDArray[np.float32], float], npt.NDArray[Any]]
    margin_m: float


@dataclass(frozen=True, slots=True)
class Kind:
    """One sort of raster.

    Attributes
    ----------
    name, about : str
    column : str
        The attribute that is gathered; "z" is the height.
    statistic : str
        Of the values in a cell, unless another is asked for.
    band : Band
    per_area : bool
        The statistic is divided by the area of a cell.
    derived : Derived, optional
        What is made of the gathered heights.
    made_of : tuple of str
        The attributes that the value of a point follows from, where it is none by itself.
    value : callable, optional
        The value of points, of these.
    by_line : bool
        Flight lines are told apart: see `linedifference`.
    cell_m : float
        Size of a cell where nothing else is asked for.
    """

    name: str
    about: str
    column: str
    statistic: str
    band: Band
    per_area: bool = False
    derived: Derived | None = None
    made_of: tuple[str, ...] = ()
    value: Callable[[Points], Values] | None = None
    by_line: bool = False
    cell_m: float = CELL_M

    @property
    def of_surface(self) -> bool:
        """It shows a surface, to which no point belongs that is alone."""
        return self.column == "z" and not self.per_area

    def values(self, points: Points) -> Values:
        """The value of each point.

        Raises
        ------
        UsageError
            The points do not have that attribute.
        """
        if self.value is not None:
            return self.value(points)
        return points.xyz_m[:, 2] if self.column == "z" else points[self.column]


def _sigma(points: Points) -> Values:
    """How well the place of each point is known, one sigma of the way to where it is: both horizontal axes and the height."""
    sigma_h, sigma_v = points["sigma_h"], points["sigma_v"]
    return np.sqrt(2.0 * sigma_h.astype(np.float64) ** 2 + sigma_v.astype(np.float64) ** 2)


def _shade(height_m: npt.NDArray[np.float32], cell_m: float) -> npt.NDArray[Any]:
    """1 to 255, 0 where nothing is known."""
    light = relief.hillshade(relief.filled(height_m, max(round(GAP_M / cell_m), 1)), cell_m)
    return np.where(np.isfinite(light), 1.0 + np.nan_to_num(light) * 254.0, 0.0).round().astype(np.uint8)


def _local(height_m: npt.NDArray[np.float32], cell_m: float) -> npt.NDArray[Any]:
    return relief.local_relief(relief.filled(height_m, max(round(GAP_M / cell_m), 1)), cell_m, LOCAL_RADIUS_M)


def _sky(height_m: npt.NDArray[np.float32], cell_m: float) -> npt.NDArray[Any]:
    return relief.sky_view(relief.filled(height_m, max(round(GAP_M / cell_m), 1)), cell_m, SKY_RADIUS_M)


def _tied(statistic: str | None, name: str) -> None:
    """Refuse a statistic of what has none.

    Raises
    ------
    UsageError
    """
    if statistic is not None:
        raise UsageError(f"{name} with statistic {statistic}: it compares flight lines and has none")


LOCAL_RADIUS_M: Final = 5.0
SKY_RADIUS_M: Final = 10.0

KINDS: Final = (
    Kind("dsm", "surface model: the highest point of each cell", "z", "max", Band("surface height", "m", resampling="average")),
    Kind("intensity", "mean intensity", "intensity", "mean", Band("mean intensity")),
    Kind("density", "points per square metre", "z", "count", Band("density", "1/m2", no_data=None), per_area=True),
    Kind(
        "hillshade", "surface model lit from the north-west, 45 deg above the horizon", "z", "max",
        Band("hillshade", "", "uint8", 0.0), derived=Derived(_shade, GAP_M),
    ),
    Kind(
        "local-relief", f"heights less their mean over {LOCAL_RADIUS_M:g} m around: shows what is low and small", "z", "min",
        Band("local relief", "m"), derived=Derived(_local, GAP_M + 3.0 * LOCAL_RADIUS_M),
    ),
    Kind(
        "sky-view", f"share of the sky that is seen, horizon within {SKY_RADIUS_M:g} m", "z", "min", Band("sky-view factor"),
        derived=Derived(_sky, GAP_M + SKY_RADIUS_M),
    ),
    Kind(
        "sigma", "how well points are known, one sigma in space", "sigma", "mean", Band("point sigma", "m"),
        made_of=("sigma_h", "sigma_v"), value=_sigma,
    ),
    Kind(
        "strip-difference", "height of the later flight line over the earlier, of the two that differ most", "z", "mean",
        linedifference.BAND, made_of=(linedifference.LINE,), by_line=True, cell_m=linedifference.CELL_M,
    ),
)  # fmt: skip
"""The sorts with a name of their own; any attribute of points is one too."""


def kind(name: str, statistic: str | None = None) -> Kind:
    """A sort of raster, with another statistic if one is given.

    Raises
    ------
    UsageError
        There is none of that name, or it has no such statistic.
    """
    found = next((each for each in KINDS if each.name == name), None)
    if found is None:
        attribute = next((each for each in TABLE if each.name == name), None)
        if attribute is None:
            raise UsageError(f"{name!r}: found, expected one of {', '.join(names())}")
        found = Kind(name, attribute.about, name, "mean", Band(attribute.brief, attribute.unit))
    if found.by_line:
        _tied(statistic, name)
    if statistic is None or statistic == found.statistic:
        return found
    if statistic not in ALL_STATISTICS:
        raise UsageError(f"statistic {statistic!r}: found, expected one of {', '.join(ALL_STATISTICS)}")
    if found.per_area:
        raise UsageError(f"{name} with statistic {statistic}: it is the count of points and has no other")
    if statistic == "count":
        return replace(found, statistic="count", band=Band("count", no_data=None))
    return replace(found, statistic=statistic)


def names() -> tuple[str, ...]:
    """All that `kind` takes."""
    return (*(each.name for each in KINDS), *(each.name for each in TABLE if each.name not in {k.name for k in KINDS}))


_ROOM_CELLS: Final = 10_000_000
_ROOM_EACH: Final = 1000
"""So many cells, and so many more a point, a raster may have: a corridor across its bounding box has some 40, a stray point millions."""


class Gathering:
    """A raster of one kind, gathered from points in any order.

    Parameters
    ----------
    kind : Kind
    cell_m : float
    folder : Path
        For what does not fit into memory.
    cells : Cells, optional
        Of the same values, which others look at too and whoever made them fills; default: its own.

    Attributes
    ----------
    cells : Cells or Medians

    Raises
    ------
    UsageError
        The cell is no size.
    """

    def __init__(self, kind: Kind, cell_m: float, folder: Path, cells: Cells | None = None) -> None:
        self._kind, self._cell_m, self._points = kind, checked_cell(cell_m), 0
        if cells is not None:
            cells.keep(kind.statistic)
        self.cells: Cells | Medians = (
            cells if cells is not None
            else Medians(cell_m, folder) if kind.statistic == "median"
            else Cells(cell_m, {kind.statistic})
        )  # fmt: skip

    def add(self, points: Points) -> None:
        """Take points."""
        self.count(points)
        self.cells.add(points.xyz_m, self._kind.values(points))

    def count(self, points: Points) -> None:
        """Count points whose values are taken elsewhere."""
        self._points += len(points)

    @property
    def band(self) -> Band:
        """What the raster holds."""
        return self._kind.band

    def made(self, path: Path) -> tuple[Grid, Callable[[Window], npt.NDArray[Any]]]:
        """The grid, and what gives its windows; `path` is named in errors.

        Raises
        ------
        CoverageError
            No point had a value, or a few lie far from all others.
        """
        grid = self.cells.grid()
        if grid is None:
            raise CoverageError(f"{path.name}: not one point has a value of {self._kind.column}")
        if grid.columns * grid.rows > _ROOM_CELLS + _ROOM_EACH * self._points:
            raise CoverageError(
                f"{path.name}: {self._points:,} points lie within {grid.columns * self._cell_m:,.0f} x {grid.rows * self._cell_m:,.0f} m, "
                f"{grid.columns * grid.rows:,} cells, nearly all empty; are some of the points strays? leave these out, or take larger "
                "cells"
            )
        return grid, self._block

    def write(self, path: Path, crs: pyproj.CRS | None) -> None:
        """Write the raster.

        Raises
        ------
        CoverageError
            No point had a value, or a few lie far from all others.
        SourceError
            It cannot be written.
        """
        grid, block = self.made(path)
        geotiff.write(path, grid, crs, self._kind.band, block)

    def _block(self, window: Window) -> npt.NDArray[Any]:
        chosen = self._kind
        if chosen.derived is not None:
            return derive(chosen.derived, self._heights, window, self._cell_m)
        values = self.cells.window(window, chosen.statistic)
        return values / np.float32(self._cell_m**2) if chosen.per_area else values

    def _heights(self, window: Window) -> npt.NDArray[np.float32]:
        return self.cells.window(window, self._kind.statistic)


def derive(how: Derived, heights: Source, window: Window, cell_m: float) -> npt.NDArray[Any]:
    """What follows from heights in a window, of heights around it."""
    margin = int(np.ceil(how.margin_m / cell_m)) + 1
    wide = how.make(heights(window.grown(margin)), cell_m)
    return wide[margin:-margin, margin:-margin]


def needed(kind: Kind) -> Collection[str]:
    """The attributes that a reader has to give."""
    if kind.made_of:
        return kind.made_of
    return () if kind.column == "z" else (kind.column,)


Gathered = Gathering | linedifference.Gathering


def gathering(kind: Kind, cell_m: float, folder: Path) -> Gathered:
    """What gathers points for a raster of some kind."""
    return linedifference.Gathering(cell_m, folder) if kind.by_line else Gathering(kind, cell_m, folder)
