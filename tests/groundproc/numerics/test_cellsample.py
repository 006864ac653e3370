"""Whole cells of a cloud, as many as may be held."""

import numpy as np
import pytest

from groundproc.numerics.cellsample import CellSample
from groundproc.strips.density import Density


def spread(side_m: float, per_m2: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, [side_m, side_m, 3.0], (int(side_m**2 * per_m2), 3))


def test_a_small_cloud_is_held_whole() -> None:
    sample = CellSample(4.0, 10_000)
    xyz = spread(20.0, 20.0)
    sample.add(xyz)
    assert np.array_equal(sample.points(), xyz)


@pytest.mark.parametrize("pieces", [1, 7])
def test_of_a_large_one_some_cells_are_held_with_all_their_points(pieces: int) -> None:
    sample, xyz = CellSample(4.0, 5_000), spread(100.0, 10.0)
    for piece in np.array_split(xyz, pieces):
        sample.add(piece)
    held = sample.points()
    assert 1_000 < len(held) <= 5_000
    cells = {tuple(each) for each in np.floor(held[:, :2] / 4.0).astype(int)}
    inside = [tuple(each) in cells for each in np.floor(xyz[:, :2] / 4.0).astype(int)]
    assert len(held) == sum(inside)  # whatever the pieces


@pytest.mark.parametrize("pieces", [1, 5])
def test_of_a_few_crowded_cells_some_are_held_too(pieces: int) -> None:
    """As from a hovering aircraft: half of all points on one part in a hundred. Halving the cells once left none at all."""
    rng = np.random.default_rng(3)
    crowded = np.concatenate([spread(120.0, 2.0), spread(12.0, 200.0)])
    xyz = crowded[rng.permutation(len(crowded))]
    sample = CellSample(4.0, 6_000)
    for piece in np.array_split(xyz, pieces):
        sample.add(piece)
    held = sample.points()
    assert 2_500 < len(held) <= 6_000
    assert len({tuple(each) for each in np.floor(held[:, :2] / 4.0).astype(int)}) > 1


def test_of_a_single_cell_no_more_than_asked_for_is_held() -> None:
    sample = CellSample(4.0, 1_000)
    for seed in range(3):
        sample.add(spread(3.9, 100.0, seed))
    assert len(sample.points()) == 1_000


@pytest.mark.parametrize("side_m", [8.0, 30.0, 400.0])
def test_patches_hold_forty_points_on_places_of_any_size(side_m: float) -> None:
    """On 30 m too: a sample of one cell in so many once found none there, and patches became 4 m wide."""
    density = Density()
    for piece in np.array_split(spread(side_m, 40.0), 3):
        density.add(piece)
    assert density.voxel_m() == pytest.approx(1.0, rel=0.05)
