"""dsm.tif: the surface model, a height for each cell that has points."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.products import raster
from groundproc.raster.kinds import ALL_STATISTICS


@dataclass(frozen=True, slots=True)
class Options(raster.Options):
    """Of the surface model.

    Attributes
    ----------
    statistic : str
    """

    statistic: str = option("max", "of the heights in a cell", choices=ALL_STATISTICS)


class Dsm(raster.RasterProduct):
    """The highest point of each cell, unless another statistic is chosen."""

    KIND, FILE = "dsm", "dsm.tif"
