"""Kalman filter and backward smoother over a whole flight, about a reference: one Gauss-Newton step.

The reference need not obey the equations of motion. What it misses them by is a known input of the filter, so that the step ends at the
optimum of the linearised problem wherever it began. The smoother is that of Durbin and Koopman (2012, 4.4; Bryson and Frazier 1963): it
carries an adjoint back instead of inverting covariances, which costs no more than the filter itself and keeps the covariance's rank.
Measurements are taken one scalar after the other.

The filter runs twice: the first time it keeps its state at the start of each block only, the second time all of one block, which the
smoother then walks back over. An hour at 200 nodes a second needs 18 MB for that.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.inertial.model import (
    ATTITUDE,
    FIX_POSITION,
    FIX_VELOCITY,
    FORCE_BIAS,
    GYRO_BIAS,
    GYRO_MATRIX,
    HEADING,
    POSE,
    POSITION,
    STATES,
    TILT,
    VELOCITY,
)
from groundproc.numerics.rotations import mat_of_quat, quat_difference_outside, quat_turned_by

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BLOCK: Final = 400
"""Nodes in a block."""


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
    rate_density, force_density : ndarray, shape (n - 1,)
        Power spectral density of the noise of both [rad^2/s], [m^2/s^3].
    gravity_m_s2 : float
    keep : ndarray, shape (n - 1, 5)
        What a step leaves of the correlated errors: of the fixes' position, how much of their velocity's error goes into it [s], of the
        velocity's, of the tilt's, of the heading's.
    drive : ndarray, shape (STATES,)
        Density of the noise that drives the slow states [unit^2/s].
    """

    position_m: Array
    velocity_m_s: Array
    quat: Array
    step_s: Array
    angle_rad: Array
    push_m_s: Array
    rate_density: Array
    force_density: Array
    gravity_m_s2: float
    keep: Array
    drive: Array


class Rows(NamedTuple):
    """Scalar measurements, in the order of their nodes.

    Attributes
    ----------
    first : ndarray of int64, shape (n + 1,)
        Row of the first measurement of each node.
    coefficients : ndarray of int64, shape (m,)
        How many each has.
    state : ndarray of int64, shape (m, most)
        States that they belong to.
    value : ndarray, shape (m, most)
        Their values.
    measured, variance : ndarray, shape (m,)
        Measured less reference, and the variance of its noise.
    """

    first: Ints
    coefficients: Ints
    state: Ints
    value: Array
    measured: Array
    variance: Array


class Smoothed(NamedTuple):
    """What the smoother fills in; all states and their covariances at one node of `stride` only.

    Attributes
    ----------
    stride : int
    correction : ndarray, shape (n, 9)
        Smoothed position, velocity and attitude, less the reference.
    residual : ndarray, shape (m,)
        What is left of each measurement.
    states : ndarray, shape (ceil(n / stride), STATES)
    covariance : ndarray of float32, shape (ceil(n / stride), 9, 9)
        Of position, velocity and attitude.
    variance : ndarray, shape (ceil(n / stride), STATES)
        Of all states.
    """

    stride: int
    correction: Array
    residual: Array
    states: Array
    covariance: npt.NDArray[np.float32]
    variance: Array


class Tape(NamedTuple):
    """What the filter leaves of one block.

    Attributes
    ----------
    states : ndarray, shape (BLOCK + 1, STATES)
    covariances : ndarray, shape (BLOCK + 1, STATES, STATES)
        After the measurements of each node.
    gains : ndarray, shape (most, STATES)
    innovations, spreads : ndarray, shape (most,)
        Of each row, and the variance of the innovation.
    """

    states: Array
    covariances: Array
    gains: Array
    innovations: Array
    spreads: Array


