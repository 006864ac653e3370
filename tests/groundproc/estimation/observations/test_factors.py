"""Every kind of observation: its matrix against differences of its own residual, and whitening against the dense covariance."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import multivariate_normal

from flightlog import frames
from groundproc.estimation.observations import attitudes as stated_attitudes
from groundproc.estimation.observations import fixes
from groundproc.estimation.observations.accelerometer import force_factor
from groundproc.estimation.observations.gyro import turn_factor
from groundproc.estimation.observations.rows import (
    GRAVITY,
    Factor,
    H,
    RowBuilder,
    Unknowns,
    eye,
    normal_equations,
    prior_factor,
    turned,
    whitened,
)
from groundproc.estimation.observations.source import Clock
from groundproc.estimation.observations.tie import Tie, tie_factor
from groundproc.estimation.observations.unit import Unit, make_unit, place_on_grid
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.motion import ImuTrack
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.stated import Attitudes, Positions

Array = npt.NDArray[np.float64]
INTERVALS = 12
START_NS = 1_779_000_000_000_000_000
STEP_S = STEP_NS * 1e-9
LEVER = np.array([0.02, -0.05, 0.18])
MAT_SENSOR_INS = turned(np.array([0.35, 0.02, -0.01]))
COMPASS = np.deg2rad([1.0, 5.0, -3.0, 2.0, -1.0])


def attitude_at(seconds: npt.NDArray[np.floating[Any]]) -> Array:
    """A multirotor's motion: some tens of deg/s."""
    turn = np.stack([0.2 * np.sin(3 * seconds), 0.15 * np.cos(4 * seconds), 0.8 * seconds], axis=1)
    return np.asarray(frames.quat_exp(turn))


def position_at(seconds: npt.NDArray[np.floating[Any]]) -> Array:
    return np.stack([4 * seconds, np.sin(2 * seconds), 8 + 0.3 * np.cos(3 * seconds)], axis=1)


@pytest.fixture
def path() -> Path:
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_S
    return Path(START_NS, attitude_at(seconds), position_at(seconds))


def samples(rate_hz: float, lever: Array) -> ImuTrack:
    """What a perfect unit at a place beside the sensor measures on that motion: by differences over 1 ms, without the module's help."""
    seconds = np.arange(-0.5, INTERVALS * H + 0.5, 1.0 / rate_hz)

    def place(t: Array) -> Array:
        return np.asarray(position_at(t) + frames.mat_from_quat(attitude_at(t)) @ lever)

    d = 1e-3
    turn = frames.quat_multiply(frames.quat_inverse(attitude_at(seconds - d)), attitude_at(seconds + d))
    acceleration = (place(seconds + d) - 2 * place(seconds) + place(seconds - d)) / d**2 - GRAVITY
    force = np.einsum("nji,nj->ni", frames.mat_from_quat(attitude_at(seconds)), acceleration)
    time_ns = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    return ImuTrack("RAW_IMU", time_ns, frames.quat_log(turn) / (2 * d), force, 0.002, 0.05)


@pytest.fixture
def unit(path: Path) -> Unit:
    return make_unit("ins", samples(400.0, LEVER), path, np.zeros(3), LEVER)


def unknowns_of(*names: str) -> Unknowns:
    unknowns = Unknowns(INTERVALS)
    unknowns.add("world.turn", np.ones(3))
    unknowns.add("world.shift", np.ones(3))
    for name in names:
        unknowns.add(name, np.ones({"ins.delay": 1, "ins.drift": 1, "late": 1, "compass": 5}.get(name, 3)))
    return unknowns


UNIT_NAMES = tuple(
    f"ins.{name}"
    for name in (
        "bias", "scale", "shear", "turn", "accel_bias", "accel_scale", "accel_shear", "accel_turn", "lever", "delay", "drift",
    )
)  # fmt: skip


def changed_unit(unit: Unit, track: ImuTrack, path: Path, name: str, change: Array) -> Unit:
    """The unit with one of its globals changed, as the adjustment takes a solution in."""
    values = {key: value.copy() for key, value in unit.values.items()}
    if name in ("turn", "accel_turn"):
        values[name] = frames.quat_log(frames.quat_from_mat((turned(change) @ turned(values[name]))[None]))[0]
    else:
        values[name] = values[name] + change
    made = replace(unit, values=values)
    if name in ("delay", "drift"):
        place_on_grid(made, track, path)
    return made


