"""trims.png: what the dynamic calibration added to the trajectory, over time."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from groundproc.files import written_aside

Array = npt.NDArray[np.float64]


def draw_trims(path: Path, time_ns: npt.NDArray[np.int64], trims: dict[str, Array], course_deg: Array) -> None:
    """Draw trims by name, each of shape (n,), the yaw with its witness, course less heading [deg]."""
    seconds = (time_ns - time_ns[0]) * 1e-9
    figure = Figure(figsize=(9, 6), layout="tight")
    axes = figure.subplots(3, 1, sharex=True)
    axes[0].plot(seconds, course_deg, ".", color="0.7", markersize=3, label="course over ground - heading")
    axes[0].plot(seconds, trims["yaw_deg"], lw=1, label="yaw")
    for name in ("pitch_deg", "roll_deg"):
        axes[1].plot(seconds, trims[name], lw=1, label=name.removesuffix("_deg"))
    for name in ("altitude_m", "x_m", "y_m"):
        axes[2].plot(seconds, trims[name], lw=1, label=name.removesuffix("_m"))
    for axis, label in zip(axes, ("yaw trim [deg]", "trim [deg]", "trim [m]"), strict=True):
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        axis.legend(loc="upper right", fontsize=8)
    yaw = trims["yaw_deg"]
    axes[0].set_ylim(yaw.min() - 5, yaw.max() + 5)
    axes[2].set_xlabel("time [s]")
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=90, format="png")
