"""Turns within a slice: clusters on the walls of a room, seen by a sensor whose attitude is off as a gyro's noise makes it."""

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.voxels import PlaneMap
from groundproc.estimation.odometry.within import Seen, Within

Array = npt.NDArray[np.float64]
DENSITY = np.deg2rad(0.13)
"""The HDL-32E's gyro in the air, vibration that aliases included [rad/sqrt(s)]."""
NOISE_M = 0.006
"""Of a cluster of ten returns."""
UP = np.array([0.0, 0.0, 1.0])


def wall_points(rng: np.random.Generator, count: int) -> Array:
    """Points on the floor and four walls of a room of 20 x 16 m, off the borders of voxels."""
    side = rng.integers(0, 5, count)
    x, y, z = rng.uniform(-10, 10, count), rng.uniform(-8, 8, count), rng.uniform(-2.2, 3, count)
    x[side == 0], x[side == 1] = -10.3, 10.2
    y[side == 2], y[side == 3] = -8.3, 8.2
    z[side == 4] = -2.2
    return np.stack([x, y, z], axis=1)


def room(rng: np.random.Generator) -> PlaneMap:
    planes = PlaneMap(0.5)
    points = wall_points(rng, 120_000)
    clusters = np.zeros(len(points), CLUSTER_DTYPE)
    clusters["count"] = 1
    planes.insert(points, clusters, 4000.0)
    return planes


def slice_seen(rng: np.random.Generator, off_rad: Array) -> Seen:
    """Clusters of one revolution, each turned by what the attitude at its moment is off."""
    points = wall_points(rng, 3000)
    azimuth = np.arctan2(points[:, 0], points[:, 1]) % (2.0 * np.pi)
    since = (azimuth / (2.0 * np.pi) * SLICE_NS).astype(np.int64)
    points += NOISE_M * rng.normal(size=points.shape)
    turn = np.stack([np.interp(since, np.arange(STEPS + 1) * STEP_NS, axis) for axis in off_rad.T], axis=1)
    return Seen(since, points + np.cross(turn, points), np.full(len(points), 10, np.int32))


def wandering(rng: np.random.Generator, first_rad: Array) -> Array:
    """A random walk on the grid of a slice, shape (STEPS + 1, 3)."""
    steps = DENSITY * np.sqrt(STEP_NS * 1e-9) * rng.normal(size=(STEPS, 3))
    return np.asarray(first_rad + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))


def test_what_a_gyro_gathers_within_a_slice_is_found() -> None:
    """The filter has taken out the mean of each: a quarter of what is left is found, with weights as careful as the filter's."""
    rng = np.random.default_rng(4)
    planes, places, within = room(rng), np.zeros((STEPS + 1, 3)), Within(DENSITY)
    end, before, after = np.zeros(3), [], []
    for _ in range(20):
        walk = wandering(rng, end)
        turn = -walk.mean(axis=0)
        left = walk + turn
        found = within(slice_seen(rng, left), places, _small(turn), (planes.arrays, UP))
        end = left[-1]
        before.append(np.square(left).sum(axis=1).mean())
        after.append(np.square(left + found).sum(axis=1).mean())
    assert np.sqrt(np.mean(after)) < 0.8 * np.sqrt(np.mean(before))


def test_a_good_slice_stays_as_it_is() -> None:
    """Noise of clusters alone moves it by less than a third of what the gyro gathers in half a slice."""
    rng = np.random.default_rng(5)
    found = Within(DENSITY)(
        slice_seen(rng, np.zeros((STEPS + 1, 3))), np.zeros((STEPS + 1, 3)), np.eye(3), (room(rng).arrays, UP)
    )
    assert np.abs(found).max() < DENSITY * np.sqrt(0.05) / 3.0


def test_where_there_is_no_map_nothing_is_turned() -> None:
    seen = slice_seen(np.random.default_rng(6), np.full((STEPS + 1, 3), 1e-3))
    found = Within(DENSITY)(seen, np.zeros((STEPS + 1, 3)), np.eye(3), (PlaneMap(0.5).arrays, np.zeros(3)))
    np.testing.assert_allclose(found, 0.0, rtol=0, atol=1e-12)


def test_level_ground_alone_does_not_turn_the_heading() -> None:
    """Its normals lean by noise; the mean of them is what counts."""
    rng = np.random.default_rng(7)
    planes = PlaneMap(0.5)
    points = rng.uniform([-10, -10, -2.02], [10, 10, -1.98], (60_000, 3))
    clusters = np.zeros(len(points), CLUSTER_DTYPE)
    clusters["count"] = 1
    planes.insert(points, clusters, 4000.0)
    azimuth = np.arctan2(points[:3000, 0], points[:3000, 1]) % (2.0 * np.pi)
    seen = Seen((azimuth / (2 * np.pi) * SLICE_NS).astype(np.int64), points[:3000], np.full(3000, 10, np.int32))
    found = Within(DENSITY)(seen, np.zeros((STEPS + 1, 3)), np.eye(3), (planes.arrays, UP))
    assert np.abs(found[:, 2]).max() < 1e-9


def _small(turn: Array) -> Array:
    x, y, z = turn
    return np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