@njit(cache=True, nogil=True)
def _step(k: int, motion: Motion, couple: Array, defect: Array) -> None:
    """What couples the states over the step from node k to the next, and by how much the reference misses it.

    couple[0]: force times step turned into the local frame; couple[1:4]: matrix of the step's middle; couple[4]: angles turned.
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
    gained = couple[0].copy()
    gained[2] -= motion.gravity_m_s2 * dt
    for i in range(3):
        reached = velocity[k, i] + gained[i]
        defect[POSITION + i] = position[k, i] + 0.5 * dt * (velocity[k, i] + reached) - position[k + 1, i]
        defect[VELOCITY + i] = reached - velocity[k + 1, i]
    quat_turned_by(quat[k], angle[k], 1.0, middle)
    quat_difference_outside(middle, quat[k + 1], defect[ATTITUDE : ATTITUDE + 3])


@njit(cache=True, nogil=True)
def _forward_rows(m: Array, dt: float, couple: Array, keep: Array) -> None:
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
    read = np.empty((3, columns))
    for i in range(3):
        row = GYRO_MATRIX + 3 * i
        for j in range(columns):
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
                - dt
                * (
                    couple[1 + i, 0] * m[FORCE_BIAS, j]
                    + couple[1 + i, 1] * m[FORCE_BIAS + 1, j]
                    + couple[1 + i, 2] * m[FORCE_BIAS + 2, j]
                )
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
    for j in range(columns):
        m[TILT, j] *= keep[3]
        m[TILT + 1, j] *= keep[3]
        m[HEADING, j] *= keep[4]


@njit(cache=True, nogil=True)
def _backward_rows(m: Array, dt: float, couple: Array, keep: Array) -> None:
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
            push[i, j] = m[VELOCITY + i, j] + 0.5 * dt * m[POSITION + i, j]
            swung[i, j] = (
                couple[1, i] * m[ATTITUDE, j] + couple[2, i] * m[ATTITUDE + 1, j] + couple[3, i] * m[ATTITUDE + 2, j]
            )
    for i in range(3):
        row = GYRO_MATRIX + 3 * i
        for j in range(columns):
            m[FORCE_BIAS + i, j] -= dt * (
                couple[1, i] * push[0, j] + couple[2, i] * push[1, j] + couple[3, i] * push[2, j]
            )
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
def _congruent(p: Array, dt: float, couple: Array, keep: Array, back: bool) -> None:
    """Make of symmetric p, in place: transition @ p @ transition.T, or the same with the transposed transition."""
    for _ in range(2):
        if back:
            _backward_rows(p, dt, couple, keep)
        else:
            _forward_rows(p, dt, couple, keep)
        for i in range(STATES):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]


@njit(cache=True, nogil=True)
def _predict(k: int, x: Array, p: Array, motion: Motion, couple: Array, defect: Array) -> None:
    """State and covariance from node k to the next."""
    dt, keep, drive = motion.step_s[k], motion.keep[k], motion.drive
    _step(k, motion, couple, defect)
    _forward_rows(x.reshape(STATES, 1), dt, couple, keep)
    for i in range(POSE):
        x[i] += defect[i]
    _congruent(p, dt, couple, keep, False)
    for i in range(STATES):
        p[i, i] += drive[i] * dt
    for i in range(3):
        p[VELOCITY + i, VELOCITY + i] += motion.force_density[k] * dt
        p[ATTITUDE + i, ATTITUDE + i] += motion.rate_density[k] * dt


@njit(cache=True, nogil=True)
def _update(row: int, rows: Rows, x: Array, p: Array, gain: Array) -> tuple[float, float]:
    """Take one scalar measurement; gives innovation and its variance, and leaves the gain."""
    count, index, value = rows.coefficients, rows.state, rows.value
    spread = rows.variance[row]
    innovation = rows.measured[row]
    gain[:] = 0.0
    for c in range(count[row]):
        i, h = index[row, c], value[row, c]
        innovation -= h * x[i]
        for j in range(STATES):
            gain[j] += p[i, j] * h
    for c in range(count[row]):
        spread += value[row, c] * gain[index[row, c]]
    for i in range(STATES):
        x[i] += gain[i] / spread * innovation
        g = gain[i] / spread
        for j in range(STATES):
            p[i, j] -= g * gain[j]
    for i in range(STATES):
        gain[i] /= spread
    return innovation, spread


@njit(cache=True, nogil=True)
def _undo(row: int, rows: Rows, at: int, tape: Tape, r: Array, n: Array, work: Array) -> None:
    """Carry the adjoint back over one scalar measurement, whose gain stands at `at` on the tape."""
    count, index, value = rows.coefficients, rows.state, rows.value
    gain, innovation, spread = tape.gains[at], tape.innovations[at], tape.spreads[at]
    along, inner = 0.0, 0.0
    for i in range(STATES):
        along += gain[i] * r[i]
        work[i] = 0.0
        for j in range(STATES):
            work[i] += n[i, j] * gain[j]
    for i in range(STATES):
        inner += gain[i] * work[i]
    for c in range(count[row]):
        i, h = index[row, c], value[row, c]
        r[i] += h * (innovation / spread - along)
        for j in range(STATES):
            n[i, j] -= h * work[j]
            n[j, i] -= h * work[j]
    for c in range(count[row]):
        for d in range(count[row]):
            n[index[row, c], index[row, d]] += value[row, c] * value[row, d] * (inner + 1.0 / spread)


@njit(cache=True, nogil=True)
def _smoothed(x: Array, p: Array, r: Array, out: Array) -> None:
    for i in range(STATES):
        total = x[i]
        for j in range(STATES):
            total += p[i, j] * r[j]
        out[i] = total


@njit(cache=True, nogil=True)
def _forward(motion: Motion, rows: Rows, start: Array, start_covariance: Array, blocks: Tape) -> float:
    """Filter the whole flight, keeping the states at the start of each block; gives the sum of the squared innovations."""
    first = rows.first
    couple, defect, gain = np.empty((5, 3)), np.empty(POSE), np.empty(STATES)
    x, p = start.copy(), start_covariance.copy()
    misfit = 0.0
    for k in range(len(motion.position_m)):
        if k:
            _predict(k - 1, x, p, motion, couple, defect)
        for row in range(first[k], first[k + 1]):
            innovation, spread = _update(row, rows, x, p, gain)
            misfit += innovation * innovation / spread
        if k % BLOCK == 0:
            blocks.states[k // BLOCK], blocks.covariances[k // BLOCK] = x, p
    return float(misfit)


@njit(cache=True, nogil=True)
def _record(low: int, high: int, motion: Motion, rows: Rows, tape: Tape) -> None:
    """Filter one block again, keeping everything: states and covariances of its nodes, gains and innovations of its rows."""
    first = rows.first
    couple, defect = np.empty((5, 3)), np.empty(POSE)
    x, p = tape.states[0].copy(), tape.covariances[0].copy()
    base = first[low + 1]
    for k in range(low + 1, high + 1):
        _predict(k - 1, x, p, motion, couple, defect)
        for row in range(first[k], first[k + 1]):
            at = row - base
            tape.innovations[at], tape.spreads[at] = _update(row, rows, x, p, tape.gains[at])
        tape.states[k - low], tape.covariances[k - low] = x, p


@njit(cache=True, nogil=True)
def _left(row: int, rows: Rows, state: Array) -> float:
    """What a state leaves of a measurement."""
    left = float(rows.measured[row])
    for c in range(rows.coefficients[row]):
        left -= rows.value[row, c] * state[rows.state[row, c]]
    return float(left)


@njit(cache=True, nogil=True)
def _back(
    low: int, high: int, motion: Motion, rows: Rows, tape: Tape, adjoint: tuple[Array, Array], out: Smoothed
) -> None:
    """Smooth the nodes of one block from its last to the one after its first; of the first block all.

    `adjoint` are its vector, shape (STATES,), and its matrix, shape (STATES, STATES): what was carried back so far.
    """
    r, n = adjoint
    first = rows.first
    couple, defect, work, state = np.empty((5, 3)), np.empty(POSE), np.empty(STATES), np.empty(STATES)
    base = first[low + 1]
    for k in range(high, low if low else -1, -1):
        p = tape.covariances[k - low]
        _smoothed(tape.states[k - low], p, r, state)
        out.correction[k] = state[:POSE]
        for row in range(first[k], first[k + 1]):
            out.residual[row] = _left(row, rows, state)
        if k % out.stride == 0:
            slot = k // out.stride
            out.states[slot] = state
            full = p - p @ (n @ p)
            out.covariance[slot] = full[:POSE, :POSE]
            for i in range(STATES):
                out.variance[slot, i] = full[i, i]
        if k > low:
            for row in range(first[k + 1] - 1, first[k] - 1, -1):
                _undo(row, rows, row - base, tape, r, n, work)
            dt, keep = motion.step_s[k - 1], motion.keep[k - 1]
            _step(k - 1, motion, couple, defect)
            _backward_rows(r.reshape(STATES, 1), dt, couple, keep)
            _congruent(n, dt, couple, keep, True)


@njit(cache=True, nogil=True)
def smooth(motion: Motion, rows: Rows, start: Array, start_covariance: Array, out: Smoothed) -> float:
    """Filter forward, smooth back.

    Parameters
    ----------
    motion : Motion
    rows : Rows
    start, start_covariance : ndarray, shape (STATES,) and (STATES, STATES)
        Mean and covariance of the first node's states before its measurements.
    out : Smoothed
        Filled in.

    Returns
    -------
    float
        Twice the negative log likelihood, less constants: squares of the innovations over their variances.
    """
    first, nodes = rows.first, len(motion.position_m)
    blocks = (nodes - 1 + BLOCK - 1) // BLOCK
    none = np.empty(0)
    saved = Tape(
        np.empty((blocks + 1, STATES)), np.empty((blocks + 1, STATES, STATES)), np.empty((0, STATES)), none, none
    )
    misfit: float = _forward(motion, rows, start, start_covariance, saved)
    most = 1
    for block in range(blocks):
        most = max(most, first[min((block + 1) * BLOCK, nodes - 1) + 1] - first[block * BLOCK + 1])
    tape = Tape(
        np.empty((BLOCK + 1, STATES)), np.empty((BLOCK + 1, STATES, STATES)), np.empty((most, STATES)), np.empty(most),
        np.empty(most),
    )  # fmt: skip
    adjoint = (np.zeros(STATES), np.zeros((STATES, STATES)))
    for block in range(blocks - 1, -1, -1):
        low, high = block * BLOCK, min((block + 1) * BLOCK, nodes - 1)
        tape.states[0], tape.covariances[0] = saved.states[block], saved.covariances[block]
        _record(low, high, motion, rows, tape)
        _back(low, high, motion, rows, tape, adjoint, out)
    return misfit
