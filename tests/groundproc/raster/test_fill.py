"""Empty cells filled by a membrane."""

import numpy as np
import pytest

from groundproc.raster.fill import fill


def test_known_cells_stay_and_a_plane_is_met_between_them() -> None:
    rows, columns = np.mgrid[:90, :130].astype(np.float32)
    plane = 0.3 * rows - 0.1 * columns + 50.0
    known = np.random.default_rng(3).random(plane.shape) < 0.2
    known[0] = known[-1] = True
    known[:, 0] = known[:, -1] = True
    filled = fill(np.where(known, plane, np.nan).astype(np.float32))
    assert np.array_equal(filled[known], plane[known])
    # a plane is its own membrane; few sweeps leave a part of a cell's step
    assert np.abs(filled - plane).max() < 0.15
    assert np.sqrt(np.mean((filled - plane) ** 2)) < 0.02


def test_a_gap_is_never_higher_or_lower_than_its_rim() -> None:
    values = np.random.default_rng(1).uniform(3.0, 7.0, (64, 64)).astype(np.float32)
    values[10:50, 20:55] = np.nan
    filled = fill(values)
    assert np.isfinite(filled).all()
    gap = filled[10:50, 20:55]
    assert gap.min() > 3.0 - 0.5
    assert gap.max() < 7.0 + 0.5


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (3, 2)])
def test_small_rasters_are_filled_from_one_cell(shape: tuple[int, int]) -> None:
    values = np.full(shape, np.nan, np.float32)
    values[0, 0] = 4.0
    assert fill(values) == pytest.approx(4.0)


def test_nothing_known_stays_unknown() -> None:
    assert np.isnan(fill(np.full((4, 5), np.nan, np.float32))).all()
