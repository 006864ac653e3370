"""adjustment.png: what the adjustment left over, over time, and how well it knows what it estimated."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.products.product import Context

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

BLIND_BELOW: Final = 50
"""Matched clusters of a tenth of a second below which the lidar has next to no planes."""
AXES_OF: Final = {
    "bias": ("x", "y", "z"), "scale": ("x", "y", "z"), "shear": ("yz", "zx", "xy"), "turn": ("x", "y", "z"),
    "accel_bias": ("x", "y", "z"), "accel_scale": ("x", "y", "z"), "accel_shear": ("yz", "zx", "xy"), "accel_turn": ("x", "y", "z"),
    "lever": ("x", "y", "z"),
    "compass": ("const", "sin", "cos", "sin2", "cos2"),
    "spin": ("x sin", "x cos", "y sin", "y cos", "z sin", "z cos"),
}  # fmt: skip
"""What the numbers of an estimated parameter are of."""
UNITS_OF: Final = {
    "bias": "deg/s", "scale": "%", "shear": "%", "turn": "deg", "accel_bias": "m/s^2", "accel_scale": "%",
    "accel_shear": "%", "accel_turn": "deg", "lever": "cm", "delay": "ms", "drift": "ppm", "compass": "deg",
    "spin": "deg", "spin_share": "%",
}  # fmt: skip
FACTORS: Final = {
    "scale": 100.0, "spin_share": 100.0, "shear": 100.0, "accel_scale": 100.0, "accel_shear": 100.0, "lever": 100.0, "delay": 1000.0,
    "drift": 1e6,
}  # fmt: skip
"""From the unit of quality.json to that of the table, where they differ."""
_TITLE: Final = 150
"""Characters that fit across the picture."""
_WIDE_IN, _PLOT_IN, _GAP_IN, _SIDE_IN, _TABLE_ROW_IN = 13.0, 2.15, 0.5, 0.75, 0.21
"""Width of the picture, height of a plot, room below it, room at its left, height of a row of the table [inches]."""
_DPI: Final = 90
_HEAD: Final = ["unit", "parameter", "value", "sigma", "before +-", ""]
_RIGHT: Final = (0.15, 0.46, 0.62, 0.76, 0.9, 1.0)
"""Where the columns of the table end."""
DOT: Final[dict[str, Any]] = {"marker": ".", "linestyle": "", "markersize": 3}


@dataclass(frozen=True, slots=True)
class Sheet:
    """What the picture shows of one run: the estimate's figures by their names, less "adjustment.".

    Attributes
    ----------
    slice_s : ndarray, shape (n,)
        End of each slice of a tenth of a second, from the run's first.
    matched, seen : ndarray, shape (n,)
        Clusters that found a plane in the odometry, and all.
    residual_m : ndarray, shape (n,)
        RMS of their distances; not-a-number where nothing was seen.
    sigma_s : ndarray, shape (m,)
    sigma_position_m, sigma_attitude_rad : ndarray, shape (m, 3)
        Of the trajectory: east, north, up; roll, pitch, heading.
    moved_m, turned_rad : ndarray, shape (n + 1, 3)
        Final path less the odometry, laid on it as a whole: local frame; about the sensor's axes. Empty without a batch.
    position_s, position_off_m, position_sigma_m : ndarray, shape (k,), (k, 3), (k, 3)
        Stated positions less the path.
    heading_rad, heading_off_rad : ndarray, shape (j,)
        Stated headings less those of the path.
    curve_rad : ndarray, shape (5,)
        The compass curve as estimated; empty where there is none.
    windows, restarts, is_worse : ndarray, shape ()
        How many windows there were (0: causal), how often the odometry began anew, whether the trajectory is what it began from.
    round_name, round_value : ndarray, shape (r,)
        Chi-square and residuals in sigma of the last round.
    estimated_name, estimated_value, estimated_sigma, estimated_prior_sigma, estimated_held : ndarray, shape (p,)
        A row for each number that was estimated, in units of quality.json.
    """

    slice_s: Array
    matched: Array
    seen: Array
    residual_m: Array
    sigma_s: Array
    sigma_position_m: Array
    sigma_attitude_rad: Array
    moved_m: Array
    turned_rad: Array
    position_s: Array
    position_off_m: Array
    position_sigma_m: Array
    heading_rad: Array
    heading_off_rad: Array
    curve_rad: Array
    windows: npt.NDArray[Any]
    restarts: npt.NDArray[Any]
    is_worse: npt.NDArray[Any]
    round_name: npt.NDArray[np.str_]
    round_value: Array
    estimated_name: npt.NDArray[np.str_]
    estimated_value: Array
    estimated_sigma: Array
    estimated_prior_sigma: Array
    estimated_held: npt.NDArray[np.bool_]


def draw(context: Context) -> None:
    """Draw the estimate's figures; nothing where there was no adjustment."""
    if (sheet := sheet_of(context.estimate.figures)) is not None:
        draw_sheet(sheet).savefig(context.aside("adjustment.png"), format="png")


