"""Covariance of adjusted poses, against poses that are really moved and turned, and against samples of them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from flightlog.mount import Mount
from groundproc.estimation.adjustment import windows
from groundproc.estimation.adjustment.poses import pose_errors, semidefinite
from groundproc.estimation.adjustment.posterior import Spread
from groundproc.estimation.adjustment.run import Run
from groundproc.estimation.observations.rows import Unknowns
from groundproc.estimation.odometry.grid import STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.geodesy import LocalFrame
from tests.helpers.circling import INTERVALS, circle

Array = npt.NDArray[np.float64]


def only_known(columns: Array) -> Spread:
    """A spread without draws: its covariance is that of the columns."""
    none = np.zeros((1, columns.shape[1]))
    return Spread(none, none, columns)


def rotated(vector: Array) -> Array:
    return np.asarray(frames.mat_from_quat(frames.quat_exp(vector[None]))[0])


def pose_of(path: Path, mat_sensor_ins: Array, to_ins: Array) -> Array:
    """East, north, up, roll, pitch, heading of the ins frame at the slice boundaries, shape (n, 6)."""
    mats = frames.mat_from_quat(path.quat[::STEPS])
    heading, pitch, roll = frames.attitude_of(mats @ mat_sensor_ins)
    return np.column_stack([path.position_m[::STEPS] + mats @ to_ins, roll, pitch, heading])


@pytest.fixture
def unknowns() -> Unknowns:
    made = Unknowns(INTERVALS)
    for name in ("world.turn", "world.shift", "ins.turn", "ins.lever"):
        made.add(name, np.ones(3))
    return made


@pytest.mark.parametrize("seed", range(4))
def test_an_error_of_the_unknowns_is_the_change_that_it_makes_of_each_pose(
    unknowns: Unknowns, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One column of covariance has correlations of one, whose signs are those of the errors: lever arms, turns and all.

    The path is moved and turned by a ten thousandth; what is of second order is a ten thousandth of that. The adjustment lets the ins
    origin, 16 cm from the sensor, swing with the sensor when the whole turns: 2 % at 8 m from the centre. Its sigmas of roll and heading
    are those of level flight: the aircraft sways by 0.1 rad.
    """
    monkeypatch.setattr(windows, "SMOOTH", 1)
    mount = Mount().with_lidar(yaw_deg=3.0, roll_deg=-2.0)
    mat, lever = mount.mat_ins_lidar(), mount.lidar_position_m()
    to_ins, path = -mat.T @ lever, circle()
    path.quat = frames.quat_multiply(path.quat, np.repeat(frames.quat_from_mat(mat[None]), len(path.quat), axis=0))
    x = 1e-4 * np.random.default_rng(seed).normal(size=unknowns.size)
    part = {name: x[where] for name, where in unknowns.names.items()}
    moved = path.corrected(x[: unknowns.path_size].reshape(-1, 6))
    moved = moved.turned(rotated(part["world.turn"]), part["world.shift"])
    before = pose_of(path, mat.T, to_ins)
    changed = pose_of(moved, rotated(part["ins.turn"]) @ mat.T, to_ins + part["ins.lever"]) - before
    changed[:, 3:] = (changed[:, 3:] + np.pi) % (2 * np.pi) - np.pi
    found = windows._errors(path, unknowns, only_known(x[None]), mat, lever, (0.0, 0.0))
    for sigma, true, share in (
        (found.sigma_position_m, changed[:, :3], 0.02),
        (found.sigma_attitude_rad, changed[:, 3:], 0.11),
    ):
        np.testing.assert_allclose(sigma, np.abs(true), rtol=0, atol=share * np.linalg.norm(true, axis=1).max())
    outer = changed[:, :, None] * changed[:, None, :]
    large = np.abs(changed) > 5e-5
    both = large[:, :, None] & large[:, None, :]
    assert both.sum() > 1000
    np.testing.assert_allclose(found.correlation[both], np.sign(outer)[both], rtol=0, atol=2e-3)


