"""intensity.tif: mean intensity of each cell."""

from groundproc.products.raster import Options as Options
from groundproc.products.raster import RasterProduct


class Intensity(RasterProduct):
    """Mean intensity of each cell."""

    KIND, FILE = "intensity", "intensity.tif"