def sheet_of(figures: Mapping[str, npt.NDArray[Any]]) -> Sheet | None:
    """The sheet among an estimate's figures; None where it has none."""
    if "adjustment.slice_s" not in figures:
        return None
    return Sheet(**{each.name: figures[f"adjustment.{each.name}"] for each in fields(Sheet)})


def title(sheet: Sheet) -> str:
    """What stands above the picture."""
    blind = float(np.mean(sheet.matched < BLIND_BELOW))
    windows = int(sheet.windows)
    parts = [f"{len(sheet.slice_s) * 0.1:.0f} s", f"{windows} window(s)" if windows else "causal"]
    parts += [f"{100.0 * blind:.0f} % without planes", f"{int(sheet.restarts)} restarts"]
    if sheet.is_worse:
        parts[3] += "; the trajectory is what the adjustment began from"
    last = dict(zip(sheet.round_name.tolist(), sheet.round_value.tolist(), strict=True))
    if not last:
        return ", ".join(parts)
    told = [f"lidar chi-square {last.pop('chi_square'):.2f}"]
    told += [f"{name.removesuffix('_rms')} {value:.2f}" for name, value in last.items()]
    lines = textwrap.wrap("residuals in sigma, last round: " + ", ".join(told), _TITLE)
    return "\n".join([", ".join(parts), *lines])


