"""How the smoother's states propagate from node to node about a reference, and their values at the start."""

from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from groundproc.estimation.inertial.imu import flat_low_pass
from groundproc.estimation.inertial.readings import Readings
from groundproc.estimation.inertial.reference import Steps
from groundproc.estimation.inertial.transition import Motion
from groundproc.estimation.observations.measured import Reference
from groundproc.estimation.observations.outside import lasting
from groundproc.estimation.observations.states import (
    ATTITUDE,
    BARO,
    FIX_POSITION,
    FIX_VELOCITY,
    FORCE_BIAS,
    GYRO_BIAS,
    HEADING,
    OUTSIDE,
    POSITION,
    STATES,
    TILT,
    VELOCITY,
    Model,
    fix_velocity_sigma,
    start_covariance,
)

Array = npt.NDArray[np.float64]

STEADY_HZ: Final = 2.0
"""Up to here scale and misalignment of the accelerometers are taken to act: an aircraft leans and climbs as slowly, what is faster shakes
and moves nothing far."""


def motion_about(r: Readings, model: Model, steps: Steps, reference: Reference) -> Motion:
    """The reference with what drives the states about it."""
    step_s = np.diff(r.nodes_s)
    force = _force(r, steps, reference)
    steady = flat_low_pass(force, STEADY_HZ, 1.0 / float(np.median(step_s)))
    return Motion(
        position_m=reference.position_m,
        velocity_m_s=reference.velocity_m_s,
        quat=reference.quat,
        step_s=step_s,
        angle_rad=steps.rate * step_s[:, None],
        push_m_s=force * step_s[:, None],
        # as filters leave it its axes lie the other way round: the kernels would be compiled for that as well
        steady_m_s=np.ascontiguousarray(steady) * step_s[:, None],
        rate_density=steps.rate_density,
        force_density=steps.force_density,
        gravity_m_s2=r.gravity_m_s2,
        keep=_kept(r, model, step_s),
        drive=_drive(r, model),
    )


def start_about(r: Readings, model: Model, first: Reference, reference: Reference) -> tuple[Array, Array]:
    """State at the first node and its covariance: where the first reference began, less this one."""
    state = np.zeros(STATES)
    state[POSITION : POSITION + 3] = first.position_m[0] - reference.position_m[0]
    state[VELOCITY : VELOCITY + 3] = first.velocity_m_s[0] - reference.velocity_m_s[0]
    turn = frames.quat_multiply(first.quat[0], frames.quat_inverse(reference.quat[0]))
    state[ATTITUDE : ATTITUDE + 3] = frames.quat_log(turn)
    outside_sigma_m, _ = lasting(r.outside)
    return state, start_covariance(model, np.median(r.fix_sigma_m, axis=0), r.linked, outside_sigma_m)


def _force(r: Readings, steps: Steps, reference: Reference) -> Array:
    """Specific force of each step; where no accelerometer was, the velocity goes on as the reference has it."""
    force = steps.force.copy()
    lost = np.flatnonzero(~steps.force_known)
    lift = np.array([0.0, 0.0, r.gravity_m_s2])
    gained = np.diff(reference.velocity_m_s, axis=0)[lost] / np.diff(r.nodes_s)[lost, None] + lift
    force[lost] = np.einsum("nji,nj->ni", frames.mat_from_quat(reference.quat[lost]), gained)
    return force


def _drive(r: Readings, model: Model) -> Array:
    """Density of the noise that drives each state, shape (STATES,)."""
    fix_sigma = np.median(r.fix_sigma_m, axis=0)
    velocity_sigma = fix_velocity_sigma(model, fix_sigma, r.linked)
    outside_sigma_m, outside_tau_s = lasting(r.outside)
    drive = np.zeros(STATES)
    drive[GYRO_BIAS : GYRO_BIAS + 3] = model.gyro_bias_walk**2
    drive[FORCE_BIAS : FORCE_BIAS + 3] = model.force_bias_walk**2
    if not r.linked:
        drive[FIX_POSITION : FIX_POSITION + 3] = 2.0 * fix_sigma**2 / model.fix_tau_s
    drive[FIX_VELOCITY : FIX_VELOCITY + 3] = 2.0 * velocity_sigma**2 / model.fix_velocity_tau_s
    drive[TILT : TILT + 2] = 2.0 * model.tilt_rad**2 / model.tilt_tau_s
    drive[HEADING] = 2.0 * model.heading_rad**2 / model.heading_tau_s
    drive[BARO] = model.baro_walk**2
    drive[OUTSIDE : OUTSIDE + 3] = 2.0 * outside_sigma_m**2 / outside_tau_s
    return drive


def _kept(r: Readings, model: Model, step_s: Array) -> Array:
    """What each step leaves of the correlated errors, shape (n - 1, 6); see `Motion.keep`."""
    _, outside_tau_s = lasting(r.outside)
    return np.stack(
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
