"""Clusters on planes that are solved for within: against dense least squares with the planes written down."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.observations.planes import Rows, rows_of
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics.planerows import TILT_PRIOR
from groundproc.numerics.splines import basis

Array = npt.NDArray[np.float64]
INTERVALS = 8
SIZE = 6 * (INTERVALS + 3)
VOXEL_M = 1.0
START_NS = 1_779_000_000_000_000_000


def clusters_of(path: Path, noise_m: float, seed: int = 1) -> Clusters:
    """Clusters on the ground, two walls and a roof, seen all along the path: ten places on each square metre or so."""
    rng, count = np.random.default_rng(seed), 6000
    time_ns = START_NS + rng.integers(0, INTERVALS * STEPS * STEP_NS, count)
    along, across, kind = rng.uniform(-5, 5, count), rng.uniform(0, 5, count), rng.integers(0, 4, count)
    world = np.stack([along, across, np.full(count, 0.03)], axis=1)
    world[kind == 1] = np.stack([along, 5.33 * np.ones(count), across], axis=1)[kind == 1]
    world[kind == 2] = np.stack([-5.41 * np.ones(count), across, across[::-1]], axis=1)[kind == 2]
    world[kind == 3] = np.stack([along, across, 4.2 + 0.5 * across], axis=1)[kind == 3]
    world += noise_m * rng.normal(size=world.shape)
    g = (time_ns - START_NS) / STEP_NS
    i = np.minimum(g.astype(int), len(path.quat) - 2)
    share = (g - i)[:, None]
    place = path.position_m[i] + share * (path.position_m[i + 1] - path.position_m[i])
    mats = frames.mat_from_quat(path.quat)
    mat = mats[i] + share[:, :, None] * (mats[i + 1] - mats[i])
    xyz = np.einsum("nji,nj->ni", mat, world - place)
    return Clusters(
        time_ns, xyz.astype(np.float32), np.zeros((count, 6), np.float32), np.full(count, 8, np.int32)
    )  # fmt: skip


@pytest.fixture(scope="module")
def path() -> Path:
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.1 * np.sin(3 * seconds), 0.1 * np.cos(4 * seconds), 0.3 * seconds], axis=1)
    place = np.stack([2 * seconds, 1.0 + np.sin(2 * seconds), 2.0 + 0.3 * np.cos(3 * seconds)], axis=1)
    return Path(START_NS, frames.quat_exp(turn), place)


@pytest.fixture(scope="module")
def rows(path: Path) -> Rows:
    return rows_of(clusters_of(path, 0.01), path, VOXEL_M, 10**6, cut=False)


def dense(rows: Rows) -> tuple[Array, Array, Array]:
    """Rows by the path, by each voxel's offset and tilts, and the planes' priors: all written down."""
    count, voxels = len(rows), len(rows.first) - 1
    by_path, by_plane = np.zeros((count, SIZE)), np.zeros((count, 3 * voxels))
    for i in range(count):
        for j in range(4):
            at = 6 * (rows.knot[i] + j)
            by_path[i, at : at + 6] += rows.weights[i, j].astype(float) * rows.jacobian[i].astype(float)
    for v in range(voxels):
        part = slice(rows.first[v], rows.first[v + 1])
        by_plane[part, 3 * v : 3 * v + 3] = -np.stack(
            [np.ones(part.stop - part.start), *rows.plane[part].astype(float).T], axis=1
        )
    prior = np.tile([1e-6, (VOXEL_M * TILT_PRIOR) ** -2.0, (VOXEL_M * TILT_PRIOR) ** -2.0], voxels)
    return by_path, by_plane, prior


def reduced(rows: Rows) -> tuple[Array, Array]:
    """Normal matrix and half gradient of the path alone, by Schur's complement of the planes."""
    by_path, by_plane, prior = dense(rows)
    w = rows.weight[:, None]
    planes = by_plane.T @ (w * by_plane) + np.diag(prior)
    mixed = by_path.T @ (w * by_plane)
    normal = by_path.T @ (w * by_path) - mixed @ np.linalg.solve(planes, mixed.T)
    right = by_path.T @ (rows.weight * rows.residual_m)
    right -= mixed @ np.linalg.solve(planes, by_plane.T @ (rows.weight * rows.residual_m))
    return normal, right


