"""Positions that leave a path which the lidar holds."""

import numpy as np
import numpy.typing as npt
import pytest

from groundproc.estimation.observations.fixes import Left, strain_of, without_walks
from groundproc.estimation.observations.observation import Stretch
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Positions

Array = npt.NDArray[np.float64]

START_NS = 1_700_000_000 * 10**9
SECONDS = 60
HELD = np.full(10 * SECONDS, 0.005)


def path() -> Path:
    """A circle of 30 m at 6 m/s, level."""
    time_s = np.arange(10 * SECONDS * STEPS + 1) * STEP_NS * 1e-9
    place = np.stack([30.0 * np.cos(0.2 * time_s), 30.0 * np.sin(0.2 * time_s), np.full_like(time_s, 8.0)], axis=1)
    return Path(START_NS, np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1)), place)


def fixes(walk: Array, seed: int = 1, rate_hz: int = 3) -> Positions:
    """With errors of 3 m that last a minute, of a map that is turned by 2 deg; `walk`, shape (seconds, 3), goes on top."""
    count = SECONDS * rate_hz
    time_s = np.arange(count) / rate_hz
    rng, keep = np.random.default_rng(seed), np.exp(-1.0 / rate_hz / 60.0)
    error = [3.0 * rng.standard_normal(3)]
    for _ in range(count - 1):
        error.append(keep * error[-1] + 3.0 * np.sqrt(1.0 - keep**2) * rng.standard_normal(3))
    turn = np.deg2rad(2.0)
    grid = np.rint(time_s / (STEP_NS * 1e-9)).astype(np.int64)
    true = path().position_m[grid] @ np.array(
        [[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    more = np.stack([np.interp(time_s, np.arange(SECONDS), axis) for axis in walk.T], axis=1)
    time_ns = START_NS + grid * STEP_NS
    sigma = np.full((count, 3), 3.0)
    return Positions(time_ns, true + np.array(error) + more, sigma, np.zeros(3), np.array([60.0, 60.0, 300.0]), 0.1)


def judged(walk: Array, unheld_m: Array | None = HELD, seed: int = 1) -> tuple[Array, Left]:
    """Seconds of the fixes that are left out, and what is said of them."""
    given, left = without_walks(fixes(walk, seed), Stretch(path(), "lidar", np.zeros(3), True, unheld_m))
    assert len(given.time_ns) + len(left.time_ns) == len(fixes(walk).time_ns)
    return (left.time_ns - START_NS) * 1e-9, left


def away(first: int, rise: int, last: int, off_m: tuple[float, float, float]) -> Array:
    second = np.arange(SECONDS)
    share = np.clip(np.minimum((second - first) / rise, (last - second) / rise), 0.0, 1.0)
    return np.asarray(share[:, None] * np.array(off_m))


@pytest.mark.parametrize("seed", range(5))
def test_ordinary_errors_lose_nothing(seed: int) -> None:
    left_s, left = judged(np.zeros((SECONDS, 3)), seed=seed)
    assert not len(left_s)
    assert not left.doubt_m2.any()


@pytest.mark.parametrize(("rise", "off_m"), [(3, (20.0, 0.0, -8.0)), (6, (12.0, -9.0, 6.0)), (2, (15.0, 6.0, 0.0))])
def test_a_walk_away_from_a_path_that_is_held_is_left_out(rise: int, off_m: tuple[float, float, float]) -> None:
    left_s, left = judged(away(20, rise, 40, off_m))
    there = (left_s >= 20.0) & (left_s <= 40.0)
    assert there.mean() > 0.85
    assert there.sum() >= 3 * (20 - 2 * rise)
    assert left.farthest_m == pytest.approx(np.linalg.norm(off_m), rel=0.5)
    assert not left.doubt_m2.any()


def test_a_shift_that_is_never_taken_back_leaves_doubt_of_where_the_whole_lies() -> None:
    left_s, left = judged(away(40, 1, 10_000, (0.0, 15.0, 0.0)))
    assert left_s.min() == pytest.approx(40.0, abs=1.5)
    # a third of the time says that it is 15 m elsewhere
    assert np.sqrt(left.doubt_m2[1]) == pytest.approx(15.0 * np.sqrt(1.0 / 3.0), rel=0.4)


def test_a_lidar_that_does_not_hold_the_path_judges_nobody() -> None:
    walk = away(20, 3, 40, (20.0, 0.0, -8.0))
    assert not len(judged(walk, None)[0])
    assert not len(judged(walk, np.full(10 * SECONDS, 0.08))[0])
    blind = HELD.copy()
    blind[150:250] = np.inf
    blind[370:430] = np.inf
    assert not len(judged(walk, blind)[0])


def test_what_windows_left_out_is_told_once() -> None:
    one = Left(np.array([1, 2, 3]), 4.0, np.array([1.0, 0.0, 2.0]))
    two = Left(np.array([3, 4]), 9.0, np.array([0.0, 3.0, 0.0]))
    both = Left.of_all([one, two])
    assert both.time_ns.tolist() == [1, 2, 3, 4]
    assert both.farthest_m == 9.0
    assert both.doubt_m2.tolist() == [1.0, 3.0, 2.0]
    assert not len(Left.of_all([]).time_ns)


def stretch(unheld_m: Array | None = HELD) -> Stretch:
    return Stretch(path(), "lidar", np.zeros(3), True, unheld_m)


@pytest.mark.parametrize("seed", range(10))
def test_errors_that_change_as_stated_are_not_strained(seed: int) -> None:
    assert strain_of(fixes(np.zeros((SECONDS, 3)), seed), stretch()) == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_multipath_that_changes_within_seconds_is_seen_as_large_as_it_is(seed: int) -> None:
    """3 m on each axis that last two seconds, whatever the map is turned by and however well the other errors are stated."""
    rng, keep = np.random.default_rng(100 + seed), np.exp(-0.5)
    walk = np.zeros((SECONDS, 3))
    for second in range(1, SECONDS):
        walk[second, :2] = keep * walk[second - 1, :2] + 3.0 * np.sqrt(1.0 - keep**2) * rng.standard_normal(2)
    lag = np.exp(-np.arange(6) / 2.0)
    # variance of five changes on end of such errors, and of those that are stated, over what is stated of them
    ours = 3.0**2 * 2.0 * (1.0 - lag[5])
    stated = 5.0 * (3.0**2 * -np.expm1(-2.0 / 60.0) + 2.0 * 0.1**2)
    expected = np.sqrt((ours + stated) / stated)
    assert strain_of(fixes(walk, seed), stretch()) == pytest.approx(expected, rel=0.35)


def test_a_lidar_that_does_not_hold_the_path_says_nothing_of_the_fixes() -> None:
    walk = np.zeros((SECONDS, 3))
    walk[::4, 0] = 8.0
    given = fixes(walk)
    assert strain_of(given, stretch()) > 1.5
    assert strain_of(given, stretch(np.full(10 * SECONDS, 0.3))) == 1.0
    assert strain_of(given, stretch(None)) == 1.0
