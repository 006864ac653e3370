"""Kalman filter and backward smoother over a whole flight, about a reference: one Gauss-Newton step.

The reference need not obey the equations of motion. What it misses them by is a known input of the filter, so that the step ends at the
optimum of the linearised problem wherever it began. The smoother is that of Durbin and Koopman (2012, 4.4; Bryson and Frazier 1963): it
carries an adjoint back instead of inverting covariances, which costs no more than the filter itself and keeps the covariance's rank.
Measurements are taken one scalar after the other.

The filter runs twice: the first time it keeps its state at the start of each block only, the second time all of one block, which the
smoother then walks back over. An hour at 200 nodes a second needs 18 MB for that.
"""

from typing import Any, Final

import numpy as np
from numba import njit

from groundproc.estimation.observations.states import (
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

BLOCK: Final = 400
"""Nodes in a block."""


@njit(cache=True, nogil=True)
def quat_to_mat(q: Any, out: Any) -> None:
    """Rotation matrix of a unit quaternion, scalar first."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@njit(cache=True, nogil=True)
def turn_on(q: Any, vector: Any, share: float, out: Any) -> None:
    """Attitude turned on in its own frame by a share of a rotation vector: q exp(share vector)."""
    x, y, z = 0.5 * share * vector[0], 0.5 * share * vector[1], 0.5 * share * vector[2]
    half = np.sqrt(x * x + y * y + z * z)
    factor = 1.0 - half * half / 6.0 if half < 1e-4 else np.sin(half) / half
    w, x, y, z = np.cos(half), factor * x, factor * y, factor * z
    a, b, c, d = q[0], q[1], q[2], q[3]
    out[0] = a * w - b * x - c * y - d * z
    out[1] = a * x + b * w + c * z - d * y
    out[2] = a * y - b * z + c * w + d * x
    out[3] = a * z + b * y - c * x + d * w


@njit(cache=True, nogil=True)
def turned_between(q: Any, r: Any, out: Any) -> None:
    """Rotation vector in the outer frame from attitude r to attitude q: log(q r^-1)."""
    w = q[0] * r[0] + q[1] * r[1] + q[2] * r[2] + q[3] * r[3]
    x = -q[0] * r[1] + q[1] * r[0] - q[2] * r[3] + q[3] * r[2]
    y = -q[0] * r[2] + q[1] * r[3] + q[2] * r[0] - q[3] * r[1]
    z = -q[0] * r[3] - q[1] * r[2] + q[2] * r[1] + q[3] * r[0]
    sine = np.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, abs(w)) / sine
    if w < 0:
        factor = -factor
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@njit(cache=True, nogil=True)
def _step(k: int, reference: Any, imu: Any, gravity: float, couple: Any, defect: Any) -> None:
    """What couples the states over the step from node k to the next, and by how much the reference misses it.

    couple[0]: force times step turned into the local frame; couple[1:4]: matrix of the step's middle; couple[4]: angles turned.
    """
    position, velocity, quat = reference
    step_s, angle, push = imu[0], imu[1], imu[2]
    dt = step_s[k]
    middle, mat = np.empty(4), couple[1:4]
    turn_on(quat[k], angle[k], 0.5, middle)
    quat_to_mat(middle, mat)
    for i in range(3):
        couple[0, i] = mat[i, 0] * push[k, 0] + mat[i, 1] * push[k, 1] + mat[i, 2] * push[k, 2]
        couple[4, i] = angle[k, i]
    gained = couple[0].copy()
    gained[2] -= gravity * dt
    for i in range(3):
        reached = velocity[k, i] + gained[i]
        defect[POSITION + i] = position[k, i] + 0.5 * dt * (velocity[k, i] + reached) - position[k + 1, i]
        defect[VELOCITY + i] = reached - velocity[k + 1, i]
    turn_on(quat[k], angle[k], 1.0, middle)
    turned_between(middle, quat[k + 1], defect[ATTITUDE : ATTITUDE + 3])


@njit(cache=True, nogil=True)
def _forward_rows(m: Any, dt: float, couple: Any, keep: Any) -> None:
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
def _backward_rows(m: Any, dt: float, couple: Any, keep: Any) -> None:
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
def _congruent(p: Any, dt: float, couple: Any, keep: Any, back: bool) -> None:
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
def _predict(
    k: int, x: Any, p: Any, reference: Any, imu: Any, gravity: float, keep: Any, drive: Any, couple: Any, defect: Any
) -> None:
    """State and covariance from node k to the next."""
    dt = imu[0][k]
    _step(k, reference, imu, gravity, couple, defect)
    _forward_rows(x.reshape(STATES, 1), dt, couple, keep)
    for i in range(POSE):
        x[i] += defect[i]
    _congruent(p, dt, couple, keep, False)
    for i in range(STATES):
        p[i, i] += drive[i] * dt
    for i in range(3):
        p[VELOCITY + i, VELOCITY + i] += imu[4][k] * dt
        p[ATTITUDE + i, ATTITUDE + i] += imu[3][k] * dt


@njit(cache=True, nogil=True)
def _update(row: int, rows: Any, x: Any, p: Any, gain: Any) -> tuple[float, float]:
    """Take one scalar measurement; gives innovation and its variance, and leaves the gain."""
    count, index, value, measured, variance = rows
    spread = variance[row]
    innovation = measured[row]
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
def _undo(row: int, rows: Any, r: Any, n: Any, gain: Any, innovation: float, spread: float, work: Any) -> None:
    """Carry the adjoint back over one scalar measurement."""
    count, index, value, _, _ = rows
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
def _smoothed(x: Any, p: Any, r: Any, out: Any) -> None:
    for i in range(STATES):
        total = x[i]
        for j in range(STATES):
            total += p[i, j] * r[j]
        out[i] = total


@njit(cache=True, nogil=True)
def _forward(
    motion: Any, first: Any, rows: Any, start: Any, start_covariance: Any, saved_x: Any, saved_p: Any
) -> float:
    """Filter the whole flight, keeping the states at the start of each block; gives the sum of the squared innovations."""
    reference, imu, gravity, keep, drive = motion
    couple, defect, gain = np.empty((5, 3)), np.empty(POSE), np.empty(STATES)
    x, p = start.copy(), start_covariance.copy()
    misfit = 0.0
    for k in range(len(reference[0])):
        if k:
            _predict(k - 1, x, p, reference, imu, gravity, keep[k - 1], drive, couple, defect)
        for row in range(first[k], first[k + 1]):
            innovation, spread = _update(row, rows, x, p, gain)
            misfit += innovation * innovation / spread
        if k % BLOCK == 0:
            saved_x[k // BLOCK], saved_p[k // BLOCK] = x, p
    return float(misfit)


@njit(cache=True, nogil=True)
def _record(low: int, high: int, motion: Any, first: Any, rows: Any, tape: Any) -> None:
    """Filter one block again, keeping everything: states and covariances of its nodes, gains and innovations of its rows."""
    reference, imu, gravity, keep, drive = motion
    xs, ps, gains, innovations, spreads = tape
    couple, defect = np.empty((5, 3)), np.empty(POSE)
    x, p = xs[0].copy(), ps[0].copy()
    base = first[low + 1]
    for k in range(low + 1, high + 1):
        _predict(k - 1, x, p, reference, imu, gravity, keep[k - 1], drive, couple, defect)
        for row in range(first[k], first[k + 1]):
            innovations[row - base], spreads[row - base] = _update(row, rows, x, p, gains[row - base])
        xs[k - low], ps[k - low] = x, p


@njit(cache=True, nogil=True)
def _left(row: int, rows: Any, state: Any) -> float:
    """What a state leaves of a measurement."""
    count, index, value, measured, _ = rows
    left = float(measured[row])
    for c in range(count[row]):
        left -= value[row, c] * state[index[row, c]]
    return float(left)


@njit(cache=True, nogil=True)
def _back(
    low: int,
    high: int,
    motion: Any,
    first: Any,
    rows: Any,
    tape: Any,
    r: Any,
    n: Any,
    stride: int,
    correction: Any,
    residual: Any,
    kept: Any,
    kept_covariance: Any,
    kept_variance: Any,
) -> None:
    """Smooth the nodes of one block from its last to the one after its first; of the first block all."""
    reference, imu, gravity, keep, _ = motion
    xs, ps, gains, innovations, spreads = tape
    couple, defect, work, state = np.empty((5, 3)), np.empty(POSE), np.empty(STATES), np.empty(STATES)
    base = first[low + 1]
    for k in range(high, low if low else -1, -1):
        _smoothed(xs[k - low], ps[k - low], r, state)
        correction[k] = state[:POSE]
        for row in range(first[k], first[k + 1]):
            residual[row] = _left(row, rows, state)
        if k % stride == 0:
            kept[k // stride] = state
            full = ps[k - low] - ps[k - low] @ (n @ ps[k - low])
            kept_covariance[k // stride] = full[:POSE, :POSE]
            for i in range(STATES):
                kept_variance[k // stride, i] = full[i, i]
        if k > low:
            for row in range(first[k + 1] - 1, first[k] - 1, -1):
                _undo(row, rows, r, n, gains[row - base], innovations[row - base], spreads[row - base], work)
            _step(k - 1, reference, imu, gravity, couple, defect)
            _backward_rows(r.reshape(STATES, 1), imu[0][k - 1], couple, keep[k - 1])
            _congruent(n, imu[0][k - 1], couple, keep[k - 1], True)


@njit(cache=True, nogil=True)
def smooth(
    reference: Any,
    imu: Any,
    gravity: float,
    keep: Any,
    drive: Any,
    first: Any,
    rows: Any,
    start: Any,
    start_covariance: Any,
    stride: int,
    correction: Any,
    residual: Any,
    kept: Any,
    kept_covariance: Any,
    kept_variance: Any,
) -> float:
    """Filter forward, smooth back.

    Parameters
    ----------
    reference : tuple of ndarray
        Position (n, 3), velocity (n, 3), quaternion (n, 4) of the nodes.
    imu : tuple of ndarray
        For the step after each node: length [s] (n,), angle turned [rad] (n, 3), force times length [m/s] (n, 3), and the power spectral
        densities of the noise of both: [rad^2/s] (n,), [m^2/s^3] (n,).
    gravity : float
        [m/s^2]
    keep : ndarray, shape (m, 5)
        For each node's step, what is left of the correlated errors: of the fixes' position, how much of their velocity's error goes
        into it [s], of the velocity's, of the tilt's, of the heading's.
    drive : ndarray, shape (STATES,)
        Density of the noise that drives the slow states [unit^2/s].
    first : ndarray of int, shape (n + 1,)
        Row of the first measurement of each node.
    rows : tuple of ndarray
        Measurements: number of coefficients, states and values of them, measured value, variance.
    start, start_covariance : ndarray
        Mean and covariance of the first node's states before its measurements.
    stride : int
        Covariances and all states are kept at every so manieth node.
    correction : ndarray, shape (n, 9)
        Out: smoothed position, velocity and attitude, less the reference.
    residual : ndarray, shape (rows,)
        Out: what is left of each measurement.
    kept : ndarray, shape (ceil(n / stride), STATES)
        Out: all smoothed states.
    kept_covariance : ndarray, shape (ceil(n / stride), 9, 9)
        Out: covariance of position, velocity and attitude, single precision.
    kept_variance : ndarray, shape (ceil(n / stride), STATES)
        Out: variance of all states.

    Returns
    -------
    float
        Twice the negative log likelihood, less constants: squares of the innovations over their variances.
    """
    motion = (reference, imu, gravity, keep, drive)
    nodes = len(reference[0])
    blocks = (nodes - 1 + BLOCK - 1) // BLOCK
    saved_x, saved_p = np.empty((blocks + 1, STATES)), np.empty((blocks + 1, STATES, STATES))
    misfit: float = _forward(motion, first, rows, start, start_covariance, saved_x, saved_p)
    most = 1
    for block in range(blocks):
        most = max(most, first[min((block + 1) * BLOCK, nodes - 1) + 1] - first[block * BLOCK + 1])
    tape = (
        np.empty((BLOCK + 1, STATES)),
        np.empty((BLOCK + 1, STATES, STATES)),
        np.empty((most, STATES)),
        np.empty(most),
        np.empty(most),
    )
    r, n = np.zeros(STATES), np.zeros((STATES, STATES))
    for block in range(blocks - 1, -1, -1):
        low, high = block * BLOCK, min((block + 1) * BLOCK, nodes - 1)
        tape[0][0], tape[1][0] = saved_x[block], saved_p[block]
        _record(low, high, motion, first, rows, tape)
        _back(
            low,
            high,
            motion,
            first,
            rows,
            tape,
            r,
            n,
            stride,
            correction,
            residual,
            kept,
            kept_covariance,
            kept_variance,
        )
    return misfit
