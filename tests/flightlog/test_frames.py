from itertools import product

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flightlog import frames

Array = npt.NDArray[np.float64]
EPS = np.finfo(float).eps
angle = st.floats(-2 * np.pi, 2 * np.pi)
tilt = st.floats(-np.pi / 2 + 1e-3, np.pi / 2 - 1e-3)
component = st.floats(-1, 1)
RIGHT, FORWARD, UP = np.eye(3)


def unit(parts: list[float]) -> Array:
    quat = np.array(parts)
    return np.asarray(quat / np.linalg.norm(quat))


quats = st.lists(component, min_size=4, max_size=4).filter(lambda p: np.linalg.norm(p) > 0.1).map(unit)
vectors = st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array)


def scipy_of(quat: Array) -> Rotation:
    return Rotation.from_quat(quat, scalar_first=True)


@given(angle, angle, angle)
def test_the_matrix_of_the_source_is_its_product_of_three_rotations(yaw: float, pitch: float, roll: float) -> None:
    cg, sg, ca, sa, cb, sb = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    about_y = np.array([[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]])
    about_x = np.array([[1, 0, 0], [0, ca, sa], [0, -sa, ca]])
    about_z = np.array([[cg, sg, 0], [-sg, cg, 0], [0, 0, 1]])
    assert frames.rotation(yaw, pitch, roll) == pytest.approx(about_y @ about_x @ about_z, abs=8 * EPS)


@given(angle, angle, angle)
def test_the_attitude_matrix_is_scipys_zxy_sequence(heading: float, pitch: float, roll: float) -> None:
    theirs = Rotation.from_euler("ZXY", [-heading, pitch, roll]).as_matrix()
    assert frames.mat_local_ins(heading, pitch, roll) == pytest.approx(theirs, abs=16 * EPS)


@given(angle, angle, angle)
def test_the_attitude_is_mavlinks_zyx_in_frd_and_ned_with_the_axes_swapped(h: float, p: float, r: float) -> None:
    ned_from_frd = Rotation.from_euler("ZYX", [h, p, r]).as_matrix()
    swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert frames.mat_local_ins(h, p, r) == pytest.approx(swap @ ned_from_frd @ swap, abs=16 * EPS)


@pytest.mark.parametrize(
    ("heading_deg", "ahead"), [(0, (0, 1, 0)), (90, (1, 0, 0)), (180, (0, -1, 0)), (270, (-1, 0, 0))]
)
def test_heading_counts_clockwise_from_north(heading_deg: float, ahead: tuple[float, float, float]) -> None:
    mat = frames.mat_local_ins(np.deg2rad(heading_deg), 0.0, 0.0)
    assert mat @ FORWARD == pytest.approx(ahead, abs=4 * EPS)
    assert mat @ UP == pytest.approx(UP, abs=4 * EPS)


@pytest.mark.parametrize(
    ("heading_deg", "pitch_deg", "roll_deg"), list(product((0, 90, 180, 270), (-15, 0, 15), (-25, 0, 25)))
)
def test_the_nose_goes_up_and_the_right_wing_down(heading_deg: float, pitch_deg: float, roll_deg: float) -> None:
    heading, pitch, roll = np.deg2rad([heading_deg, pitch_deg, roll_deg])
    mat = frames.mat_local_ins(heading, pitch, roll)
    assert (mat @ FORWARD)[2] == pytest.approx(np.sin(pitch), abs=4 * EPS)
    assert (mat @ RIGHT)[2] == pytest.approx(-np.sin(roll) * np.cos(pitch), abs=4 * EPS)
    east, north = (mat @ FORWARD)[:2]
    assert np.arctan2(east, north) % (2 * np.pi) == pytest.approx(heading, abs=8 * EPS)


def test_the_scanner_tilted_by_minus_20_degrees_looks_down_ahead() -> None:
    ahead = FORWARD @ frames.rotation(0.0, np.deg2rad(-20), 0.0)
    assert ahead == pytest.approx([0, np.cos(np.deg2rad(20)), -np.sin(np.deg2rad(20))])


def test_step_1_of_the_source_puts_a_shot_where_azimuth_and_elevation_point() -> None:
    azimuth, elevation, range_m = np.deg2rad(30), np.deg2rad(-10), 50.0
    shot = np.array([0, range_m, 0]) @ frames.rotation(-azimuth, elevation, 0.0)
    level = range_m * np.cos(elevation)
    expected = [level * np.sin(azimuth), level * np.cos(azimuth), range_m * np.sin(elevation)]
    assert shot == pytest.approx(expected, abs=range_m * 4 * EPS)


@given(angle, tilt, st.floats(-np.pi + 1e-9, np.pi))
def test_an_attitude_comes_back_from_its_matrix(heading: float, pitch: float, roll: float) -> None:
    h, p, r = frames.attitude_of(frames.mat_local_ins(heading, pitch, roll))
    assert 0 <= h < 2 * np.pi
    tolerance = 16 * EPS / np.cos(pitch)  # the closer to the zenith, the less heading and roll are apart
    assert np.abs((h - heading + np.pi) % (2 * np.pi) - np.pi) < tolerance
    assert p == pytest.approx(pitch, abs=tolerance)
    assert np.abs((r - roll + np.pi) % (2 * np.pi) - np.pi) < tolerance


