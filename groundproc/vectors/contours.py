"""Lines of equal height of a raster."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from contourpy import contour_generator

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud.metres import metres_in
from groundproc.raster.geotiff import Raster

Array = npt.NDArray[np.float64]

INDEX: Final = 5
"""Every fifth line is an index contour."""
MOST_CELLS: Final = 400_000_000
_MOST_LINES: Final = 100_000
_DIGITS: Final = 9


@dataclass(frozen=True, slots=True)
class Contour:
    """One line, in the units of the raster's CRS.

    Attributes
    ----------
    height : float
    places : ndarray, shape (n, 2)
    index : bool
        Drawn stronger and labelled.
    """

    height: float
    places: Array
    index: bool

    @property
    def length(self) -> float:
        """Along the line."""
        return float(np.linalg.norm(np.diff(self.places, axis=0), axis=1).sum())

    def label(self) -> tuple[Array, float]:
        """Where a label goes, half way along, and how far it is turned [deg], readable from below."""
        step = np.linalg.norm(np.diff(self.places, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(step)])
        half = np.searchsorted(along, along[-1] / 2.0).clip(1, len(along) - 1)
        share = (along[-1] / 2.0 - along[half - 1]) / max(step[half - 1], 1e-9)
        d = self.places[half] - self.places[half - 1]
        turn = float(np.degrees(np.arctan2(d[1], d[0])))
        return self.places[half - 1] + share * d, (turn + 90.0) % 180.0 - 90.0


def contours(raster: Raster, interval: float, shortest: float = 0.0) -> Iterator[Contour]:
    """Lines at whole multiples of an interval, through the heights of the centres of the cells; none beside unknown cells.

    Parameters
    ----------
    raster : Raster
    interval, shortest : float
        Between lines and of the shortest line, in the units of its heights and of its coordinates.

    Raises
    ------
    UsageError
        The interval is none, or gives too many lines.
    CoverageError
        No height is known, or there are more cells than fit into memory.
    """
    word = metres_in(raster.crs).height_word
    if not (np.isfinite(interval) and interval > 0.0):
        raise UsageError(f"interval {interval:g} {word}: expected more than 0, for example 0.5")
    grid = raster.grid
    if grid.columns * grid.rows > MOST_CELLS:
        raise CoverageError(
            f"{raster.path}: {grid.columns} x {grid.rows} cells, expected at most {MOST_CELLS:,}; choose larger cells"
        )
    if min(grid.columns, grid.rows) < 2:
        raise CoverageError(
            f"{raster.path}: {grid.columns} x {grid.rows} cells, expected two or more each way: lines run between their centres"
        )
    heights = raster.window(grid)
    if not np.isfinite(heights).any():
        raise CoverageError(f"{raster.path}: no height is known")
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    first, last = int(np.ceil(low / interval)), int(np.floor(high / interval))
    if last - first > _MOST_LINES:
        raise UsageError(
            f"interval {interval:g} {word}: heights of {low:.2f} to {high:.2f} {word} would give {last - first} levels"
        )
    x = raster.west_m + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = raster.north_m - (np.arange(grid.rows) + 0.5) * grid.cell_m
    generator = contour_generator(x, y, np.ma.masked_invalid(heights), name="serial", chunk_size=0)
    for step in range(first, last + 1):
        height = round(step * interval, _DIGITS)  # three times 0.3 is 0.9 for people
        for places in generator.lines(height):
            line = Contour(height, np.asarray(places), step % INDEX == 0)
            if len(line.places) > 1 and line.length >= shortest:
                yield line
