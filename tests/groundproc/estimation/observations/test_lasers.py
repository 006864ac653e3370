"""Corrections of the lasers: their columns against moved clusters, recovery in a made-up room, and clusters apart."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from flightlog.hdl32e import ELEVATION_DEG, LASERS
from groundproc.estimation.observations.lasers import PRIOR, UNKNOWNS, Corrections, LaserColumns, shifted
from groundproc.estimation.observations.planes import Rows, rows_of
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.slices import Clusterer, Slice
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
INTERVALS = 10
START_NS = 1_779_000_000_000_000_000
ROOM = np.array([[-6.3, 7.2], [-5.4, 8.3], [-2.7, 3.4]])
"""Walls, floor and ceiling of a room, none on the border of a voxel [m]."""
VOXEL_M = 1.0


@pytest.fixture(scope="module")
def path() -> Path:
    """Through the room, turning about all axes."""
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.5 * np.sin(5 * seconds), 0.5 * np.cos(4 * seconds), 2.0 * seconds], axis=1)
    place = np.stack([2 * np.sin(3 * seconds), 2 * np.cos(2 * seconds), np.sin(4 * seconds)], axis=1)
    return Path(START_NS, frames.quat_exp(turn), place)


def directions(azimuth: Array, elevation: Array) -> Array:
    """The manual's: x right, y forward, z up, azimuth clockwise."""
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=1
    )


def seen(path: Path, count: int, range_m: Array, elevation_rad: Array, noise_m: float, seed: int = 1) -> Clusters:
    """Single returns of a sensor whose lasers are off by so much, decoded with the manual's table."""
    rng = np.random.default_rng(seed)
    step = rng.integers(0, len(path.quat) - 1, count)
    laser = rng.integers(0, LASERS, count).astype(np.int32)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, count), np.deg2rad(np.array(ELEVATION_DEG))[laser]
    mats, place = frames.mat_from_quat(path.quat[step]), path.position_m[step]
    sight = np.einsum("nij,nj->ni", mats, directions(azimuth, elevation + elevation_rad[laser]))
    with np.errstate(divide="ignore"):
        reach = np.min(np.where(sight > 0, ROOM[:, 1] - place, ROOM[:, 0] - place) / sight, axis=1)
    measured = reach - range_m[laser] + noise_m * rng.normal(size=count)
    xyz = measured[:, None] * directions(azimuth, elevation)
    return Clusters(
        START_NS + step * STEP_NS, xyz.astype(np.float32), np.zeros((count, 6), np.float32), np.ones(count, np.int32), laser
    )  # fmt: skip


@pytest.fixture(scope="module")
def rows(path: Path) -> Rows:
    return rows_of(seen(path, 4000, np.zeros(LASERS), np.zeros(LASERS), 0.01), path, VOXEL_M, 10**6, cut=False)


def in_world(path: Path, clusters: Clusters) -> Array:
    step = (clusters.time_ns - START_NS) // STEP_NS
    return np.asarray(
        np.einsum("nij,nj->ni", frames.mat_from_quat(path.quat[step]), clusters.xyz_m) + path.position_m[step]
    )


def test_distances_change_as_the_columns_say(path: Path, rows: Rows) -> None:
    """Witness: the clusters moved by another table, and how far that is along each row's normal; 5 mm and 0.05 deg, float32."""
    clusters = seen(path, 4000, np.zeros(LASERS), np.zeros(LASERS), 0.01)
    rng = np.random.default_rng(2)
    change = np.concatenate([0.005 * rng.normal(size=LASERS), np.deg2rad(0.05) * rng.normal(size=LASERS)])
    moved = replace(clusters, xyz_m=shifted(clusters.xyz_m, clusters.laser, change))
    off = (in_world(path, moved) - in_world(path, clusters))[rows.cluster]
    along = np.einsum("ni,ni->n", off, rows.jacobian[:, 3:])
    (lasers,) = rows.more
    assert isinstance(lasers, LaserColumns)
    stated = np.einsum("nk,kn->n", lasers.change, change.reshape(2, LASERS)[:, lasers.laser])
    # second order: half of 12 m times (3 x 0.05 deg)^2, and 3 x 5 mm times 3 x 0.05 deg
    assert np.abs(stated - along).max() < 8e-5
    # and the table itself: a range longer by c, an elevation higher by e
    azimuth = np.arctan2(clusters.xyz_m[:, 0], clusters.xyz_m[:, 1])
    elevation = np.arctan2(clusters.xyz_m[:, 2], np.hypot(clusters.xyz_m[:, 0], clusters.xyz_m[:, 1]))
    reach = np.linalg.norm(clusters.xyz_m, axis=1) + change[:LASERS][clusters.laser]
    exact = reach[:, None] * directions(azimuth, elevation + change[LASERS:][clusters.laser])
    assert np.abs(moved.xyz_m - exact).max() < 8e-5


