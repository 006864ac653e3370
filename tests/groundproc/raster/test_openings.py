"""Openings by octagons, against scipy and against what makes an opening one."""

import numpy as np
import pytest
from scipy.ndimage import grey_opening

from groundproc.raster.openings import dilated, eroded, opened

SURFACE = np.random.default_rng(5).normal(size=(47, 61)).astype(np.float32)


def _octagon(radius: int) -> np.ndarray:
    """The octagon itself: where one low cell spreads to."""
    point = np.zeros((2 * radius + 1, 2 * radius + 1), np.float32)
    point[radius, radius] = -1.0
    return np.asarray(eroded(point, radius) < 0)


@pytest.mark.parametrize("radius", [1, 2, 3, 5, 9])
def test_it_is_the_opening_by_a_shape_close_to_a_disc(radius: int) -> None:
    shape = _octagon(radius)
    j, i = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    assert shape[radius].all()
    assert shape[:, radius].all()
    assert np.array_equal(shape, shape.T)
    assert np.array_equal(shape, shape[::-1])
    assert not shape[np.hypot(i, j) > 1.12 * radius + 0.5].any()
    assert shape[np.hypot(i, j) < 0.9 * radius - 0.5].all()
    inner = (slice(2 * radius, -2 * radius or None),) * 2
    expected = grey_opening(SURFACE, footprint=shape, mode="nearest")
    if SURFACE[inner].size:
        assert np.array_equal(opened(SURFACE, radius)[inner], expected[inner])


@pytest.mark.parametrize("radius", [1, 4, 30])
def test_an_opening_is_below_its_surface_and_opens_no_further(radius: int) -> None:
    once = opened(SURFACE, radius)
    assert (once <= SURFACE).all()
    assert np.array_equal(opened(once, radius), once)
    assert (eroded(SURFACE, radius) <= once).all()
    assert (dilated(SURFACE, radius) >= SURFACE).all()