def by_the_path(residual: Callable[[Path], Array], path: Path, offset: int, size: float) -> Array:
    """Differences of a residual by the spline's coefficients of rotation (0) or position (3); shape (rows, knots, 3)."""
    columns = []
    for k in range(INTERVALS + 3):
        for c in range(3):
            step = np.zeros((INTERVALS + 3, 6))
            step[k, offset + c] = size
            columns.append((residual(path.corrected(step)) - residual(path.corrected(-step))) / (2 * size))
    return np.array(columns).T.reshape(-1, INTERVALS + 3, 3)


def of_the_path(factor: Factor, offset: int) -> Array:
    dense = factor.matrix.toarray()[:, : 6 * (INTERVALS + 3)]
    return np.asarray(dense.reshape(len(dense), INTERVALS + 3, 6)[:, :, offset : offset + 3])


def by_the_world(residual: Callable[[Path], Array], path: Path, name: str) -> Array:
    columns = []
    for c in range(3):
        step = np.zeros(3)
        step[c] = 1e-5
        turn = (lambda s: (turned(s), np.zeros(3))) if name == "world.turn" else (lambda s: (np.eye(3), s))
        columns.append((residual(path.turned(*turn(step))) - residual(path.turned(*turn(-step)))) / 2e-5)
    return np.array(columns).T


def assert_close(found: Array, expected: Array, share: float) -> None:
    """Two matrices whose largest entry sets the scale."""
    assert np.abs(expected).max() > 0
    assert np.abs(found - expected).max() < share * np.abs(expected).max()


# Inertial units --------------------------------------------------------------------------------------------------------


def test_a_perfect_unit_on_the_true_path_leaves_nothing(path: Path, unit: Unit) -> None:
    """Left is what straight lines between samples 2.5 ms apart do: (w dt)^2 / 8 of rates and forces, w = 4 rad/s: 1e-5 of some."""
    unknowns = unknowns_of(*UNIT_NAMES)
    assert np.abs(turn_factor(unit, path, unknowns).residual).max() < 1e-5
    assert np.abs(force_factor(unit, path, unknowns).residual).max() < 0.01


def test_what_a_gyro_says_is_linear_as_stated(path: Path, unit: Unit) -> None:
    unknowns = unknowns_of(*UNIT_NAMES)
    factor = turn_factor(unit, path, unknowns)
    numeric = by_the_path(lambda p: turn_factor(unit, p, unknowns).residual, path, 0, 1e-5)
    assert_close(of_the_path(factor, 0), numeric, 1e-3)
    assert not of_the_path(factor, 3).any()
    track = samples(400.0, LEVER)
    dense = factor.matrix.toarray()
    # by the slice's whole turn at once: it is up to 0.09 rad, and by so much the second order may differ
    for name, size in (
        ("bias", 1e-4),
        ("scale", 1e-4),
        ("shear", 1e-4),
        ("turn", 1e-4),
        ("delay", 1e-3),
        ("drift", 1e-3),
    ):
        where = unknowns.names[f"ins.{name}"]
        columns = []
        for c in range(where.stop - where.start):
            step = np.zeros(where.stop - where.start)
            step[c] = size
            ahead, behind = (
                turn_factor(changed_unit(unit, track, path, name, s), path, unknowns).residual for s in (step, -step)
            )
            columns.append((ahead - behind) / (2 * size))
        assert_close(dense[:, where], np.array(columns).T, 0.09)
    for name in ("world.turn", "world.shift", "ins.accel_bias", "ins.lever"):
        assert not dense[:, unknowns.names[name]].any()


