"""The smoother against dense least squares with numerical derivatives, and the pieces around it against outside values."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from groundproc.estimation.inertial import imu, kalman
from groundproc.estimation.inertial.imu import Samples
from groundproc.estimation.inertial.readings import normal_gravity, pressure_height
from groundproc.estimation.inertial.transition import Motion, backward_rows, forward_rows
from groundproc.estimation.observations.states import (
    ATTITUDE,
    FIX_POSITION,
    FIX_VELOCITY,
    FORCE_BIAS,
    FORCE_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    HEADING,
    OUTSIDE,
    STATES,
    TILT,
    Model,
    start_covariance,
)

Array = npt.NDArray[np.float64]
NODES, STEP_S, GRAVITY = 25, 0.05, 9.81
KEEP = (0.97, 0.05, 0.8, 0.9, 0.95, 0.85)


def turned(quat: Array) -> Rotation:
    return Rotation.from_quat(np.roll(quat, -1, axis=-1))


def advanced(position: Array, velocity: Array, turn: Rotation, slow: Array, angle: Array, push: Array) -> Any:
    """One step of strapdown navigation with errors of the sensors, from textbook equations."""
    matrix = slow[GYRO_MATRIX - 9 : GYRO_MATRIX].reshape(3, 3)
    true_angle = angle - STEP_S * slow[GYRO_BIAS - 9 : GYRO_BIAS - 6] - matrix @ angle
    force_matrix = slow[FORCE_MATRIX - 9 : FORCE_MATRIX].reshape(3, 3)
    true_push = push - STEP_S * slow[FORCE_BIAS - 9 : FORCE_BIAS - 6] - force_matrix @ push
    # gyro readings of the step's middle turn the force as the filter has it: with the angle as read
    halfway = turn * Rotation.from_rotvec(0.5 * angle)
    gained = halfway.apply(true_push) + np.array([0.0, 0.0, -GRAVITY * STEP_S])
    middle = halfway * Rotation.from_rotvec(true_angle - angle) * halfway.inv()
    after = middle * turn * Rotation.from_rotvec(angle)
    slow = slow.copy()
    fix, drift = slice(FIX_POSITION - 9, FIX_POSITION - 6), slice(FIX_VELOCITY - 9, FIX_VELOCITY - 6)
    slow[fix] = KEEP[0] * slow[fix] + KEEP[1] * slow[drift]
    slow[drift] *= KEEP[2]
    slow[TILT - 9 : TILT - 7] *= KEEP[3]
    slow[HEADING - 9] *= KEEP[4]
    slow[OUTSIDE - 9 : OUTSIDE - 6] *= KEEP[5]
    return position + STEP_S * (velocity + 0.5 * gained), velocity + gained, after, slow


def transition(reference: tuple[Array, Array, Array], k: int, angle: Array, push: Array) -> tuple[Array, Array]:
    """Numerical derivative of a step and what the reference misses it by."""
    position, velocity, quat = reference
    base, after = turned(quat[k]), turned(quat[k + 1])

    def stepped(error: Array) -> Array:
        turn = Rotation.from_rotvec(error[6:9]) * base
        p, v, r, s = advanced(position[k] + error[:3], velocity[k] + error[3:6], turn, error[9:], angle, push)
        return np.concatenate([p - position[k + 1], v - velocity[k + 1], (r * after.inv()).as_rotvec(), s])

    missed = stepped(np.zeros(STATES))
    size = 1e-4
    # about a reference that obeys the step, so that the logarithm's own curvature is not in it
    columns = [(stepped(size * e) - stepped(-size * e)) / (2 * size) for e in np.eye(STATES)]
    return np.stack(columns, axis=1), missed


def problem(seed: int) -> Any:
    """A small random flight whose reference nearly obeys the equations of motion, and random measurements."""
    rng = np.random.default_rng(seed)
    angle, push = 0.02 * rng.standard_normal((NODES - 1, 3)), 0.5 * rng.standard_normal((NODES - 1, 3))
    push[:, 2] += GRAVITY * STEP_S
    position, velocity = np.zeros((NODES, 3)), np.zeros((NODES, 3))
    velocity[0] = rng.standard_normal(3)
    turns = [Rotation.random(random_state=seed)]
    for k in range(NODES - 1):
        p, v, r, _ = advanced(position[k], velocity[k], turns[k], np.zeros(STATES - 9), angle[k], push[k])
        position[k + 1] = p + 1e-3 * rng.standard_normal(3)
        velocity[k + 1] = v + 1e-3 * rng.standard_normal(3)
        turns.append(Rotation.from_rotvec(1e-4 * rng.standard_normal(3)) * r)
    quat = np.roll(np.stack([r.as_quat() for r in turns]), 1, axis=1)
    each = 2
    index = np.stack([rng.choice(STATES, 4, replace=False) for _ in range(NODES * each)])
    value = rng.standard_normal(index.shape)
    measured, variance = 0.01 * rng.standard_normal(len(index)), rng.uniform(1e-4, 1e-2, len(index))
    rows = (np.full(len(index), 4), index, value, measured, variance)
    return (position, velocity, quat), angle, push, np.arange(0, NODES * each + 1, each), rows


@pytest.mark.parametrize("block", [7, 400])
def test_the_smoother_is_least_squares(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    reference, angle, push, first, rows = problem(block)
    rng = np.random.default_rng(1)
    drive = rng.uniform(1e-4, 1e-2, STATES)
    drive[:9] = 0.0
    densities = np.full(NODES - 1, 1e-4), np.full(NODES - 1, 1e-2)
    start, covariance = 0.01 * rng.standard_normal(STATES), np.diag(rng.uniform(1e-3, 1e-1, STATES))
    correction, residual = np.empty((NODES, 9)), np.empty(len(rows[3]))
    kept, variance, kept_covariance = (
        np.empty((NODES, STATES)),
        np.empty((NODES, STATES)),
        np.empty((NODES, 9, 9), np.float32),
    )
    monkeypatch.setattr(kalman, "BLOCK", block)
    if block != 400:  # into this one kernel the constant is compiled
        monkeypatch.setattr(kalman, "_forward", kalman._forward.py_func)
    keep = np.tile(KEEP, (NODES - 1, 1))
    # arrays laid out as the method's own are: for others the whole smoother would be compiled once more
    step_s = np.full(NODES - 1, STEP_S)
    motion = Motion(*reference, step_s, angle, push, push, *densities, GRAVITY, keep, drive)
    out = kalman.Smoothed(1, correction, residual, kept, kept_covariance, variance)
    kalman.smooth(motion, kalman.Rows(first, *rows), start, covariance, out)
    # all states of all nodes as one Gaussian vector, conditioned on all measurements at once
    noise = drive * STEP_S
    noise[3:6], noise[6:9] = densities[1][0] * STEP_S, densities[0][0] * STEP_S
    size = NODES * STATES
    mean, joint = np.zeros(size), np.zeros((size, size))
    mean[:STATES], joint[:STATES, :STATES] = start, covariance
    for k in range(NODES - 1):
        now, then = slice(k * STATES, (k + 1) * STATES), slice((k + 1) * STATES, (k + 2) * STATES)
        matrix, missed = transition(reference, k, angle[k], push[k])
        mean[then] = matrix @ mean[now] + missed
        past = matrix @ joint[now, : now.stop]
        joint[then, : now.stop], joint[: now.stop, then] = past, past.T
        joint[then, then] = matrix @ joint[now, now] @ matrix.T + np.diag(noise)
    lines = np.zeros((len(rows[3]), size))
    for k in range(NODES):
        for row in range(first[k], first[k + 1]):
            lines[row, k * STATES + rows[1][row]] = rows[2][row]
    gain = np.linalg.solve(lines @ joint @ lines.T + np.diag(rows[4]), lines @ joint).T
    expected = (mean + gain @ (rows[3] - lines @ mean)).reshape(NODES, STATES)
    sigma = np.sqrt(np.diag(joint - gain @ lines @ joint)).reshape(NODES, STATES)
    # derivatives of the filter are of first order in the angles of a step, 0.02 rad
    assert np.abs(kept - expected).max() < 0.02 * np.abs(expected).max()
    assert (np.abs(kept - expected) / sigma).max() < 0.05
    assert np.abs(np.sqrt(variance) / sigma - 1.0).max() < 0.02
    whole = joint - gain @ lines @ joint
    poses = np.stack([whole[k * STATES : k * STATES + 9, k * STATES : k * STATES + 9] for k in range(NODES)])
    each = sigma[:, :9, None] * sigma[:, None, :9]
    assert np.abs((kept_covariance - poses) / each).max() < 0.03
    np.testing.assert_array_equal(correction, kept[:, :9])


def test_the_adjoint_keeps_its_digits_over_a_measurement_far_better_than_what_was_known() -> None:
    """1 cm where 300 m were known: the covariance before it is P - P N P, and P is 9e4 m2 against some 1e-4 m2 that are sought."""
    rng = np.random.default_rng(3)
    state = np.array([0, 1, ATTITUDE])
    value = np.array([100.0, 3.0, -30.0])
    half = 1000.0 * rng.standard_normal((STATES, STATES))
    after = half @ half.T / STATES
    known = np.diag(np.square(np.r_[np.full(3, 300.0), np.full(STATES - 3, 0.1)]))
    # north is known from the row before it, as rows are made independent of each other one by one
    known[1, 1] = 1e-4
    known[0, 3] = known[3, 0] = 5.0
    row = np.zeros(STATES)
    row[state] = value
    spread = float(row @ known @ row) + 1.0
    gain = known @ row / spread
    none, alone = np.zeros(1), np.zeros(1, np.int64)
    rows = kalman.Rows(alone, np.array([3]), state[None], value[None], none, np.ones(1))
    tape = kalman.Tape(none, none, gain[None], none, np.array([spread]))
    found = after.copy()
    kalman._undo(0, rows, 0, tape, np.zeros(STATES), found, np.empty(STATES))

    exact = np.vectorize(Fraction, otypes=[object])
    left = exact(np.eye(STATES)) - np.outer(exact(gain), exact(row))
    true = left.T @ exact(after) @ left + np.outer(exact(row), exact(row)) / Fraction(spread)
    off = (exact(found) - true).astype(np.float64)
    assert np.array_equal(found, found.T)
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-15 * np.abs(after).max())
    # a tenth of what is sought of the position east
    assert abs(off[0, 0]) * known[0, 0] ** 2 < 1e-5


def test_forward_and_backward_transitions_are_each_others_transposes() -> None:
    rng = np.random.default_rng(0)
    couple, keep = rng.standard_normal((6, 3)), rng.uniform(0.5, 1.0, 6)
    forward, backward = np.eye(STATES), np.eye(STATES)
    forward_rows(forward, 0.3, couple, keep)
    backward_rows(backward, 0.3, couple, keep)
    np.testing.assert_allclose(backward, forward.T, rtol=0, atol=1e-14)


def test_the_start_knows_nothing_of_position_and_heading() -> None:
    covariance = start_covariance(Model(), np.array([3.0, 3.0, 4.5]), linked=True, outside_sigma_m=np.full(3, 0.02))
    sigma = np.sqrt(np.diag(covariance))
    assert (sigma > 0).all()
    assert sigma[0] >= 100.0
    assert sigma[ATTITUDE + 2] >= np.pi / 2


def test_normal_gravity_and_standard_atmosphere() -> None:
    # NIMA TR8350.2: equator, pole, and 45 deg
    assert normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-9)
    assert normal_gravity(90.0, 0.0) == pytest.approx(9.8321849379, abs=1e-8)
    assert normal_gravity(45.0, 1000.0) == pytest.approx(9.806199 - 0.003086, abs=2e-5)
    # ICAO standard atmosphere (Doc 7488): 1000 m and 3000 m
    np.testing.assert_allclose(
        pressure_height(np.array([1013.25, 898.746, 701.085])), [0.0, 1000.0, 3000.0], rtol=0, atol=0.5
    )


class TestTwoImus:
    """A fast noisy sensor in other axes and a slow good one."""

    MATRIX = Rotation.from_euler("xyz", [-20.0, 1.0, 3.0], degrees=True).as_matrix()

    def rates(self, time_s: Array) -> Array:
        return np.stack(
            [0.4 * np.sin(2.1 * time_s), 0.3 * np.sin(3.7 * time_s + 1), 0.5 * np.sin(1.3 * time_s + 2)], axis=1
        )

    def samples(self, noise: float, sign: float = 1.0) -> tuple[Samples, Samples, Array]:
        rng = np.random.default_rng(3)
        fast_s = np.cumsum(rng.uniform(0.0013, 0.0087, 12000))
        slow_s = np.arange(0.0, 59.0, 0.04)
        axes = np.diag([1.0, 1.0, sign])
        fast = self.rates(fast_s) @ self.MATRIX @ axes + np.array([-0.4, -0.1, -0.2])
        fast += noise * rng.standard_normal(fast.shape)
        slow = self.rates(slow_s) + 0.002 * rng.standard_normal((len(slow_s), 3))
        return Samples("slow", slow_s, slow), Samples("fast", fast_s, fast), np.arange(0.0, 58.0, 0.005)

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_axes_signs_and_offsets_are_found(self, sign: float) -> None:
        slow, fast, nodes_s = self.samples(0.02, sign)
        prior = self.MATRIX @ np.diag([1.0, 1.0, sign]) @ Rotation.from_euler("z", 1.0, degrees=True).as_matrix()
        signal = imu.combine(nodes_s, slow, fast, prior, 0.03)
        assert signal is not None
        assert signal.alignment is not None
        np.testing.assert_allclose(signal.alignment.matrix, self.MATRIX @ np.diag([1.0, 1.0, sign]), rtol=0, atol=3e-3)
        error = signal.mean - self.rates(nodes_s[:-1] + 0.0025)
        # what the integral gathers in ten seconds is what the stated density allows
        gathered = np.diff(np.cumsum(error - error.mean(axis=0), axis=0)[::2000] * 0.005, axis=0)
        assert np.abs(gathered).max() < 4.0 * np.sqrt(np.median(signal.density) * 10.0)
        assert 0.5 < signal.share <= 1.0

    def test_noise_density_of_white_noise(self) -> None:
        _, fast, _ = self.samples(0.02)
        density = imu.noise_density(fast, np.linspace(10.0, 50.0, 9))
        np.testing.assert_allclose(density, 0.02**2 * 0.005, rtol=0.3)

    def test_vibration_of_accelerometers_is_no_white_noise(self) -> None:
        """Rotors shake by 1.5 m/s^2 at 23 Hz and the lidar's own at 10 Hz; the sensor's noise is 0.15.

        Taken for white, the vibration made the matrix 1.2 times too large, and the slow sensor, of three times the noise, was followed.
        """
        rng = np.random.default_rng(4)
        fast_s, slow_s = np.cumsum(rng.uniform(0.0013, 0.0087, 12000)), np.arange(0.0, 59.0, 0.01)
        nodes_s = np.arange(0.0, 58.0, 0.005)

        def felt(time_s: Array) -> Array:
            push = np.stack(
                [0.4 * np.sin(0.9 * time_s), 0.5 * np.sin(0.7 * time_s + 1), 9.8 + 0.3 * np.sin(1.1 * time_s + 2)],
                axis=1,
            )
            shaken = 1.5 * np.sin(2 * np.pi * (23.0 + np.sin(0.3 * time_s)) * time_s) + 0.4 * np.sin(
                20 * np.pi * time_s
            )
            return np.asarray(push + shaken[:, None])

        fast = felt(fast_s) @ self.MATRIX + 0.15 * rng.standard_normal((len(fast_s), 3))
        slow = felt(slow_s) + 0.6 * rng.standard_normal((len(slow_s), 3))
        still = np.zeros((len(nodes_s) - 1, 3))
        samples = Samples("slow", slow_s, slow), Samples("fast", fast_s, fast)
        signal = imu.combine(nodes_s, *samples, self.MATRIX, 0.02, rate_rad_s=still, lever_m=np.zeros(3))
        assert signal is not None
        assert signal.alignment is not None
        # noise of the slow one over the motion, in as many samples: 0.6 / 0.3 / sqrt(6000)
        np.testing.assert_allclose(signal.alignment.matrix, self.MATRIX, rtol=0, atol=3 * 0.026)
        # the lidar's noise is 1/32 of the other's over twice as many samples
        assert signal.share < 0.3
        # samples 1.3 to 8.7 ms apart stand for 5.9 ms on average; between them the vibration is not quite met
        assert np.median(signal.density) == pytest.approx(0.15**2 * 0.0059 * (1.0 - signal.share), rel=0.4)

    def test_motion_too_fast_for_the_samples_counts_as_noise(self) -> None:
        time_s = np.arange(0.0, 60.0, 0.35)
        few = Samples("few", time_s, self.rates(time_s))
        assert imu.noise_density(few, np.array([30.0]))[0] > 1e-4

    def test_holes_of_the_fast_one_are_filled_by_the_slow_one(self) -> None:
        slow, fast, nodes_s = self.samples(0.02)
        there = (fast.time_s < 20.0) | (fast.time_s > 24.0)
        holed = Samples("fast", fast.time_s[there], fast.value[there])
        signal = imu.combine(nodes_s, slow, holed, self.MATRIX, 0.03)
        assert signal is not None
        assert signal.known.all()
        inside = (nodes_s[:-1] > 20.1) & (nodes_s[:-1] < 23.9)
        error = signal.mean[inside] - self.rates(nodes_s[:-1][inside] + 0.0025)
        assert np.abs(error).max() < 0.02

    def test_without_either_there_is_nothing(self) -> None:
        assert imu.combine(np.arange(0.0, 1.0, 0.01), None, None, np.eye(3), 0.01) is None


def test_the_model_is_a_value() -> None:
    assert replace(Model(), tilt_rad=0.1) != Model()
