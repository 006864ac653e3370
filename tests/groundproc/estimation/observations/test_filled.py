"""What fills its voxel, as rows: bushes that stand still hold a path that nothing else holds."""

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.observations.planes import Rows, rows_of
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.matching import FILLED_SIGMA_M
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
INTERVALS = 8
VOXEL_M = 0.5
START_NS = 1_779_000_000_000_000_000
BUSHES = 60
SPREAD_M = 0.08


def flown() -> Path:
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.1 * np.sin(3 * seconds), 0.1 * np.cos(4 * seconds), 0.3 * seconds], axis=1)
    place = np.stack([2 * seconds, np.sin(2 * seconds), 5.0 + 0.3 * np.cos(3 * seconds)], axis=1)
    return Path(START_NS, frames.quat_exp(turn), place)


def bushes(path: Path, count: int = 4000, even: bool = False) -> Clusters:
    """Single returns of leaves about the middles of voxels, or evenly all over these."""
    rng = np.random.default_rng(3)
    middle = VOXEL_M * (rng.integers(-30, 30, (BUSHES, 3)) + 0.5)
    middle[:, 2] = VOXEL_M * (rng.integers(-1, 4, BUSHES) + 0.5)
    shape = rng.uniform(-0.5, 0.5, (count, 3)) * VOXEL_M if even else SPREAD_M * rng.normal(size=(count, 3))
    world = middle[rng.integers(0, BUSHES, count)] + shape
    step = np.sort(rng.integers(0, INTERVALS * STEPS, count))
    mats = frames.mat_from_quat(path.quat)[step]
    xyz = np.einsum("nji,nj->ni", mats, world - path.position_m[step])
    return Clusters(
        START_NS + step * STEP_NS, xyz.astype(np.float32), np.zeros((count, 6), np.float32), np.ones(count, np.int32)
    )


def rows_at(path: Path, clusters: Clusters, filled: int = 10**6) -> Rows:
    return rows_of(clusters, path, VOXEL_M, 1000, cut=False, filled=filled)


def test_a_cluster_has_three_rows_along_axes_at_right_angles() -> None:
    path = flown()
    rows = rows_at(path, bushes(path))
    assert len(rows) % 3 == 0
    assert 0.85 * 3 * 4000 < len(rows) <= 3 * 4000  # a bush whose few leaves happen to lie flat is left out
    assert not rows.plane.any()
    for cluster in rows.cluster[:20].tolist():
        axes = rows.jacobian[rows.cluster == cluster, 3:].astype(float)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), rtol=0, atol=1e-5)


def test_without_being_asked_for_there_are_none() -> None:
    path = flown()
    assert len(rows_of(bushes(path), path, VOXEL_M, 1000, cut=False)) == 0


def test_what_fills_its_voxel_from_face_to_face_tells_nothing() -> None:
    """The mean of what is within the faces stays in the middle wherever the sensor is."""
    path = flown()
    some, none = (rows_at(path, bushes(path, even=even)) for even in (False, True))
    assert none.weight.sum() < 0.1 * some.weight.sum()


def test_bushes_bring_back_a_path_that_was_bent() -> None:
    """As well as their spread allows: of n rows of a knot, each of sigma s, the mean is known to s / sqrt(n)."""
    path = flown()
    clusters = bushes(path)
    rng = np.random.default_rng(8)
    bent = path.corrected(rng.normal(size=(INTERVALS + 3, 6)) * [0.0, 0.0, 0.0, 0.02, 0.02, 0.02])
    before = bent.position_m - path.position_m
    for _ in range(3):
        rows = rows_at(bent, clusters)
        size = rows.path_size
        normal = np.stack([rows.apply(column) for column in np.eye(size)], axis=1)
        weak = np.diag(np.tile([1e12] * 3 + [1.0] * 3, size // 6))  # turns are known
        bent = bent.corrected(np.linalg.solve(normal + weak, -rows.gradient()).reshape(-1, 6))
    after = bent.position_m - path.position_m
    sigma_m = np.hypot(SPREAD_M, FILLED_SIGMA_M) / np.sqrt(4000 / INTERVALS)
    wave = np.std(after - after.mean(axis=0))
    assert wave < 3.0 * sigma_m
    assert wave < 0.4 * np.std(before - before.mean(axis=0))


def test_at_most_so_many_clusters_of_a_slice_are_used() -> None:
    path = flown()
    rows = rows_at(path, bushes(path), filled=100)
    of_slice = np.bincount(rows.knot, minlength=INTERVALS) / 3.0
    # by whole voxels: of sixty bushes a draw takes twelve, give or take three
    assert of_slice.max() < 100 * (1.0 + 3.0 / np.sqrt(12))
    assert of_slice.sum() > 0.3 * 100 * INTERVALS
