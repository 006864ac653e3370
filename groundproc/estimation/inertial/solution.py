"""The estimate: linearise about a reference, smooth, learn the noise from what is left, and again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.estimation.inertial import kalman
from groundproc.estimation.inertial.imu import flat_low_pass
from groundproc.estimation.inertial.readings import (
    UNKNOWN_FORCE_DENSITY,
    UNKNOWN_RATE_DENSITY,
    Readings,
    drives,
    standing,
)
from groundproc.estimation.inertial.transition import Motion
from groundproc.estimation.method import Given
from groundproc.estimation.observations import measured_of
from groundproc.estimation.observations.measured import Heard, Learnt, Measured, Reference, Rows, System
from groundproc.estimation.observations.outside import lasting
from groundproc.estimation.observations.states import (
    ATTITUDE,
    BARO,
    FIX_POSITION,
    FORCE_BIAS,
    GYRO_BIAS,
    HEADING,
    OUTSIDE,
    POSE,
    POSITION,
    STATES,
    TILT,
    VELOCITY,
    Model,
    fix_velocity_sigma,
    start_covariance,
)
from groundproc.flight.timeline import Leg
from groundproc.numerics import robust
from groundproc.numerics.rotations import quat_difference_outside, quat_multiply, quat_turned_by

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

ITERATIONS: Final = 6
DONE_M: Final = 0.01
DONE_RAD: Final = np.deg2rad(0.01)
"""Corrections under which the iteration ends."""
STEADY_HZ: Final = 2.0
"""Up to here scale and misalignment of the accelerometers are taken to act: an aircraft leans and climbs as slowly, what is faster shakes
and moves nothing far."""
KEPT_NS: Final = NS_PER_S // 10
"""Spacing of the states and covariances that are kept."""
OUTLIER: Final = 4.0
"""Residuals in units of their noise from which a measurement counts less (Cauchy)."""
LONGEST_BRIDGE_S: Final = 60.0
"""Longest silence of the fixes that accelerometers bridge."""
LONGEST_BLIND_S: Final = 1.0
"""Longest silence of gyros and attitudes."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Smoothed states of one leg.

    Attributes
    ----------
    readings : Readings
    model : Model
        With what was learnt.
    time_ns : ndarray of int64, shape (n,)
        UTC of the nodes.
    position_m, velocity_m_s, quat, rate_rad_s : ndarray, shape (n, 3), (n, 3), (n, 4), (n, 3)
    covered : ndarray of bool, shape (n,)
    kept_ns : ndarray of int64, shape (k,)
        UTC of what follows.
    states : ndarray, shape (k, STATES)
        Smoothed; position, velocity and attitude are what was left to correct in the last iteration.
    covariance : ndarray of float32, shape (k, 9, 9)
        Of position, velocity and attitude.
    variance : ndarray, shape (k, STATES)
        Of all states.
    residual_rms, rows, outliers : dict of str to float or int
        By the kind of the measurement.
    stands_s : float
        How long the vehicle stood.
    driving : bool
        It goes where it points.
    iterations : int
    last_step_m, last_step_rad : float
        Largest correction of the last iteration.
    """

    readings: Readings
    model: Model
    time_ns: npt.NDArray[np.int64]
    position_m: Array
    velocity_m_s: Array
    quat: Array
    rate_rad_s: Array
    covered: Mask
    kept_ns: npt.NDArray[np.int64]
    states: Array
    covariance: npt.NDArray[np.float32]
    variance: Array
    residual_rms: dict[str, float]
    rows: dict[str, int]
    outliers: dict[str, int]
    stands_s: float
    driving: bool
    iterations: int
    last_step_m: float
    last_step_rad: float


@dataclass(frozen=True, slots=True)
class _Imu:
    """Rates and forces of each step, with those of the reference where no sensor was."""

    rate: Array
    force: Array
    rate_density: Array
    force_density: Array
    known: Mask
    force_known: Mask


def solve(
    readings: Readings, model: Model | None = None, given: Given | None = None, leg: Leg | None = None
) -> Solution:
    """Estimate one leg.

    Parameters
    ----------
    readings : Readings
    model : Model, optional
    given : Given, optional
    leg : Leg, optional
        The flight, and which part of it this is, for observations that bring something of their own.
    """
    model = Model() if model is None else model
    imu = _imu(readings)
    reference = _start(readings, imu)
    stands, driving = standing(readings), drives(readings)
    sources = measured_of(Heard(readings, stands, driving, given, leg))
    noise = {kind: learnt for source in sources for kind, learnt in source.learnt.items()}
    first = reference
    stride = max(KEPT_NS // readings.step_ns, 1)
    nodes = len(readings.nodes_s)
    slots = -(-nodes // stride)
    states, covariance = np.empty((slots, STATES)), np.empty((slots, POSE, POSE), np.float32)
    spread = np.empty((slots, STATES))
    weight: Array | None = None
    moved = (np.inf, np.inf)
    iteration = 0
    system = _system(sources, readings, reference, imu.rate, model)
    residual = np.zeros(len(system.measured))
    while iteration < ITERATIONS:
        iteration += 1
        if iteration > 1:
            system = _system(sources, readings, reference, imu.rate, model)
        variance = system.variance if weight is None else system.variance / weight
        correction = _smooth(
            readings,
            model,
            imu,
            reference,
            first,
            replace(system, variance=variance),
            stride,
            residual,
            states,
            covariance,
            spread,
        )
        reference = _corrected(reference, correction)
        moved = (
            float(np.abs(correction[:, POSITION : POSITION + 3]).max()),
            float(np.abs(correction[:, ATTITUDE : ATTITUDE + 3]).max()),
        )
        if iteration >= 3 and moved[0] < DONE_M and moved[1] < DONE_RAD:
            break
        if iteration < ITERATIONS:
            if iteration <= 3:
                model = _learnt(model, noise, system, residual, states, spread)
            weight = robust.cauchy(residual / _noise(noise, system, model) / OUTLIER)
    return _solution(
        readings,
        model,
        imu,
        reference,
        states,
        covariance,
        spread,
        system,
        residual,
        weight,
        stands,
        driving,
        iteration,
        moved,
        stride,
    )


def _imu(r: Readings) -> _Imu:
    """Where no gyro was, the attitudes' own differences; where no accelerometer was, the velocities'."""
    steps = len(r.nodes_s) - 1
    middle = 0.5 * (r.nodes_s[1:] + r.nodes_s[:-1])
    left = np.clip(np.searchsorted(r.attitude_s, middle) - 1, 0, len(r.attitude_s) - 2)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(r.quat[:-1]), r.quat[1:]))
    rate = (turn / np.diff(r.attitude_s)[:, None])[left]
    rate_density = np.full(steps, UNKNOWN_RATE_DENSITY)
    known = np.zeros(steps, np.bool_)
    if r.gyro is not None:
        known = r.gyro.known
        rate = np.where(known[:, None], r.gyro.mean, rate)
        rate_density = np.where(known, r.gyro.density, rate_density)
        # a lidar whose gyro nothing has been compared with may be off by tens of degrees a second
        if r.gyro.share == 0.0:
            rate = rate - np.where(
                known[:, None],
                np.median((r.gyro.mean - (turn / np.diff(r.attitude_s)[:, None])[left])[known], axis=0),
                0.0,
            )
    force = np.zeros((steps, 3))
    force_known = np.zeros(steps, np.bool_)
    force_density = np.full(steps, UNKNOWN_FORCE_DENSITY)
    if r.force is not None:
        force_known = r.force.known
        force = np.where(force_known[:, None], r.force.mean, 0.0)
        force_density = np.where(force_known, r.force.density, force_density)
    return _Imu(rate, force, rate_density, force_density, known, force_known)


def _start(r: Readings, imu: _Imu) -> Reference:
    """The autopilot's own solution on the nodes, its attitudes joined by the gyros."""
    position = np.stack([np.interp(r.nodes_s, r.fix_s, axis) for axis in r.fix_m.T], axis=1)
    if r.fix_velocity_m_s is not None and np.isfinite(r.fix_velocity_m_s).all():
        velocity = np.stack([np.interp(r.nodes_s, r.fix_s, axis) for axis in r.fix_velocity_m_s.T], axis=1)
    else:
        velocity = np.gradient(position, r.step_ns * 1e-9, axis=0)
    place = np.clip(np.rint(r.attitude_s / (r.step_ns * 1e-9)).astype(np.int64), 0, len(r.nodes_s) - 1)
    keep = np.diff(place, prepend=-1) > 0
    quat = np.empty((len(r.nodes_s), 4))
    _join(imu.rate * (r.step_ns * 1e-9), place[keep], r.quat[keep], quat)
    position = position - frames.mat_from_quat(quat) @ r.lever_m
    return Reference(position, velocity, quat)


