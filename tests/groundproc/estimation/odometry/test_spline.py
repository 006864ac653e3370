"""The path and the spline that corrects it, against scipy's B-splines and rotations."""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from flightlog import frames
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path, integrated, smooth_path

Array = npt.NDArray[np.float64]
INTERVALS = 7


def scipys(coefficients: Array) -> BSpline:
    """The same uniform cubic B-spline, in knots: its knots go on by three on both sides."""
    return BSpline(np.arange(-3.0, len(coefficients) + 1.0), coefficients, 3)


def wavy(intervals: int = INTERVALS) -> Path:
    """A path that turns and flies about."""
    seconds = np.arange(intervals * STEPS + 1) * STEP_NS * 1e-9
    turn = np.stack([0.5 * np.sin(3 * seconds), 0.4 * np.cos(4 * seconds), 2.0 * seconds], axis=1)
    place = np.stack([5 * seconds, np.sin(2 * seconds), 10 + 0.3 * np.cos(5 * seconds)], axis=1)
    return Path(10**18, frames.quat_exp(turn), place)


def test_a_path_is_turned_in_the_body_and_moved_by_the_spline() -> None:
    path, coefficients = wavy(), np.random.default_rng(1).normal(size=(INTERVALS + 3, 6)) * 0.2
    corrected = path.corrected(coefficients)
    value = scipys(coefficients)(np.arange(INTERVALS * STEPS + 1) / STEPS)
    expected = Rotation.from_quat(path.quat, scalar_first=True) * Rotation.from_rotvec(value[:, :3])
    off = expected.inv() * Rotation.from_quat(corrected.quat, scalar_first=True)
    assert off.magnitude().max() < 1e-12
    np.testing.assert_allclose(corrected.position_m, path.position_m + value[:, 3:], rtol=0, atol=1e-14)
    assert (corrected.start_ns, corrected.intervals) == (path.start_ns, INTERVALS)


def test_equal_coefficients_move_every_pose_alike() -> None:
    """The weights sum to one everywhere, the last pose included."""
    moved = wavy().corrected(np.tile([0.0, 0.0, 0.0, 1.0, -2.0, 3.0], (INTERVALS + 3, 1)))
    np.testing.assert_allclose(moved.position_m - wavy().position_m, np.tile([1.0, -2.0, 3.0], (len(moved.quat), 1)))
    np.testing.assert_allclose(moved.quat, wavy().quat, rtol=0, atol=1e-15)


def test_a_rigid_motion_keeps_what_the_sensor_sees() -> None:
    """A point that the sensor sees lands on the moved place of the point."""
    path, mat, shift = wavy(), Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([4.0, 5.0, -6.0])
    moved, point = path.turned(mat, shift), np.array([3.0, -1.0, 2.0])
    before = frames.mat_from_quat(path.quat) @ point + path.position_m
    after = frames.mat_from_quat(moved.quat) @ point + moved.position_m
    np.testing.assert_allclose(after, before @ mat.T + shift, rtol=0, atol=1e-13)


def test_rates_are_integrated_step_by_step() -> None:
    rate = np.random.default_rng(2).normal(size=(60, 3))
    start = frames.quat_exp(np.array([[0.2, 0.3, -0.4]]))[0]
    expected = [Rotation.from_quat(start, scalar_first=True)]
    for turn in rate * STEP_NS * 1e-9:
        expected.append(expected[-1] * Rotation.from_rotvec(turn))
    found = Rotation.from_quat(integrated(rate, start), scalar_first=True)
    assert max((a.inv() * b).magnitude() for a, b in zip(expected, found, strict=True)) < 1e-13


def test_a_smooth_path_goes_through_its_poses_with_the_gyros_motion_between() -> None:
    """The rates lack a slow drift: the path is that of the poses at the boundaries, and between them right to what a cubic leaves."""
    true = wavy()
    step_s = STEP_NS * 1e-9
    rate = frames.quat_log(frames.quat_multiply(frames.quat_inverse(true.quat[:-1]), true.quat[1:])) / step_s
    at = np.arange(INTERVALS + 1) * STEPS
    made = smooth_path(7, rate + np.deg2rad([1.0, -2.0, 3.0]), true.quat[at], true.position_m[at])
    assert made.start_ns == 7

    def off(where: npt.NDArray[np.int64]) -> Array:
        turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(true.quat[where]), made.quat[where]))
        return np.asarray(np.linalg.norm(turn, axis=1))

    assert off(at).max() < 1e-12
    np.testing.assert_allclose(made.position_m[at], true.position_m[at], rtol=0, atol=1e-12)
    # of 4 deg/s over 0.1 s, 0.4 deg, a cubic's correction leaves less than a hundredth
    assert np.rad2deg(off(np.arange(len(true.quat))).max()) < 0.004
    # and of a swing of 5 rad/s and 0.3 m between knots h apart, (5 h)^4 / 384 at most inside, some times that at the ends
    assert np.abs(made.position_m - true.position_m).max() < 20 * 0.5**4 / 384
