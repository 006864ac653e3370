"""Covariance of poses: interpolation that stays a covariance, and turns as changes of roll, pitch and heading."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightlog import frames
from flightlog.errors import CoverageError
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.covariance import Correlation, correlation_of, mat_attitude_turn
from groundproc.trajectory.trajectory import Trajectory, joined

START_NS = 1_779_272_223_000_000_000


def covariances(count: int, seed: int = 1) -> np.ndarray:
    """Covariances of rank four: on the edge of what is semi-definite."""
    draws = np.random.default_rng(seed).normal(size=(count, 6, 4)) * [[[0.3]] * 1]
    return np.asarray(draws @ np.swapaxes(draws, 1, 2))


def standing(knots: int, step_ns: int, covariance: np.ndarray, every: int, start_ns: int = START_NS) -> Trajectory:
    """A trajectory at rest with a covariance at every so many knots, its sigmas linear between."""
    time_ns = start_ns + np.arange(knots, dtype=np.int64) * step_ns
    coarse = time_ns[::every]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    fine = np.stack([np.interp(time_ns - start_ns, coarse - start_ns, column) for column in sigma.T], axis=1)
    zero = np.zeros((knots, 3))
    return Trajectory(
        LocalFrame(58.4, 15.6, 60.0),
        time_ns,
        zero,
        zero,
        np.tile([1.0, 0.0, 0.0, 0.0], (knots, 1)),
        zero,
        fine[:, :3],
        fine[:, 3:],
        np.append(np.ones(knots - 1, np.bool_), False),
        correlation=correlation_of(coarse, covariance),
    )


def test_at_its_knots_a_covariance_is_what_was_given_and_between_a_covariance_with_the_trajectorys_sigmas() -> None:
    given_ = covariances(6)
    trajectory = standing(101, 5_000_000, given_, 20)
    np.testing.assert_allclose(trajectory.covariance_at(trajectory.time_ns[::20]), given_, rtol=0, atol=1e-15)
    at = START_NS + np.random.default_rng(2).integers(0, 500_000_000, 300)
    found = trajectory.covariance_at(at)
    sigma = np.hstack([trajectory.sigma_position_m, trajectory.sigma_attitude_rad])
    wanted = np.stack([np.interp(at - START_NS, trajectory.time_ns - START_NS, c) for c in sigma.T], axis=1)
    np.testing.assert_allclose(np.sqrt(np.diagonal(found, axis1=1, axis2=2)), wanted, rtol=1e-12)
    assert np.linalg.eigvalsh(found).min() > -1e-12
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))


def test_there_is_no_covariance_outside_the_trajectory() -> None:
    trajectory = standing(21, 5_000_000, covariances(2), 20)
    for off in (trajectory.time_ns[0] - 1, trajectory.time_ns[-1] + 1):
        with pytest.raises(CoverageError, match="no covariance"):
            trajectory.covariance_at(np.array([off]))


def test_a_part_keeps_its_covariances_and_parts_joined_keep_theirs() -> None:
    first = standing(101, 5_000_000, covariances(6), 20)
    bare = replace(first.after(int(first.time_ns[-1]) - 50_000_001), correlation=None)
    first = first.before(int(first.time_ns[57]))
    later = standing(41, 5_000_000, covariances(3, seed=9), 20, START_NS + 10**9)
    whole = joined([later, bare, first])
    for part in (first, later):
        at = np.random.default_rng(4).integers(part.time_ns[0], part.time_ns[-1] + 1, 50)
        np.testing.assert_allclose(whole.covariance_at(at), part.covariance_at(at), rtol=0, atol=1e-14)
    alone = bare.time_ns[3:4]
    np.testing.assert_array_equal(whole.covariance_at(alone), bare.covariance_at(alone))
    off_diagonal = whole.covariance_at(alone)[0] - np.diag(np.diag(whole.covariance_at(alone)[0]))
    assert (off_diagonal == 0.0).all()


def test_a_part_that_begins_between_two_covariances_has_the_same_ones() -> None:
    whole = standing(101, 5_000_000, covariances(6), 20)
    part = whole.after(int(whole.time_ns[33])).before(int(whole.time_ns[71]))
    at = np.random.default_rng(4).integers(part.time_ns[0], part.time_ns[-1] + 1, 50)
    np.testing.assert_allclose(part.covariance_at(at), whole.covariance_at(at), rtol=0, atol=1e-15)


def test_a_single_matrix_holds_throughout() -> None:
    one = Correlation(np.array([START_NS]), np.eye(6)[None])
    np.testing.assert_array_equal(one.at(START_NS + np.arange(-5, 5)), np.tile(np.eye(6), (10, 1, 1)))


@given(heading=st.floats(-np.pi, np.pi), pitch=st.floats(-1.2, 1.2), roll=st.floats(-3.0, 3.0), seed=st.integers(0, 99))
def test_a_small_turn_changes_roll_pitch_and_heading_as_the_matrix_says(
    heading: float, pitch: float, roll: float, seed: int
) -> None:
    """Against the difference of the angles before and after; what is left is of second order."""
    turn = np.random.default_rng(seed).normal(0, 1e-5, 3)
    before = frames.mat_local_ins(*(np.array([angle]) for angle in (heading, pitch, roll)))
    after = frames.mat_from_quat(frames.quat_exp(turn[None])) @ before
    changed = np.concatenate(frames.attitude_of(after)) - np.concatenate(frames.attitude_of(before))
    changed = (changed + np.pi) % (2 * np.pi) - np.pi
    said = mat_attitude_turn(np.array([heading]), np.array([pitch]))[0] @ turn
    np.testing.assert_allclose(changed[::-1], said, rtol=0, atol=3e-8)
