"""trajectory.gpx and trajectory.kml: the flown path for phones and globes."""

from groundproc.products.product import Context
from groundproc.vectors.tracks import write_gpx, write_kml


def write(context: Context) -> None:
    """Write both."""
    write_gpx(context.aside("trajectory.gpx"), context.estimate.trajectory)
    write_kml(context.aside("trajectory.kml"), context.estimate.trajectory, ", ".join(context.inputs))
