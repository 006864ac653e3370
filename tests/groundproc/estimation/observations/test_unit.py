"""What an inertial unit's noise is learnt from: the residuals of slices that the lidar holds, and no others; and its place on a grid."""

import numpy as np
import pytest

from flightlog.constants import NS_PER_S
from groundproc.estimation.observations.unit import FEWEST_HELD, learnt_sigma, make_unit, place_on_grid
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack, on_grid
from groundproc.estimation.odometry.spline import Path

SLICES = 600
SCATTER, LEAST = 0.1, 0.4


@pytest.mark.parametrize(
    ("held", "sigma", "expected"),
    [
        (SLICES, 0.08, 0.08),
        (120, 0.08, 0.08),  # four fifths follow the unit and leave nothing
        (120, 0.3, 0.3),
        (120, 0.01, LEAST * SCATTER),
        (FEWEST_HELD - 1, 0.08, SCATTER),
        (0, 0.08, SCATTER),
    ],
)
def test_a_units_noise_is_told_where_the_lidar_holds_the_path(held: int, sigma: float, expected: float) -> None:
    rng = np.random.default_rng(3)
    is_held = np.arange(SLICES) < held
    residual = np.where(is_held, sigma, 1e-4)[:, None] * rng.standard_normal((SLICES, 3))
    # of a median absolute deviation of n rows of three: 1.17 / sqrt(2 n) of it, three times that
    chance = 3.0 * 1.17 / np.sqrt(2.0 * 3.0 * max(held, 1))
    assert learnt_sigma(residual, is_held, SCATTER, LEAST) == pytest.approx(expected, rel=chance)


@pytest.mark.parametrize(("rate_hz", "silent_s"), [(40.0, 0), (200.0, 0), (200.0, 7)])
def test_a_unit_is_placed_by_the_samples_about_a_window_as_by_all(rate_hz: float, silent_s: int) -> None:
    """A slow unit's cubic and a fast one's straight lines, in a window within ten minutes, with a delay that drifts.

    Where a fast unit is silent for more than a third of a window, it is fast all the same.
    """
    rng = np.random.default_rng(5)
    time_ns = np.arange(0, 600 * NS_PER_S, round(NS_PER_S / rate_hz))
    time_ns = time_ns[(time_ns < 300 * NS_PER_S) | (time_ns >= (300 + silent_s) * NS_PER_S)]
    track = ImuTrack("lidar", time_ns, rng.normal(size=(len(time_ns), 3)), rng.normal(size=(len(time_ns), 3)), 0.1, 0.1)
    steps = 100 * STEPS
    for start_s in (0.0, 298.7, 590.0):
        start_ns = round(start_s * NS_PER_S)
        path = Path(start_ns, np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)), np.zeros((steps + 1, 3)))
        unit = make_unit("lidar", track, path, np.zeros(3), np.zeros(3))
        unit.values["delay"], unit.values["drift"] = np.array([0.01]), np.array([3e-5])
        place_on_grid(unit, track, path)
        middle_ns = start_ns + steps * STEP_NS // 2
        late_ns = np.rint(1e7 + 3e-5 * (time_ns - middle_ns)).astype(np.int64)
        for found, values in ((unit.rate_rad_s, track.rate_rad_s), (unit.force_m_s2, track.force_m_s2)):
            expected, known = on_grid(time_ns - late_ns, values, start_ns, steps)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(unit.known, known)
