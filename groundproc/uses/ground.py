"""Use ground: classes, terrain, canopy, buildings."""

from dataclasses import dataclass

from flightlog.config import option
from groundproc.analysis.ground import Task, work
from groundproc.analysis.terrain.settings import PRESETS
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the ground; see `swath ground`.

    Attributes
    ----------
    terrain : str
    cell_m, window_m : float or None
    """

    terrain: str = option("auto", "what the land is like", choices=tuple(PRESETS))
    cell_m: float | None = option(None, "size of a cell [m]; null: by the density", minimum=0.05, maximum=100)
    window_m: float | None = option(
        None, "half the width of the largest building [m]; null: by the terrain", minimum=1, maximum=200
    )


def make(site: Site, options: Options) -> Told:
    """Class the ground."""
    folder = site.folder
    made = work(
        Task(
            site.cloud, folder / "ground.laz", folder / "dtm.tif", folder / "dtm_sigma.tif", folder / "chm.tif",
            folder / "buildings.geojson", None, options.terrain, options.cell_m, options.window_m,
        ),
        site.progress,
    )  # fmt: skip
    figures = made.figures()
    share = figures["classes"]["ground"] / max(figures["points"], 1)
    rmse = made.holdout.rmse_m
    known = "" if rmse is None else f", known to {rmse:.3f} m RMS"
    return Told(f"{share:.0%} of the points are ground{known}; {made.buildings} buildings", figures)
