"""What beams pass through, by one thread or by several."""

import numpy as np
import pytest

from groundproc.cloud import freespace
from groundproc.cloud.surroundings import Surroundings


def evidence(threads: int, monkeypatch: pytest.MonkeyPatch) -> freespace.Evidence:
    """Of points in a box of 8 m, seen from a place that moves through it."""
    monkeypatch.setattr(freespace, "cores", lambda: threads)
    rng = np.random.default_rng(5)
    count = 60_000
    xyz_m = rng.uniform(-4.0, 4.0, (count, 3))
    origins_m = np.stack([np.linspace(-3.0, 3.0, count), np.zeros(count), np.zeros(count)], axis=1)
    time_ns = np.arange(count, dtype=np.int64) * 1_000_000
    around = Surroundings()
    voxel = around.add(xyz_m, time_ns, origins_m)
    np.testing.assert_array_equal(voxel, around.of(xyz_m))
    around.find_planes()
    lookout = freespace.Lookout(around)
    for some in np.array_split(np.arange(count), 3):
        lookout.look_along(xyz_m[some], origins_m[some], time_ns[some], voxel[some])
    return lookout.evidence


def test_threads_that_share_the_cubes_see_what_one_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    alone, shared = evidence(1, monkeypatch), evidence(4, monkeypatch)
    assert alone.open_looks.sum() > 1000
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one, other)
