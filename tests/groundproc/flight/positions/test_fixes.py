"""Solutions in a local frame: judged by textbook formulas and by scipy's rotations."""

from dataclasses import replace
from typing import Any

import gnss
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightlog import frames
from flightlog.errors import LogError, UsageError
from flightlog.mount import Mount
from groundproc.flight.positions.fixes import lever_arm, outside_fixes
from groundproc.flight.positions.solution import Quality, Solution, diagonal_covariance
from groundproc.geodesy import LocalFrame

FRAME = LocalFrame(58.39, 15.62, 100.0)
ORIGIN = gnss.ecef(58.39, 15.62, 100.0)
AXES = gnss.mat_enu_ecef(58.39, 15.62)


def solution(**named: Any) -> Solution:
    """Five fixes over 3 km; a full covariance."""
    n = 5
    factor = np.array([[0.02, 0, 0], [0.01, 0.03, 0], [-0.02, 0.01, 0.05]])
    plain = Solution(
        source="a.pos",
        format="RTKLIB .pos",
        point="antenna",
        height_reference="ellipsoid",
        sigma_source="RTKLIB's filter",
        time_ns=np.arange(n) * 10**9,
        latitude_deg=58.39 + np.linspace(-0.01, 0.02, n),
        longitude_deg=15.62 + np.linspace(0.02, -0.03, n),
        height_m=np.linspace(90, 150, n),
        covariance_m2=np.tile(factor @ factor.T, (n, 1, 1)),
        quality=np.array([1, 1, 2, 5, 1], np.uint8),
    )
    return replace(plain, **named)


def test_positions_and_covariances_are_those_of_the_textbook() -> None:
    found = outside_fixes(solution(), FRAME, np.zeros(3))
    place = gnss.ecef(solution().latitude_deg, solution().longitude_deg, solution().height_m)
    np.testing.assert_allclose(found.position_m, (place - ORIGIN) @ AXES.T, rtol=0, atol=1e-6)
    for k in range(5):
        here = gnss.mat_enu_ecef(float(solution().latitude_deg[k]), float(solution().longitude_deg[k]))
        expected = AXES @ here.T @ solution().covariance_m2[k] @ here @ AXES.T
        np.testing.assert_allclose(found.covariance_m2[k], expected, rtol=0, atol=1e-15)
    assert np.abs(found.covariance_m2[4] - solution().covariance_m2[4]).max() > 1e-8  # the axes of 3 km away are others


