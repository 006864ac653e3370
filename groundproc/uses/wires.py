"""Use wires: power lines, and how far everything is from them."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.wires import Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the wires; see `swath wires`.

    Attributes
    ----------
    least_height_m : float
    """

    least_height_m: float = option(3.0, "height above ground that wires hang at, at least [m]", minimum=1, maximum=100)


def make(site: Site, options: Options) -> Told:
    """Find them."""
    folder = site.folder
    task = Task(site.cloud, folder / "wires.geojson", folder / "wires.laz", options.least_height_m)
    figures = work(task, site.progress).figures()
    near = [each["clearance_vegetation_m"] for each in figures["wires"] if each["clearance_vegetation_m"] is not None]
    growth = f", growth no nearer than {min(near):.2f} m" if near else ""
    thin = ", ".join(f"{figures[name]} {name}" for name in ("poles", "masts", "stays", "fences"))
    return Told(f"{len(figures['wires'])} wires{growth}; {thin}", figures)