def draw_sheet(sheet: Sheet) -> Figure:
    """Draw the sheet."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter

    rows, words = _table(sheet), title(sheet)
    plots = 4 if len(sheet.moved_m) else 3
    above, below = 0.25 + 0.17 * (words.count("\n") + 1), _TABLE_ROW_IN * ((len(rows) + 1) // 2 + 1)
    # placed by hand: to have matplotlib look for room takes it as long as two more pictures
    high = above + plots * (_PLOT_IN + _GAP_IN) + below + 0.1
    figure = Figure(figsize=(_WIDE_IN, high), dpi=_DPI)
    grid = figure.add_gridspec(
        plots, 2, left=_SIDE_IN / _WIDE_IN, right=1.0 - 0.2 / _WIDE_IN, wspace=0.15,
        top=1.0 - above / high, bottom=(below + 0.1 + _GAP_IN) / high, hspace=_GAP_IN / _PLOT_IN,
    )  # fmt: skip
    axes = [[figure.add_subplot(grid[row, column]) for column in range(2)] for row in range(plots)]
    figure.suptitle(words, fontsize=10, y=1.0 - 0.1 / high)
    _lines(axes[0][0], sheet.sigma_s, sheet.sigma_position_m, ("east", "north", "up"), "position sigma [m]")
    _lines(
        axes[0][1],
        sheet.sigma_s,
        np.rad2deg(sheet.sigma_attitude_rad),
        ("roll", "pitch", "heading"),
        "attitude sigma [deg]",
    )
    axes[0][1].set_yscale("log")
    for scale in axes[0][1].yaxis.set_major_formatter, axes[0][1].yaxis.set_minor_formatter:
        scale(FormatStrFormatter("%g"))
    axis = axes[1][0]
    axis.plot(sheet.slice_s, sheet.seen, color="0.7", lw=1, label="seen")
    axis.plot(sheet.slice_s, sheet.matched, lw=1, label="on a plane of the map")
    _finish(axis, "clusters of 0.1 s")
    axis = axes[1][1]
    axis.plot(sheet.slice_s, 100.0 * sheet.residual_m, lw=1, label="RMS off the plane, odometry")
    _finish(axis, "distance [cm]")
    knots = np.concatenate([[0.0], sheet.slice_s])[: len(sheet.moved_m)]
    if len(knots):
        _lines(axes[2][0], knots, 100.0 * sheet.moved_m, ("east", "north", "up"), "path - odometry [cm]")
        _lines(axes[2][1], knots, np.rad2deg(sheet.turned_rad), ("x", "y", "z of the sensor"), "path - odometry [deg]")
    axis = axes[-1][0]
    for i, name in enumerate(("east", "north", "up")):
        axis.plot(sheet.position_s, sheet.position_off_m[:, i], **DOT, color=f"C{i}", label=name)
    _finish(axis, "stated position - path [m]")
    for axis in (*(each for row in axes[:-1] for each in row), axes[-1][0]):
        for start, end in _stretches(sheet.matched < BLIND_BELOW):
            left = sheet.slice_s[start - 1] if start else 0.0
            axis.axvspan(float(left), float(sheet.slice_s[end - 1]), color="0.85", zorder=0)
        axis.set_xlim(0.0, float(sheet.slice_s[-1]))
    for axis in axes[-1][0], axes[-2][1]:
        axis.set_xlabel("time [s]")
    _draw_compass(axes[-1][1], sheet)
    if rows:
        figure.figimage(_table_image(rows, below), round(0.1 * _DPI), round(0.1 * _DPI), origin="upper")
    return figure


def _lines(axis: Axes, seconds: Array, values: Array, names: tuple[str, str, str], label: str) -> None:
    for i, name in enumerate(names):
        axis.plot(seconds, values[:, i], lw=1, label=name)
    _finish(axis, label)


def _finish(axis: Axes, label: str) -> None:
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    axis.legend(loc="upper right", fontsize=8)


def _stretches(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _draw_compass(axis: Axes, sheet: Sheet) -> None:
    axis.plot(
        np.rad2deg(sheet.heading_rad), np.rad2deg(sheet.heading_off_rad), **DOT, color="0.5", label="stated - path"
    )
    if len(sheet.curve_rad):
        at = np.linspace(0.0, 2.0 * np.pi, 181)
        terms = np.stack([np.ones_like(at), np.sin(at), np.cos(at), np.sin(2 * at), np.cos(2 * at)], axis=1)
        axis.plot(np.rad2deg(at), np.rad2deg(terms @ sheet.curve_rad), lw=1.5, color="C3", label="compass curve")
    axis.set_xlim(0.0, 360.0)
    axis.set_xticks(range(0, 361, 45))
    axis.set_xlabel("heading [deg]")
    _finish(axis, "heading error [deg]")


def _table(sheet: Sheet) -> list[tuple[list[str], bool]]:
    """Rows of text, one for each number, and whether it is held."""
    rows = []
    names = sheet.estimated_name.tolist()
    for i, key in enumerate(names):
        last = key.rsplit(".", 1)[-1]
        base = next((n for n in sorted(UNITS_OF, key=len, reverse=True) if last == n or last.startswith(n + "_")), last)
        source = "autopilot" if key.startswith("ins.") else ("lidar's IMU" if key.startswith("lidar.") else "")
        name = {
            "turn": "boresight" if key.startswith("ins.") else "misalignment",
            "lever": "place",
            "shear": "cross-axis",
            "accel_shear": "accel cross-axis",
            "accel_turn": "accel misalignment",
        }.get(base, base)
        axes = AXES_OF.get(base, ("",))
        axis = axes[(i - names.index(key)) % len(axes)]
        numbers = (sheet.estimated_value[i], sheet.estimated_sigma[i], sheet.estimated_prior_sigma[i])
        texts = [f"{FACTORS.get(base, 1.0) * number:.3g}" if number else "0" for number in numbers]
        held = bool(sheet.estimated_held[i])
        label = f"{name.replace('_', ' ')} {axis} [{UNITS_OF.get(base, '')}]"
        rows.append(([source, label, *texts, "held" if held else ""], held))
    return rows


def _table_image(rows: list[tuple[list[str], bool]], high_in: float) -> npt.NDArray[np.uint8]:
    """Two columns of rows side by side, below heads of their own, as pixels, shape (high, wide, 3).

    Pillow writes the 485 texts of a usual table in 20 ms, matplotlib takes a second.
    """
    from matplotlib import get_data_path
    from PIL import Image, ImageDraw, ImageFont

    half, wide = (len(rows) + 1) // 2, (_WIDE_IN - 0.2) * _DPI
    image = Image.new("RGB", (round(wide), round(high_in * _DPI)), "white")
    pen = ImageDraw.Draw(image)
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", 8.0 * _DPI / 72.0)
    row_high = (image.height - 1) / (half + 1.0)
    for column, part in enumerate((rows[:half], rows[half:])):
        if not part:
            continue
        left, width = 0.51 * column * wide, 0.49 * wide
        for number, (texts, held) in enumerate([(_HEAD, False), *part]):
            for text, right in zip(texts, _RIGHT, strict=True):
                place = left + width * right, (number + 0.5) * row_high
                pen.text(place, text, font=font, anchor="rm", fill="#999999" if held else "black")
        for number in range(len(part) + 2):
            pen.line([(left, number * row_high), (left + width, number * row_high)], fill="#cccccc")
    return np.asarray(image)