def test_the_rows_are_of_many_voxels_and_slices(rows: Rows) -> None:
    assert len(rows.first) > 50
    assert set(rows.knot.tolist()) == set(range(INTERVALS))
    assert (np.diff(rows.first) >= 2).all()


def test_the_normal_matrix_is_schurs_complement_of_the_planes(rows: Rows) -> None:
    normal, _ = reduced(rows)
    found = np.stack([rows.apply(column) for column in np.eye(SIZE)], axis=1)
    np.testing.assert_allclose(found, normal, rtol=0, atol=1e-9 * np.abs(normal).max())
    np.testing.assert_allclose(found, found.T, rtol=0, atol=1e-9 * np.abs(normal).max())
    assert np.linalg.eigvalsh(found).min() > -1e-9 * np.abs(normal).max()


def test_the_gradient_is_that_of_the_cost_with_the_planes_at_their_best(rows: Rows) -> None:
    _, right = reduced(rows)
    np.testing.assert_allclose(rows.gradient(), right, rtol=0, atol=1e-9 * np.abs(right).max())


def test_the_cost_is_what_dense_least_squares_leave(rows: Rows) -> None:
    """The planes' priors pull next to nothing: their own cost, which is not told, is below a thousandth."""
    _, by_plane, prior = dense(rows)
    root = np.sqrt(rows.weight)
    stacked = np.concatenate([root[:, None] * by_plane, np.diag(np.sqrt(prior))])
    right = np.concatenate([-root * rows.residual_m, np.zeros(len(prior))])
    best = np.linalg.lstsq(stacked, right, rcond=None)[0]
    left = rows.residual_m + by_plane @ best
    cost, used = rows.cost()
    assert cost == pytest.approx(float((rows.weight * left**2).sum()), rel=1e-6)
    assert used == int((rows.weight > 0).sum())


def test_what_the_rows_see_is_the_transpose_of_what_they_spread(rows: Rows) -> None:
    rng = np.random.default_rng(2)
    values, vector = rng.normal(size=len(rows)), rng.normal(size=SIZE)
    by_path, _, _ = dense(rows)
    np.testing.assert_allclose(rows.along(vector), by_path @ vector, rtol=0, atol=1e-9 * np.abs(by_path @ vector).max())
    assert rows.spread(values) @ vector == pytest.approx(values @ rows.seen(vector), rel=1e-9)
    # the normal matrix is what is spread of what is along
    np.testing.assert_allclose(rows.spread(rows.along(vector)), rows.apply(vector), rtol=1e-7, atol=1e-3)


def test_the_band_is_the_normal_matrix_with_the_planes_known(rows: Rows) -> None:
    by_path, _, _ = dense(rows)
    band, expected = np.zeros((SIZE, SIZE)), by_path.T @ (rows.weight[:, None] * by_path)
    for k, blocks in enumerate(rows.band()):
        at = slice(6 * k, 6 * k + 24)
        band[at, at] += blocks.transpose(0, 2, 1, 3).reshape(24, 24)
    np.testing.assert_allclose(band, expected, rtol=0, atol=1e-9 * expected.max())