def test_vibration_makes_no_delay(path: Path) -> None:
    """A gyro that does not follow the vibration of the path: on average over its phases the rows ask for no delay.

    The yardstick is what one phase of the line at 23 Hz asks for alone.
    """
    seconds = np.arange(INTERVALS * STEPS + 1) * STEP_S
    track = samples(400.0, np.zeros(3))
    pulls = []
    for phase in np.linspace(0.0, 2 * np.pi, 40, endpoint=False):
        shake = np.zeros((len(seconds), 3))
        shake[:, 0] = np.deg2rad(0.05) * np.sin(2 * np.pi * 23.0 * seconds + phase)
        shaken = Path(START_NS, frames.quat_multiply(attitude_at(seconds), frames.quat_exp(shake)), path.position_m)
        made = make_unit("ins", track, shaken, np.zeros(3), np.zeros(3))
        unknowns = unknowns_of(*UNIT_NAMES)
        factor = turn_factor(made, shaken, unknowns)
        column = factor.matrix[:, unknowns.names["ins.delay"]].toarray()[:, 0]
        pulls.append(-float(column @ factor.residual) / float(column @ column))
    assert np.std(pulls) > 1e-4  # one phase alone: a tenth of a millisecond and more
    assert abs(np.mean(pulls)) < 2e-5


def test_what_an_accelerometer_says_is_linear_as_stated(path: Path, unit: Unit) -> None:
    unknowns = unknowns_of(*UNIT_NAMES)
    factor = force_factor(unit, path, unknowns)

    def residual(p: Path) -> Array:
        return force_factor(unit, p, unknowns).residual

    assert_close(of_the_path(factor, 3), by_the_path(residual, path, 3, 1e-4), 1e-6)
    # the whole lever arm turns with the attitude: 0.18 m in second differences over 0.1 s would be 18 m/s^2 for 1 rad; left out
    plain = changed_unit(unit, samples(400.0, LEVER), path, "lever", -LEVER)
    at_the_sensor = force_factor(plain, path, unknowns)
    numeric = by_the_path(lambda p: force_factor(plain, p, unknowns).residual, path, 0, 1e-5)
    # the force is felt over two slices, and stands at the knot between: sums over neighbours agree
    assert_close(of_the_path(at_the_sensor, 0).sum(axis=1), numeric.sum(axis=1), 0.03)
    dense, track = factor.matrix.toarray(), samples(400.0, LEVER)
    for name, size, share in (
        ("accel_bias", 1e-3, 0.05),
        ("accel_turn", 1e-4, 0.06),
        ("turn", 1e-4, 0.06),
        ("lever", 1e-3, 1e-6),
    ):
        where = unknowns.names[f"ins.{name}"]
        columns = []
        for c in range(3):
            step = np.zeros(3)
            step[c] = size
            ahead, behind = (
                force_factor(changed_unit(unit, track, path, name, s), path, unknowns).residual for s in (step, -step)
            )
            columns.append((ahead - behind) / (2 * size))
        assert_close(dense[:, where], np.array(columns).T, share)
    # a turn of the world turns residuals too; where they are small, what is left is gravity's
    assert_close(dense[:, unknowns.names["world.turn"]], by_the_world(residual, path, "world.turn"), 0.5)


def test_scale_and_cross_axis_terms_act_on_the_force_that_lasts() -> None:
    """At rest, tilted, that is all of it."""
    count = INTERVALS * STEPS + 1
    path = Path(START_NS, np.tile(attitude_at(np.array([0.3])), (count, 1)), np.zeros((count, 3)))
    resting = frames.mat_from_quat(path.quat[0]).T @ -GRAVITY
    track = samples(400.0, LEVER)
    track = replace(track, rate_rad_s=0.0 * track.rate_rad_s, force_m_s2=np.tile(resting, (len(track.time_ns), 1)))
    unit = make_unit("ins", track, path, np.zeros(3), LEVER)
    unit.values["accel_turn"] = np.array([0.02, -0.01, 0.03])
    unknowns = unknowns_of(*UNIT_NAMES)
    dense = force_factor(unit, path, unknowns).matrix.toarray()
    for name in ("accel_scale", "accel_shear"):
        columns = []
        for step in 1e-4 * np.eye(3):
            ahead, behind = (
                force_factor(changed_unit(unit, track, path, name, s), path, unknowns).residual for s in (step, -step)
            )
            columns.append((ahead - behind) / 2e-4)
        assert_close(dense[:, unknowns.names[f"ins.{name}"]], np.array(columns).T, 1e-6)


