"""A path that drifts by metres without being lost comes back: it is laid on what it saw before, and on nothing else."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.estimation.adjustment.loops import closed_loops
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.growing import Growing
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import Track

Array = npt.NDArray[np.float64]
Route = Callable[[Array], tuple[Array, Array]]
START_NS = 1_779_000_000_000_000_000
SEEN = 120
"""Clusters of a slice."""
DRIFT_M = np.array([2.6, -1.7, 0.4])
DRIFT_RAD = np.deg2rad(1.2)
FROM, UNTIL = 80, 400
"""Slices between which the path drifts."""


def wall(begin: tuple[float, float], end: tuple[float, float], height_m: float = 6.0) -> tuple[Array, Array, float]:
    """Begin, end, height of an upright wall."""
    return np.array(begin), np.array(end), height_m


def house(x: float, y: float, wide: float, deep: float, turn_deg: float = 0.0) -> list[tuple[Array, Array, float]]:
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()[:2, :2]
    corner = np.array([[-wide, -deep], [wide, -deep], [wide, deep], [-wide, deep]]) / 2.0 @ turn.T + (x, y)
    return [wall(tuple(corner[i]), tuple(corner[(i + 1) % 4])) for i in range(4)]


def yards() -> list[tuple[Array, Array, float]]:
    """Houses of all sizes about a way round of 250 m."""
    rng = np.random.default_rng(4)
    walls = []
    for turn in np.arange(0.0, 2.0 * np.pi, 0.42).tolist():
        for radius in (24.0, 56.0):
            off = radius + float(rng.uniform(-3.0, 3.0))
            walls += house(
                off * np.cos(turn), off * np.sin(turn), *rng.uniform(5.0, 11.0, 2), float(rng.uniform(0, 90))
            )
    return walls


def row_of_houses() -> list[tuple[Array, Array, float]]:
    """Equal houses every 8 m on both sides of a street."""
    walls = []
    for x in np.arange(-200.0, 200.0, 8.0).tolist():
        walls += house(x, 14.0, 5.0, 6.0) + house(x + 2.0, -14.0, 5.0, 6.0)
    return walls


def round_about(seconds: Array) -> tuple[Array, Array]:
    """Way and heading of 6 m/s on a circle of 40 m: once round in 42 s."""
    turn = seconds * 6.0 / 40.0
    return np.stack([40.0 * np.cos(turn), 40.0 * np.sin(turn), 2.0 + 0.0 * turn], axis=1), turn


def there_and_back(seconds: Array) -> tuple[Array, Array]:
    """Along a street for 20 s, and back."""
    out = 60.0 - np.abs(6.0 * seconds - 120.0)
    return np.stack([out, 0.0 * out, 2.0 + 0.0 * out], axis=1), 0.0 * seconds


def flown(walls: list[tuple[Array, Array, float]], route: Route, slices: int, drift: float) -> tuple[Path, Track, Path]:
    """A drifting path, its track, and the true path; what is seen are points of walls and ground within 35 m."""
    rng = np.random.default_rng(7)
    seconds = np.arange(slices * STEPS + 1) * STEP_NS * 1e-9
    place, heading = route(seconds)
    true = Path(START_NS, frames.quat_exp(np.stack([0 * heading, 0 * heading, heading], axis=1)), place)
    begins, ends, heights = (np.array([each[i] for each in walls]) for i in range(3))
    length = np.linalg.norm(ends - begins, axis=1)
    normal = np.stack([-(ends - begins)[:, 1], (ends - begins)[:, 0]], axis=1) / length[:, None]
    clusters = []
    for number in range(slices):
        step = number * STEPS + np.sort(rng.integers(0, STEPS, SEEN))
        middle = place[number * STEPS]
        near = np.flatnonzero(np.linalg.norm((begins + ends) / 2.0 - middle[:2], axis=1) < 35.0)
        which = rng.choice(near, SEEN, p=length[near] / length[near].sum())
        along = rng.uniform(0, 1, SEEN)[:, None]
        flat = begins[which] + along * (ends - begins)[which] + 0.01 * rng.normal(size=(SEEN, 1)) * normal[which]
        world = np.column_stack([flat, rng.uniform(0, 1, SEEN) * heights[which]])
        on_ground = rng.random(SEEN) < 0.3
        world[on_ground, :2] = middle[:2] + rng.uniform(-30, 30, (int(on_ground.sum()), 2))
        world[on_ground, 2] = 0.01 * rng.normal(size=int(on_ground.sum()))
        mats = frames.mat_from_quat(true.quat[step])
        made = np.zeros(SEEN, CLUSTER_DTYPE)
        made["time_ns"] = START_NS + step * STEP_NS
        made["xyz"] = np.einsum("nji,nj->ni", mats, world - place[step])
        made["count"] = 16  # returns that lie about their mean by 15 cm on the surface, by 1 cm across it
        across = np.column_stack([normal[which], np.zeros(SEEN)])
        across[on_ground] = [0.0, 0.0, 1.0]
        spread = 16.0 * (0.15**2 * np.eye(3) - (0.15**2 - 0.01**2) * across[:, :, None] * across[:, None, :])
        made["scatter"] = spread[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        clusters.append(made)
    share = drift * np.clip((np.arange(len(seconds)) / STEPS - FROM) / (UNTIL - FROM), 0.0, 1.0)
    turn = frames.quat_exp(np.stack([0 * share, 0 * share, DRIFT_RAD * share], axis=1))
    # each step is turned by as much as the attitude is, or what is seen of one wall would not lie on it
    steps = np.einsum("nij,nj->ni", frames.mat_from_quat(turn)[:-1], np.diff(place, axis=0))
    way = place[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    off = Path(START_NS, frames.quat_multiply(turn, true.quat), way + share[:, None] * DRIFT_M)
    loose = (np.arange(slices) >= FROM) & (np.arange(slices) < UNTIL)
    track = Track(0, clusters=clusters, unheld_m=np.where(loose, 0.2, 0.005).tolist())
    sigma = np.concatenate([np.full(3, np.deg2rad(0.4)), np.full(3, 0.8)])
    track.sigma = Growing(6, [sigma * min(max(k - FROM, 1) / (UNTIL - FROM), 1.0) for k in range(slices)])
    return off, track, true


def test_a_way_round_that_drifts_by_three_metres_is_laid_on_its_begin() -> None:
    path, track, true = flown(yards(), round_about, 550, 1.0)
    loops = closed_loops(path, track, 0, 550)
    assert len(loops.closed) == 1
    (told,) = loops.closed
    at = 475 * STEPS
    assert told["moved_m"] == pytest.approx(np.linalg.norm(path.position_m[at] - true.position_m[at]), abs=0.3)
    assert told["turned_deg"] == pytest.approx(1.2, abs=0.2)
    off = np.linalg.norm(loops.path.position_m - true.position_m, axis=1)
    assert off[(UNTIL + 40) * STEPS :].max() < max(0.1, 3.0 * told["sigma_m"])
    assert off[: FROM * STEPS].max() < 0.01  # what was right stays
    assert off.max() < 0.3
    turned = frames.quat_log(frames.quat_multiply(frames.quat_inverse(true.quat), loops.path.quat))
    assert np.rad2deg(np.abs(turned[(UNTIL + 40) * STEPS :])).max() < 0.15


def test_a_path_that_does_not_drift_stays_as_it_is() -> None:
    path, track, _ = flown(yards(), round_about, 550, 0.0)
    loops = closed_loops(path, track, 0, 550)
    assert loops.path is path
    assert not loops.closed
    assert loops.apart == 0


def test_in_a_row_of_equal_houses_no_loop_is_closed() -> None:
    """2.6 m along the street, houses every 8 m: the next ones fit as well as the true ones."""
    path, track, _ = flown(row_of_houses(), there_and_back, 420, 1.0)
    loops = closed_loops(path, track, 0, 420)
    assert loops.path is path
    assert not loops.closed
    assert loops.apart > 0
