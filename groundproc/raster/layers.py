"""Rasters that are gathered from the same points, side by side: which points count, and which cells they lie in, is found once for all."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from groundproc.cloud.points import Points
from groundproc.cloud.selection import SURFACES, Selection
from groundproc.raster.cells import Cells, in_cells
from groundproc.raster.grid import checked_cell
from groundproc.raster.kinds import Gathered, Gathering, Kind, gathering, needed

Source = tuple[str, Callable[[Points], Any] | None]
"""What the value of a point is: an attribute, or a function of several."""


class Layer:
    """One of several rasters: takes all points, as each of the others does.

    Parameters
    ----------
    sheet : _Sheet
    gathered : Gathering
        Filled by the sheet.
    """

    def __init__(self, sheet: "_Sheet", gathered: Gathered) -> None:
        self._sheet, self._gathered, self._pieces = sheet, gathered, 0

    def add(self, points: Points) -> None:
        """Take points: the layer that is given them first takes them for all."""
        self._pieces += 1
        if self._pieces > self._sheet.pieces:
            self._sheet.add(points)

    def write(self, path: Path, crs: pyproj.CRS | None) -> None:
        """Write the raster.

        Raises
        ------
        CoverageError
            No point had a value, or a few lie far from all others.
        SourceError
            It cannot be written.
        """
        self._gathered.write(path, crs)


class Layers:
    """The rasters of one pass over the points."""

    def __init__(self) -> None:
        self._sheets: dict[tuple[float, bool], _Sheet] = {}

    def layer(self, kind: Kind, cell_m: float, folder: Path, all_classes: bool) -> Layer:
        """A raster more.

        Parameters
        ----------
        kind : Kind
        cell_m : float
        folder : Path
            For what does not fit into memory.
        all_classes : bool
            Noise and what moves count too.
        """
        key = cell_m, all_classes
        sheet = self._sheets.get(key)
        if sheet is None or sheet.pieces:  # those that were before have points that this one has not
            sheet = self._sheets[key] = _Sheet(cell_m, all_classes)
        return Layer(sheet, sheet.gathering(kind, folder))


class _Sheet:
    """Rasters with cells of one size that look at the same points.

    Attributes
    ----------
    pieces : int
        How often points were taken.
    """

    def __init__(self, cell_m: float, all_classes: bool) -> None:
        self.pieces = 0
        self._cell_m = cell_m
        self._selection = Selection(() if all_classes else (SURFACES,))
        self._gatherings: list[Gathering] = []
        self._others: list[Gathered] = []
        self._cells: dict[Source, tuple[Kind, Cells]] = {}
        self._needed: set[str] = set()

    def gathering(self, kind: Kind, folder: Path) -> Gathered:
        """A raster more; of the same values as another one, it has its cells."""
        self._needed |= set(needed(kind))
        source = kind.column, kind.value
        if kind.by_line or kind.statistic == "median":  # these sort points in ways of their own
            self._others.append(gathering(kind, self._cell_m, folder))
            return self._others[-1]
        if source not in self._cells:
            self._cells[source] = kind, Cells(checked_cell(self._cell_m), ())
        self._gatherings.append(Gathering(kind, self._cell_m, folder, self._cells[source][1]))
        return self._gatherings[-1]

    def add(self, points: Points) -> None:
        """Take points for all rasters."""
        self.pieces += 1
        points = self._selection.of(points, self._needed)
        for other in self._others:
            other.add(points)
        for each in self._gatherings:
            each.count(points)
        if self._cells and len(points):
            self._fill(points)

    def _fill(self, points: Points) -> None:
        """Take points, placed with numbers as all of a flight are, into the cells."""
        placed = in_cells(points.xyz_m, self._cell_m)
        for kind, cells in self._cells.values():
            values = np.ascontiguousarray(kind.values(points), np.float64)
            if np.isfinite(values).all():
                cells.add_placed(placed, values)
            else:
                cells.add(points.xyz_m, values)
