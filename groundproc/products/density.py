"""density.tif: points per square metre, 0 where there are none."""

from groundproc.products.raster import Options as Options
from groundproc.products.raster import RasterProduct


class Density(RasterProduct):
    """Points per square metre, 0 where there are none."""

    KIND, FILE = "density", "density.tif"