def test_heading_stays_below_a_full_turn_however_little_left_of_north() -> None:
    heading, _, _ = frames.attitude_of(frames.mat_local_ins(-1e-20, 0.0, 0.0))
    assert heading == 0.0


def test_many_attitudes_at_once_give_the_same_as_one_by_one() -> None:
    angles = np.random.default_rng(1).uniform(-3, 3, (3, 5, 4))
    mats = frames.mat_local_ins(*angles)
    assert mats.shape == (5, 4, 3, 3)
    assert (mats[2, 3] == frames.mat_local_ins(*angles[:, 2, 3])).all()
    assert frames.rotation(angles[0], 0.1, 0.2).shape == (5, 4, 3, 3)
    assert frames.quat_from_mat(mats).shape == (5, 4, 4)
    assert frames.mat_from_quat(frames.quat_from_mat(mats)) == pytest.approx(mats, abs=8 * EPS)


# Quaternions ----------------------------------------------------------------------------------------------------------


@given(quats)
def test_matrix_of_a_quaternion_is_scipys(quat: Array) -> None:
    assert frames.mat_from_quat(quat) == pytest.approx(scipy_of(quat).as_matrix(), abs=8 * EPS)


@given(quats)
def test_quaternion_of_a_matrix_is_the_one_it_came_from(quat: Array) -> None:
    again = frames.quat_from_mat(frames.mat_from_quat(quat))
    assert again[0] >= 0
    assert min(np.abs(again - quat).max(), np.abs(again + quat).max()) < 8 * EPS


@pytest.mark.parametrize("axis", [RIGHT, FORWARD, UP, unit([1, 1, 0]), unit([1, -1, 1])])
def test_half_turns_are_exact_too(axis: Array) -> None:
    mat = Rotation.from_rotvec(np.pi * axis).as_matrix()
    assert frames.mat_from_quat(frames.quat_from_mat(mat)) == pytest.approx(mat, abs=8 * EPS)


@given(quats, quats)
def test_the_product_is_scipys(left: Array, right: Array) -> None:
    ours = scipy_of(frames.quat_multiply(left, right)).as_matrix()
    assert ours == pytest.approx((scipy_of(left) * scipy_of(right)).as_matrix(), abs=16 * EPS)


@given(quats, quats, quats)
def test_the_product_is_associative_and_of_unit_length(a: Array, b: Array, c: Array) -> None:
    one = frames.quat_multiply(frames.quat_multiply(a, b), c)
    other = frames.quat_multiply(a, frames.quat_multiply(b, c))
    assert one == pytest.approx(other, abs=16 * EPS)
    assert np.linalg.norm(one) == pytest.approx(1, abs=16 * EPS)


@given(quats)
def test_a_rotation_and_its_inverse_cancel(quat: Array) -> None:
    assert frames.quat_multiply(quat, frames.quat_inverse(quat)) == pytest.approx([1, 0, 0, 0], abs=8 * EPS)


@given(vectors)
def test_exp_is_scipys(vector: Array) -> None:
    theirs = Rotation.from_rotvec(vector).as_matrix()
    # an angle of up to 173 rad is itself known to 173 eps, half of it to 87
    assert scipy_of(frames.quat_exp(vector)).as_matrix() == pytest.approx(theirs, abs=256 * EPS)
    assert np.linalg.norm(frames.quat_exp(vector)) == pytest.approx(1, abs=128 * EPS)


@given(quats)
def test_log_is_scipys(quat: Array) -> None:
    theirs = scipy_of(quat).as_rotvec()
    ours = frames.quat_log(quat)
    if np.pi - np.linalg.norm(theirs) < 1e-6:  # half a turn: either way round is right
        ours, theirs = scipy_of(frames.quat_exp(ours)).as_matrix(), scipy_of(quat).as_matrix()
    assert ours == pytest.approx(theirs, abs=32 * EPS)


@given(st.lists(component, min_size=3, max_size=3).map(np.array), st.integers(-300, 0))
def test_log_undoes_exp_down_to_the_smallest_rotations(direction: Array, exponent: int) -> None:
    vector = direction * 10.0**exponent
    assert frames.quat_log(frames.quat_exp(vector)) == pytest.approx(vector, rel=1e-12, abs=1e-300)


@given(vectors)
def test_frd_to_rfu_is_its_own_inverse_and_keeps_handedness(vector: Array) -> None:
    assert (frames.ins_from_frd(frames.ins_from_frd(vector)) == vector).all()
    assert (frames.ins_from_frd(np.array([1.0, 2.0, 3.0])) == [2.0, 1.0, -3.0]).all()
    assert np.linalg.det(frames.ins_from_frd(np.eye(3))) == pytest.approx(1)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_a_nose_straight_up_or_down_has_its_pitch_though_the_matrix_is_rounded_beyond_one(up: float) -> None:
    mat = frames.mat_local_ins(0.3, up * np.pi / 2, 0.0)
    mat[2, 1] = np.nextafter(up, 2 * up)
    assert frames.attitude_of(mat)[1] == up * np.pi / 2
