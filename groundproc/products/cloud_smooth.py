"""cloud_smooth.laz: a marked copy of the cloud, its points on surfaces freed of the sensor's noise."""

from dataclasses import dataclass

from flightlog.config import option
from flightlog.errors import SourceError
from groundproc.analysis.smoothing import Task, work
from groundproc.products.product import Context
from groundproc.reporting.cloudpart import CLOUDS

FILE = "cloud_smooth.laz"


@dataclass(frozen=True, slots=True)
class Options:
    """Of the smoothing; see `swath smooth`.

    Attributes
    ----------
    sigma_m : float or None
    """

    sigma_m: float | None = option(
        None, "noise along normals [m]; null: as the smoothest quarter of the cloud has it", minimum=0.0005, maximum=1.0
    )


def write(context: Context, options: Options) -> None:
    """Smooth what was placed."""
    cloud = next((context.finished / name for name in reversed(CLOUDS) if (context.finished / name).is_file()), None)
    if cloud is None:
        raise SourceError(f"no product holds the points; expected {' or '.join(reversed(CLOUDS))} among the products")
    work(Task(cloud, context.aside(FILE), options.sigma_m), lambda count: None)
