"""What is solid is told by its points: one flat top, or two with a step, against leaves at any height."""

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.analysis.detection.bodies import body
from groundproc.analysis.detection.targets import Target

Array = npt.NDArray[np.float64]

TARGET = Target(row=0, column=0, size=0, turn=0, top=5, score=0.0)
"""4.4 x 1.9 m, its length to the east."""
LOW_M = 0.5


def seen(rng: np.random.Generator, height: Array, x: Array) -> Array:
    """Points of a width of 1.8 m, on a slope of 5 %."""
    return np.column_stack([x, rng.uniform(-0.9, 0.9, len(x)), 0.05 * x + height])


def score(rng: np.random.Generator, x: Array, height: Array) -> float:
    points = seen(rng, height, x)
    found = body(TARGET, np.zeros(2), points, height, 1.8, LOW_M)
    assert found is not None
    return found.score


@pytest.mark.parametrize("end", [-1.0, 1.0])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.35])
def test_a_car_is_solid_with_its_bonnet_at_either_end(end: float, share: float) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        x = rng.uniform(-2.2, 2.2, 50)
        height = np.where(end * x > 2.2 - 4.4 * share, 1.15, 1.8) + rng.normal(0, 0.03, 50)
        # 30 points of one flat top are worth 30; of two, a little less
        assert score(rng, x, height) > 25.0


def test_leaves_are_not_made_solid_by_a_step() -> None:
    scores = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scores.append(score(rng, rng.uniform(-2.2, 2.2, 50), rng.uniform(0.6, 2.4, 50)))
    assert max(scores) < -10.0


def test_a_step_is_at_an_end_and_not_anywhere() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(-2.2, 2.2, 50)
    mixed = np.where(rng.uniform(size=50) < 0.35, 1.15, 1.8) + rng.normal(0, 0.03, 50)
    ordered = np.where(x > 0.7, 1.15, 1.8) + rng.normal(0, 0.03, 50)
    assert score(rng, x, mixed) < score(rng, x, ordered) - 20.0
