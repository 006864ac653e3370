"""Use reflectance: that of every echo, and an orthophoto of it."""

from dataclasses import dataclass
from pathlib import Path

from flightlog.config import option
from groundproc.radiometry.orthophoto import orthophoto
from groundproc.radiometry.site import Task
from groundproc.radiometry.work import run
from groundproc.uses.site import Site, Told


@dataclass(frozen=True, slots=True)
class Options:
    """Of the reflectance; see `swath reflectance`. Targets are those that the survey names.

    Attributes
    ----------
    visibility_km : float or None
    cell_m : float
    """

    visibility_km: float | None = option(None, "visibility; null: the air takes nothing", minimum=0.1, maximum=500)
    cell_m: float = option(0.25, "cell of the orthophoto [m]", minimum=0.01, maximum=100)


def make(site: Site, options: Options) -> Told:
    """Calibrate."""
    folder, targets = site.folder, site.survey.targets
    lever_m = site.estimate.mount.lidar.position_m
    told = run(
        Task(
            [site.cloud], folder, site.trajectory, None if targets is None else Path(targets), None, options.visibility_km,
            lever_m=lever_m,
        ),
        lambda stage, count: site.progress(count),
    )  # fmt: skip
    calibrated = (folder / site.cloud.with_suffix(".laz").name).rename(folder / "reflectance.laz")
    orthophoto([calibrated], folder / "reflectance.tif", "reflectance", options.cell_m, None, site.progress)
    kind = "relative, for want of targets" if told["relative"] else f"from {len(told['targets'])} targets"
    sigma = "" if told["c_cal_sigma"] is None else f" ± {told['c_cal_sigma']:.2g}"
    return Told(f"c_cal {told['c_cal']:.4g}{sigma}, {kind}", told)
