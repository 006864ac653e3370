"""Transition of the states from node to node, and the amount by which the reference violates it.

The filter uses it as it is, the smoother transposed.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

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
    POSITION,
    STATES,
    TILT,
    VELOCITY,
)
from groundproc.numerics.rotations import mat_of_quat, quat_difference_outside, quat_turned_by

Array = npt.NDArray[np.float64]


class Motion(NamedTuple):
    """The reference and what drives the states, over n nodes and the steps between them.

    Attributes
    ----------
    position_m, velocity_m_s : ndarray, shape (n, 3)
        Of the reference, in the local frame.
    quat : ndarray, shape (n, 4)
        Local from ins.
    step_s : ndarray, shape (n - 1,)
        Length of each step.
    angle_rad, push_m_s : ndarray, shape (n - 1, 3)
        Angle turned in it, and specific force times its length, in the ins frame.
    steady_m_s : ndarray, shape (n - 1, 3)
        The same push without vibration, on which scale and misalignment of the accelerometers act. On a noisy reading they would explain
        its noise by itself.
    rate_density, force_density : ndarray, shape (n - 1,)
        Power spectral density of the noise of both [rad^2/s], [m^2/s^3].
    gravity_m_s2 : float
    keep : ndarray, shape (n - 1, 6)
        What a step leaves of the correlated errors: of the fixes' position, how much of their velocity's error goes into it [s], of the
        velocity's, of the tilt's, of the heading's, of a better receiver's.
    drive : ndarray, shape (STATES,)
        Density of the noise that drives the slow states [unit^2/s].
    """

    position_m: Array
    velocity_m_s: Array
    quat: Array
    step_s: Array
    angle_rad: Array
    push_m_s: Array
    steady_m_s: Array
    rate_density: Array
    force_density: Array
    gravity_m_s2: float
    keep: Array
    drive: Array


@njit(cache=True, nogil=True)
def step(k: int, motion: Motion, couple: Array, defect: Array) -> None:
    """What couples the states over the step from node k to the next, and the amount by which the reference violates it.

    couple[0]: force times step turned into the local frame; couple[1:4]: matrix of the step's middle; couple[4]:
    angles turned; couple[5]: steady force times step.
    """
    position, velocity, quat = motion.position_m, motion.velocity_m_s, motion.quat
    angle, push = motion.angle_rad, motion.push_m_s
    dt = motion.step_s[k]
    middle, mat = np.empty(4), couple[1:4]
    quat_turned_by(quat[k], angle[k], 0.5, middle)
    mat_of_quat(middle, mat)
    for i in range(3):
        couple[0, i] = mat[i, 0] * push[k, 0] + mat[i, 1] * push[k, 1] + mat[i, 2] * push[k, 2]
        couple[4, i] = angle[k, i]
        couple[5, i] = motion.steady_m_s[k, i]
    gained = couple[0].copy()
    gained[2] -= motion.gravity_m_s2 * dt
    for i in range(3):
        reached = velocity[k, i] + gained[i]
        defect[POSITION + i] = position[k, i] + 0.5 * dt * (velocity[k, i] + reached) - position[k + 1, i]
        defect[VELOCITY + i] = reached - velocity[k + 1, i]
    quat_turned_by(quat[k], angle[k], 1.0, middle)
    quat_difference_outside(middle, quat[k + 1], defect[ATTITUDE : ATTITUDE + 3])


@njit(cache=True, nogil=True)
def forward_rows(m: Array, dt: float, couple: Array, keep: Array) -> None:
    """Transition of the columns of m, in place: m <- transition @ m. Loops run along the rows, so that they vectorise."""
    columns = m.shape[1]
    # attitude error turns the force: error x force
    turn = np.array(
        [
            [0.0, couple[0, 2], -couple[0, 1]],
            [-couple[0, 2], 0.0, couple[0, 0]],
            [couple[0, 1], -couple[0, 0], 0.0],
        ]
    )
    read, felt = np.empty((3, columns)), np.empty((3, columns))
    for i in range(3):
        row, force_row = GYRO_MATRIX + 3 * i, FORCE_MATRIX + 3 * i
        for j in range(columns):
            felt[i, j] = (
                dt * m[FORCE_BIAS + i, j]
                + couple[5, 0] * m[force_row, j]
                + couple[5, 1] * m[force_row + 1, j]
                + couple[5, 2] * m[force_row + 2, j]
            )
            read[i, j] = (
                dt * m[GYRO_BIAS + i, j]
                + couple[4, 0] * m[row, j]
                + couple[4, 1] * m[row + 1, j]
                + couple[4, 2] * m[row + 2, j]
            )
    for i in range(3):
        for j in range(columns):
            pushed = (
                turn[i, 0] * m[ATTITUDE, j]
                + turn[i, 1] * m[ATTITUDE + 1, j]
                + turn[i, 2] * m[ATTITUDE + 2, j]
                - couple[1 + i, 0] * felt[0, j]
                - couple[1 + i, 1] * felt[1, j]
                - couple[1 + i, 2] * felt[2, j]
            )
            m[POSITION + i, j] += dt * (m[VELOCITY + i, j] + 0.5 * pushed)
            m[VELOCITY + i, j] += pushed
    for i in range(3):
        for j in range(columns):
            m[ATTITUDE + i, j] -= (
                couple[1 + i, 0] * read[0, j] + couple[1 + i, 1] * read[1, j] + couple[1 + i, 2] * read[2, j]
            )
            m[FIX_POSITION + i, j] = keep[0] * m[FIX_POSITION + i, j] + keep[1] * m[FIX_VELOCITY + i, j]
            m[FIX_VELOCITY + i, j] *= keep[2]
            m[OUTSIDE + i, j] *= keep[5]
    for j in range(columns):
        m[TILT, j] *= keep[3]
        m[TILT + 1, j] *= keep[3]
        m[HEADING, j] *= keep[4]


@njit(cache=True, nogil=True)
def backward_rows(m: Array, dt: float, couple: Array, keep: Array) -> None:
    """Transposed transition of the columns of m, in place: m <- transition.T @ m."""
    columns = m.shape[1]
    for j in range(columns):
        m[TILT, j] *= keep[3]
        m[TILT + 1, j] *= keep[3]
        m[HEADING, j] *= keep[4]
    # what a push does to velocity and position, and what a reading of the gyros does to the attitude
    push, swung = np.empty((3, columns)), np.empty((3, columns))
    for i in range(3):
        for j in range(columns):
            m[FIX_VELOCITY + i, j] = keep[2] * m[FIX_VELOCITY + i, j] + keep[1] * m[FIX_POSITION + i, j]
            m[FIX_POSITION + i, j] *= keep[0]
            m[OUTSIDE + i, j] *= keep[5]
            push[i, j] = m[VELOCITY + i, j] + 0.5 * dt * m[POSITION + i, j]
            swung[i, j] = (
                couple[1, i] * m[ATTITUDE, j] + couple[2, i] * m[ATTITUDE + 1, j] + couple[3, i] * m[ATTITUDE + 2, j]
            )
    for i in range(3):
        row, force_row = GYRO_MATRIX + 3 * i, FORCE_MATRIX + 3 * i
        for j in range(columns):
            pushed = couple[1, i] * push[0, j] + couple[2, i] * push[1, j] + couple[3, i] * push[2, j]
            m[FORCE_BIAS + i, j] -= dt * pushed
            m[force_row, j] -= couple[5, 0] * pushed
            m[force_row + 1, j] -= couple[5, 1] * pushed
            m[force_row + 2, j] -= couple[5, 2] * pushed
            m[GYRO_BIAS + i, j] -= dt * swung[i, j]
            m[row, j] -= couple[4, 0] * swung[i, j]
            m[row + 1, j] -= couple[4, 1] * swung[i, j]
            m[row + 2, j] -= couple[4, 2] * swung[i, j]
            m[VELOCITY + i, j] += dt * m[POSITION + i, j]
    for j in range(columns):
        m[ATTITUDE, j] += couple[0, 1] * push[2, j] - couple[0, 2] * push[1, j]
        m[ATTITUDE + 1, j] += couple[0, 2] * push[0, j] - couple[0, 0] * push[2, j]
        m[ATTITUDE + 2, j] += couple[0, 0] * push[1, j] - couple[0, 1] * push[0, j]


@njit(cache=True, nogil=True)
def congruent(p: Array, dt: float, couple: Array, keep: Array, back: "bool | np.bool_") -> None:
    """Make of symmetric p, in place: transition @ p @ transition.T, or the same with the transposed transition.

    Kernels give `back` as `np.bool_`: of a constant's own type, this would be compiled twice.
    """
    for _ in range(2):
        if back:
            backward_rows(p, dt, couple, keep)
        else:
            forward_rows(p, dt, couple, keep)
        for i in range(STATES):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]
