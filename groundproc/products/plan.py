"""A plan of some points above an elevation seen from the south, to one scale, with all that a plan needs to be read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.files import written_aside
from groundproc.raster.relief import filled, hillshade
from groundproc.reporting.maps import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = npt.NDArray[np.float64]

DRAWN_WITH: Final = ("matplotlib.figure", "matplotlib.backends.backend_agg", "matplotlib.patheffects")
"""What is imported when a plan is drawn."""
PIXELS: Final = 600
_BACK: Final = "#10131a"
_EDGE: Final = (0.3, 99.7)
"""Percentiles of each axis between which the plan lies: single points far away would make all others small."""
_MARGIN_M: Final = 1.0
_GAP: Final = 3
"""Pixels that the surface bridges: a sample leaves some empty."""
_PATH: Final = "#ff4d6d"


@dataclass(frozen=True, slots=True)
class Plan:
    """What is drawn.

    Attributes
    ----------
    xyz_m : ndarray, shape (n, 3)
    value : ndarray, shape (n,)
        That gives the colour.
    limits : tuple of float
        Between which colours span.
    label, colours, title : str
        `colours` by their name in `reporting.maps`.
    paths : sequence of ndarray, shape (k, 3)
        Of the flight.
    shaded : bool
        The plan is lit from the north-west, as a surface.
    """

    xyz_m: Array
    value: Array
    limits: tuple[float, float]
    label: str
    colours: str
    title: str
    paths: Sequence[Array] = field(default_factory=tuple)
    shaded: bool = False


def draw_plan(path: Path, plan: Plan) -> None:
    """Write it as PNG."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure  # pyplot takes half a second more to import

    low, high = np.percentile(plan.xyz_m, _EDGE, axis=0)
    low, high = low - _MARGIN_M, high + _MARGIN_M
    width, depth, rise = high - low
    inches = 9.0 / max(width, depth)
    above, side = (width * inches, depth * inches), (width * inches, rise * inches)
    size = (max(above[0], 4.5) + 2.6, above[1] + side[1] + 2.2)
    figure = Figure(figsize=size, dpi=100)
    left = 1.2 / size[0]
    colours = ScalarMappable(Normalize(*plan.limits), ListedColormap(palette(plan.colours) / 255.0))
    top = figure.add_axes((left, (side[1] + 1.4) / size[1], above[0] / size[0], above[1] / size[1]))
    south = figure.add_axes((left, 0.6 / size[1], side[0] / size[0], side[1] / size[1]))
    for axes, shown, name in ((top, (0, 1), "northing [m]"), (south, (0, 2), "height [m]")):
        corner = list(shown)
        picture = _picture(plan, shown, low, high, colours)
        extent = np.column_stack([low[corner], high[corner]]).ravel().tolist()
        axes.imshow(picture, extent=tuple(extent), origin="lower", interpolation="nearest")
        axes.set(xlabel="easting [m]", ylabel=name, xlim=extent[:2], ylim=extent[2:], facecolor=_BACK)
        axes.ticklabel_format(useOffset=False, style="plain")
        axes.locator_params(axis="x", nbins=max(int(above[0] / 1.3), 2))
    _dress(top, plan.paths, float(width))
    figure.text(left, 1.0 - 0.45 / size[1], plan.title, fontsize=10)
    bar = figure.add_axes((left + (above[0] + 0.3) / size[0], top.get_position().y0, 0.2 / size[0], above[1] / size[1]))
    figure.colorbar(colours, cax=bar, label=plan.label, extend="both")
    with written_aside(path) as aside:
        figure.savefig(aside, format="png")


def _picture(plan: Plan, shown: tuple[int, int], low: Array, high: Array, colours: Any) -> Array:
    """Colours of the plan, or of the elevation, shape (rows, columns, 4); the first row is the lowest."""
    pixel_m = float(max(high[0] - low[0], high[1] - low[1])) / PIXELS
    is_plan, corner = shown == (0, 1), list(shown)
    # from above the highest point of a pixel is seen, from the south the nearest
    nearness = plan.xyz_m[:, 2].copy() if is_plan else -plan.xyz_m[:, 1]
    width, height = np.ceil((high[corner] - low[corner]) / pixel_m).astype(int).tolist()
    raster = np.full((height, width), np.nan)
    _see(plan.xyz_m, shown, (low, pixel_m), nearness, plan.value, raster)
    if not (plan.shaded and is_plan):
        picture = np.asarray(colours.to_rgba(raster), np.float64)
    else:
        raster = filled(raster[::-1].astype(np.float32), _GAP)[::-1].astype(np.float64)
        picture = _shaded(raster, np.asarray(colours.to_rgba(raster), np.float64), pixel_m)
    picture[np.isnan(raster)] = 0.0
    return picture


def _dress(axes: Axes, paths: Sequence[Array], width_m: float) -> None:
    """Path of the flight, length to scale, and north."""
    from matplotlib.patheffects import withStroke

    halo: list[Any] = [withStroke(linewidth=3.5, foreground=_BACK)]
    for number, place in enumerate(paths):
        axes.plot(place[:, 0], place[:, 1], color=_PATH, lw=1.4, path_effects=halo, label="" if number else "flight")
        axes.plot(*place[0, :2], marker="o", color=_PATH, ms=4, path_effects=halo)
    length_m = round_length(width_m)
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    room = 0.03 * max(east - west, north - south)
    x, y = west + room, south + room
    axes.plot([x, x + length_m], [y, y], color="white", lw=3, solid_capstyle="butt", path_effects=halo)
    axes.text(
        x + length_m / 2, y + 0.5 * room, f"{length_m:g} m", color="white", ha="center", va="bottom", path_effects=halo
    )
    axes.annotate(
        "N", (east - room, north - room), (east - room, north - 3.4 * room), color="white", ha="center", va="center", weight="bold",
        arrowprops={"arrowstyle": "-|>", "color": "white", "lw": 1.5}, path_effects=halo,
    )  # fmt: skip


def round_length(width_m: float) -> float:
    """1, 2 or 5 times a power of ten, at most a quarter of a width."""
    unit = 10.0 ** np.floor(np.log10(width_m / 4.0))
    return float(unit * max(factor for factor in (1.0, 2.0, 5.0) if factor * unit <= width_m / 4.0 * (1 + 1e-9)))


def _shaded(surface_m: Array, colours: Array, pixel_m: float) -> Array:
    """Colours of a surface lit from the north-west; rows go north."""
    light = hillshade(np.ascontiguousarray(surface_m[::-1], np.float32), pixel_m)[::-1]
    out = colours.copy()
    # flat ground, at the cosine of 45 deg, keeps its colour; beside a gap nothing is known of the slope
    out[..., :3] *= (0.3 + 0.99 * np.nan_to_num(light, nan=0.7))[..., None]
    return np.clip(out, 0.0, 1.0)


@njit(cache=True, nogil=True)
def _see(xyz: Any, shown: Any, corner: Any, nearness: Any, value: Any, raster: Any) -> None:
    """Fill in the value of the nearest point in each pixel, of several that are as near the last; empty pixels stay as they are."""
    (across, up), (low, pixel_m), (rows, columns) = shown, corner, raster.shape
    nearest = np.full(raster.shape, -np.inf)
    for i in range(len(xyz)):
        x, y = (xyz[i, across] - low[across]) / pixel_m, (xyz[i, up] - low[up]) / pixel_m
        if x >= 0.0 and y >= 0.0 and x < columns and y < rows:
            column, row = int(x), int(y)
            if nearness[i] >= nearest[row, column]:
                nearest[row, column], raster[row, column] = nearness[i], value[i]
