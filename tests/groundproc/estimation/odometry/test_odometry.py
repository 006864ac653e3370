"""The odometry in rooms whose walls are planes: rays are met analytically, so the true motion is known exactly."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.bearing import Bearing
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.matching import observable
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.odometry import Odometry
from groundproc.estimation.odometry.slices import Slice
from groundproc.estimation.odometry.state import GYRO, POSITION, ROTATION, STATES, VELOCITY, State
from groundproc.estimation.odometry.tracker import LOST_M

Array = npt.NDArray[np.float64]
START_NS = 1_779_000_000_000_000_000
SLICES = 40
STEP_S = STEP_NS * 1e-9
GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
GYRO_BIAS = np.deg2rad([0.8, -0.5, 0.6])
RETURNS = 12_000


def quat_at(seconds: npt.NDArray[np.floating[Any]]) -> Array:
    turn = np.stack([0.15 * np.sin(2 * seconds), 0.1 * np.sin(3 * seconds), 0.5 * seconds], axis=1)
    return np.asarray(frames.quat_exp(turn))


def place_at(seconds: npt.NDArray[np.floating[Any]]) -> Array:
    return np.stack([2 * np.sin(seconds), 1.5 * np.cos(seconds) - 1.5, 3 + 0.4 * np.sin(2 * seconds)], axis=1)


def speed_at(seconds: npt.NDArray[np.floating[Any]]) -> Array:
    return np.asarray((place_at(seconds + 1e-4) - place_at(seconds - 1e-4)) / 2e-4)


def motion() -> Motion:
    """What a perfect unit with a biased gyro measures, as means over the steps: turns and gains of speed from pose to pose."""
    seconds = np.arange(SLICES * STEPS + 1) * STEP_S
    quat = quat_at(seconds)
    rate = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / STEP_S
    gained = np.diff(speed_at(seconds), axis=0) / STEP_S - GRAVITY
    middle = frames.mat_from_quat(quat_at(seconds[:-1] + 0.5 * STEP_S))
    force = np.einsum("nji,nj->ni", middle, gained)
    known = np.ones(len(rate), np.bool_)
    return Motion(START_NS, rate + GYRO_BIAS, force, known, np.deg2rad(0.01), 0.003, "test")


def room(origin: Array, ray: Array) -> Array:
    """Distance along rays from inside a box of 24 x 18 x 7 m to its walls; none lies on the border of voxels."""
    low, high = np.array([-12.2, -9.3, -0.2]), np.array([11.8, 8.7, 6.8])
    with np.errstate(divide="ignore"):
        far = np.where(ray > 0, (high - origin) / ray, (low - origin) / ray)
    return np.asarray(far.min(axis=1))


def ground(origin: Array, ray: Array) -> Array:
    """Distance along rays to the plane z = -0.2 m."""
    with np.errstate(divide="ignore"):
        return np.where(ray[:, 2] < 0, (-0.2 - origin[:, 2]) / ray[:, 2], np.inf)


def piece(number: int, distance: Callable[[Array, Array], Array], noise_m: float = 0.0) -> Slice:
    """One revolution of 32 lasers from 30 deg down to 10 deg up."""
    rng = np.random.default_rng(number)
    since = np.sort(rng.integers(0, SLICE_NS, RETURNS))
    azimuth = 2 * np.pi * since / SLICE_NS
    elevation = np.deg2rad(np.linspace(-30, 10, 32))[rng.integers(0, 32, RETURNS)]
    sight = np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    time_ns = START_NS + number * SLICE_NS + since
    seconds = (time_ns - START_NS) * 1e-9
    ray = np.einsum("nij,nj->ni", frames.mat_from_quat(quat_at(seconds)), sight)
    reach = distance(place_at(seconds), ray) + noise_m * rng.normal(size=RETURNS)
    seen = (reach > 1.0) & (reach < 60.0)
    return Slice(number, time_ns[seen], (sight * reach[:, None])[seen].astype(np.float32))


def start() -> State:
    now = np.zeros(1)
    sigma = np.repeat([np.deg2rad(0.02), 1e-3, 1.0, np.deg2rad(1.0), 0.3, 0.3], 3)
    # the speed is not known at the start, nor the gyro's bias
    return State(
        quat_at(now)[0], place_at(now)[0], speed_at(now)[0] + [0.3, -0.2, 0.1], np.zeros(3), np.zeros(3), GRAVITY.copy(), np.diag(sigma**2)
    )  # fmt: skip


def since(first: tuple[Array, Array], last: tuple[Array, Array]) -> tuple[Array, Array]:
    """Motion from one pose to another in the axes of the first: rotation vector and shift."""
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(first[0][None]), last[0][None]))[0]
    return turn, (last[1] - first[1]) @ frames.mat_from_quat(first[0][None])[0]


def true_pose(number: int) -> tuple[Array, Array]:
    """At the end of a slice."""
    now = np.array([(number + 1) * SLICE_NS * 1e-9])
    return quat_at(now)[0], place_at(now)[0]


@pytest.mark.parametrize(("noise_m", "place_m", "turn_deg"), [(0.0, 0.008, 0.05), (0.02, 0.015, 0.1)])
def test_in_a_room_the_true_motion_is_found(noise_m: float, place_m: float, turn_deg: float) -> None:
    """Begun with a wrong speed and gyro bias, which put the first map some centimetres off: after a second the motion is right."""
    odometry = Odometry(start(), motion(), 0, 0.5)
    first: tuple[Array, Array] | None = None
    for number in range(SLICES):
        step = odometry.step(piece(number, room, noise_m))
        pose = odometry.state.quat.copy(), odometry.state.position_m.copy()
        if number == 10:
            first = pose
        if first is not None:
            assert step.matched > 500
            assert step.residual_m < 0.01 + noise_m
            turn, shift = since(first, pose)
            true_turn, true_shift = since(true_pose(10), true_pose(number))
            assert np.linalg.norm(shift - true_shift) < place_m
            assert np.rad2deg(np.linalg.norm(turn - true_turn)) < turn_deg
    assert first is not None
    end = np.array([SLICES * SLICE_NS * 1e-9])
    np.testing.assert_allclose(odometry.state.velocity_m_s, speed_at(end)[0], rtol=0, atol=0.05)
    np.testing.assert_allclose(odometry.state.gyro_bias_rad_s, GYRO_BIAS, rtol=0, atol=np.deg2rad(0.05))
    sigma = np.sqrt(np.diag(odometry.state.covariance))
    assert sigma[POSITION].max() < 0.01
    assert sigma[GYRO].max() < np.deg2rad(0.1)


def test_without_the_turns_within_slices_all_but_the_attitudes_stated_of_a_step_is_the_same() -> None:
    both = [Odometry(start(), motion(), 0, 0.5, turns=turns) for turns in (True, False)]
    stated = []
    for number in range(6):
        seen, bare = (each.step(piece(number, room, 0.02)) for each in both)
        for name in ("quat", "position_m", "velocity_m_s", "gyro_bias_rad_s", "sigma", "clusters", "world_m"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(bare, name))
        stated.append(np.abs(seen.quats - bare.quats).max())
    first, second = (each.planes.voxels[: each.planes.count] for each in both)
    np.testing.assert_array_equal(first, second)
    assert stated[0] == 0.0, "there is no map yet"
    assert min(stated[1:]) > 0.0


def test_what_is_done_beside_the_filter_gives_the_same_to_the_bit() -> None:
    """Attitudes of a step, and its way into the map, are waited for where they are asked for."""
    plain, beside = (Odometry(start(), motion(), 0, 0.5, beside=each) for each in (False, True))
    kept: list[list[int]] = [[], []]
    for number in range(6):
        seen, also = (each.step(piece(number, room, 0.02)) for each in (plain, beside))
        for each, counts in zip((plain, beside), kept, strict=True):
            each.afterwards(lambda planes, counts=counts: counts.append(planes.count))  # type: ignore[misc] # of this turn
        for name in ("quat", "position_m", "sigma", "clusters", "world_m"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(also, name))
        beside.settle()
        np.testing.assert_array_equal(seen.quats, also.quats)
    assert kept[0] == kept[1]
    np.testing.assert_array_equal(
        plain.planes.voxels[: plain.planes.count], beside.planes.voxels[: beside.planes.count]
    )


def test_over_an_infinite_plane_nothing_is_learnt_of_place_and_heading() -> None:
    """East, north and heading stay as uncertain as at the start, or more; height and tilt are held.

    Normals that change with the linearisation leak a little, as in every filter of this kind: no more than a heading to 5 deg in 4 s.
    """
    state, heading_rad = start(), 0.02
    state.covariance[2, 2] = heading_rad**2
    odometry, free = (Odometry(deepcopy(state), motion(), 0, 0.5) for _ in range(2))
    spread = []
    for number in range(SLICES):
        odometry.step(piece(number, ground, 0.02))
        free.propagate(number)
        up = frames.mat_from_quat(odometry.state.quat[None])[0].T @ [0.0, 0.0, 1.0]
        covariance = odometry.state.covariance
        spread.append(np.sqrt([up @ covariance[ROTATION, ROTATION] @ up, covariance[3, 3], covariance[4, 4]]))
    assert min(heading for heading, _, _ in spread) > (heading_rad**-2 + np.deg2rad(5.0) ** -2) ** -0.5
    assert (np.diff(np.array(spread)[:, 1:], axis=0) > 0).all()
    seen, blind = (np.sqrt(np.diag(o.state.covariance))[POSITION] for o in (odometry, free))
    assert (seen[:2] > 0.75 * blind[:2]).all()
    assert seen[2] < 0.01
    assert blind[2] > 1.0
    away = odometry.state.position_m - true_pose(SLICES - 1)[1]
    assert abs(away[2]) < 0.02
    assert (np.abs(away[:2]) < 3 * seen[:2]).all()


def test_a_position_or_an_attitude_is_taken_as_a_kalman_update() -> None:
    """Against the textbook's formula in information form, on a covariance of full rank."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(STATES, STATES)) * 0.05
    state = start()
    state.covariance = root @ root.T + 1e-4 * np.eye(STATES)
    before, sigma = deepcopy(state), np.array([0.5, 0.4, 0.3])
    odometry = Odometry(state, motion(), 0, 0.5)
    fix = state.position_m + np.array([0.2, -0.1, 0.3])
    odometry.position_fix(fix, sigma)
    observed = np.zeros((3, STATES))
    observed[:, POSITION] = np.eye(3)
    information = np.linalg.inv(before.covariance) + observed.T @ np.diag(sigma**-2.0) @ observed
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(odometry.state.covariance, expected, rtol=1e-6, atol=1e-9)
    change = expected @ observed.T @ np.diag(sigma**-2.0) @ np.array([0.2, -0.1, 0.3])
    np.testing.assert_allclose(odometry.state.position_m, before.position_m + change[POSITION], rtol=0, atol=1e-9)
    np.testing.assert_allclose(odometry.state.velocity_m_s, before.velocity_m_s + change[VELOCITY], rtol=0, atol=1e-9)
    # an attitude that is known far better than before is taken over
    odometry = Odometry(deepcopy(before), motion(), 0, 0.5)
    asked = frames.quat_multiply(frames.quat_exp(np.array([[0.01, -0.02, 0.03]])), before.quat[None])
    odometry.attitude_fix(asked[0], np.full(3, 1e-6))
    off = frames.quat_log(frames.quat_multiply(frames.quat_inverse(asked), odometry.state.quat[None]))
    assert np.linalg.norm(off) < 1e-4
    assert np.sqrt(np.diag(odometry.state.covariance)[ROTATION]).max() < 1e-5


