"""tiles/: all points in squares of the map, with an index (cloud.vpc) for QGIS and PDAL, and an overview."""

from dataclasses import dataclass

import numpy as np

from flightlog.config import option
from groundproc.cloud.packer import Packer
from groundproc.cloud.points import Points
from groundproc.cloud.tiling import FORMATS, INDEX, LARGEST_M, SMALLEST_M, Tiling
from groundproc.cloud.vpc import write_vpc
from groundproc.files import make_folder
from groundproc.products.product import Context

FOLDER = "tiles"


@dataclass(frozen=True, slots=True)
class Options:
    """Of the tiles.

    Attributes
    ----------
    size_m : float
    format : str
    """

    size_m: float = option(
        250.0, "side of a tile [m]; edges lie on whole multiples of it", minimum=SMALLEST_M, maximum=LARGEST_M
    )
    format: str = option("copc", "of the files", choices=tuple(FORMATS))


class Tiles:
    """Gathers points by square; files are written when all are known.

    Parameters
    ----------
    options : Options
    """

    def __init__(self, options: Options) -> None:
        self._options = options

    def begin(self, context: Context) -> None:
        """Begin with no points."""
        self._context, self._folder = context, context.folder / FOLDER
        self._packer: Packer | None = None

    def add(self, points: Points) -> None:
        """Take points."""
        context = self._context
        if self._packer is None:
            self._packer = Packer(self._folder, points.columns, crs=context.crs, offset_m=context.origin_m)
            self._tiling = Tiling(self._packer.header, context.folder, self._options.size_m)
        records = np.zeros(len(points), self._packer.dtype)
        self._packer.pack(points, records)
        self._tiling.add(records)

    def finish(self) -> None:
        """Write all files."""
        assert self._packer is not None
        make_folder(self._folder)
        tiles, overview = self._tiling.write(self._folder, self._options.format, lambda points: None)
        write_vpc(self._folder / INDEX, tiles, overview, self._packer.header, self._context.crs)
