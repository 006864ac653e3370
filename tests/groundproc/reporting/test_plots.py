"""Curves as SVG: what is drawn is where the values are, and nothing of it is lost by thinning."""

import base64
import io
import itertools
import re

import numpy as np
import pytest
from PIL import Image

from groundproc.reporting.maps import coloured, lit, of_points, palette, png, scale_m, span
from groundproc.reporting.plots import Curve, Plot, draw, thinned, ticks


def test_a_thinned_curve_is_the_extremes_of_each_column_with_gaps_where_nothing_is_known() -> None:
    rng = np.random.default_rng(3)
    for count in (1201, 7333):
        y = np.round(rng.normal(0.0, 3.0, count))  # many are alike: the first one counts
        y[rng.random(count) < 0.4] = np.nan
        y[:40] = y[-40:] = np.nan
        y[100] = np.inf
        expected: list[int] = []
        edges = np.linspace(0, count, 601).astype(int)
        for begin, end in itertools.pairwise(edges.tolist()):
            known = [n for n in range(begin, end) if not np.isnan(y[n])]
            if any(np.isfinite(y[n]) for n in known):
                expected += sorted({min(known, key=y.__getitem__), max(known, key=y.__getitem__)})
            else:
                expected.append(begin)
        found, _ = thinned(np.arange(count, dtype=float), y)
        assert found.astype(int).tolist() == expected


def test_a_thinned_curve_keeps_every_peak() -> None:
    rng = np.random.default_rng(3)
    x, y = np.arange(50_000.0), rng.normal(size=50_000)
    y[31_234] = 99.0
    y[17] = -99.0
    some_x, some_y = thinned(x, y)
    assert len(some_x) <= 1200
    assert some_y.max() == 99.0
    assert some_y.min() == -99.0
    assert (np.diff(some_x) > 0).all()
    assert some_x[np.argmax(some_y)] == 31_234


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 10, [0, 2, 4, 6, 8, 10]), (-0.3, 0.31, [-0.2, 0, 0.2]), (995, 1005, [996, 998, 1000, 1002, 1004])],
)
def test_ticks_are_round(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == pytest.approx(expected)


def test_a_gap_breaks_the_line_and_a_curve_of_nothing_is_not_drawn() -> None:
    y = np.array([1.0, 2.0, np.nan, 3.0, 4.0])
    drawn = draw(Plot("t", "x", "y", [Curve("", np.arange(5.0), y)]))
    assert re.search(r'd="M[\d. L]+M[\d. L]+"', drawn)
    assert draw(Plot("t", "x", "y", [Curve("", np.arange(3.0), np.full(3, np.nan))])) == ""
    assert "NaN" not in draw(Plot("t", "x", "y", [Curve("", np.zeros(4), np.full(4, 7.0))])).replace("nan", "NaN")


def test_names_are_escaped() -> None:
    drawn = draw(
        Plot(
            "<b>", "<i>", '"<u>', [Curve("<s>", np.arange(3.0), np.arange(3.0)), Curve("b", np.arange(3.0), np.ones(3))]
        )
    )
    assert not re.search(r"<(b|i|u|s)>", drawn)


def test_scales_are_round_and_of_a_third_of_the_map() -> None:
    for width in (3.0, 77.0, 1234.0):
        long = scale_m(width)
        assert width / 9 < long <= width / 3.5
        assert float(f"{long:.0e}") == long


def test_a_map_of_points_shows_the_highest_of_a_pixel_north_up() -> None:
    place = np.array([[0.0, 0, 1], [0, 0, 5], [10, 20, 3], [10, 0, 2]])
    layer = of_points(np.repeat(place, 600, axis=0))
    assert np.nanmax(layer.values[-1]) == 5.0
    assert np.nanmax(layer.values[: len(layer.values) // 4]) == 3.0
    assert span(layer.values)[0] < span(layer.values)[1]
    assert palette("height").shape == (255, 3)


@pytest.mark.parametrize("many", [False, True])
def test_a_picture_has_the_colours_that_it_was_given(many: bool) -> None:
    values = np.linspace(0.0, 9.0, 60 * 40, dtype=np.float32).reshape(40, 60)
    values[3, 5] = np.nan
    colours = coloured(values, "height", 0.0, 9.0)
    if many:
        colours = lit(colours, np.random.default_rng(1).uniform(1, 255, (40, 60)).astype(np.float32))
    data = base64.b64decode(png(colours).removeprefix("data:image/png;base64,"))
    back = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
    np.testing.assert_array_equal(back, colours)
    assert back[3, 5, 3] == 0


def test_flat_ground_keeps_its_colour_in_the_light_of_a_relief() -> None:
    colours = coloured(np.full((2, 2), 4.0, np.float32), "height", 0.0, 9.0)
    flat = 1.0 + 254.0 * np.cos(np.pi / 4)  # as raster.kinds stores it
    same = lit(colours, np.full((2, 2), flat, np.float32)).astype(int)
    assert abs(same[..., :3] - colours[..., :3]).max() <= 2
