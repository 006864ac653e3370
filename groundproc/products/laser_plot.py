"""lasers.png: corrections of the single lasers, with their sigmas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from groundproc.products.product import Context

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]


def draw(context: Context) -> None:
    """Draw the estimate's figures; nothing where no lasers were estimated."""
    if "lasers.range_m" in context.estimate.figures:
        draw_lasers(context.estimate.figures).savefig(context.aside("lasers.png"), format="png")


def draw_lasers(figures: Mapping[str, npt.NDArray[Any]]) -> Figure:
    """Bars of range and elevation offsets in the order of the elevations, each with its sigma; grey is what was not seen well enough.

    Parameters
    ----------
    figures : mapping
        lasers.table_elevation_rad, shape (n,): before corrections.
        lasers.range_m, range_sigma_m, range_found (bool), shape (n,); range_mean_m, shape (2,): mean offset and its sigma.
        lasers.elevation_rad and so on: the same of the elevations.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.5), dpi=110)
    upper, lower = figure.subplots(2, 1, sharex=True)
    table_deg = np.rad2deg(figures["lasers.table_elevation_rad"])
    order = np.argsort(table_deg)
    for axis, kind, own, unit, scale in (
        (upper, "range", "m", "mm", 1e3), (lower, "elevation", "rad", "deg", np.rad2deg(1.0)),
    ):  # fmt: skip
        value, sigma = figures[f"lasers.{kind}_{own}"], figures[f"lasers.{kind}_sigma_{own}"]
        mean, sigma_mean = scale * figures[f"lasers.{kind}_mean_{own}"]
        _bars(axis, scale * value[order], scale * sigma[order], figures[f"lasers.{kind}_found"][order])
        axis.set_ylabel(f"{kind} offset [{unit}]")
        axis.set_title(f"mean {mean:+.2g} {unit}, sigma {sigma_mean:.2g} {unit}", fontsize=10)
    lower.set_xticks(range(len(order)), [f"{degrees:.1f}" for degrees in table_deg[order]], rotation=90, fontsize=8)
    lower.set_xlabel("elevation of the laser [deg]")
    figure.tight_layout()
    return figure


def _bars(axis: Axes, value: Array, sigma: Array, found: npt.NDArray[np.bool_]) -> None:
    colours = np.where(found, "C0", "0.75")
    axis.bar(np.arange(len(value)), value, color=colours.tolist(), yerr=sigma, capsize=2, ecolor="0.2")
    axis.axhline(0.0, color="0.4", lw=0.8)
    axis.grid(axis="y", alpha=0.3)
