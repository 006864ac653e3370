"""trims.png: what the dynamic calibration added to the trajectory, over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from groundproc.products.product import Context

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(context: Context) -> None:
    """Draw the estimate's trims; nothing where there are none."""
    if "trims.time_ns" in context.estimate.figures:
        draw_trims(context.estimate.figures).savefig(context.aside("trims.png"), dpi=90, format="png")


def draw_trims(figures: Mapping[str, npt.NDArray[Any]]) -> Figure:
    """Draw trims over time, the yaw with its witness, course less heading.

    Parameters
    ----------
    figures : mapping
        trims.time_ns; trims.yaw_rad, pitch_rad, roll_rad, altitude_m, x_m, y_m, course_rad (nan where there is none), shape (n,).
    """
    from matplotlib.figure import Figure

    time_ns = figures["trims.time_ns"]
    seconds = (time_ns - time_ns[0]) * 1e-9
    yaw_deg, course_deg = np.rad2deg(figures["trims.yaw_rad"]), np.rad2deg(figures["trims.course_rad"])
    figure = Figure(figsize=(9, 6), layout="tight")
    axes = figure.subplots(3, 1, sharex=True)
    axes[0].plot(seconds, course_deg, ".", color="0.7", markersize=3, label="course over ground - heading")
    axes[0].plot(seconds, yaw_deg, lw=1, label="yaw")
    for name in ("pitch", "roll"):
        axes[1].plot(seconds, np.rad2deg(figures[f"trims.{name}_rad"]), lw=1, label=name)
    for name in ("altitude", "x", "y"):
        axes[2].plot(seconds, figures[f"trims.{name}_m"], lw=1, label=name)
    for axis, label in zip(axes, ("yaw trim [deg]", "trim [deg]", "trim [m]"), strict=True):
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        axis.legend(loc="upper right", fontsize=8)
    axes[0].set_ylim(yaw_deg.min() - 5, yaw_deg.max() + 5)
    axes[2].set_xlabel("time [s]")
    return figure
