"""lasers.png: corrections of the single lasers, with their sigmas."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundproc.estimation.adjustment.lasers import Corrections
from groundproc.files import written_aside
from groundproc.sensors.shots import LaserTable

Array = npt.NDArray[np.float64]


def draw_lasers(path: Path, corrections: Corrections, nominal: LaserTable) -> None:
    """Bars of range and elevation offsets in the order of the elevations, each with its sigma; grey is what was not seen well enough."""
    elevation_deg = np.rad2deg(nominal.elevation_rad)
    order = np.argsort(elevation_deg)
    figure = Figure(figsize=(11, 6.5), dpi=110)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axis, kind, unit, scale in ((upper, "range", "mm", 1e3), (lower, "elevation", "deg", np.rad2deg(1.0))):
        value, sigma, found = corrections.of(kind)
        mean, sigma_mean = (scale * number for number in corrections.mean(kind))
        _bars(axis, scale * value[order], scale * sigma[order], found[order])
        axis.set_ylabel(f"{kind} offset [{unit}]")
        axis.set_title(f"mean {mean:+.2g} {unit}, sigma {sigma_mean:.2g} {unit}", fontsize=10)
    lower.set_xticks(range(len(order)), [f"{elevation_deg[k]:.1f}" for k in order], rotation=90, fontsize=8)
    lower.set_xlabel("elevation of the laser [deg]")
    figure.tight_layout()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png")


def _bars(axis: Axes, value: Array, sigma: Array, found: npt.NDArray[np.bool_]) -> None:
    colours = np.where(found, "C0", "0.75")
    axis.bar(np.arange(len(value)), value, color=colours.tolist(), yerr=sigma, capsize=2, ecolor="0.2")
    axis.axhline(0.0, color="0.4", lw=0.8)
    axis.grid(axis="y", alpha=0.3)
