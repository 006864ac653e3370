"""Pictures of an assessment: where points are off and by how much, and how differences are spread."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.files import written_aside

Array = npt.NDArray[np.float64]

_NAMED: Final = 40
"""Points beyond which their names would hide them."""
_DOTS: Final = 40_000
_ARROW: Final = 0.12
"""Length of the usual arrow in the width of the map."""


def _plt() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def residuals(path: Path, ids: list[str], place_m: Array, d_m: Array, title: str) -> None:
    """A map with arrows of differences in plan and colours of those in height, beside histograms of each axis.

    Parameters
    ----------
    path : Path
        PNG.
    ids : list of str
    place_m, d_m : ndarray, shape (n, 3)
        NaN where an axis is not known.
    title : str
    """
    plt = _plt()
    figure = plt.figure(figsize=(11.0, 6.0))
    grid = figure.add_gridspec(3, 2, width_ratios=(1.7, 1.0))
    _map(figure, figure.add_subplot(grid[:, 0]), ids, place_m, d_m)
    for axis, name in enumerate(("dx", "dy", "dz")):
        _histogram(figure.add_subplot(grid[axis, 1]), d_m[:, axis], name)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=110)
    plt.close(figure)


def distances(path: Path, shown: list[tuple[str, Array, Array]], title: str) -> None:
    """Maps of distances by colour, side by side on one scale, and how they are spread.

    Parameters
    ----------
    path : Path
        PNG.
    shown : list of (str, ndarray, ndarray)
        Name, places, shape (n, 3), and distances, shape (n,) [m].
    title : str
    """
    plt = _plt()
    figure, axes = plt.subplots(1, len(shown) + 1, figsize=(5.5 * (len(shown) + 1), 5.2))
    every = np.concatenate([np.abs(d_m) for _, _, d_m in shown])
    most = 1e3 * max(float(np.percentile(every, 95)) if len(every) else 0.01, 1e-3)
    for map_axes, (name, place_m, d_m) in zip(axes, shown, strict=False):
        some = slice(None, None, max(len(d_m) // _DOTS, 1))
        origin = np.floor(place_m.min(axis=0)) if len(place_m) else np.zeros(3)
        x, y = (place_m[some, :2] - origin[:2]).T
        drawn = map_axes.scatter(x, y, c=1e3 * d_m[some], s=4, cmap="coolwarm", vmin=-most, vmax=most, rasterized=True)
        figure.colorbar(drawn, ax=map_axes, label="difference [mm]", shrink=0.8)
        map_axes.set(title=name, xlabel=f"east - {origin[0]:.0f} [m]", ylabel=f"north - {origin[1]:.0f} [m]")
        map_axes.set_aspect("equal", adjustable="datalim")
        if not len(d_m):
            continue
        label = (
            f"{name} median {1e3 * np.median(d_m):+.1f}, RMS {1e3 * np.sqrt(np.mean(d_m**2)):.1f} mm, n = {len(d_m):,}"
        )
        axes[-1].hist(
            np.clip(1e3 * d_m, -1.5 * most, 1.5 * most), bins=60, alpha=0.6, density=True, label=label.strip()
        )
    axes[-1].axvline(0.0, color="k", lw=0.8)
    axes[-1].set(xlabel="difference [mm]", yticks=[])
    axes[-1].legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.12))
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=110)
    plt.close(figure)


def _map(figure: Any, axes: Any, ids: list[str], place_m: Array, d_m: Array) -> None:
    origin = np.floor(place_m.min(axis=0))
    x, y = (place_m[:, :2] - origin[:2]).T
    up = np.isfinite(d_m[:, 2])
    most = float(np.percentile(np.abs(d_m[up, 2]), 98)) if up.any() else 0.01
    most = max(most, 1e-3)
    drawn = axes.scatter(
        x[up], y[up], c=d_m[up, 2], cmap="coolwarm", vmin=-most, vmax=most, s=36, edgecolors="0.3", lw=0.5
    )
    axes.scatter(x[~up], y[~up], marker="x", c="0.4", s=24)
    figure.colorbar(drawn, ax=axes, label="dz [m]", shrink=0.8)
    plan = np.isfinite(d_m[:, :2]).all(axis=1)
    wide = max(float(np.ptp(x)), float(np.ptp(y)), 1.0)
    if plan.any():
        usual = max(float(np.median(np.hypot(*d_m[plan, :2].T))), 1e-4)
        by = _ARROW * wide / usual
        arrows = axes.quiver(
            x[plan],
            y[plan],
            by * d_m[plan, 0],
            by * d_m[plan, 1],
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.004,
            color="k",
        )
        axes.quiverkey(arrows, 0.85, 1.03, by * usual, f"{1e3 * usual:.0f} mm", labelpos="E")
    else:
        axes.text(0.02, 1.02, "heights only", transform=axes.transAxes, fontsize=8)
    if len(ids) <= _NAMED:
        for name, a, b in zip(ids, x, y, strict=True):
            axes.annotate(name[:12], (a, b), xytext=(4, 4), textcoords="offset points", fontsize=7)
    axes.margins(0.15)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"east - {origin[0]:.0f} [m]")
    axes.set_ylabel(f"north - {origin[1]:.0f} [m]")


def _histogram(axes: Any, values: Array, name: str) -> None:
    known = values[np.isfinite(values)]
    axes.set_ylabel(name)
    axes.set_yticks([])
    if not len(known):
        axes.text(0.5, 0.5, "not known", ha="center", transform=axes.transAxes)
        return
    half = max(float(np.abs(known).max()), 1e-3)
    bins = int(np.clip(2.0 * np.sqrt(len(known)), 5, 60))
    axes.hist(known, bins=bins, range=(-half, half), color="0.7", edgecolor="0.4")
    axes.axvline(0.0, color="k", lw=0.8)
    axes.axvline(known.mean(), color="C3", lw=1.2)
    rmse = float(np.sqrt(np.mean(known**2)))
    axes.set_title(f"mean {1e3 * known.mean():+.1f}, RMSE {1e3 * rmse:.1f} mm, n = {len(known)}", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_xlabel(f"{name} [m]", fontsize=8)