def test_the_scale_of_a_unit_that_shakes_is_not_its_noise() -> None:
    """A reading of 2 % too much under vibration three times as large as what the flight pushes, on the true path.

    The vibration's mean over two slices is 0.32 m/s^2, against 0.7 of the push: with the reading itself as the regressor the scale comes
    out 0.2 too large.
    """
    seconds = np.arange(600 * STEPS + 1) * STEP_S
    push = 1.0 * np.sin(0.7 * seconds)
    path = Path(START_NS, np.tile([1.0, 0.0, 0.0, 0.0], (len(seconds), 1)), np.zeros((len(seconds), 3)))
    path.position_m[:, 2] = -1.0 / 0.49 * np.sin(0.7 * seconds)
    stamps = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    force = np.stack([0.0 * push, 0.0 * push, 1.02 * (push - GRAVITY[2])], axis=1)
    force += 2.0 * np.random.default_rng(2).standard_normal(force.shape)
    track = ImuTrack("RAW_IMU", stamps, np.zeros_like(force), force, 0.002, 0.05)
    unit = make_unit("ins", track, path, np.zeros(3), np.zeros(3))
    unknowns = Unknowns(600)
    for name in ("world.turn", *UNIT_NAMES):
        unknowns.add(name, np.ones({"ins.delay": 1, "ins.drift": 1}.get(name, 3)))
    factor = force_factor(unit, path, unknowns)
    up = slice(2, None, 3)
    design = np.stack(
        [factor.matrix.toarray()[up, unknowns.names[f"ins.{name}"].start + 2] for name in ("accel_bias", "accel_scale")]
    )
    bias, scale = np.linalg.solve(design @ design.T, -design @ factor.residual[up])
    # 2 m/s^2 at 200 Hz over a minute, against 0.7: 2.6 % is one sigma
    assert scale == pytest.approx(0.02, abs=3 * 0.026)
    assert bias + GRAVITY[2] * (0.02 - scale) == pytest.approx(0.0, abs=3 * 2.0 / np.sqrt(600 * STEPS))


def test_where_a_unit_was_silent_it_says_nothing(path: Path, unit: Unit) -> None:
    unit.known[5 * STEPS + 3] = False
    unit.force_known[5 * STEPS + 3] = False
    unknowns = unknowns_of(*UNIT_NAMES)
    assert len(turn_factor(unit, path, unknowns).residual) == 3 * (INTERVALS - 1)
    # both knots that the slice lies beside
    assert len(force_factor(unit, path, unknowns).residual) == 3 * (INTERVALS - 1 - 2)


# Anchors ---------------------------------------------------------------------------------------------------------------


def positions() -> Positions:
    """Five fixes a second, off by something."""
    seconds = np.arange(0.03, INTERVALS * H, 0.2)
    place = position_at(seconds) + frames.mat_from_quat(attitude_at(seconds)) @ LEVER
    off = np.random.default_rng(3).normal(size=place.shape)
    time_ns = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    return Positions(time_ns, place + off, np.full(place.shape, 2.0), LEVER, np.array([60.0, 60.0, 300.0]), 0.1)


def attitudes(noise_rad: float = 0.01) -> Attitudes:
    seconds = np.arange(0.01, INTERVALS * H, 0.1)
    quat = frames.quat_multiply(
        attitude_at(seconds), np.tile(frames.quat_from_mat(MAT_SENSOR_INS[None]), (len(seconds), 1))
    )
    # the compass's error turns what it says about the vertical: true heading is to the west of what it says by that much
    heading = frames.attitude_of(frames.mat_from_quat(quat))[0]
    terms = np.stack(
        [np.ones_like(heading), np.sin(heading), np.cos(heading), np.sin(2 * heading), np.cos(2 * heading)]
    )
    turn = np.zeros((len(seconds), 3))
    turn[:, 2] = -COMPASS @ terms
    turn += np.random.default_rng(4).normal(size=turn.shape) * noise_rad
    time_ns = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    return Attitudes(time_ns, frames.quat_multiply(frames.quat_exp(turn), quat), np.deg2rad([1.0, 1.0, 2.0]), 10.0)