@njit(cache=True, nogil=True)
def _join(angle: Array, place: npt.NDArray[np.int64], given: Array, out: Array) -> None:
    """Attitudes on nodes: turned on from each given one by the gyros, what is missed at the next one spread evenly before it."""
    nodes = len(out)
    missed, part, unit = np.empty(3), np.empty(4), np.array([1.0, 0.0, 0.0, 0.0])
    out[place[0]] = given[0]
    for k in range(place[0] - 1, -1, -1):
        quat_turned_by(out[k + 1], angle[k], -1.0, out[k])
    for i in range(len(place)):
        low = place[i]
        high = place[i + 1] if i + 1 < len(place) else nodes - 1
        out[low] = given[i]
        for k in range(low, high):
            quat_turned_by(out[k], angle[k], 1.0, out[k + 1])
        if i + 1 == len(place):
            break
        quat_difference_outside(given[i + 1], out[high], missed)
        for k in range(low + 1, high):
            quat_turned_by(unit, missed, (k - low) / (high - low), part)
            quat_multiply(part, out[k], out[k])


def _smooth(
    r: Readings,
    model: Model,
    imu: _Imu,
    reference: Reference,
    first: Reference,
    system: System,
    stride: int,
    residual: Array,
    states: Array,
    covariance: npt.NDArray[np.float32],
    spread: Array,
) -> Array:
    """One step: corrections of the reference's position, velocity and attitude, shape (n, 9)."""
    step_s = np.diff(r.nodes_s)
    fix_sigma = np.median(r.fix_sigma_m, axis=0)
    drive = np.zeros(STATES)
    drive[GYRO_BIAS : GYRO_BIAS + 3] = model.gyro_bias_walk**2
    drive[FORCE_BIAS : FORCE_BIAS + 3] = model.force_bias_walk**2
    if not r.linked:
        drive[FIX_POSITION : FIX_POSITION + 3] = 2.0 * fix_sigma**2 / model.fix_tau_s
    drive[FIX_POSITION + 3 : FIX_POSITION + 6] = (
        2.0 * fix_velocity_sigma(model, fix_sigma, r.linked) ** 2 / model.fix_velocity_tau_s
    )
    drive[TILT : TILT + 2] = 2.0 * model.tilt_rad**2 / model.tilt_tau_s
    drive[HEADING] = 2.0 * model.heading_rad**2 / model.heading_tau_s
    drive[BARO] = model.baro_walk**2
    outside_sigma_m, outside_tau_s = lasting(r.outside)
    drive[OUTSIDE : OUTSIDE + 3] = 2.0 * outside_sigma_m**2 / outside_tau_s
    keep = np.stack(
        [
            np.exp(-step_s / model.fix_tau_s),
            step_s if r.linked else np.zeros_like(step_s),
            np.exp(-step_s / model.fix_velocity_tau_s),
            np.exp(-step_s / model.tilt_tau_s),
            np.exp(-step_s / model.heading_tau_s),
            np.exp(-step_s / outside_tau_s),
        ],
        axis=1,
    )
    # where no accelerometer was, the velocity goes on as the reference has it
    lift = np.array([0.0, 0.0, r.gravity_m_s2])
    force = imu.force.copy()
    lost = np.flatnonzero(~imu.force_known)
    gained = np.diff(reference.velocity_m_s, axis=0)[lost] / step_s[lost, None] + lift
    force[lost] = np.einsum("nji,nj->ni", frames.mat_from_quat(reference.quat[lost]), gained)
    steady = flat_low_pass(force, STEADY_HZ, 1.0 / float(np.median(step_s)))
    start = np.zeros(STATES)
    start[POSITION : POSITION + 3] = first.position_m[0] - reference.position_m[0]
    start[VELOCITY : VELOCITY + 3] = first.velocity_m_s[0] - reference.velocity_m_s[0]
    start[ATTITUDE : ATTITUDE + 3] = frames.quat_log(
        frames.quat_multiply(first.quat[0], frames.quat_inverse(reference.quat[0]))
    )
    correction = np.empty((len(r.nodes_s), POSE))
    motion = Motion(
        reference.position_m, reference.velocity_m_s, reference.quat, step_s, imu.rate * step_s[:, None], force * step_s[:, None],
        steady * step_s[:, None], imu.rate_density, imu.force_density, r.gravity_m_s2, keep, drive,
    )  # fmt: skip
    out = kalman.Smoothed(stride, correction, residual, states, covariance, spread)
    kalman.smooth(
        motion,
        kalman.Rows(system.first, system.count, system.index, system.value, system.measured, system.variance),
        start,
        start_covariance(model, fix_sigma, r.linked, outside_sigma_m),
        out,
    )
    return correction


