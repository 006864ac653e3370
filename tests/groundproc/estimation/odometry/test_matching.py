"""What leaves, ground and narrow planes tell of a pose: against dense least squares."""

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from groundproc.estimation.odometry.matching import (
    FILLED_RETURNS,
    FILLED_SIGMA_M,
    INFLATION,
    RELIEF,
    Normal,
    Sums,
    told,
    update,
    weakest,
)
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.state import STATES, State
from groundproc.estimation.odometry.voxels import FLATNESS, LONGEST, NORMAL, SPREAD, PlaneMap
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]

VOXEL_M = 1.0
TREES_M = np.array([[8.5, 2.5, 1.5], [-6.5, 7.5, 3.5], [3.5, -9.5, 2.5], [-7.5, -4.5, 0.5], [1.5, 11.5, 4.5]])
"""Middles of voxels."""


def map_of(points_m: Array, voxel_m: float = VOXEL_M) -> PlaneMap:
    """Of single returns."""
    clusters = np.zeros(len(points_m), CLUSTER_DTYPE)
    clusters["count"] = 1
    planes = PlaneMap(voxel_m)
    planes.insert(points_m, clusters, 1e9)
    return planes


def crowns(rng: np.random.Generator, sigma_m: tuple[float, float, float] = (0.1, 0.14, 0.18)) -> Array:
    """400 returns of each tree, well within its voxel."""
    return np.concatenate([at + np.clip(rng.normal(size=(400, 3)), -2.5, 2.5) * sigma_m for at in TREES_M])


def state(place_m: Array, turn_rad: Array, sigma: float) -> State:
    quat = frames.quat_exp(turn_rad[None])[0]
    zero = np.zeros(3)
    gravity = np.array([0.0, 0.0, -9.80665])
    return State(quat, place_m.copy(), zero.copy(), zero.copy(), zero.copy(), gravity, np.eye(STATES) * sigma**2)


def moments(points_m: Array) -> tuple[Array, Array, Array]:
    """Mean, variances along the axes in rising order, and the axes as columns."""
    values, axes = np.linalg.eigh(np.cov(points_m.T, bias=True))
    return points_m.mean(axis=0), values, axes


def test_a_voxel_of_leaves_has_their_axes_and_spreads() -> None:
    points = crowns(np.random.default_rng(1))
    planes = map_of(points)
    for i, at in enumerate(TREES_M):
        row = int(np.flatnonzero(planes.keys[: planes.count] == voxel_key(*at.tolist(), 1.0 / VOXEL_M))[0])
        voxel, (_, values, axes) = planes.voxels[row], moments(points[400 * i : 400 * (i + 1)])
        assert voxel[FLATNESS] < 0.0
        np.testing.assert_allclose(voxel[SPREAD : SPREAD + 3], values, rtol=1e-6)
        assert abs(voxel[NORMAL : NORMAL + 3] @ axes[:, 0]) > 1 - 1e-9
        assert abs(voxel[LONGEST : LONGEST + 3] @ axes[:, 2]) > 1 - 1e-9


def test_trees_pull_the_pose_as_dense_least_squares_says() -> None:
    """Three rows for each cluster along the axes of its voxel, and nothing else in the world."""
    rng = np.random.default_rng(2)
    points = crowns(rng)
    planes = map_of(points)
    prior, begun = 0.05, state(np.array([0.03, -0.02, 0.025]), np.deg2rad([0.1, -0.15, 0.2]), 0.05)
    mat = frames.mat_from_quat(begun.quat[None])[0]
    tree = np.repeat(np.arange(len(TREES_M)), 30)
    counts = rng.integers(1, 9, len(tree)).astype(np.int32)
    # where the sensor, in truth at the origin, sees them
    body = TREES_M[tree] + rng.normal(scale=0.02, size=(len(tree), 3))
    rows, left, weight = [], [], []
    for n, i in enumerate(tree):
        mean, values, axes = moments(points[400 * i : 400 * (i + 1)])
        off = mat @ body[n] + begun.position_m - mean
        for value, axis in zip(values, axes.T, strict=True):
            rows.append(np.concatenate([np.cross(body[n], mat.T @ axis), axis]))
            left.append(axis @ off)
            variance = value / min(counts[n], FILLED_RETURNS) + FILLED_SIGMA_M**2
            weight.append((1.0 - 12.0 * value / VOXEL_M**2) / (INFLATION * variance))
    j, w = np.array(rows), np.array(weight)
    information = np.eye(6) / prior**2 + j.T @ (w[:, None] * j)
    change = -np.linalg.solve(information, j.T @ (w * np.array(left)))
    covariance = begun.covariance.copy()
    matched, residual, unheld, after = update(planes.arrays, body, counts, begun.arrays, covariance, np.zeros(3))
    assert matched == len(body)
    assert residual == 0.0  # of planes: there is none
    np.testing.assert_allclose(begun.position_m, np.array([0.03, -0.02, 0.025]) + change[3:], rtol=0, atol=2e-4)
    turned = frames.mat_from_quat(frames.quat_exp(change[None, :3]))[0]
    np.testing.assert_allclose(frames.mat_from_quat(begun.quat[None])[0], mat @ turned, rtol=0, atol=5e-5)
    # the kernel's rows are those of the pose that it ends at, 5 mrad away
    dense = np.linalg.inv(information)
    sigma = np.sqrt(np.diag(dense))
    np.testing.assert_allclose(
        after[:6, :6] / np.outer(sigma, sigma), dense / np.outer(sigma, sigma), rtol=0, atol=0.01
    )
    np.testing.assert_allclose(after[6:, 6:], covariance[6:, 6:], rtol=0, atol=1e-12)
    assert np.linalg.norm(change[3:]) > 0.02  # they did pull
    expected = weakest(j.T @ (w[:, None] * j))
    assert unheld == pytest.approx(expected, rel=0.02)
    assert expected[0] > expected[1]


