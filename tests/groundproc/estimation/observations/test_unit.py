"""What an inertial unit's noise is learnt from: the residuals of slices that the lidar holds, and no others."""

import numpy as np
import pytest

from groundproc.estimation.observations.unit import FEWEST_HELD, learnt_sigma

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