def position_factor(path: Path, unknowns: Unknowns) -> Factor:
    (course,) = fixes.position_factors(positions(), path, unknowns)
    return course


def test_true_positions_leave_nothing_and_their_errors_stand_in_the_residual(path: Path) -> None:
    given = positions()
    true = replace(given, position_m=position_at((given.time_ns - START_NS) * 1e-9) + frames.mat_from_quat(
        attitude_at((given.time_ns - START_NS) * 1e-9)) @ LEVER)  # fmt: skip
    (factor,) = fixes.position_factors(true, path, unknowns_of())
    # straight between grid points 5 ms apart
    assert np.abs(factor.residual).max() < 1e-4
    (moved,) = fixes.position_factors(replace(true, position_m=true.position_m - [3.0, 0.0, 0.0]), path, unknowns_of())
    assert moved.residual[0] == pytest.approx(3.0, abs=1e-4)


def test_what_positions_say_is_linear_as_stated(path: Path) -> None:
    """A correction is taken at the middle fix of a second, so the weights of single knots are another's; their sum is right."""
    unknowns = unknowns_of()
    factor = position_factor(path, unknowns)

    def residual(p: Path) -> Array:
        return position_factor(p, unknowns).residual

    assert_close(of_the_path(factor, 3).sum(axis=1), by_the_path(residual, path, 3, 1e-4).sum(axis=1), 1e-9)
    dense = factor.matrix.toarray()
    assert_close(dense[:, unknowns.names["world.shift"]], by_the_world(residual, path, "world.shift"), 1e-6)
    # the middle of a second for its mean: 0.1 s at 4 m/s, of some metres
    assert_close(dense[:, unknowns.names["world.turn"]], by_the_world(residual, path, "world.turn"), 0.1)


def test_what_attitudes_say_is_linear_as_stated(path: Path) -> None:
    unknowns, given = unknowns_of("compass", "ins.turn"), attitudes()

    def made(p: Path, mat: Array = MAT_SENSOR_INS, compass: Array = COMPASS) -> Factor:
        factor = stated_attitudes.attitude_factor(given, p, unknowns, mat, compass, "ins.turn")
        assert factor is not None
        return factor

    factor = made(path)
    # noise of 0.01 rad about the curve alone, in means of ten; a wrong sign of the curve would leave 0.2 rad
    assert np.abs(factor.residual).max() < 0.02
    dense = factor.matrix.toarray()

    def residual(p: Path) -> Array:
        return made(p).residual

    assert_close(of_the_path(factor, 0).sum(axis=1), by_the_path(residual, path, 0, 1e-5).sum(axis=1), 0.25)
    assert_close(dense[:, unknowns.names["world.turn"]], by_the_world(residual, path, "world.turn"), 0.25)
    columns = [
        (made(path, compass=COMPASS + s).residual - made(path, compass=COMPASS - s).residual) / 2e-5
        for s in 1e-5 * np.eye(5)
    ]
    assert_close(dense[:, unknowns.names["compass"]], np.array(columns).T, 1e-9)
    columns = [
        (made(path, turned(s) @ MAT_SENSOR_INS).residual - made(path, turned(-s) @ MAT_SENSOR_INS).residual) / 2e-5
        for s in 1e-5 * np.eye(3)
    ]
    assert_close(dense[:, unknowns.names["ins.turn"]], np.array(columns).T, 0.25)


def test_what_a_tie_says_is_linear_as_stated(path: Path) -> None:
    rng, unknowns = np.random.default_rng(5), unknowns_of()
    quat, place = path.quat[: 5 * STEPS : STEPS], path.position_m[: 5 * STEPS : STEPS]
    tie = Tie(
        frames.quat_multiply(quat, frames.quat_exp(1e-3 * rng.normal(size=(5, 3)))),
        place + rng.normal(size=(5, 3)),
        rng.uniform(0.0, 1e-4, (5, 3)),
    )

    def residual(p: Path) -> Array:
        return tie_factor(tie, p, unknowns).residual

    factor = tie_factor(tie, path, unknowns)
    assert len(factor.residual) == 30
    for offset, share in ((0, 2e-3), (3, 1e-6)):
        assert_close(of_the_path(factor, offset), by_the_path(residual, path, offset, 1e-5), share)


