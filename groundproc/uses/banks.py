"""Use banks: edges of banks and lines of waters of one flight."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.banks.work import LEAST_DROP_M, LEAST_SLOPE_DEG, Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the banks; see `swath banks`.

    Attributes
    ----------
    least_drop_m, least_slope_deg : float
    """

    least_drop_m: float = option(LEAST_DROP_M, "height of the lowest bank [m]", minimum=0.1, maximum=100)
    least_slope_deg: float = option(LEAST_SLOPE_DEG, "slope of the gentlest [deg]", minimum=10, maximum=85)


def make(site: Site, options: Options) -> Told:
    """Draw them."""
    task = Task(
        site.cloud,
        site.folder / "banks.geojson",
        least_drop_m=options.least_drop_m,
        least_slope_deg=options.least_slope_deg,
    )
    figures = work(task, site.progress).figures()
    return Told(
        f"{figures['banks']} banks with {figures['upper_m']:.0f} m of upper edge, {figures['water_m']:.0f} m of water line",
        figures,
    )
