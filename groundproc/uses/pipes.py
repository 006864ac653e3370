"""Use pipes: pipelines as cylinders."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.pipes import Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the pipes; see `swath pipes`.

    Attributes
    ----------
    least_length_m : float
    """

    least_length_m: float = option(6.0, "length of the shortest [m]", minimum=2, maximum=10_000)


def make(site: Site, options: Options) -> Told:
    """Find them."""
    figures = work(Task(site.cloud, site.folder / "pipes.geojson", options.least_length_m), site.progress).figures()
    length = sum(each["length_m"] for each in figures["pipes"])
    return Told(f"{len(figures['pipes'])} pipes, {length:.1f} m in all", figures)
