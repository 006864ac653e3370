"""Use moving: what the cloud was freed of."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.moving import EVERY_S, Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of what moves; see `swath moving`.

    Attributes
    ----------
    every_s : float
    """

    every_s: float = option(EVERY_S, "between places of a thing [s]", minimum=0.05, maximum=60)


def make(site: Site, options: Options) -> Told:
    """Tell of it."""
    folder = site.folder
    task = Task(site.cloud, folder / "moving.geojson", folder / "ways.geojson", options.every_s)
    figures = work(task, site.progress).figures()
    fastest = figures["fastest_m_s"]
    speed = "" if fastest is None else f", the fastest at {fastest:.1f} m/s"
    return Told(f"{figures['things']} things moved{speed}", figures)