def test_the_correlations_are_those_of_samples() -> None:
    """Poses at one pitch, their errors drawn 200 000 times as turns of the levelled aircraft, angles those of the turned attitudes."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(6, 8)) * np.array([0.3, 0.2, 0.5, 1e-3, 2e-3, 8e-3])[:, None]
    heading, pitch, roll = 2.1, np.deg2rad(-14.0), np.deg2rad(5.0)
    drawn = rng.normal(size=(200_000, 8)) @ root.T
    axes = np.array(
        [[np.sin(heading), np.cos(heading), 0.0], [np.cos(heading), -np.sin(heading), 0.0], [0.0, 0.0, 1.0]]
    )
    turns = frames.mat_from_quat(frames.quat_exp(drawn[:, 3:] @ axes))
    before = frames.mat_local_ins(*(np.array([angle]) for angle in (heading, pitch, roll)))
    after = frames.attitude_of(turns @ before)
    angles = np.stack([after[2] - roll, after[1] - pitch, after[0] % (2 * np.pi) - heading], axis=1)
    wanted = np.corrcoef(np.hstack([drawn[:, :3], angles]).T)
    found = pose_errors(only_known(root.T), lambda x: np.tile(x, (3, 1)), np.full(3, pitch), smooth=1, smooth_draws=1)
    # of so many samples a correlation is right to 1/450
    np.testing.assert_allclose(found.correlation, np.tile(wanted, (3, 1, 1)), rtol=0, atol=4 / 450)
    np.testing.assert_allclose(found.sigma_position_m[0], np.sqrt(np.square(root).sum(axis=1))[:3], rtol=1e-12)


def test_what_is_drawn_only_is_found_with_draws_enough() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) + 2.0 * np.eye(6)
    covariance = root @ root.T
    draws = rng.normal(size=(4000, 6)) @ root.T
    spread = Spread(draws, np.zeros_like(draws), np.zeros((0, 6)))
    found = pose_errors(spread, lambda x: x[None] * [1, 1, 1, 1, 1, -1], np.zeros(1), smooth=1, smooth_draws=1)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        found.correlation[0], covariance / np.outer(sigma, sigma), rtol=0, atol=4 / np.sqrt(4000)
    )


def test_the_sigmas_are_those_of_the_variances_and_the_correlations_always_a_covariances() -> None:
    """Few draws, and anchors that take more off than there is: where the difference is negative, it counts for nothing."""
    rng = np.random.default_rng(5)
    size, count = 60, 40
    of = rng.normal(size=(count, 6, size))
    spread = Spread(rng.normal(size=(12, size)), 1.2 * rng.normal(size=(12, size)), rng.normal(size=(20, size)))

    def errors(x: Array) -> Array:
        return np.asarray(of @ x)

    pitch = rng.uniform(-0.4, 0.4, count)
    found = pose_errors(spread, errors, pitch, smooth=1, smooth_draws=7, extra=0.25)
    variance = spread.variance(errors)
    sigma = np.sqrt(variance + np.repeat([0.0, 0.25], 3))
    np.testing.assert_allclose(np.hstack([found.sigma_position_m, found.sigma_attitude_rad]), sigma, rtol=1e-14)
    np.testing.assert_array_equal(found.correlation, np.swapaxes(found.correlation, 1, 2))
    assert (np.diagonal(found.correlation, axis1=1, axis2=2) == 1.0).all()
    assert np.linalg.eigvalsh(found.correlation).min() > -1e-12


def test_the_nearest_semidefinite_matrix_is_the_matrix_itself_where_it_is_one() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 6, 3))
    good = root @ np.swapaxes(root, 1, 2)
    np.testing.assert_allclose(semidefinite(good), good, rtol=0, atol=1e-12)
    np.testing.assert_allclose(semidefinite(-good), 0.0, rtol=0, atol=1e-12)


def test_windows_that_are_joined_add_what_the_joining_does_not_know() -> None:
    """Two windows of a flight: at each slice boundary the covariance is the sum of the window's and the joining's."""
    rng = np.random.default_rng(4)
    cut = 30

    def errors(count: int) -> Any:
        root = rng.normal(size=(count, 6, 8))
        covariance = root @ np.swapaxes(root, 1, 2)
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        return SimpleNamespace(
            sigma_position_m=sigma[:, :3],
            sigma_attitude_rad=sigma[:, 3:],
            correlation=covariance / (sigma[:, :, None] * sigma[:, None, :]),
            covariance=covariance,
            datum=covariance[0],
        )

    first, second, joined = errors(cut + 11), errors(INTERVALS - cut + 1), errors(INTERVALS + 5)
    first.own, second.own = cut, INTERVALS - cut
    path = circle()
    motion: Any = SimpleNamespace(start_ns=path.start_ns, known=np.ones(INTERVALS * STEPS, np.bool_))
    unused: Any = None
    run = Run([first, second], path, unused, motion, unused, joined)
    given: Any = SimpleNamespace(frame=LocalFrame(58.4, 15.6, 60.0))
    made = run.trajectory(given, Mount())
    wanted = np.concatenate([first.covariance[:cut], second.covariance]) + joined.covariance[: INTERVALS + 1]
    knots = made.time_ns[::STEPS]
    np.testing.assert_allclose(made.covariance_at(knots), wanted, rtol=1e-9, atol=1e-9)
    assert made.correlation is not None
    np.testing.assert_array_equal(made.correlation.time_ns, knots)
    # what windows do not know of where they lie is the joining's
    np.testing.assert_array_equal(made.datum, joined.datum)
