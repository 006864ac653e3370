"""Points in rows of cells."""

import numpy as np
import pytest

from groundproc.numerics.voxelhash import assign, newcomers, row_by_row


def test_rows_of_cells_from_the_corner() -> None:
    """All points once; their cells ascend, row by row; within a cell they stay in the order in which they came."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform((-40.0, 300.0, 0.0), (20.0, 330.0, 9.0), (20_000, 3))
    order = row_by_row(xyz, 1.0)
    assert (np.sort(order) == np.arange(len(xyz))).all()
    column, row = np.floor(xyz[order, :2] - xyz[:, :2].min(axis=0)).astype(int).T
    assert (np.diff(row) >= 0).all()
    assert (np.diff(column)[np.diff(row) == 0] >= 0).all()
    within = (np.diff(row) == 0) & (np.diff(column) == 0)
    assert (np.diff(order)[within] > 0).all()


@pytest.mark.parametrize("size_m", [(0.0, 0.0), (1e7, 0.0), (0.0, 1e7), (1e7, 1e7), (0.3, 4e5)])
def test_areas_that_are_mostly_empty_take_wider_cells(size_m: tuple[float, float]) -> None:
    """Work and memory follow the points, not the area."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, 1.0, (1_000, 2)) * size_m
    assert (np.sort(row_by_row(xy, 0.01)) == np.arange(1_000)).all()
    assert not len(row_by_row(xy[:0], 1.0))
    assert row_by_row(xy[:1], 1.0).tolist() == [0]


@pytest.mark.parametrize(("points", "across_m"), [(0, 1.0), (1, 1.0), (5_000, 2.0), (300_000, 40.0)])
def test_voxels_are_numbered_as_they_first_come(points: int, across_m: float) -> None:
    """However many there are: the last case has more than the numbering begins with room for."""
    xyz = np.random.default_rng(5).uniform(-across_m, across_m, (points, 3))
    voxel, voxels = assign(xyz, 1.0)
    _, begins, of_point = np.unique(np.floor(xyz).astype(int), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(begins), int)
    rank[np.argsort(begins)] = np.arange(len(begins))
    assert voxels == len(begins)
    assert (voxel == rank[of_point.ravel()]).all()


@pytest.mark.parametrize(("points", "across_m"), [(0, 1.0), (1, 1.0), (5_000, 2.0), (300_000, 40.0)])
def test_the_first_point_of_each_voxel(points: int, across_m: float) -> None:
    """However many voxels there are: the last case has more than the table begins with room for."""
    corner = np.array([500_000.0, 6_000_000.0, -3.0])
    xyz = corner + np.random.default_rng(6).uniform(0.0, 2 * across_m, (points, 3))
    first, voxels = newcomers(xyz, corner, 0.5)
    begins = np.unique(np.floor((xyz - corner) * 2.0).astype(int), axis=0, return_index=True)[1]
    assert voxels == len(begins)
    assert np.flatnonzero(first).tolist() == sorted(begins)
