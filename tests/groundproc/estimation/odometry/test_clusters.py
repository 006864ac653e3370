"""Clusters that lie in a file."""

import numpy as np
import pytest

from groundproc.estimation.odometry.clusters import Clusters
from groundproc.machine.system import let_go


def some(count: int) -> Clusters:
    rng = np.random.default_rng(8)
    return Clusters(
        rng.integers(0, 1 << 60, count), rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 6)).astype(np.float32), rng.integers(1, 9, count).astype(np.int32),
    )  # fmt: skip


@pytest.mark.parametrize("count", [0, 1, 70_000])
@pytest.mark.parametrize("apart", [False, True])
def test_columns_are_the_same_however_often_they_are_let_go(count: int, apart: bool) -> None:
    clusters, expected = some(count), some(count)
    if apart:
        clusters.laser = expected.laser = np.arange(count, dtype=np.int32)
    clusters.set_aside()
    for _ in range(2):
        let_go()
        for name in ("time_ns", "xyz_m", "scatter_m2", "count", "laser"):
            np.testing.assert_array_equal(getattr(clusters, name), getattr(expected, name))
        assert len(clusters) == count