def _corrected(reference: Reference, correction: Array) -> Reference:
    quat = frames.quat_multiply(frames.quat_exp(correction[:, ATTITUDE : ATTITUDE + 3]), reference.quat)
    return Reference(
        reference.position_m + correction[:, POSITION : POSITION + 3],
        reference.velocity_m_s + correction[:, VELOCITY : VELOCITY + 3],
        quat / np.linalg.norm(quat, axis=1, keepdims=True),
    )


def _system(sources: Sequence[Measured], r: Readings, reference: Reference, rates: Array, model: Model) -> System:
    """The rows of all observations about a reference."""
    rows = Rows(reference, rates, model, r.nodes_s, r.step_ns)
    for source in sources:
        source.rows(rows)
    return rows.system()


def _noise(learnt: Mapping[str, Learnt], system: System, model: Model) -> Array:
    """Sigma of each row's noise by the model; as stated where none is learnt."""
    sigma = np.sqrt(system.variance)
    for kind, each in learnt.items():
        sigma[system.of(kind)] = getattr(model, each.field)
    return np.asarray(sigma)


def _learnt(
    model: Model, noise: Mapping[str, Learnt], system: System, residual: Array, states: Array, variance: Array
) -> Model:
    """White noise from the residuals' median, and the size of the correlated errors from the states themselves (expectation step)."""
    changed: dict[str, Any] = {}
    for kind, each in noise.items():
        chosen = residual[system.of(kind)]
        if len(chosen) >= 50:
            changed[each.field] = float(np.clip(robust.sigma(chosen, 0.0), each.least, each.most))
    for name, part, least, most in (
        ("tilt_rad", slice(TILT, TILT + 2), np.deg2rad(0.2), np.deg2rad(10.0)),
        ("heading_rad", slice(HEADING, HEADING + 1), np.deg2rad(0.3), np.deg2rad(20.0)),
    ):
        expected = np.square(states[:, part]) + variance[:, part]
        changed[name] = float(np.clip(np.sqrt(expected.mean()), least, most))
    return replace(model, **changed)