def test_attitudes_and_velocities_are_turned_to_the_frame() -> None:
    attitude = frames.quat_from_mat(frames.mat_local_ins(np.full(5, 0.3), np.full(5, 0.1), np.full(5, -0.2)))
    velocity = np.tile([1.0, 2.0, 3.0], (5, 1))
    found = outside_fixes(solution(quat_place_ins_wxyz=attitude, velocity_m_s=velocity), FRAME, np.zeros(3))
    assert found.quat_local_ins_wxyz is not None
    assert found.velocity_m_s is not None
    turn = AXES @ gnss.mat_enu_ecef(float(solution().latitude_deg[4]), float(solution().longitude_deg[4])).T
    np.testing.assert_allclose(
        frames.mat_from_quat(found.quat_local_ins_wxyz[4]), turn @ frames.mat_from_quat(attitude[4]), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(found.velocity_m_s[4], turn @ velocity[4], rtol=0, atol=1e-12)
    # meridians converge: 0.03 deg further west, north has turned to the east by as much as that times the sine of latitude
    convergence = np.deg2rad(0.03) * np.sin(np.deg2rad(58.4))
    assert frames.attitude_of(turn)[0] == pytest.approx(convergence, rel=0.01)


def test_the_covariance_of_angles_becomes_that_of_a_rotation() -> None:
    rng = np.random.default_rng(3)
    angles = np.array([2.1, 0.4, -0.7])  # heading, pitch, roll
    factor = np.deg2rad([[0.05, 0, 0], [0.02, 0.06, 0], [0.1, -0.1, 0.3]])  # roll, pitch, heading
    covariance = factor @ factor.T
    attitude = frames.quat_from_mat(frames.mat_local_ins(*angles))
    here = solution(
        latitude_deg=np.full(5, 58.39),
        longitude_deg=np.full(5, 15.62),
        quat_place_ins_wxyz=np.tile(attitude, (5, 1)),
        attitude_covariance_rad2=np.tile(covariance, (5, 1, 1)),
    )
    found = outside_fixes(here, FRAME, np.zeros(3))
    assert found.attitude_covariance_rad2 is not None
    roll, pitch, heading = (rng.normal(size=(200_000, 3)) @ factor.T).T
    # scipy's own order: heading, pitch, roll as intrinsic turns about -z, x, y
    true = Rotation.from_euler("ZXY", [-angles[0], angles[1], angles[2]])
    drawn = Rotation.from_euler("ZXY", np.stack([-(angles[0] + heading), angles[1] + pitch, angles[2] + roll], axis=-1))
    sample = np.cov((drawn * true.inv()).as_rotvec().T)
    np.testing.assert_allclose(found.attitude_covariance_rad2[0], sample, rtol=0, atol=0.02 * np.abs(sample).max())


def test_heights_are_asked_for_and_never_guessed() -> None:
    plain = solution()
    with pytest.raises(LogError, match="no undulation"):
        outside_fixes(plain, FRAME, np.zeros(3), height="msl")
    given = outside_fixes(plain, FRAME, np.zeros(3), height="msl", undulation_m=29.0)
    same = outside_fixes(replace(plain, height_m=plain.height_m - 29.0), FRAME, np.zeros(3))
    np.testing.assert_array_equal(given.position_m, same.position_m)
    own = replace(plain, height_reference="msl", undulation_m=np.array([29.0, np.nan, 29.0, 29.0, 29.0]))
    np.testing.assert_array_equal(
        outside_fixes(own, FRAME, np.zeros(3), height="ellipsoid").position_m,
        outside_fixes(replace(plain, height_m=plain.height_m + 29.0), FRAME, np.zeros(3)).position_m,
    )
    with pytest.raises(LogError, match="'relative'"):
        outside_fixes(plain, FRAME, np.zeros(3), height="relative")


def test_a_sigma_is_stated_or_asked_for() -> None:
    silent = solution(covariance_m2=np.full((5, 3, 3), np.nan))
    with pytest.raises(UsageError, match="states no sigma for 5 of its 5"):
        outside_fixes(silent, FRAME, np.zeros(3))
    given = outside_fixes(silent, FRAME, np.zeros(3), sigma_m=(0.1, 0.2, 0.3), sigma_scale=2.0)
    np.testing.assert_allclose(given.sigma_m[0], [0.2, 0.4, 0.6], rtol=1e-4)
    half = solution(
        covariance_m2=np.where(np.arange(5)[:, None, None] < 2, np.nan, diagonal_covariance(np.full((5, 3), 0.01)))
    )
    assert outside_fixes(half, FRAME, np.zeros(3), sigma_m=(1.0, 1.0, 1.0)).sigma_m[:, 0] == pytest.approx(
        [1, 1, 0.01, 0.01, 0.01]
    )


def test_qualities_and_times_are_chosen_and_counted() -> None:
    fixed = outside_fixes(solution(left_out={"damaged": 2}), FRAME, np.zeros(3), qualities=(Quality.FIX,))
    assert fixed.time_ns.tolist() == [0, 10**9, 4 * 10**9]
    assert fixed.left_out == {"damaged": 2, "other_quality": 2}
    with pytest.raises(LogError, match="none of its 5 positions is of quality ppp"):
        outside_fixes(solution(), FRAME, np.zeros(3), qualities=(Quality.PPP,))
    thin = outside_fixes(solution(), FRAME, np.zeros(3), interval_s=2.0)
    assert thin.time_ns.tolist() == [0, 2 * 10**9, 4 * 10**9]
    assert thin.left_out == {"thinned": 2}
    part = outside_fixes(solution(), FRAME, np.zeros(3)).between(10**9, 3 * 10**9)
    assert part.time_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    assert len(part.position_m) == 3


def test_where_the_antenna_sits_is_never_guessed() -> None:
    antenna, inertial = solution(), solution(point="ins")
    with pytest.raises(UsageError, match="neither a lever arm is given nor gps_position_m"):
        lever_arm(antenna, Mount())
    mount = Mount(gps_position_m=(0.1, -0.2, 0.3))
    np.testing.assert_array_equal(lever_arm(antenna, mount), [0.1, -0.2, 0.3])
    np.testing.assert_array_equal(lever_arm(antenna, mount, (1, 2, 3)), [1, 2, 3])
    np.testing.assert_array_equal(lever_arm(inertial, mount), [0, 0, 0])
    np.testing.assert_array_equal(lever_arm(inertial, mount, (1, 2, 3)), [1, 2, 3])
