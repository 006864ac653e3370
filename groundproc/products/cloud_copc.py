"""cloud.copc.laz: all points as an octree, for viewers that read what they show (QGIS, Potree, CloudCompare)."""

import numpy as np

from groundproc.cloud.copc import CopcBuilder
from groundproc.cloud.packer import Packer
from groundproc.cloud.points import Points
from groundproc.products.product import Context


class CloudCopc:
    """Gathers points by the square that they lie in; the octree is made when all are known."""

    def begin(self, context: Context) -> None:
        """Begin with no points."""
        self._context, self._path = context, context.aside("cloud.copc.laz")
        self._packer: Packer | None = None

    def add(self, points: Points) -> None:
        """Take points."""
        if self._packer is None:
            context = self._context
            self._packer = Packer(self._path, points.columns, crs=context.crs, offset_m=context.origin_m)
            self._builder = CopcBuilder(self._packer.header, context.folder)
        records = np.zeros(len(points), self._packer.dtype)
        self._packer.pack(points, records)
        self._builder.add(records)

    def finish(self) -> None:
        """Write the file."""
        assert self._packer is not None
        self._packer.state_totals(self._packer.header)
        self._builder.write(self._path)
