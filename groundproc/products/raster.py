"""Rasters of the points of a flight: what their files have in common."""

from dataclasses import dataclass
from typing import ClassVar

from flightlog.config import option
from groundproc.cloud.points import Points
from groundproc.products.product import Context
from groundproc.raster.grid import SMALLEST_CELL_M
from groundproc.raster.kinds import CELL_M, kind


@dataclass(frozen=True, slots=True)
class Options:
    """Of a raster.

    Attributes
    ----------
    cell_m : float
    all_classes : bool
    """

    cell_m: float = option(CELL_M, "size of a cell [m]; edges lie on whole multiples of it", minimum=SMALLEST_CELL_M)
    all_classes: bool = option(False, "noise and what moves count too")


class RasterProduct:
    """A raster that is gathered while points are placed.

    Parameters
    ----------
    options : Options
    """

    KIND: ClassVar[str]
    """Of `raster.kinds`."""
    FILE: ClassVar[str]

    def __init__(self, options: Options) -> None:
        self._options = options

    def begin(self, context: Context) -> None:
        """Begin with no points."""
        self._crs, self._path = context.crs, context.aside(self.FILE)
        chosen, options = kind(self.KIND, getattr(self._options, "statistic", None)), self._options
        self._layer = context.layers.layer(chosen, options.cell_m, context.folder, options.all_classes)

    def add(self, points: Points) -> None:
        """Take points."""
        self._layer.add(points)

    def finish(self) -> None:
        """Write the file."""
        self._layer.write(self._path, self._crs)
