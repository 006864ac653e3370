"""A clock that is off by seconds, on a flight with known truth: it is found by the rays of common points, and one that is right is left."""

import imageblock
import numpy as np
import pytest

from groundproc.imagery import clockoffset
from groundproc.imagery.bundle.block import ImagePoints
from groundproc.imagery.measurements import Measurements


@pytest.mark.parametrize("off_s", [0.04, 3.2, -7.65])
def test_a_clock_that_is_off_by_seconds_is_found_to_what_an_adjustment_begins_with(off_s: float) -> None:
    truth = imageblock.true_camera(timeshift_s=off_s)
    flown = imageblock.fly(truth, strips=3, per_strip=5, points=150, seed=4, spacing_m=(11.5, 22.5), height=30.0)
    known = imageblock.disturbed(flown, 4, np.array([0.02, 0.02, 0.03]), np.array([0.1, 0.1, 0.2]))
    believed = imageblock.true_camera(timeshift_s=0.0, sigma={"timeshift_s": 0.2})
    rows = sorted(flown.rows, key=lambda row: (row[1], row[0]))
    image, point = (np.array([row[k] for row in rows]) for k in (0, 1))
    pixel, one = np.array([row[2] for row in rows]), np.ones(len(rows))
    measured = Measurements(ImagePoints(image, point, pixel, one, one), (), one > 0)
    own = np.ones(len(flown.stamp_ns), np.bool_)
    found = clockoffset.found(known, believed, own, flown.stamp_ns, measured)
    assert found == pytest.approx(0.0 if abs(off_s) < 0.6 else off_s, abs=0.1)
    certain = imageblock.true_camera(timeshift_s=0.0, sigma={"timeshift_s": 0.0})
    assert clockoffset.found(known, certain, own, flown.stamp_ns, measured) == 0.0
