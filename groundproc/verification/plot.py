"""The figures of all panels as a picture: scatter, intensity and detection against the distance, and lasers against each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from groundproc.verification.measure import Measured
from groundproc.verification.panels import Sheet


def draw(measured: Sequence[Measured], sheet: Sheet, path: Path) -> None:
    """Draw it; written in place."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, ((first, second), (third, fourth)) = plt.subplots(2, 2, figsize=(10.0, 7.2))
    for number, value in enumerate(sorted({each.panel.reflectance for each in measured})):
        some = sorted(
            (each for each in measured if each.panel.reflectance == value), key=lambda each: each.panel.distance_m
        )
        _curves(first, second, third, some, f"C{number}", f"{value:.1%}")
    first.axhline(1e3 * sheet.range_sigma_m, color="0.6", ls="--", lw=1.0)
    first.set_ylabel("scatter of ranges [mm]")
    first.set_ylim(0.0)
    second.set_ylabel("intensity")
    second.set_yscale("log")
    third.set_ylabel("shots with an echo")
    third.set_ylim(-0.03, 1.03)
    for axes in (first, second, third):
        axes.set_xlabel("distance [m]")
    first.legend(title="reflectance", frameon=False)
    _lasers(fourth, measured)
    figure.tight_layout()
    figure.savefig(path, format="png", dpi=110)
    plt.close(figure)


def _curves(first: Any, second: Any, third: Any, some: Sequence[Measured], colour: str, name: str) -> None:
    seen = [each for each in some if each.seen]
    away = [each.panel.distance_m for each in seen]
    scatter = [1e3 * each.whole.sigma_m for each in seen]
    known = [1e3 * each.whole.sigma_of_sigma_m for each in seen]
    first.errorbar(away, scatter, known, color=colour, marker="o", ms=4, lw=1.2, label=name)
    strength, spread = [each.whole.intensity for each in seen], [each.whole.intensity_sigma for each in seen]
    second.errorbar(away, strength, spread, color=colour, marker="o", ms=4, lw=1.2, capsize=2)
    second.axhline(100.0 * some[0].panel.reflectance, color=colour, ls="--", lw=0.8)
    shot = [each for each in some if each.whole.shots]
    third.plot(
        [each.panel.distance_m for each in shot],
        [each.whole.detected for each in shot],
        color=colour,
        marker="o",
        ms=4,
        lw=1.2,
    )


def _lasers(axes: Any, measured: Sequence[Measured]) -> None:
    """Means of each laser about the panels that several of them see."""
    rows = [row for each in measured if each.seen and len(each.lasers) > 1 for row in each.lasers if row.echoes > 1]
    laser = np.array([row.laser for row in rows])
    off = 1e3 * np.array([row.off_m for row in rows])
    axes.scatter(laser, off, s=10, color="0.5")
    for each in np.unique(laser):
        axes.plot([each - 0.4, each + 0.4], [np.median(off[laser == each])] * 2, color="C3", lw=2)
    axes.axhline(0.0, color="0.8", lw=0.8)
    axes.set_xlabel("laser in firing order")
    axes.set_ylabel("ranges off the panel [mm]")
