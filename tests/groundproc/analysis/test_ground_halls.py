"""Buildings wider than the openings, and what is as wide and is ground; shrubs on an even slope."""

import numpy as np
import pytest

from groundproc.analysis.terrain.filter import bare_ground
from groundproc.analysis.terrain.settings import Settings

Y, X = np.mgrid[:200, :200] + 0.5


def found(truth: np.ndarray, seed: int = 1, missing: float = 0.3) -> np.ndarray:
    """Cells whose lowest point is ground: heights with scatter, some cells without any; those are false."""
    rng = np.random.default_rng(seed)
    lowest = truth + rng.normal(0, 0.05, truth.shape)
    lowest = np.where(rng.random(truth.shape) < missing, np.nan, lowest).astype(np.float32)
    bare = bare_ground(lowest, Settings())
    return np.asarray(np.abs(lowest - bare.height_m) <= bare.reach_m)


def part(west: float, south: float, width: float, height: float) -> np.ndarray:
    return np.asarray((np.abs(X - west - width / 2) < width / 2) & (np.abs(Y - south - height / 2) < height / 2))


def share(ground: np.ndarray, area: np.ndarray, missing: float = 0.3) -> float:
    return float(ground[area].mean()) / (1.0 - missing)


def test_a_hall_with_courts_and_two_levels_is_none() -> None:
    court = part(60, 60, 14, 20)
    hall = part(40, 40, 100, 64) & ~court
    truth = np.where(hall, np.where(X < 90, 9.0, 14.0 + 0.02 * Y), 0.01 * X)
    ground = found(truth)
    assert share(ground, hall) < 0.01
    assert share(ground, ~hall) > 0.99
    # trees stand along one of its walls
    trees = part(40, 104, 100, 6)
    ground = found(np.where(trees, 7.0 + 3.0 * np.sin(X), truth))
    assert share(ground, hall) < 0.01


def _wide() -> dict[str, np.ndarray]:
    return {
        "a terrace below a face": np.where(Y > 120, 16.0, np.where(part(50, 60, 80, 60), 8.0, 0.0)),
        "a heap of earth": np.clip(0.9 * (60 - np.maximum(np.abs(X - 100), np.abs(Y - 100))), 0, 12),
        "a plateau with a road up": np.maximum(
            np.where(part(60, 60, 80, 80), 8.0, 0.0), np.where(part(94, 2, 12, 60), 8.0 - 0.13 * (62 - Y), 0.0)
        ),
        "a piece cut off by the edge": np.where(part(100, 60, 100, 80), 8.0, 0.0),
        "a pit": np.where(part(60, 60, 80, 80), -8.0, 0.0),
    }


@pytest.mark.parametrize("name", _wide())
def test_what_is_as_wide_and_no_hall_is_ground(name: str) -> None:
    ground = found(_wide()[name])
    assert share(ground, np.ones_like(ground)) > 0.98


def test_shrubs_on_an_even_slope_are_no_ground_and_edges_of_terraces_are() -> None:
    rng = np.random.default_rng(3)
    shrub = rng.random(X.shape) < 0.1
    ground = found(0.5 * X + np.where(shrub, 0.9, 0.0))
    assert share(ground, shrub) < 0.1
    assert share(ground, ~shrub) > 0.99
    ground = found(4.0 * np.floor(X / 25))
    assert share(ground, np.ones_like(ground)) > 0.95