def test_a_tie_tells_no_more_of_a_speed_than_a_window_whose_end_walks_away(path: Path) -> None:
    """Along a street the end of a window is bent by decimetres a second, and two hundred poses of it share that one error."""
    count, rate_m2_s = 12, 0.05
    unknowns, time_s = unknowns_of(), H * np.arange(count)
    quat, place = path.quat[: count * STEPS : STEPS], path.position_m[: count * STEPS : STEPS]
    walk_m2 = np.tile(rate_m2_s * time_s[:, None], 3)

    def speed_sigma(walk: Array) -> float:
        sigma = tie_factor(Tie(quat, place, walk), path, unknowns).sigma.reshape(count, 6)[:, 3]
        return float(np.square(time_s / sigma).sum() ** -0.5)

    # what a random walk that is looked at all the way along leaves of a constant speed
    covariance = rate_m2_s * np.minimum(time_s[1:, None], time_s[1:])
    honest = float((time_s[1:] @ np.linalg.solve(covariance, time_s[1:])) ** -0.5)
    assert honest < speed_sigma(walk_m2) < 2.0 * honest
    # and where the lidar holds the way, the two agree to a centimetre at each pose
    assert speed_sigma(np.zeros((count, 3))) == pytest.approx(0.01 / np.sqrt(np.square(time_s).sum()))


def test_a_delay_of_positions_and_attitudes_is_linear_as_stated(path: Path) -> None:
    """Stamps late by some milliseconds: rows follow differences of their own residual; a delay that is held is no column."""
    step_s = 2e-3

    def residuals(delay_s: float) -> tuple[Array, Array]:
        clock = Clock("late", 0.1, np.array([delay_s]))
        (course,) = fixes.position_factors(positions(), path, unknowns_of("late"), 0, clock)
        turn = stated_attitudes.attitude_factor(
            attitudes(0.0), path, unknowns_of("compass", "late"), MAT_SENSOR_INS, COMPASS, None, clock
        )
        assert turn is not None
        return course.residual, turn.residual

    clock, unknowns = Clock("late", 0.1), Unknowns(INTERVALS)
    for name, size in (("world.turn", 3), ("world.shift", 3), ("compass", 5)):
        unknowns.add(name, np.ones(size))
    size = unknowns.size
    clock.unknowns(unknowns)
    Clock("held").unknowns(unknowns)
    assert unknowns.size == size + 1
    (course,) = fixes.position_factors(positions(), path, unknowns, 0, clock)
    turn = stated_attitudes.attitude_factor(attitudes(0.0), path, unknowns, MAT_SENSOR_INS, COMPASS, None, clock)
    assert turn is not None
    for factor, ahead, behind in zip((course, turn), residuals(step_s), residuals(-step_s), strict=True):
        stated = factor.matrix.toarray()[:, unknowns.names["late"]][:, 0]
        # rates over 25 ms of a motion of 4 rad/s, and a compass that turns with the heading
        assert_close(stated, (ahead - behind) / (2 * step_s), 0.1)


def test_too_few_observations_are_none(path: Path) -> None:
    far = replace(positions(), time_ns=positions().time_ns + 10**12)
    assert fixes.position_factors(far, path, unknowns_of()) == []
    late = replace(attitudes(), time_ns=attitudes().time_ns + 10**12)
    assert stated_attitudes.attitude_factor(late, path, unknowns_of("compass"), np.eye(3), COMPASS, None) is None


# Noise -----------------------------------------------------------------------------------------------------------------


def test_fixes_that_stand_apart_do_not_say_where_the_whole_lies() -> None:
    """Ten of sixty seconds 30 m off, as beside a wall, move the plain mean by 5 m."""
    time_s = np.arange(60.0)
    lasting = 1.5 * np.stack([np.sin(time_s / 12.0), np.cos(time_s / 15.0), np.sin(time_s / 20.0 + 1.0)], axis=1)
    sigma = np.full((60, 3), 2.5)
    weights = fixes.mean_weights(lasting, sigma)
    np.testing.assert_allclose(weights, 1.0 / 60.0)  # errors that last are all right: the mean is the plain one
    astray = lasting.copy()
    astray[20:30] += [30.0, 0.0, -10.0]
    weights = fixes.mean_weights(astray, sigma)
    assert not weights[20:30].any()
    np.testing.assert_allclose((weights * astray).sum(axis=0), np.delete(lasting, np.s_[20:30], axis=0).mean(axis=0))


