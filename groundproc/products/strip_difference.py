"""strip_difference.tif: by how much flight lines differ in height where they overlap on smooth surfaces."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.products import raster
from groundproc.raster.grid import SMALLEST_CELL_M
from groundproc.raster.linedifference import CELL_M


@dataclass(frozen=True, slots=True)
class Options(raster.Options):
    """Of the differences: larger cells than those of other rasters, so that each line has points in them."""

    cell_m: float = option(CELL_M, "size of a cell [m]; edges lie on whole multiples of it", minimum=SMALLEST_CELL_M)


class StripDifference(raster.RasterProduct):
    """The later line less the earlier in each cell; where no lines overlap, all of it is no data."""

    KIND, FILE = "strip-difference", "strip_difference.tif"
