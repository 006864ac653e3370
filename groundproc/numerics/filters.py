"""Filters, spectra and peaks of evenly spaced series: what is used of scipy.signal, whose import takes 0.65 CPU-seconds of every start.

They give what scipy gives with the same arguments (`tests`), to rounding.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def butterworth(cutoff_hz: float, rate_hz: float) -> Array:
    """Low-pass of fourth order as two sections of second order, shape (2, 6): b0 b1 b2 a0 a1 a2, a0 being 1.

    By the bilinear transformation, with the frequency warped so that half the power is left at the cutoff.
    """
    warped = 4.0 * np.tan(np.pi * cutoff_hz / rate_hz)
    sections = np.empty((2, 6))
    gain = 1.0
    # the pair of poles that is farther from the unit circle goes first
    for row, angle in enumerate((7.0 * np.pi / 8.0, 5.0 * np.pi / 8.0)):
        pole = warped * np.exp(1j * angle)
        place = (4.0 + pole) / (4.0 - pole)
        gain *= warped**2 / abs(4.0 - pole) ** 2
        sections[row] = (1.0, 2.0, 1.0, 1.0, -2.0 * place.real, abs(place) ** 2)
    sections[0, :3] *= gain
    return sections


def forward_and_back(sections: Array, values: Array, padding: int) -> Array:
    """Values, shape (n, ...), through sections of second order along the first axis, forward and then back: no delay.

    Both ends are continued by `padding` values, turned about the last one, fewer than there are values.
    """
    flat = np.asarray(values, np.float64).reshape(len(values), -1)
    begin, end = 2.0 * flat[0] - flat[padding:0:-1], 2.0 * flat[-1] - flat[-2 : -padding - 2 : -1]
    longer = np.concatenate([begin, flat, end]) if padding else flat.copy()
    settled = _settled(sections)
    for _ in range(2):
        _filter(sections, settled[..., None] * longer[0], longer)
        longer = np.ascontiguousarray(longer[::-1])  # a view would be another type, compiled anew
    return np.ascontiguousarray(longer[padding : len(longer) - padding]).reshape(np.shape(values))


def _settled(sections: Array) -> Array:
    """States of sections that have seen ones for ever, shape (sections, 2)."""
    state, level = np.empty((len(sections), 2)), 1.0
    for row, (b0, b1, b2, _, a1, a2) in enumerate(sections):
        out = (b0 + b1 + b2) / (1.0 + a1 + a2)
        state[row] = level * (out - b0), level * (b2 - a2 * out)
        level *= out
    return state


@njit(cache=True, nogil=True)
def _filter(sections: Array, state: Array, values: Array) -> None:
    """Put values, shape (n, k), through sections in place; `state` has the shape (sections, 2, k)."""
    for n in range(len(values)):
        for k in range(values.shape[1]):
            x = values[n, k]
            for s in range(len(sections)):
                y = sections[s, 0] * x + state[s, 0, k]
                state[s, 0, k] = sections[s, 1] * x - sections[s, 4] * y + state[s, 1, k]
                state[s, 1, k] = sections[s, 2] * x - sections[s, 5] * y
                x = y
            values[n, k] = x


def spectrum(values: Array, rate_hz: float, piece: int) -> tuple[Array, Array]:
    """One-sided power spectral density of values, shape (n, k), by Welch: pieces that overlap by half, under Hann's window.

    Parameters
    ----------
    values : ndarray, shape (n, k)
    rate_hz : float
    piece : int
        Even; at most n.

    Returns
    -------
    at_hz : ndarray, shape (piece // 2 + 1,)
    density : ndarray, shape (piece // 2 + 1, k)
    """
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(piece) / piece)
    begins = range(0, len(values) - piece + 1, piece // 2)
    cut = np.stack([values[begin : begin + piece] for begin in begins])
    cut = (cut - cut.mean(axis=1, keepdims=True)) * window[:, None]
    power = np.square(np.abs(np.fft.rfft(cut, axis=1))).mean(axis=0) / (rate_hz * np.square(window).sum())
    power[1:-1] *= 2.0
    return np.asarray(np.fft.rfftfreq(piece, 1.0 / rate_hz)), np.asarray(power, np.float64)


def peaks(values: Array, height: float, prominence: float, apart: int) -> Ints:
    """Places of the peaks of values, shape (n,), in order; of a flat top its middle.

    Parameters
    ----------
    values : ndarray, shape (n,)
    height : float
        Of a peak, at least.
    prominence : float
        By how much one has to go down from it, at least, to get to a higher place or to the end.
    apart : int
        Within so many places the highest stays; of equals the last.
    """
    if not len(values):
        return np.empty(0, np.int64)
    edges = np.flatnonzero(np.diff(values))
    # runs of equal values, and the middle of each
    first, last = np.concatenate([[0], edges + 1]), np.concatenate([edges, [len(values) - 1]])
    level = values[first]
    top = np.flatnonzero((level[1:-1] > level[:-2]) & (level[1:-1] > level[2:])) + 1
    at = (first[top] + last[top]) // 2
    at = at[values[at] >= height]
    kept = np.ones(len(at), np.bool_)
    for i in np.argsort(values[at], kind="stable")[::-1]:
        if kept[i]:
            kept[np.abs(at - at[i]) < apart] = False
            kept[i] = True
    return np.array([i for i in at[kept] if _prominence(values, int(i)) >= prominence], np.int64)


def _prominence(values: Array, at: int) -> float:
    """How far a peak stands above the higher of the lowest places on either side, as far as nothing is higher than it."""
    higher = values > values[at]
    before, after = np.flatnonzero(higher[:at]), np.flatnonzero(higher[at:])
    begin = before[-1] + 1 if len(before) else 0
    end = at + after[0] if len(after) else len(values)
    return float(values[at] - max(values[begin : at + 1].min(), values[at:end].min()))