def _solution(
    r: Readings,
    model: Model,
    imu: _Imu,
    reference: Reference,
    states: Array,
    covariance: npt.NDArray[np.float32],
    variance: Array,
    system: System,
    residual: Array,
    weight: Array | None,
    stands: Mask,
    driving: bool,
    iterations: int,
    moved: tuple[float, float],
    stride: int,
) -> Solution:
    time_ns = r.start_ns + np.arange(len(r.nodes_s), dtype=np.int64) * r.step_ns
    kept_ns = time_ns[::stride]
    # the rate at a node is the mean of the steps at both sides, less the bias
    bias = np.stack([np.interp(time_ns, kept_ns, states[:, GYRO_BIAS + i]) for i in range(3)], axis=1)
    rate = np.concatenate([imu.rate[:1], 0.5 * (imu.rate[1:] + imu.rate[:-1]), imu.rate[-1:]]) - bias
    rms, count, outliers = {}, {}, {}
    for number, kind in enumerate(system.kinds):
        chosen = system.kind == number
        if chosen.any():
            rms[kind] = float(np.sqrt(np.mean(residual[chosen] ** 2)))
            count[kind] = int(chosen.sum())
            outliers[kind] = 0 if weight is None else int((weight[chosen] < 0.5).sum())
    return Solution(
        r,
        model,
        time_ns,
        reference.position_m,
        reference.velocity_m_s,
        reference.quat,
        rate,
        _covered(r, imu),
        kept_ns,
        states,
        covariance,
        variance,
        rms,
        count,
        outliers,
        float(stands.sum() * r.step_ns * 1e-9),
        driving,
        iterations,
        *moved,
    )


def _covered(r: Readings, imu: _Imu) -> Mask:
    """For each interval from a node to the next, whether something says how the vehicle moved; False for the last node."""

    def silent(time_s: Array, longest_s: float) -> Mask:
        after = np.clip(np.searchsorted(time_s, r.nodes_s[:-1], side="right"), 1, len(time_s) - 1)
        return np.asarray(time_s[after] - time_s[after - 1] > longest_s)

    turning = imu.known | ~silent(r.attitude_s, LONGEST_BLIND_S)
    outside_s = [(fixes.time_ns - r.start_ns) * 1e-9 for fixes in r.outside]
    placed_s = np.unique(np.concatenate([r.fix_s, *outside_s]))
    moving = ~silent(placed_s, 3.0) | (imu.force_known & ~silent(placed_s, LONGEST_BRIDGE_S))
    return np.append(turning & moving, False)
