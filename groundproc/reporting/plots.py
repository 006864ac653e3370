"""Curves over time or another axis as SVG in the colours of the page, light or dark."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.reporting.markup import Html, tag

Array = npt.NDArray[np.float64]

_WIDTH: Final = 640.0
_HEIGHT: Final = 220.0
_LEFT: Final = 58.0
_RIGHT: Final = 12.0
_TOP: Final = 10.0
_BOTTOM: Final = 38.0
_COLUMNS: Final = 600
"""Beyond so many points, only the least and the largest of a column are drawn."""
_COLOURS: Final = ("#1769c2", "#c2571a", "#2b8a57", "#8a4fb8")
"""Where the page's own, which go by light and dark, are not looked at: attributes yield to its style."""
_TEXT: Final = {"font_size": "11", "font_family": "sans-serif", "fill": "#4c5763"}


@dataclass(frozen=True, slots=True)
class Curve:
    """One line, or one set of dots.

    Attributes
    ----------
    name : str
    x, y : ndarray, shape (n,)
        What is not a number breaks the line.
    dots : bool
    """

    name: str
    x: Array
    y: Array
    dots: bool = False


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves in one frame.

    Attributes
    ----------
    title, x_label, y_label : str
    curves : sequence of Curve
    zero : bool
        The vertical axis begins at 0.
    about : str
        A sentence below.
    marks : sequence of (float, float)
        Stretches of the horizontal axis that are shaded.
    """

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    zero: bool = False
    about: str = ""
    marks: Sequence[tuple[float, float]] = field(default_factory=tuple)


@dataclass(frozen=True, slots=True)
class _Frame:
    """From values to places in the picture."""

    left: float
    right: float
    low: float
    high: float

    def x(self, value: Array) -> Array:
        return _LEFT + (value - self.left) / (self.right - self.left) * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: Array) -> Array:
        return _TOP + (self.high - value) / (self.high - self.low) * (_HEIGHT - _TOP - _BOTTOM)


def draw(plot: Plot) -> Html:
    """The picture with its title; empty where there is nothing to draw."""
    curves = [each for each in plot.curves if np.isfinite(each.y).any()]
    if not curves:
        return Html("")
    frame = _frame(plot, curves)
    parts = [*_grid(frame, plot), *_marks(frame, plot)]
    for number, curve in enumerate(curves):
        parts.append(_dots(frame, curve, number) if curve.dots else _line(frame, curve, number))
    label = f"{plot.title}: {plot.y_label} over {plot.x_label}"
    picture = tag("svg", parts, viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}", role="img", aria_label=label, class_="plot")
    names = [
        tag("span", tag("i", class_=f"c{number % len(_COLOURS)}"), curve.name) for number, curve in enumerate(curves)
    ] if len(curves) > 1 or curves[0].name else []  # fmt: skip
    caption = tag("figcaption", plot.about) if plot.about else Html("")
    head = tag("div", tag("h3", plot.title), tag("div", names, class_="names"), class_="plothead")
    return tag("figure", head, picture, caption)


def thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """A curve with at most two points for each column of the picture: the least and the largest."""
    if len(x) <= 2 * _COLUMNS:
        return x, y
    edges = np.linspace(0, len(x), _COLUMNS + 1).astype(int)
    starts, counts = edges[:-1], np.diff(edges)
    known = np.logical_or.reduceat(np.isfinite(y), starts)
    extremes = [
        _first(y == np.repeat(of.reduceat(y, starts), counts), starts)[known]
        for of in (np.fmin, np.fmax)  # they pass by what is no number
    ]
    chosen = np.unique(np.concatenate([*extremes, starts[~known]]))
    return x[chosen], y[chosen]


def _first(where: npt.NDArray[np.bool_], starts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The first place of a mask from each start on; the mask's length where there is none."""
    places = np.append(np.flatnonzero(where), len(where))
    return np.asarray(places[np.searchsorted(places, starts)])


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round values from low to high."""
    rough = (high - low) / most
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * unit for factor in (1.0, 2.0, 5.0, 10.0) if factor * unit >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [number * step for number in range(first, math.floor(high / step + 1e-9) + 1)]


def _frame(plot: Plot, curves: Sequence[Curve]) -> _Frame:
    x = np.concatenate([each.x[np.isfinite(each.y)] for each in curves])
    y = np.concatenate([each.y[np.isfinite(each.y)] for each in curves])
    low, high = float(y.min()), float(y.max())
    if plot.zero:
        low = min(low, 0.0)
    room = (high - low) * 0.06 or max(abs(high), 1.0) * 0.1
    left, right = float(x.min()), float(x.max())
    return _Frame(
        left, right if right > left else left + 1.0, low if plot.zero and low == 0.0 else low - room, high + room
    )


def _grid(frame: _Frame, plot: Plot) -> list[Html]:
    parts = []
    for value in ticks(frame.low, frame.high, 5):
        y = float(frame.y(np.array(value)))
        parts.append(
            tag("line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=round(y, 1), y2=round(y, 1), stroke="#d5dbe2", class_="grid")
        )
        parts.append(
            tag("text", _short(value), x=_LEFT - 7, y=round(y + 4.0, 1), class_="end", text_anchor="end", **_TEXT)
        )
    for value in ticks(frame.left, frame.right, 8):
        x = float(frame.x(np.array(value)))
        parts.append(
            tag(
                "text",
                _short(value),
                x=round(x, 1),
                y=_HEIGHT - _BOTTOM + 16,
                class_="middle",
                text_anchor="middle",
                **_TEXT,
            )
        )
    parts.append(
        tag(
            "text",
            plot.x_label,
            x=(_LEFT + _WIDTH) / 2,
            y=_HEIGHT - 4,
            class_="middle label",
            text_anchor="middle",
            **_TEXT,
        )
    )
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    parts.append(
        tag(
            "text",
            plot.y_label,
            x=12.0,
            y=middle,
            class_="middle label",
            text_anchor="middle",
            **_TEXT,
            transform=f"rotate(-90 12 {middle:g})",
        )
    )
    return parts


def _marks(frame: _Frame, plot: Plot) -> list[Html]:
    parts = []
    for begin, end in plot.marks:
        left, right = (float(np.clip(frame.x(np.array(each)), _LEFT, _WIDTH - _RIGHT)) for each in (begin, end))
        height = _HEIGHT - _TOP - _BOTTOM
        parts.append(
            tag(
                "rect",
                x=round(left, 1),
                y=_TOP,
                width=round(max(right - left, 0.5), 1),
                height=height,
                fill="#e6eaee",
                class_="mark",
            )
        )
    return parts


def _line(frame: _Frame, curve: Curve, number: int) -> Html:
    x, y = thinned(curve.x, curve.y)
    known = np.isfinite(y)
    words, pen = [], False
    for left, top, drawn in zip(
        frame.x(x).tolist(), frame.y(np.where(known, y, 0.0)).tolist(), known.tolist(), strict=True
    ):
        if drawn:
            words.append(f"{'L' if pen else 'M'}{left:.1f} {top:.1f}")
        pen = drawn
    return _stroke("".join(words), "line", number, 1.4)


def _dots(frame: _Frame, curve: Curve, number: int) -> Html:
    known = np.isfinite(curve.y)
    x, y = thinned(curve.x[known], curve.y[known])
    words = [f"M{left:.1f} {top:.1f}h0" for left, top in zip(frame.x(x).tolist(), frame.y(y).tolist(), strict=True)]
    return _stroke("".join(words), "dots", number, 3.2)


def _stroke(words: str, kind: str, number: int, width: float) -> Html:
    colour = number % len(_COLOURS)
    return tag(
        "path", d=words, fill="none", stroke=_COLOURS[colour], stroke_width=width, stroke_linecap="round", stroke_linejoin="round",
        class_=f"{kind} s{colour}",
    )  # fmt: skip


def _short(value: float) -> str:
    text = f"{value:.6g}"
    return "0" if float(text) == 0.0 else text.replace("-", "−")
