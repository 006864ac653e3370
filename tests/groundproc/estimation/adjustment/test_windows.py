"""Windows of a flight, joined."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.estimation.adjustment.windows import Window, _laid_on, joined_path
from groundproc.estimation.observations.rows import Unknowns, turned
from groundproc.estimation.observations.tie import Tie
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000


def flown(first: int, last: int) -> Path:
    """Slices of one motion."""
    seconds = np.arange(first * STEPS, last * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.2 * np.sin(seconds), 0.1 * np.cos(2 * seconds), 0.4 * seconds], axis=1)
    place = np.stack([3 * seconds, np.sin(seconds), 8 + np.cos(seconds)], axis=1)
    return Path(START_NS + first * STEPS * STEP_NS, frames.quat_exp(turn), place)


def window(first: int, last: int, path: Path) -> Window:
    none = np.zeros((last - first + 1, 3))
    return Window(first, last, last - first, path, {}, Unknowns(last - first), none, none, [])


def off(a: Path, b: Path) -> tuple[Array, Array]:
    """Differences of attitude [rad] and position [m]."""
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(a.quat), b.quat))
    return np.linalg.norm(turn, axis=1), np.linalg.norm(a.position_m - b.position_m, axis=1)


def test_windows_that_agree_join_to_the_whole() -> None:
    whole = joined_path([window(a, b, flown(a, b)) for a, b in ((0, 40), (30, 70), (60, 90))])
    assert whole.start_ns == START_NS
    assert whole.intervals == 90
    turn, place = off(whole, flown(0, 90))
    assert turn.max() < 1e-9
    assert place.max() < 1e-9


def test_windows_that_differ_are_faded_into_each_other_without_a_step() -> None:
    """2 cm and 1 mrad apart, over an overlap of 10 slices: no step is larger than its share of that, and each end is one's own."""
    second = flown(30, 70).turned(turned(np.array([0.0, 0.0, 1e-3])), np.array([0.02, 0.0, 0.0]))
    whole = joined_path([window(0, 40, flown(0, 40)), window(30, 70, second)])
    turn, place = off(whole, flown(0, 70))
    begin, end = 30 * STEPS, 40 * STEPS
    assert turn[: begin + 1].max() < 1e-12
    assert place[: begin + 1].max() < 1e-12
    assert (
        off(
            Path(0, whole.quat[end:], whole.position_m[end:]),
            Path(0, second.quat[10 * STEPS :], second.position_m[10 * STEPS :]),
        )[1].max()
        < 1e-12
    )
    assert np.abs(np.diff(turn)).max() < 1.01e-3 / (end - begin)
    assert np.abs(np.diff(place)).max() < 0.06 / (end - begin)
    assert (np.diff(turn[begin : end + 1]) > -1e-12).all()


def test_three_windows_keep_their_places() -> None:
    """Joins do not shift what comes after them."""
    moved = [
        flown(a, b).turned(np.eye(3), np.array([0.01 * i, 0.0, 0.0]))
        for i, (a, b) in enumerate(((0, 40), (30, 70), (60, 90)))
    ]
    whole = joined_path([window(0, 40, moved[0]), window(30, 70, moved[1]), window(60, 90, moved[2])])
    place = (whole.position_m - flown(0, 90).position_m)[:, 0]
    np.testing.assert_allclose(place[: 30 * STEPS], 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(place[40 * STEPS : 60 * STEPS], 0.01, rtol=0, atol=1e-12)
    np.testing.assert_allclose(place[70 * STEPS :], 0.02, rtol=0, atol=1e-12)


def test_a_path_is_laid_on_the_begin_of_the_one_before_as_a_rigid_body() -> None:
    true = flown(30, 70)
    tie = Tie(true.quat[: 10 * STEPS : STEPS], true.position_m[: 10 * STEPS : STEPS], np.zeros((10, 3)))
    away = true.turned(Rotation.from_rotvec([0.01, -0.02, 0.3]).as_matrix(), np.array([5.0, -3.0, 2.0]))
    turn, place = off(_laid_on(away, tie), true)
    # the turn of the world is found exactly where it is the same everywhere
    assert turn.max() < 1e-9
    assert place.max() < 1e-7
