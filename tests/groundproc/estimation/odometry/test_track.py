"""What is kept of a slice for the batch."""

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.track import shares_by_direction, thinned
from groundproc.estimation.odometry.voxels import PlaneMap

Array = npt.NDArray[np.float64]


def street(turn_rad: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Points of two walls of 100 m, of level ground, and of six ends of cars across the street; which are those."""
    rng = np.random.default_rng(3)
    walls = np.column_stack(
        [rng.uniform(-50, 50, 40_000), 9.2 * rng.choice([-1.0, 1.0], 40_000), rng.uniform(0.1, 5, 40_000)]
    )
    ground = np.column_stack([rng.uniform(-50, 50, 20_000), rng.uniform(-9, 9, 20_000), np.full(20_000, -0.2)])
    ends = np.column_stack(
        [rng.choice(np.arange(-39.8, 41.0, 16.0), 1200), rng.uniform(5.0, 6.5, 1200), rng.uniform(0.0, 1.0, 1200)]
    )
    points = np.concatenate([walls, ground, ends]) + rng.normal(scale=0.01, size=(61_200, 3))
    sine, cosine = np.sin(turn_rad), np.cos(turn_rad)
    points = points @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return points, np.arange(61_200) >= 60_000


@pytest.mark.parametrize("turn_deg", [0.0, 27.0, 45.0])
def test_the_few_planes_across_a_street_are_kept_beside_long_walls_however_it_runs(turn_deg: float) -> None:
    points, ends = street(np.deg2rad(turn_deg))
    clusters = np.zeros(len(points), CLUSTER_DTYPE)
    clusters["count"] = 1
    planes = PlaneMap(0.5)
    planes.insert(points, clusters, 1e9)
    # a hundred clusters a slice find the ends: as many as one in sixty of what walls and ground have
    some = np.concatenate([np.flatnonzero(~ends)[::10], np.flatnonzero(ends)[::12]])
    clusters["time_ns"] = np.arange(len(points))
    kept = thinned(clusters[some], points[some], planes, 1200)
    assert 0.85 * 1200 < len(kept) < 1.15 * 1200
    # one in nine of all planes are kept; of ends all those are whose voxel holds a plane, and cuts no narrow sliver off it
    assert ends[kept["time_ns"]].sum() > 0.5 * ends[some].sum()


def test_planes_that_all_face_one_way_share_evenly() -> None:
    normal = np.tile([0.6, 0.8, 0.0], (1000, 1)) + np.random.default_rng(1).normal(scale=0.02, size=(1000, 3))
    share = shares_by_direction(normal / np.linalg.norm(normal, axis=1, keepdims=True), 200.0)
    assert share.sum() == pytest.approx(200.0)
    assert np.percentile(share, 95) < 0.6


def test_two_directions_share_evenly_and_what_one_does_not_need_the_other_has() -> None:
    across = np.tile([0.0, 1.0, 0.0], (900, 1))
    share = shares_by_direction(np.concatenate([across, np.tile([1.0, 0.0, 0.0], (300, 1))]), 400.0)
    assert share[:900].sum() == pytest.approx(share[900:].sum(), rel=0.02)
    share = shares_by_direction(np.concatenate([across, np.tile([1.0, 0.0, 0.0], (30, 1))]), 400.0)
    assert (share[900:] == 1.0).all()
    assert share.sum() == pytest.approx(400.0)
    assert (shares_by_direction(across, 1000.0) == 1.0).all()
    assert not len(shares_by_direction(np.zeros((0, 3)), 10.0))
