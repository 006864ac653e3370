from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from imageblock import FRAME

from flightlog import frames
from groundproc.estimation.surveyed import with_covariance
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
    step, covariance = information_gained(before, after, moved)
    np.testing.assert_allclose(np.linalg.inv(covariance), gain, rtol=1e-3, atol=1e-3 * np.abs(gain).max())
    together = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(covariance))
    np.testing.assert_allclose(together @ np.linalg.solve(covariance, step), moved, atol=1e-3 * np.abs(moved).max())


def test_where_images_say_nothing_nothing_is_handed_back() -> None:
    before = np.diag([1e-4] * 3 + [1e-6] * 3)
    step, covariance = information_gained(before, before.copy(), np.zeros(6))
    np.testing.assert_array_equal(step, 0.0)
    assert (np.diag(covariance) > 1e3 * np.diag(before)).all()


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
    np.testing.assert_allclose(frames.mat_from_quat(solution.quat_place_ins_wxyz), mats, atol=1e-6)
    assert len(thinned(poses, 2.0).time_ns) == 3
