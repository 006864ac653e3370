"""trajectory.gpkg: the flown path as lines, for maps."""

from groundproc.products.product import Context
from groundproc.vectors.tracks import write_gpkg


def write(context: Context) -> None:
    """Write it, in the CRS of the points."""
    write_gpkg(context.aside("trajectory.gpkg"), context.estimate.trajectory, context.projection, context.crs)
