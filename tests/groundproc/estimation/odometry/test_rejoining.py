"""A piece of the path after a stretch without a view is found on the map before, and laid on it with all that belongs to it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.estimation.odometry.growing import Growing
from groundproc.estimation.odometry.rejoining import LOOSE, WORTH, Rejoining, turned_scatter
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.state import POSITION, STATES, State
from groundproc.estimation.odometry.track import Track
from groundproc.estimation.odometry.voxels import PlaneMap

Array = npt.NDArray[np.float64]

TURN = Rotation.from_rotvec(np.deg2rad([0.2, -0.3, 2.0]))
SHIFT_M = np.array([2.4, -1.6, 0.5])
"""What the path is off by after the stretch."""


def yard(seed: int) -> Array:
    """Points on the ground, on four walls and on a hedge, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-30, 30, (40_000, 2)), np.zeros(40_000)])
    parts = [ground]
    for (x, y), (u, v) in (
        ((-8, -5), (6, -5)),
        ((6, -5), (6, 4)),
        ((6, 4), (-8, 4)),
        ((-8, 4), (-8, -5)),
        ((-20, 12), (2, 16)),
    ):
        share = rng.uniform(0, 1, 6000)
        parts.append(np.column_stack([x + share * (u - x), y + share * (v - y), rng.uniform(0, 5, 6000)]))
    return np.concatenate(parts) + rng.normal(0.0, 0.01, (sum(map(len, parts)), 3))


def filled(planes: PlaneMap, points_m: Array) -> None:
    """Put points into a map, each a cluster of three returns."""
    clusters = np.zeros(len(points_m), CLUSTER_DTYPE)
    clusters["count"] = 3
    for first in range(0, len(points_m), 10_000):
        planes.insert(points_m[first : first + 10_000].copy(), clusters[first : first + 10_000], 4000.0)


def state(position_m: Array, sigma_m: float) -> State:
    """A filter that stands still."""
    covariance = 1e-6 * np.eye(STATES)
    covariance[POSITION, POSITION] = sigma_m**2 * np.eye(3)
    return State(
        frames.quat_from_mat(TURN.inv().as_matrix()[None])[0], position_m, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), covariance
    )  # fmt: skip


def noted(track: Track, place_m: Array) -> None:
    """One more slice of a track."""
    track.quat.append(frames.quat_from_mat(TURN.inv().as_matrix()[None])[0])
    track.position_m.append(place_m.copy())
    track.velocity_m_s.append(np.zeros(3))
    track.quats.append(None)
    track.clusters.append(np.zeros(1, CLUSTER_DTYPE))


@pytest.fixture(scope="module")
def flown() -> Any:
    """Forty slices that hold, ten that do not, and a piece that lies elsewhere, until it is found."""
    filter_ = SimpleNamespace(state=state(np.zeros(3), 0.01), planes=PlaneMap(0.5), voxel_m=0.5)
    odometry: Any = filter_
    filled(odometry.planes, yard(1))
    watch, start = Rejoining(in_time=False), np.array([1.0, 0.0, 0.0, 0.0])
    track = Track(0, Growing(4, [start]), Growing(3, [np.zeros(3)]))
    for _ in range(WORTH + 10):
        noted(track, np.zeros(3))
        watch.note(odometry, 500, 0.01)
    for _ in range(2 * LOOSE):
        odometry.state = state(np.zeros(3), 1.5)
        noted(track, np.zeros(3))
        watch.note(odometry, 0, np.inf)
    assert len(watch.lost) == 1
    off = TURN.inv()
    odometry.state = state(off.apply(-SHIFT_M), 0.01)
    filled(odometry.planes, off.apply(yard(2) - SHIFT_M))
    found = None
    for _ in range(30):
        noted(track, odometry.state.position_m)
        watch.note(odometry, 500, 0.01)
        found = found or watch.after(odometry, track)
    return odometry, track, watch, found


def test_the_piece_is_found_and_laid_where_it_belongs(flown: Any) -> None:
    """The filter, the slices of the piece and its map lie on the map before, to what voxels of half a metre tell."""
    odometry, track, watch, found = flown
    assert found is not None
    assert not watch.lost
    assert np.linalg.norm(odometry.state.position_m) < 0.05
    assert np.linalg.norm(track.position_m[-25]) < 0.05
    level = Rotation.from_matrix(frames.mat_from_quat(track.quat[-25][None])[0])
    assert np.rad2deg(level.magnitude()) < 0.1
    (told,) = track.rejoined
    assert told["moved_m"] == pytest.approx(np.linalg.norm(SHIFT_M), abs=0.1)
    assert told["lost_s"] == pytest.approx(1.0, abs=0.11)


def test_the_stretch_between_takes_its_share(flown: Any) -> None:
    """Nothing jumps within it, and what was flown before stays where it was."""
    _, track, _, _ = flown
    places = np.array(track.position_m)
    first = WORTH + 10
    assert not places[: first + 1].any()
    steps = np.linalg.norm(np.diff(places[first : first + 2 * LOOSE + 1], axis=0), axis=1)
    assert steps.max() < 0.3 * np.linalg.norm(SHIFT_M)


def test_second_moments_turn_with_their_axes() -> None:
    """As those of turned points."""
    points = np.random.default_rng(3).normal(size=(50, 3)) * [0.3, 0.1, 0.01]

    def moments(xyz: Array) -> Array:
        return np.asarray((xyz.T @ xyz)[np.triu_indices(3)])

    found = turned_scatter(moments(points)[None], TURN.as_matrix())[0]
    assert np.allclose(found, moments(TURN.apply(points)), rtol=0, atol=1e-12)


def test_a_path_that_may_be_centimetres_off_keeps_its_map() -> None:
    """Its planes are met."""
    odometry: Any = SimpleNamespace(state=state(np.zeros(3), 0.1), planes=PlaneMap(0.5), voxel_m=0.5)
    watch, before = Rejoining(in_time=False), odometry.planes
    for matched in [500] * (WORTH + 1) + [0] * 20:
        watch.note(odometry, matched, 0.01 if matched else np.inf)
    assert odometry.planes is before
    assert not watch.lost