def test_what_planes_of_two_directions_show_is_all_but_the_way_along_both() -> None:
    """A corridor: floor and walls, nothing ahead; its projection leaves out the shift along it and nothing else."""
    rng, information = np.random.default_rng(2), np.zeros((6, 6))
    for normal in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]):
        for point in rng.uniform(-5, 5, (200, 3)):
            j = np.concatenate([np.cross(point, normal), normal])
            information += np.outer(j, j)
    known = observable(information, 1e-3)
    np.testing.assert_allclose(known @ known, known, rtol=0, atol=1e-9)
    assert np.trace(known) == pytest.approx(5.0, abs=1e-9)
    np.testing.assert_allclose(known @ [0, 0, 0, 0, 1, 0], 0.0, rtol=0, atol=1e-2)
    np.testing.assert_allclose(known @ [0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0], rtol=0, atol=1e-2)


def test_inertial_data_that_end_are_not_extrapolated() -> None:
    odometry = Odometry(start(), motion(), 0, 0.5)
    with pytest.raises(IndexError, match="beyond the inertial data"):
        odometry.propagate(SLICES)


# Bearing of the map --------------------------------------------------------------------------------------------------


def along_a_street(off_deg: float, speed_off: float = 1.0) -> tuple[Array, Array]:
    """A way as the odometry has it with a heading that is off, and the fixes beside the true one: 60 s at 5 m/s, there and back."""
    seconds = np.arange(0.0, 120.0, 1.0 / 3.0)
    north = 5.0 * np.minimum(seconds, 120.0 - seconds)
    true = np.stack([0.0 * north, north, 7.0 + 0.0 * north], axis=1)
    rng, error = np.random.default_rng(9), np.zeros((len(seconds), 3))
    keep = np.exp(-1.0 / 3.0 / 60.0)
    error[0] = 2.5 * rng.normal(size=3)
    for i in range(1, len(error)):
        error[i] = keep * error[i - 1] + 2.5 * np.sqrt(1 - keep**2) * rng.normal(size=3)
    angle = np.deg2rad(off_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return error[0] + speed_off * true @ turn.T, true + error


@pytest.mark.parametrize("off_deg", [-12.0, 0.0, 6.0])
def test_a_heading_that_is_off_is_not_a_lost_way(off_deg: float) -> None:
    """At the end of a street of 300 m the raw fixes lie up to 60 m beside the way; on the map's axes they keep to their own errors."""
    way, fixes = along_a_street(off_deg)
    bearing = Bearing(way[0].copy())
    off = np.array([bearing.on_map(at, fix, 2.5) - at for at, fix in zip(way, fixes, strict=True)])
    raw = np.linalg.norm(fixes - way, axis=1)
    if off_deg:
        assert raw.max() > 30.0
    assert np.abs(off).max() < LOST_M
    # 8 m: three sigma of a fix, as far as it differs from the first one
    assert np.abs(off[90:]).max() < 8.0 + 2.0


def test_a_way_that_stands_still_or_turns_back_is_lost() -> None:
    """What no turn of the map explains is still seen."""
    for speed_off in (0.0, -1.0):
        way, fixes = along_a_street(0.0, speed_off)
        bearing = Bearing(way[0].copy())
        off = np.array([bearing.on_map(at, fix, 2.5) - at for at, fix in zip(way, fixes, strict=True)])
        assert (np.abs(off[60:180]).max(axis=1) > LOST_M).all()
