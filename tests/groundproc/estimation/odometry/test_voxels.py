"""The map of planes: moments against numpy's, and how it grows and forgets."""

import tempfile

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE, Clusterer, Slice
from groundproc.estimation.odometry.voxels import (
    COUNT,
    FLATNESS,
    LEVEL,
    LONGEST,
    MEAN,
    NORMAL,
    SCATTER,
    SPREAD,
    TILT,
    PlaneMap,
    find,
)
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]
UNIT = np.array([1.0, 0.0, 0.0, 0.0])


def singles(count: int) -> npt.NDArray[np.void]:
    """Clusters of one return each."""
    clusters = np.zeros(count, CLUSTER_DTYPE)
    clusters["count"] = 1
    return clusters


def row_at(planes: PlaneMap, point: Array) -> int:
    key = voxel_key(float(point[0]), float(point[1]), float(point[2]), 1.0 / planes.voxel_m)
    return int(find(planes.table, planes.keys, key))


def moments(points: Array) -> tuple[Array, Array]:
    off = points - points.mean(axis=0)
    scatter = off.T @ off
    return points.mean(axis=0), scatter[np.triu_indices(3)]


def test_moments_of_a_voxel_are_numpys_however_they_came() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-4, 6, 0.1], [-3.51, 6.49, 0.13], (500, 3))
    planes = PlaneMap(0.5)
    for part in np.array_split(points, 7):
        planes.insert(part, singles(len(part)), 1e9)
    assert planes.count == 1
    voxel, (mean, scatter) = planes.voxels[row_at(planes, points[0])], moments(points)
    assert voxel[COUNT] == 500
    np.testing.assert_allclose(voxel[MEAN : MEAN + 3], mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(voxel[SCATTER : SCATTER + 6], scatter, rtol=1e-9, atol=1e-9)
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    assert abs(voxel[NORMAL : NORMAL + 3] @ vectors[:, 0]) > 1 - 1e-9
    assert voxel[FLATNESS] == pytest.approx(values[0], rel=1e-6)
    assert voxel[LEVEL] == pytest.approx(voxel[NORMAL : NORMAL + 3] @ mean)


def test_clusters_bring_the_scatter_of_their_returns_along() -> None:
    """All returns of a slice, put in by clusters, have the moments of all returns."""
    rng = np.random.default_rng(2)
    points = rng.uniform([0.01, 0.01, 0.2], [0.99, 0.99, 0.24], (3000, 3))
    times = np.sort(rng.integers(0, STEPS * STEP_NS, len(points)))
    clusters, world = Clusterer(0.25)(
        Slice(0, times, points.astype(np.float32)), 0, np.tile(UNIT, (STEPS + 1, 1)), np.zeros((STEPS + 1, 3))
    )
    assert len(clusters) == 16
    assert clusters["count"].sum() == 3000
    planes = PlaneMap(1.0)
    planes.insert(world, clusters, 1e9)
    mean, scatter = moments(points.astype(np.float32).astype(float))
    voxel = planes.voxels[row_at(planes, points[0])]
    np.testing.assert_allclose(voxel[MEAN : MEAN + 3], mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(voxel[SCATTER : SCATTER + 6], scatter, rtol=1e-5, atol=1e-3)


def test_a_cluster_is_the_mean_of_its_returns_seen_from_where_the_sensor_was() -> None:
    """A sensor that flies 0.5 m in the slice: returns of one place of the world are one cluster, and its mean lies there again."""
    rng, target = np.random.default_rng(3), np.array([5.1, 0.1, 1.1])
    position = np.linspace(0.0, 0.5, STEPS + 1)[:, None] * np.array([1.0, 0.0, 0.0])
    times = np.sort(rng.integers(0, STEPS * STEP_NS, 40))
    g = times / STEP_NS
    seen = target - np.stack([0.5 * g / STEPS, 0 * g, 0 * g], axis=1) + rng.uniform(-0.05, 0.05, (40, 3))
    clusters, world = Clusterer(0.5)(
        Slice(0, times, seen.astype(np.float32)), 0, np.tile(UNIT, (STEPS + 1, 1)), position
    )
    assert len(clusters) == 1
    expected = (seen + np.stack([0.5 * g / STEPS, 0 * g, 0 * g], axis=1)).mean(axis=0)
    np.testing.assert_allclose(world[0], expected, rtol=0, atol=1e-6)
    assert clusters["time_ns"][0] == pytest.approx(times.mean(), abs=1.0)
    place = 0.5 * clusters["time_ns"][0] / (STEPS * STEP_NS)
    np.testing.assert_allclose(clusters["xyz"][0] + [place, 0.0, 0.0], expected, rtol=0, atol=1e-5)
    assert clusters["range_m"][0] == pytest.approx(np.linalg.norm(seen, axis=1).mean(), abs=1e-4)


def test_what_is_no_plane_is_said_to_be_none() -> None:
    rng = np.random.default_rng(4)
    cube = rng.uniform(0.0, 0.5, (500, 3))
    few = rng.uniform([2.0, 0.0, 0.1], [2.5, 0.5, 0.11], (11, 3))
    line = np.stack([4.0 + rng.uniform(0.0, 0.5, 500), np.full(500, 0.2), np.full(500, 0.2)], axis=1)
    planes = PlaneMap(0.5)
    for points in (cube, few, line):
        planes.insert(points, singles(len(points)), 1e9)
        assert planes.voxels[row_at(planes, points[0]), FLATNESS] < 0


def test_voxels_judged_once_at_the_end_are_as_those_judged_with_each_cluster() -> None:
    """Ground, a wall, and leaves, in twenty slices; what a voxel holds is its moments' alone."""
    rng = np.random.default_rng(7)
    at_once, at_end = PlaneMap(0.5), PlaneMap(0.5)
    for _ in range(20):
        points = rng.uniform(-8.0, 8.0, (3000, 3))
        points[:1000, 2] = rng.normal(0.2, 0.02, 1000)
        points[1000:2000, 0] = rng.normal(5.2, 0.02, 1000)
        points[2000:] = 2.0 + points[2000:] / 8.0
        at_once.insert(points, singles(3000), 60.0)
        at_end.insert(points, singles(3000), 60.0, judged=False)
    at_end.judge()
    first, last = (each.voxels[: each.count] for each in (at_once, at_end))
    planes, filled = first[:, FLATNESS] >= 0.0, first[:, SPREAD] > 0.0
    assert planes.sum() > 500
    assert filled.sum() > 20
    moments_and_verdict = [*range(COUNT, NORMAL), FLATNESS, SPREAD]
    np.testing.assert_array_equal(first[:, moments_and_verdict], last[:, moments_and_verdict])
    np.testing.assert_array_equal(first[planes, : TILT + 1], last[planes, : TILT + 1])
    np.testing.assert_array_equal(first[filled, LONGEST:], last[filled, LONGEST:])


def test_a_voxel_forgets_what_is_beyond_its_memory() -> None:
    """A door that was closed and opens: with a memory of 50 returns, the mean follows those that come last."""
    planes = PlaneMap(1.0)
    for place in (0.2, 0.8):
        points = np.random.default_rng(6).uniform(0.1, 0.9, (2000, 3))
        points[:, 0] = place
        for part in np.array_split(points, 40):
            planes.insert(part, singles(len(part)), 50.0)
    voxel = planes.voxels[0]
    assert voxel[COUNT] <= 51.0
    assert voxel[MEAN] == pytest.approx(0.8, abs=1e-3)


def test_a_map_that_was_set_aside_goes_on_as_it_was() -> None:
    """It takes what comes, and has room for what it had room for."""
    rng = np.random.default_rng(6)
    kept, aside = PlaneMap(0.5), PlaneMap(0.5)
    for _ in range(3):
        world = rng.uniform(-40.0, 40.0, (40_000, 3))
        clusters = np.zeros(len(world), CLUSTER_DTYPE)
        clusters["count"] = 5
        for each in (kept, aside):
            each.insert(world, clusters, 4000.0)
        with aside.set_aside():
            assert not len(aside.voxels)
    assert aside.count == kept.count
    assert len(aside.voxels) == len(kept.voxels)
    np.testing.assert_array_equal(aside.voxels[: aside.count], kept.voxels[: kept.count])


def test_a_map_stays_in_memory_where_there_is_no_place_for_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> None:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(tempfile, "TemporaryFile", nowhere)
    planes = PlaneMap(0.5)
    planes.insert(np.zeros((1, 3)), singles(1), 4000.0)
    with planes.set_aside():
        assert planes.voxels[0, COUNT] == 1.0


def test_the_map_grows_and_forgets_what_is_far_away() -> None:
    """300,000 voxels, more than the first table holds; half of them are dropped, and every other is found again."""
    rng = np.random.default_rng(5)
    places = rng.uniform(-500.0, 500.0, (300_000, 3))
    planes = PlaneMap(0.5)
    for part in np.array_split(places, 10):
        planes.insert(part, singles(len(part)), 1e9)
    keys = {voxel_key(float(x), float(y), float(z), 2.0) for x, y, z in places[:2000]}
    assert planes.count <= len(places)
    assert 2 * planes.count <= len(planes.table)
    assert all(find(planes.table, planes.keys, key) >= 0 for key in keys)
    before = planes.count
    planes.forget_beyond(np.zeros(3), 400.0)
    near = np.linalg.norm(planes.voxels[: planes.count, MEAN : MEAN + 3], axis=1)
    assert near.max() < 400.0
    assert planes.count == pytest.approx(before * 4 / 3 * np.pi * 400.0**3 / 1000.0**3, rel=0.02)
    for place in places[:2000]:
        row = row_at(planes, place)
        assert (row >= 0) == (np.linalg.norm(place) < 400.0) or abs(np.linalg.norm(place) - 400.0) < 1.0
        if row >= 0:
            assert np.abs(planes.voxels[row, MEAN : MEAN + 3] - place).max() < 0.5