def test_rows_are_the_distances_from_the_planes_and_their_derivatives(path: Path, rows: Rows) -> None:
    """Moved by a spline, a cluster's distance from its mean plane changes by the row, to first order: against the path itself moved."""
    clusters = clusters_of(path, 0.01)
    rng = np.random.default_rng(4)
    coefficients = rng.normal(size=(INTERVALS + 3, 6)) * 1e-4

    def world(p: Path) -> Array:
        g = (clusters.time_ns[rows.cluster] - START_NS) / STEP_NS
        i = np.minimum(g.astype(int), len(p.quat) - 2)
        share = (g - i)[:, None]
        mats = frames.mat_from_quat(p.quat)
        mat = mats[i] + share[:, :, None] * (mats[i + 1] - mats[i])
        place = p.position_m[i] + share * (p.position_m[i + 1] - p.position_m[i])
        return np.asarray(np.einsum("nij,nj->ni", mat, clusters.xyz_m[rows.cluster]) + place)

    moved = world(path.corrected(coefficients)) - world(path)
    normal = rows.jacobian[:, 3:].astype(float)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=0, atol=1e-6)
    by_path, _, _ = dense(rows)
    expected = (normal * moved).sum(axis=1)
    # 1e-4 rad at 10 m: second order 1e-7; single precision of the rows 1e-7 of 1e-3
    np.testing.assert_allclose(by_path @ coefficients.ravel(), expected, rtol=0, atol=2e-6)
    for at in range(0, len(rows), 97):
        seconds = (clusters.time_ns[rows.cluster[at]] - START_NS) * 1e-9
        k = int(rows.knot[at])
        np.testing.assert_allclose(rows.weights[at], basis(float(seconds / 0.1 - k)), rtol=0, atol=1e-6)


def test_a_shifted_cluster_is_cut_as_no_part_of_its_plane(path: Path) -> None:
    """Every hundredth cluster of the ground, lifted by 0.3 m: more than ten sigmas of everything."""
    clusters = clusters_of(path, 0.003)
    whole = rows_of(clusters, path, VOXEL_M, 10**6, cut=True)
    assert (whole.weight > 0).mean() > 0.99
    mats = frames.mat_from_quat(path.quat)
    step = ((clusters.time_ns - START_NS) // STEP_NS).astype(int)
    up = mats[step][:, 2, :]
    moving = np.arange(0, len(clusters), 100)
    clusters.xyz_m[moving] += (0.3 * up[moving]).astype(np.float32)
    rows = rows_of(clusters, path, VOXEL_M, 10**6, cut=True)
    odd = np.isin(rows.cluster, moving) & (np.abs(rows.jacobian[:, 5]) > 0.95)
    assert odd.sum() > 5
    assert (rows.weight[odd] == 0.0).mean() > 0.9
    assert (rows.weight[~odd] > 0.0).mean() > 0.98


def test_over_level_ground_alone_nothing_holds_place_or_heading(path: Path) -> None:
    """One infinite plane: height and tilt are known, and the three freedoms along it get nothing, in every interval."""
    clusters = clusters_of(path, 0.01)
    ground = np.zeros(len(clusters), np.bool_)
    rng = np.random.default_rng(5)
    g = (clusters.time_ns - START_NS) / STEP_NS
    i = np.minimum(g.astype(int), len(path.quat) - 2)
    mats = frames.mat_from_quat(path.quat)[i]
    place = path.position_m[i]
    world = np.einsum("nij,nj->ni", mats, clusters.xyz_m) + place
    world[:, 2] = 0.03 + 0.01 * rng.normal(size=len(world))
    ground[:] = True
    clusters.xyz_m[:] = np.einsum("nji,nj->ni", mats, world - place)
    rows = rows_of(clusters, path, VOXEL_M, 10**6, cut=False)
    assert len(rows) > 1000
    for k, block in enumerate(rows.band().sum(axis=(1, 2))):
        mat = frames.mat_from_quat(path.quat)[k * STEPS + STEPS // 2]
        # about the vertical through the sensor, and along east and north
        for freedom in (np.concatenate([mat.T @ [0, 0, 1], np.zeros(3)]), np.eye(6)[3], np.eye(6)[4]):
            assert freedom @ block @ freedom < 1e-2 * block[5, 5]
        assert block[5, 5] > 0
