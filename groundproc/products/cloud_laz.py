"""cloud.laz: all points with all that is known of them."""

from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.products.product import Context


class CloudLaz:
    """Streams points into one file; its attributes are the columns of the first points."""

    def begin(self, context: Context) -> None:
        """Name the file; it is opened when it is known what the points have."""
        self._context, self._path = context, context.aside("cloud.laz")
        self._writer: CloudWriter | None = None

    def add(self, points: Points) -> None:
        """Write points."""
        if self._writer is None:
            context = self._context
            writer = CloudWriter(
                self._path, points.columns, crs=context.crs, offset_m=context.origin_m, aside=context.set_aside
            )
            self._writer = context.kept.enter_context(writer)
        self._writer.write(points)

    def finish(self) -> None:
        """The file is closed with the context; then its buffers go too, which the products made after it may need."""
        self._writer = None
