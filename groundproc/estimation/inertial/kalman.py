"""Kalman filter and backward smoother over a whole flight, about a reference: one Gauss-Newton step.

The reference need not obey the equations of motion. The amount by which it violates them is a known input of the
filter, so that the step ends at the optimum of the linearised problem wherever it began. The smoother is that of
Durbin and Koopman (2012, 4.4; Bryson and Frazier 1963). It carries an adjoint back instead of inverting covariances,
which costs no more than the filter itself and also works if a covariance is singular. Measurements are taken one
scalar after the other.

The filter runs twice. The first time it keeps its state only at the start of each block; the second time it keeps all
of one block, over which the smoother then runs back, while a thread does so for the block before. An hour at 200 nodes
a second needs 40 MB for that, and 9 MB for each of three blocks.
"""

import contextlib
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.inertial.transition import Motion, backward_rows, congruent, forward_rows, step
from groundproc.estimation.observations.states import ATTITUDE, POSE, STATES, VELOCITY
from groundproc.machine.readahead import ahead

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BLOCK: Final = 400
"""Nodes in a block."""
IN_USE: Final = 3
"""Blocks at once: one is smoothed, one waits, one is filtered for the second time."""
TELLS_ALL: Final = 1e-6
"""Noise over the variance of the innovation, under which the adjoint is carried back over a measurement with care."""


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
def _predict(k: int, x: Array, p: Array, motion: Motion, couple: Array, defect: Array) -> None:
    """State and covariance from node k to the next."""
    dt, keep, drive = motion.step_s[k], motion.keep[k], motion.drive
    step(k, motion, couple, defect)
    forward_rows(x.reshape(STATES, 1), dt, couple, keep)
    for i in range(POSE):
        x[i] += defect[i]
    congruent(p, dt, couple, keep, np.bool_(False))
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
def _others(but: int, left: Array, right: Array) -> float:
    """Inner product without one element."""
    total = 0.0
    for k in range(STATES):
        if k != but:
            total += left[k] * right[k]
    return float(total)


@njit(cache=True, nogil=True)
def _undo_all(row: int, rows: Rows, gain: Array, information: float, n: Array, work: Array) -> None:
    """Carry the adjoint's matrix back over a measurement that is far better than what was known before it.

    It is (I - K H)' N (I - K H) + H' H / S. Next to nothing of N is left then. Computed as a difference of its terms,
    that would be their rounding error, magnified by the covariance before the measurement, which is practically
    infinite. As a product it has digits of its own.
    """
    count, index, value = rows.coefficients[row], rows.state[row], rows.value[row]
    for c in range(count):
        for j in range(STATES):
            n[j, index[c]] -= value[c] * work[j]
    block = np.empty((count, count))
    for c in range(count):
        i, h = index[c], value[c]
        for d in range(count):
            j = index[d]
            left = n[i, j] * (1.0 - gain[i] * h) - h * _others(i, gain, n[:, j])
            block[c, d] = left + h * value[d] * information
    for c in range(count):
        for j in range(STATES):
            n[index[c], j] = n[j, index[c]]
    for c in range(count):
        for d in range(count):
            n[index[c], index[d]] = 0.5 * (block[c, d] + block[d, c])


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
        r[index[row, c]] += value[row, c] * (innovation / spread - along)
    if rows.variance[row] < TELLS_ALL * spread:
        _undo_all(row, rows, gain, 1.0 / spread, n, work)
        return
    for c in range(count[row]):
        i, h = index[row, c], value[row, c]
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
    couple, defect, gain = np.empty((6, 3)), np.empty(POSE), np.empty(STATES)
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
    couple, defect = np.empty((6, 3)), np.empty(POSE)
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
    couple, defect, work, state = np.empty((6, 3)), np.empty(POSE), np.empty(STATES), np.empty(STATES)
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
            step(k - 1, motion, couple, defect)
            backward_rows(r.reshape(STATES, 1), dt, couple, keep)
            congruent(n, dt, couple, keep, np.bool_(True))


def smooth(motion: Motion, rows: Rows, start: Array, start_covariance: Array, out: Smoothed) -> float:
    """Filter forward, smooth back.

    No kernel itself: all others would be compiled into it once more, a quarter of the smoother's time, for one call a block.

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
    tapes = [
        Tape(
            np.empty((BLOCK + 1, STATES)), np.empty((BLOCK + 1, STATES, STATES)), np.empty((most, STATES)), np.empty(most),
            np.empty(most),
        )
        for _ in range(min(blocks, IN_USE))
    ]  # fmt: skip
    backwards = [(block * BLOCK, min((block + 1) * BLOCK, nodes - 1)) for block in range(blocks - 1, -1, -1)]

    def recorded() -> Iterator[Tape]:
        for number, (low, high) in enumerate(backwards):
            tape = tapes[number % len(tapes)]
            tape.states[0], tape.covariances[0] = saved.states[low // BLOCK], saved.covariances[low // BLOCK]
            _record(low, high, motion, rows, tape)
            yield tape

    adjoint = (np.zeros(STATES), np.zeros((STATES, STATES)))
    with contextlib.closing(ahead(recorded())) as made:
        for (low, high), tape in zip(backwards, made, strict=True):
            _back(low, high, motion, rows, tape, adjoint, out)
    return misfit
