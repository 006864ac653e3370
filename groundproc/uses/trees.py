"""Use trees: a list of them."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.trees import BUSH_M, TREE_M, Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the trees; see `swath trees`.

    Attributes
    ----------
    least_height_m : float
    """

    least_height_m: float = option(
        TREE_M, "height of the lowest [m]; below 3 m they are bushes", minimum=BUSH_M, maximum=100
    )


def make(site: Site, options: Options) -> Told:
    """List them."""
    figures = work(Task(site.cloud, site.folder / "trees.geojson", options.least_height_m), site.progress).figures()
    median = figures["median_height_m"]
    height = "" if median is None else f", median height {median:.1f} m"
    return Told(f"{figures['trees']} trees, {figures['dead']} dead, {figures['bushes']} bushes{height}", figures)
