"""Use windows: what is seen through the panes of houses."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.windows import Task, work
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the windows; see `swath windows`.

    Attributes
    ----------
    walls : bool
    """

    walls: bool = option(True, "write walls.geojson too")


def make(site: Site, options: Options) -> Told:
    """Class what is behind panes."""
    folder = site.folder
    made = work(
        Task(
            site.cloud, folder / "windows.laz", folder / "walls.geojson" if options.walls else None, site.trajectory,
            lever_m=site.estimate.mount.lidar.position_m,
        ),
        site.progress,
    )  # fmt: skip
    figures = made.figures()
    return Told(
        f"{figures['walls']} walls, {figures['walls_seen_through']} seen through: {made.behind:,} points behind panes",
        figures,
    )
