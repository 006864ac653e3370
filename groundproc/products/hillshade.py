"""hillshade.tif: the surface model, lit from the north-west."""

from groundproc.products.raster import Options as Options
from groundproc.products.raster import RasterProduct


class Hillshade(RasterProduct):
    """The surface model, lit from the north-west."""

    KIND, FILE = "hillshade", "hillshade.tif"
