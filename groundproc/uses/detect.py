"""Use detect: hard targets in the open and under leaves."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.detect import LEAST_SCORE, Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the detection; see `swath detect`.

    Attributes
    ----------
    highest_m, least_score : float
    """

    highest_m: float = option(3.0, "targets are no higher above ground [m]", minimum=1, maximum=10)
    least_score: float = option(LEAST_SCORE, "score of what is claimed, at least", minimum=0, maximum=1000)


def make(site: Site, options: Options) -> Told:
    """Find them."""
    folder = site.folder
    task = Task(
        site.cloud, folder / "objects.geojson", None, folder / "penetration.tif", options.highest_m, options.least_score
    )
    figures = work(task, site.progress).figures()
    return Told(
        f"{figures['objects']} objects; {figures['penetration']:.0%} of the pulses came down, over {figures['blind_share']:.0%} of "
        f"{figures['area_ha']:.2f} ha nothing can be claimed",
        figures,
    )