def test_a_voxel_that_is_filled_from_face_to_face_tells_nothing() -> None:
    """Its mean stays in the middle wherever the sensor is."""
    rng = np.random.default_rng(3)
    points = np.concatenate([at + rng.uniform(-0.5, 0.5, (4000, 3)) for at in TREES_M])
    begun = state(np.array([0.05, 0.05, 0.05]), np.zeros(3), 0.1)
    before, counts = begun.covariance.copy(), np.full(len(TREES_M), 4, np.int32)
    matched, _, unheld, after = update(map_of(points).arrays, TREES_M, counts, begun.arrays, before, np.zeros(3))
    assert matched == len(TREES_M)
    assert unheld[0] > 0.3
    assert np.abs(begun.position_m - 0.05).max() < 0.003
    assert np.diag(after)[3:6].min() > 0.9 * 0.1**2


def random_normal(rng: np.random.Generator, scale: float) -> Normal:
    """Every direction is told to better than `TELLS_M` where the scale is 10 or more."""
    root = rng.normal(size=(6, 6)) * scale
    return Normal(root @ root.T + 2.0 * scale**2 * np.eye(6), rng.normal(size=6) * scale**2)


def nothing() -> Normal:
    return Normal(np.zeros((6, 6)), np.zeros(6))


def test_a_relief_that_tells_little_counts_in_full() -> None:
    rng = np.random.default_rng(4)
    rest, ground = random_normal(rng, 30.0), random_normal(rng, 1.0)
    found = told(Sums(rest, nothing(), ground, rest))
    np.testing.assert_allclose(found.information, rest.information + ground.information, rtol=1e-6)
    np.testing.assert_allclose(found.pull, rest.pull + ground.pull, rtol=1e-6)


def test_a_relief_tells_no_more_than_all_else_in_any_direction() -> None:
    """And its own mean says the same as before: less information, and the pull to match."""
    rng = np.random.default_rng(5)
    rest, relief = random_normal(rng, 30.0), random_normal(rng, 1000.0)
    found = told(Sums(rest, nothing(), relief, rest))
    more = found.information - rest.information
    shares = np.linalg.eigvals(np.linalg.solve(rest.information, more)).real
    np.testing.assert_allclose(shares, RELIEF, rtol=1e-3)
    # where the relief alone would put the pose, and the part of it that counts
    asked, whole = np.linalg.solve(more, found.pull - rest.pull), np.linalg.solve(relief.information, relief.pull)
    root = np.linalg.cholesky(rest.information)
    np.testing.assert_allclose(root.T @ asked, root.T @ whole, rtol=1e-3, atol=1e-4)


