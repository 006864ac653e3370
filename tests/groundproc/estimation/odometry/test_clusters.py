"""Clusters whose scatter lies in a file for a while."""

import errno
import tempfile
from io import BytesIO

import numpy as np
import pytest

from groundproc.estimation.odometry.clusters import Clusters


def some(count: int) -> Clusters:
    rng = np.random.default_rng(8)
    return Clusters(
        rng.integers(0, 1 << 60, count), rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 6)).astype(np.float32), rng.integers(1, 9, count).astype(np.int32),
    )  # fmt: skip


@pytest.mark.parametrize("count", [0, 1, 70_000])
def test_scatter_comes_back_as_it_was_however_often_it_is_put_aside(count: int) -> None:
    clusters, expected = some(count), some(count).scatter_m2
    for _ in range(2):
        clusters.take_back()
        np.testing.assert_array_equal(clusters.scatter_m2, expected)
        clusters.put_aside()
        assert not len(clusters.scatter_m2)
        assert len(clusters) == count
    clusters.take_back()
    clusters.take_back()
    np.testing.assert_array_equal(clusters.scatter_m2, expected)


class Full(BytesIO):
    """A file on a full disk."""

    def write(self, data: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_scatter_stays_where_a_file_has_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", Full)
    clusters = some(100)
    clusters.put_aside()
    clusters.take_back()
    np.testing.assert_array_equal(clusters.scatter_m2, some(100).scatter_m2)
