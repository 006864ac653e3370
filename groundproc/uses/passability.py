"""Use passability: where a vehicle can go."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.passability import Task, Vehicle, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the passability; see `swath passability`.

    Attributes
    ----------
    vehicle : Vehicle
    cell_m : float or None
    """

    vehicle: Vehicle = option(Vehicle, "what goes there")
    cell_m: float | None = option(None, "size of a cell [m]; null: by the density", minimum=0.05, maximum=100)


def make(site: Site, options: Options) -> Told:
    """Show where it can go."""
    figures = work(Task(site.cloud, site.folder, options.vehicle, options.cell_m), site.progress).figures()
    areas = figures["area_m2"]
    seen = sum(area for name, area in areas.items() if name != "unseen")
    return Told(
        f"{areas['passable'] / max(seen, 1e-9):.0%} of {seen:,.0f} m2 can be gone on, {areas['unseen']:,.0f} m2 amid them are unseen",
        figures,
    )
