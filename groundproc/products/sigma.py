"""sigma.tif: how well the points of each cell are known, one sigma in space."""

from groundproc.products.raster import Options as Options
from groundproc.products.raster import RasterProduct


class Sigma(RasterProduct):
    """Mean of the points' sigma in each cell."""

    KIND, FILE = "sigma", "sigma.tif"
