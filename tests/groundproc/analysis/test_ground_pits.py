"""Pits that are ground and pits that are none, on places of known truth."""

import numpy as np
import pytest

from groundproc.analysis.terrain.filter import Bare, bare_ground
from groundproc.analysis.terrain.settings import Settings

SCATTER_M = 0.05
Y, X = np.mgrid[:120, :120] + 0.5


def measured(truth: np.ndarray, seed: int = 1) -> np.ndarray:
    """With scatter, and nothing known of one cell in seven."""
    rng = np.random.default_rng(seed)
    heights = truth + rng.normal(0, SCATTER_M, truth.shape)
    return np.where(rng.random(truth.shape) < 0.15, np.nan, heights).astype(np.float32)


def ground(bare: Bare, lowest: np.ndarray) -> np.ndarray:
    """Lowest points that are ground."""
    return np.asarray(np.abs(lowest - bare.height_m) <= bare.reach_m)


def lost(bare: Bare, lowest: np.ndarray) -> np.ndarray:
    """Measured cells that are not, errors aside."""
    return np.isfinite(lowest) & ~bare.pit & ~ground(bare, lowest)


def hole(west: float, north: float, width: float, height: float) -> np.ndarray:
    return np.asarray((np.abs(X - west - width / 2) < width / 2) & (np.abs(Y - north - height / 2) < height / 2))


@pytest.mark.parametrize("house", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_deep_cells_scattered_in_a_corner_do_not_pull_down_the_ground_among_them(seed: int, house: bool) -> None:
    wall = hole(18, 0, 22, 60) if house else np.zeros(X.shape, bool)
    deep = np.zeros(X.shape, bool)
    for i, j in np.ndindex(3, 5):
        deep |= hole(2 + 5 * i + j, 2 + 5 * j + i, 1, 2)
    lowest = measured(np.where(wall, 17.0, 0.0), seed)
    lowest[deep] = -9.0
    bare = bare_ground(lowest, Settings())
    assert not (lost(bare, lowest) & ~wall).any()
    assert not ground(bare, lowest)[wall].any()
    assert ground(bare, lowest)[deep & ~bare.pit].all()


def _pits() -> dict[str, np.ndarray]:
    still = np.zeros_like(X)
    ditch = (np.abs(X - 60) < 1) | ((np.abs(Y - 40) < 1) & (X > 60))
    holes = hole(20, 20, 2, 3) | hole(50, 30, 1, 5) | hole(30, 90, 4, 5)
    stairs = np.where(hole(80, 60, 6, 2), -0.5 * np.floor(X - 79), 0.0)
    return {
        "a ditch with a bend": np.where(ditch, -2.6, still),
        "a ditch with a culvert": np.where((np.abs(Y - 60) < 2) & (np.abs(X - 60) > 4), -3.0, still),
        "cellar holes": np.where(holes, -3.5, still),
        "stairs down": stairs,
        "a deep slot": np.where(hole(60, 30, 1, 40), -4.0, still),
        "a quarry": np.where(X < 70, still, -8.0),
    }


@pytest.mark.parametrize("name", _pits())
def test_real_pits_are_ground(name: str) -> None:
    truth = _pits()[name]
    lowest = measured(truth)
    seen = (truth < 0) & np.isfinite(lowest)
    bare = bare_ground(lowest, Settings())
    assert seen.sum() >= 10
    assert ground(bare, lowest)[seen].all()
    assert lost(bare, lowest).mean() < 3e-3


def test_a_roof_level_with_the_slope_behind_it_is_none_however_deep_the_light_well_between() -> None:
    roof = hole(62, 40, 13, 30)
    lowest = measured(np.where(roof | (X < 60), 0.0, -4.0))
    bare = bare_ground(lowest, Settings())
    found = ground(bare, lowest)
    assert not found[roof].any()
    assert found[np.isfinite(lowest) & ~roof].all()


@pytest.mark.parametrize("seen", [0.05, 0.15, 0.3])
def test_gaps_in_a_wood_on_a_valley_side_are_ground_and_crowns_are_none(seen: float) -> None:
    rng = np.random.default_rng(5)
    floor = 10.0 * np.abs(X - 60) / 25
    gap = rng.random(X.shape) < seen
    lowest = np.where(gap, floor, floor + 12 + rng.uniform(0, 2, X.shape)).astype(np.float32)
    bare = bare_ground(lowest, Settings())
    assert not ground(bare, lowest)[~gap].any()


def test_maize_with_gaps_is_no_ground_though_its_top_is_level() -> None:
    rng = np.random.default_rng(6)
    maize = hole(15, 15, 90, 90) & (rng.random(X.shape) > 0.1)
    lowest = np.where(maize, 2.5 + rng.normal(0, 0.1, X.shape), rng.normal(0, 0.03, X.shape)).astype(np.float32)
    bare = bare_ground(lowest, Settings())
    found = ground(bare, lowest)
    assert not found[maize].any()
    assert found[~maize].all()