def test_the_normal_matrix_is_that_of_all_columns_together(path: Path, rows: Rows) -> None:
    """The lidar's part for path and lasers: what a change of the residuals by these columns does to the gradient."""
    rng, (lasers,) = np.random.default_rng(3), rows.more
    assert isinstance(lasers, LaserColumns)
    assert rows.size == rows.path_size + UNKNOWNS
    x = rng.normal(size=rows.size)
    coefficients = x[: rows.path_size].reshape(-1, 6)
    by_path = sum(
        rows.weights[:, j] * np.einsum("nc,nc->n", rows.jacobian, coefficients[rows.knot + j]) for j in range(4)
    )
    corrections = x[rows.path_size :].reshape(2, LASERS)
    by_lasers = np.einsum("nk,kn->n", lasers.change, corrections[:, lasers.laser])
    whole = replace(rows, residual_m=by_path + by_lasers).gradient()
    np.testing.assert_allclose(rows.apply(x), whole, rtol=1e-4, atol=1e-4 * np.abs(whole).max())
    y = rng.normal(size=rows.size)
    assert x @ rows.apply(y) == pytest.approx(y @ rows.apply(x), rel=1e-6)
    # without lasers nothing changes for the path
    alone = replace(rows, more=[], border=np.zeros((0, 0)), corner=np.zeros((0, 0)))
    np.testing.assert_allclose(
        alone.apply(x[: rows.path_size]), rows.apply(np.append(x[: rows.path_size], np.zeros(UNKNOWNS)))[: rows.path_size]
    )  # fmt: skip


def test_offsets_of_a_sensor_are_found_within_their_sigma(path: Path) -> None:
    """On the true path. Range noise of 5 mm; what is common to all lasers is told by walls seen from near and from far."""
    rng = np.random.default_rng(4)
    true = np.concatenate([0.008 * rng.normal(size=LASERS), np.deg2rad(0.04) * rng.normal(size=LASERS)])
    clusters = seen(path, 60_000, true[:LASERS], true[LASERS:], 0.005)
    found = np.zeros(UNKNOWNS)
    for _ in range(3):
        rows = rows_of(clusters, path, VOXEL_M, 10**6, cut=False)
        normal = rows.corner + np.diag(PRIOR**-2)
        step = -np.linalg.solve(normal, rows.gradient()[rows.path_size :] + found / PRIOR**2)
        found += step
        clusters.xyz_m = shifted(clusters.xyz_m, clusters.laser, step)
    off, sigma = found - true, np.sqrt(np.diag(np.linalg.inv(normal)))
    assert np.abs(off / sigma).max() < 4.0
    assert np.sqrt(np.mean(np.square(off / sigma))) < 1.3
    assert np.abs(off[:LASERS]).max() < 0.003
    assert np.rad2deg(np.abs(off[LASERS:]).max()) < 0.03
    made = Corrections(found, np.linalg.inv(normal))
    assert all(made.of(kind)[2].all() for kind in ("range", "elevation"))


def test_what_was_not_seen_stays_as_it_was() -> None:
    """Lasers that only look at the sky keep their prior's sigma."""
    sigma = np.where(np.arange(UNKNOWNS) % LASERS < 20, 0.1 * PRIOR, 0.95 * PRIOR)
    made = Corrections(np.full(UNKNOWNS, 0.001), np.diag(sigma**2))
    kept = made.file()
    assert kept.range_m[:20] == (0.001,) * 20
    assert kept.range_m[20:] == kept.elevation_deg[20:] == kept.sigma_range_m[20:] == (0.0,) * 12
    assert made.report()["range_held"] == [False] * 20 + [True] * 12
    assert made.mean("range")[1] == pytest.approx(np.sqrt(20 * 0.002**2 + 12 * 0.019**2) / 32)


def test_lasers_are_told_apart_where_that_is_asked_for() -> None:
    rng, count = np.random.default_rng(5), 5000
    points = rng.uniform(-3, 3, (count, 3)).astype(np.float32)
    laser = rng.integers(0, LASERS, count).astype(np.uint8)
    times = np.sort(rng.integers(0, STEPS * STEP_NS, count))
    still = np.tile([1.0, 0.0, 0.0, 0.0], (STEPS + 1, 1)), np.zeros((STEPS + 1, 3))
    piece = Slice(0, times, points, laser)
    mixed, _ = Clusterer(1.0)(piece, 0, *still)
    apart, world = Clusterer(1.0)(piece, 0, *still, apart=True)
    assert (mixed["laser"] == 0).all()
    assert apart["count"].sum() == mixed["count"].sum() == count
    expected = {(*cell, k) for *cell, k in np.column_stack([np.floor(points).astype(int), laser]).tolist()}
    found = np.column_stack([np.floor(world).astype(int), apart["laser"]]).tolist()
    assert len(found) == len(expected)
    assert {tuple(each) for each in found} == expected
