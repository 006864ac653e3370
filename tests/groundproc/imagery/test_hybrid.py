from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from imageblock import FRAME

from flightlog import frames
from flightlog.errors import LogError
from groundproc.estimation.surveyed import with_covariance, with_ties
from groundproc.flight.positions.fixes import Tied, outside_fixes
from groundproc.flight.positions.poses import read_poses
from groundproc.imagery.hybrid import Gained, information_gained, thinned, write_gained


@given(st.integers(0, 2**16))
def test_what_was_known_and_what_was_gained_make_what_is_known_after(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = np.cov(rng.normal(0, 1, (6, 40))) * 1e-3
    gain = np.linalg.inv(np.cov(rng.normal(0, 1, (6, 40))) * 10.0 ** rng.uniform(-5, -2))
    after = np.linalg.inv(np.linalg.inv(before) + gain)
    measured = rng.normal(0, 0.03, 6)
    moved = after @ gain @ measured
    told = information_gained(before, after, moved)
    step, covariance = told.step, told.covariance
    np.testing.assert_allclose(np.linalg.inv(covariance), gain, rtol=1e-3, atol=1e-3 * np.abs(gain).max())
    together = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(covariance))
    np.testing.assert_allclose(
        together @ np.linalg.solve(covariance, step), moved, rtol=0, atol=1e-3 * np.abs(moved).max()
    )


def test_where_images_say_nothing_nothing_is_handed_back() -> None:
    before = np.diag([1e-4] * 3 + [1e-6] * 3)
    told = information_gained(before, before.copy(), np.zeros(6))
    np.testing.assert_array_equal(told.step, 0.0)
    np.testing.assert_array_equal(told.adjusted, 0.0)
    assert (np.diag(told.covariance) > 1e3 * np.diag(before)).all()
    # as loose as the images say little, and nothing of it is shared
    assert (np.diag(told.own) > 10.0 * np.diag(before)).all()
    np.testing.assert_array_equal(told.shared, 0.0)


def test_poses_are_read_by_the_door_of_the_smoother(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    count = 5
    heading = np.array([0.1, 1.0, 2.0, 4.0, 6.0])
    mats = frames.mat_local_ins(heading, np.full(count, 0.05), np.full(count, -0.03))
    covariance = np.array([np.cov(rng.normal(0, 1, (6, 40))) * 1e-4 for _ in range(count)])
    time_ns = 1_700_000_000_000_000_000 + np.arange(count) * 10**9
    poses = Gained(time_ns, rng.normal(0, 50, (count, 3)), mats, covariance)
    write_gained(tmp_path, poses, FRAME)
    solution = with_covariance(read_poses(tmp_path / "trajectory.csv"), tmp_path / "covariance.npz")
    # the table rounds sigmas to a tenth of a millimetre
    np.testing.assert_allclose(solution.covariance_m2, covariance[:, :3, :3], rtol=0.03, atol=1e-7)
    assert solution.quat_place_ins_wxyz is not None
    np.testing.assert_allclose(frames.mat_from_quat(solution.quat_place_ins_wxyz), mats, rtol=0, atol=1e-6)
    assert len(thinned(poses, 2.0).time_ns) == 3


@given(st.integers(0, 2**16))
def test_a_tied_pose_is_the_adjusted_one_and_no_surer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = np.cov(rng.normal(0, 1, (6, 40))) * 1e-3
    gain = np.linalg.inv(np.cov(rng.normal(0, 1, (6, 40))) * 10.0 ** rng.uniform(-5, -3))
    after = np.linalg.inv(np.linalg.inv(before) + gain)
    moved = after @ gain @ rng.normal(0, 0.03, 6)
    told = information_gained(before, after, moved)
    # with what was known before it gives the adjusted pose
    together = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(told.own))
    np.testing.assert_allclose(
        together @ np.linalg.solve(told.own, told.adjusted), moved, rtol=0, atol=2e-2 * np.abs(moved).max()
    )
    # both parts make the covariance after, of which next to nothing is its own
    np.testing.assert_allclose(told.own + told.shared, after, rtol=0, atol=0.05 * after.max())
    assert np.trace(told.own) < 0.05 * np.trace(after)


def test_ties_are_read_where_the_poses_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    count = 4
    spread = np.array([np.cov(rng.normal(0, 1, (6, 40))) * 1e-4 for _ in range(count)])
    tied = Tied(rng.normal(0, 0.01, (count, 6)), 0.01 * spread, 0.99 * spread)
    time_ns = 1_700_000_000_000_000_000 + np.arange(count) * 10**9
    place, mats = rng.normal(0, 50, (count, 3)), np.tile(np.eye(3), (count, 1, 1))
    write_gained(tmp_path, Gained(time_ns, place, mats, spread, tied), FRAME)
    solution = with_covariance(read_poses(tmp_path / "trajectory.csv"), tmp_path / "covariance.npz")
    fixes = outside_fixes(solution, FRAME, np.zeros(3), height=solution.height_reference)
    found = with_ties(fixes, tmp_path / "covariance.npz").between(int(time_ns[1]), int(time_ns[2])).tied
    assert found is not None
    for name in ("step", "own", "shared"):
        np.testing.assert_array_equal(getattr(found, name), getattr(tied, name)[1:3])
    held = dict(np.load(tmp_path / "covariance.npz"))
    for name, spoilt, said in (("own", -held["own"], "eigenvalue"), ("step", held["step"][1:], "shape")):
        np.savez(tmp_path / "covariance.npz", **(held | {name: spoilt}))
        with pytest.raises(LogError, match=said):
            with_ties(fixes, tmp_path / "covariance.npz")
