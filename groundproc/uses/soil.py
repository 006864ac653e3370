"""Use soil: disturbed soil of one flight."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.soil import LEAST_SCORE, SIZE_M, Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the soil; see `swath soil`.

    Attributes
    ----------
    size_m, least_score : float
    """

    size_m: float = option(SIZE_M, "side of the smallest patch [m]", minimum=0.1, maximum=20)
    least_score: float = option(LEAST_SCORE, "sigmas of what is claimed, at least", minimum=1, maximum=1000)


def make(site: Site, options: Options) -> Told:
    """Find it."""
    task = Task(site.cloud, site.folder / "soil.geojson", None, options.size_m, options.least_score)
    figures = work(task, site.progress).figures()
    return Told(f"{figures['patches']} patches stand out, {figures['raised']} raised, {figures['sunk']} sunk", figures)