def test_the_relief_alone_does_not_hold_the_place() -> None:
    """Ground whose normals lean at random by 5 deg, by the thousand: height and tilt are held, the place and the heading are not."""
    rng = np.random.default_rng(6)
    level, ground = np.zeros((6, 6)), np.zeros((6, 6))
    for place in rng.uniform(-20.0, 20.0, (3000, 2)):
        point = np.array([*place, -10.0])
        normal = np.array([*rng.normal(scale=np.deg2rad(5.0), size=2), 1.0])
        normal /= np.linalg.norm(normal)
        for total, n in ((level, np.array([0.0, 0.0, 1.0])), (ground, normal)):
            j = np.concatenate([np.cross(point, n), n])
            total += 300.0 * np.outer(j, j)
    zero = np.zeros(6)
    found = told(Sums(nothing(), Normal(level, zero), Normal(ground, zero), nothing())).information
    sigma = 1.0 / np.sqrt(np.maximum(np.diag(found), 1e-12))
    assert sigma[[0, 1, 5]].max() < 0.01
    assert sigma[[2, 3, 4]].min() > 1.0
    assert 1.0 / np.sqrt(ground[3, 3]) < 0.02  # for what its normals claim


def test_a_strip_that_leans_by_no_more_than_its_width_allows_is_no_wall() -> None:
    """Two rings on rough ground make a narrow plane that leans by 25 deg; as a wall it would hold the place."""
    rng = np.random.default_rng(7)
    field = np.column_stack([rng.uniform(-12.0, 12.0, (60_000, 2)), rng.normal(scale=0.01, size=60_000) - 2.55])
    field = field[np.abs(field[:, 0] - 6.5) > 0.5]
    along, across = rng.uniform(-12.0, 12.0, 4000), rng.normal(scale=0.18, size=4000)
    strip = np.column_stack([6.5 + across, along, -2.55 + np.tan(np.deg2rad(25.0)) * across])
    rough = strip + rng.normal(scale=0.04, size=strip.shape) * [0.0, 0.0, 1.0]
    spread = {}
    for name, points in (("narrow", np.concatenate([field, rough])), ("sure", np.concatenate([field, strip]))):
        begun, memory = state(np.zeros(3), np.zeros(3), 0.1), np.array([0.0, 0.0, 1000.0])
        body = points[:: max(len(points) // 3000, 1)]
        body = np.concatenate([body, points[-2000:]])
        *_, after = update(
            map_of(points).arrays, body, np.ones(len(body), np.int32), begun.arrays, begun.covariance.copy(), memory
        )
        spread[name] = float(np.sqrt(after[3, 3]))
    assert spread["narrow"] > 0.09
    assert spread["sure"] < 0.03


def street(rng: np.random.Generator, cars: bool) -> Array:
    """Returns of 15 mm between two plain walls along x, 20 m apart, and of a street; `cars`: with ends of parked cars."""
    count = 30_000
    walls = np.column_stack(
        [rng.uniform(-25.0, 25.0, count), rng.choice([-10.0, 10.0], count), rng.uniform(0.1, 7.9, count)]
    )
    ground = np.column_stack([rng.uniform(-12.0, 12.0, (count, 2)), np.zeros(count)])
    parts = [walls, ground]
    if cars:
        for at in np.arange(-20.3, 21.0, 8.0):
            end = np.column_stack([np.full(300, at), rng.uniform(7.05, 8.7, 300), rng.uniform(0.3, 1.3, 300)])
            parts += [end, end + np.array([4.3, 0.0, 0.0]), end * np.array([1.0, -1.0, 1.0])]
    clean = np.concatenate(parts)
    return np.asarray(clean + rng.normal(scale=0.015, size=clean.shape))


@pytest.mark.parametrize("cars", [False, True])
def test_the_way_along_plain_walls_is_told_by_cars_and_not_by_normals_that_lean(cars: bool) -> None:
    """Each normal leans by half a degree and more, by the thousand: they would seem to hold the way along to centimetres."""
    rng = np.random.default_rng(8)
    planes = map_of(street(rng, cars), 0.5)
    seen = street(rng, cars)
    seen = seen[rng.permutation(len(seen))[:4000]] - [0.0, 0.0, 2.1]
    begun = state(np.array([0.0, 0.0, 2.1]), np.zeros(3), 0.1)
    count = np.ones(len(seen), np.int32)
    *_, unheld, after = update(
        planes.arrays, seen, count, begun.arrays, begun.covariance.copy(), np.array([0.0, 0.0, 1e3])
    )
    along, across, up = np.sqrt(np.diag(after)[3:6])
    assert max(across, up) < 0.03
    assert unheld[1] < 0.03
    if cars:
        assert unheld[0] < 0.06
        assert along < 0.05
    else:
        assert unheld[0] > 0.15
        assert along > 0.095
    # what the normals by themselves claim
    stands = planes.voxels[: planes.count, FLATNESS] >= 0.0
    leans = planes.voxels[: planes.count][stands]
    leans = leans[np.abs(leans[:, NORMAL + 1]) > 0.9]
    assert np.square(leans[:, NORMAL]).mean() > np.deg2rad(0.5) ** 2
