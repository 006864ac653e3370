"""Clouds thinned: evenly, to so many points, the same ones every time, of points that there are."""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest

from groundproc.cloud.reader import look
from groundproc.viewer.thinning import thin

Clouds = Callable[[int], tuple[Path, Path]]


@pytest.mark.parametrize("kind", [0, 1], ids=["laz", "copc"])
def test_a_thinned_cloud_is_even_and_of_its_own_points(clouds: Clouds, kind: int) -> None:
    path = clouds(150_000)[kind]
    some = thin(look(path), 20_000)
    assert 0.9 * 20_000 <= len(some) <= 20_000
    again = thin(look(path), 20_000)
    np.testing.assert_array_equal(some.xyz_m, again.xyz_m)
    whole = laspy.read(path)
    known = {
        tuple(each) for each in np.stack([whole.X, whole.Y, whole.Z, whole.intensity, whole.point_source_id]).T.tolist()
    }
    steps = np.rint((some.xyz_m - whole.header.offsets) / whole.header.scales).astype(int)
    told = np.column_stack([steps, some.columns["intensity"], some.columns["point_source_id"]])
    assert {tuple(each) for each in told.tolist()} <= known
    # a third of the points lie on a tenth of the ground: five times denser there, as dense as elsewhere when thinned
    local = some.xyz_m[:, :2] - some.xyz_m[:, :2].min(axis=0)
    dense = (local < [24, 18]).all(axis=1)
    rate = dense.sum() / (24 * 18), (~dense).sum() / (80 * 60 - 24 * 18)
    assert rate[0] < 1.5 * rate[1]


@pytest.mark.parametrize("kind", [0, 1], ids=["laz", "copc"])
def test_a_small_cloud_is_not_thinned(clouds: Clouds, kind: int) -> None:
    some = thin(look(clouds(3_000)[kind]), 20_000)
    assert len(some) == 3_000
    assert some.spacing_m == 0.0
    assert some.time_s is not None
    assert len(some.time_s) == 3_000


def test_of_a_flight_whole_stretches_are_read_and_they_are_its_own_points(clouds: Clouds) -> None:
    path = clouds(450_000)[0]
    some = thin(look(path), 60_000, in_time=True)
    assert 0.9 * 60_000 <= len(some) <= 60_000
    whole = laspy.read(path)
    steps = np.rint((some.xyz_m - whole.header.offsets) / whole.header.scales).astype(int)
    kept = {tuple(each) for each in steps.tolist()}
    known = np.stack([whole.X, whole.Y, whole.Z], axis=1)
    assert kept <= {tuple(each) for each in known.tolist()}
    # four times as many points as are kept make two stretches of 100,000: of the begin and of the middle
    read = np.concatenate([known[:100_000], known[200_000:300_000]])
    assert kept <= {tuple(each) for each in read.tolist()}