def gauss_markov(time_s: Array, sigma: float, tau_s: float) -> Array:
    return np.asarray(sigma**2 * np.exp(-np.abs(time_s[:, None] - time_s) / tau_s))


def test_whitened_errors_have_the_likelihood_of_the_process() -> None:
    """Without white noise differences are independent exactly: the log-likelihood is that of the dense covariance, and its gradient too."""
    rng, time_s = np.random.default_rng(6), np.cumsum(np.random.default_rng(7).uniform(0.5, 3.0, 15))
    residual, matrix = rng.normal(size=(15, 2)), rng.normal(size=(30, 4))
    unknowns = Unknowns(0)
    unknowns.add("x", np.ones(4))
    builder = RowBuilder(30, unknowns)
    builder.by(2 * np.arange(15), "x", matrix.reshape(15, 2, 4))
    sparse = builder.matrix()[:, unknowns.path_size :]
    factor = whitened("x", residual, sparse, time_s, np.full((15, 2), 2.0), np.array([60.0, 5.0]), 0.0)
    dense = [gauss_markov(time_s, 2.0, tau) for tau in (60.0, 5.0)]
    expected = sum(multivariate_normal(np.zeros(15), dense[c]).logpdf(residual[:, c]) for c in range(2))
    whole = -0.5 * np.square(factor.residual / factor.sigma).sum() - np.log(factor.sigma * np.sqrt(2 * np.pi)).sum()
    assert whole == pytest.approx(expected, rel=1e-9)
    information = sum(matrix[c::2].T @ np.linalg.solve(dense[c], matrix[c::2]) for c in range(2))
    weighed = factor.matrix.toarray() / factor.sigma[:, None]
    np.testing.assert_allclose(weighed.T @ weighed, information, rtol=1e-9)


def test_white_noise_on_top_costs_at_most_some_of_the_information() -> None:
    """Then differences of neighbours share an error, which is neglected: the information on a constant stays within a fifth."""
    time_s = np.arange(60.0)
    unknowns = Unknowns(0)
    unknowns.add("x", np.ones(3))
    builder = RowBuilder(180, unknowns)
    builder.by(3 * np.arange(60), "x", eye(60))
    matrix = builder.matrix()[:, unknowns.path_size :]
    factor = whitened("x", np.zeros((60, 3)), matrix, time_s, np.full((60, 3), 2.0), np.full(3, 60.0), 0.1)
    weighed = factor.matrix.toarray() / factor.sigma[:, None]
    stated = (weighed.T @ weighed)[0, 0]
    dense = gauss_markov(time_s, 2.0, 60.0) + 0.01 * np.eye(60)
    assert stated == pytest.approx(np.ones(60) @ np.linalg.solve(dense, np.ones(60)), rel=0.2)


def test_normal_equations_are_those_of_the_whitened_rows(path: Path, unit: Unit) -> None:
    unknowns = unknowns_of(*UNIT_NAMES, "compass")
    unknowns.value["compass"] = COMPASS
    factors = [
        turn_factor(unit, path, unknowns), force_factor(unit, path, unknowns), position_factor(path, unknowns),
        prior_factor(unknowns),
    ]  # fmt: skip
    rows = np.concatenate([f.matrix.toarray() / f.sigma[:, None] for f in factors])
    right = np.concatenate([f.residual / f.sigma for f in factors])
    normal, gradient = normal_equations(factors)
    np.testing.assert_allclose(normal.toarray(), rows.T @ rows, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(gradient, rows.T @ right, rtol=1e-9, atol=1e-6)
    # the prior pulls back what has been taken off already
    np.testing.assert_allclose(factors[-1].residual[unknowns.names["compass"]], COMPASS)
