"""Hillshade, local relief and sky-view factor of surfaces for which they are known."""

import math
from typing import Any

import numpy as np
import pytest

from groundproc.raster import relief
from groundproc.raster.grid import Window


def plane(east: float, north: float, size: int = 41, cell_m: float = 0.5) -> relief.Heights:
    """A slope, rising so many metres per metre."""
    j, i = np.mgrid[:size, :size]
    return (100.0 + east * i * cell_m - north * j * cell_m).astype(np.float32)


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (0.3, 0.0), (0.0, -0.5), (-0.7, 0.4)])
def test_a_plane_is_lit_by_the_cosine_between_its_normal_and_the_sun(east: float, north: float) -> None:
    normal = np.array([-east, -north, 1.0]) / math.sqrt(1.0 + east**2 + north**2)
    azimuth, elevation = math.radians(315.0), math.radians(45.0)
    sun = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    made = relief.hillshade(plane(east, north), 0.5)[1:-1, 1:-1]
    # heights of 100 m in float32 have steps of 8e-6 m, over 4 cells of 0.5 m
    assert made == pytest.approx(max(float(normal @ sun), 0.0), abs=3e-5)


def test_small_gaps_of_a_plane_are_filled_and_wide_ones_stay() -> None:
    heights = plane(0.0, 0.0)
    heights[10, 10] = np.nan
    heights[20:40, 20:40] = np.nan
    made = relief.filled(heights, 2)
    assert made[10, 10] == pytest.approx(100.0, abs=1e-4)
    assert np.isnan(made[30, 30])
    known = np.isfinite(heights)
    assert (made[known] == heights[known]).all()


def test_local_relief_shows_a_mound_and_not_the_slope_it_lies_on() -> None:
    heights = plane(0.05, 0.02, 201)
    j, i = np.mgrid[:201, :201]
    mound = 0.1 * np.exp(-((i - 100) ** 2 + (j - 100) ** 2) / (2 * 2.0**2))
    made = relief.local_relief((heights + mound).astype(np.float32), 0.5, 5.0)
    # a Gaussian of 2 cells smoothed by one of 10 keeps 2^2 / (2^2 + 10^2) of its height
    assert made[100, 100] == pytest.approx(0.1 * (1.0 - 4.0 / 104.0), abs=0.002)
    assert abs(made[60, 60]) < 0.002


def test_the_floor_of_a_trench_sees_the_sky_between_its_walls() -> None:
    """Walls 4 m high, 2.25 m to each side: the horizon in direction t has the tangent 4 sin(t) / 2.25."""
    cell_m = 0.25
    heights = np.full((161, 161), 4.0, np.float32)
    heights[:, 80 - 8 : 80 + 9] = 0.0
    made = relief.sky_view(heights, cell_m, 15.0)[80, 80]
    turns = np.arange(relief.SKY_DIRECTIONS) * 2 * math.pi / relief.SKY_DIRECTIONS
    tangent = 4.0 * np.abs(np.sin(turns)) / 2.25
    expected = 1.0 - np.mean(tangent / np.sqrt(1.0 + tangent**2))
    # the wall is met at whole cells: half a cell in 9, where the sine of the horizon changes most by some 3 %
    assert made == pytest.approx(expected, abs=0.02)
    assert relief.sky_view(plane(0.0, 0.0), cell_m, 5.0) == pytest.approx(1.0)


def test_band_after_band_gaps_are_filled_as_in_the_whole() -> None:
    rng = np.random.default_rng(3)
    grid = Window(-7, 100, 90, 3 * relief.BAND_ROWS // 2)
    height = (rng.normal(0, 1, (grid.rows, grid.columns)) + np.linspace(200, 260, grid.rows)[:, None]).astype(
        np.float32
    )
    height[rng.random(height.shape) < 0.6] = np.nan
    height[:, 40:60] = np.nan  # wider than what is filled
    reach = 20  # of the raster that the bands are cut of: beyond it there is nothing
    padded = np.pad(height, reach, constant_values=np.nan)

    def take(window: Window) -> Any:
        top = grid.row + grid.rows - window.row - window.rows + reach
        left = window.column - grid.column + reach
        return padded[top : top + window.rows, left : left + window.columns]

    bands = relief.filled_by_bands(take, grid, 4)
    whole = relief.filled(padded, 4)[reach:-reach, reach:-reach]
    np.testing.assert_array_equal(np.isfinite(bands), np.isfinite(whole))
    np.testing.assert_allclose(bands, whole, rtol=0, atol=1e-3)
