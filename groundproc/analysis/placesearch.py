"""Where a cloud lies on another when neither its place nor its heading is known; both only have to stand upright.

The tops of cells, without objects wider than some cells, are compared for every heading and every shift, by their
correlation over the cells that both have (masked correlation by Fourier transforms, Padfield 2012). How large that can
be by chance follows from the number of independent places in the common area; neighbouring cells are not independent.
A correlation that chance cannot explain at one place, and nowhere else, is an answer; at two places, it is none.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.ndimage import gaussian_filter

from flightlog.errors import CoverageError

Array = npt.NDArray[np.float64]
Sheet = npt.NDArray[np.float32]
Spectrum = npt.NDArray[np.complexfloating[Any, Any]]

_CELLS: Final = 96
"""Along the longer side of the larger cloud."""
_LEAST_CELL_M: Final = 0.5
_MOST_POINTS: Final = 100_000
_COARSE_POINTS: Final = 40_000
_SMOOTH_CELLS: Final = 6.0
_CLIP_M: Final = 3.0
"""Higher relief counts as this: one mast is not the place."""
_LEAST_SHARE: Final = 0.25
"""Of the smaller cloud that has to lie on the other."""
_SURE: Final = 8.0
"""Sigmas of chance: of ten million places tried the best one of a wrong cloud has 5.5."""
_RIVAL: Final = 0.8
"""Another place may be so likely, as a share of the best one's sigmas."""
_SAME_CELLS, _SAME_RAD = 4.0, np.deg2rad(6.0)
"""What is so near is the same place."""
_CANDIDATES: Final = 8


@dataclass(frozen=True, slots=True)
class Found:
    """A place of B on A.

    Attributes
    ----------
    turn_rad : float
        Of B about the vertical, counter-clockwise.
    shift_m : ndarray, shape (3,)
        Added to the turned B.
    correlation : float
        Of the relief of both, 1 at best.
    sigmas : float
        How far that is from chance.
    """

    turn_rad: float
    shift_m: Array
    correlation: float
    sigmas: float

    @property
    def matrix(self) -> Array:
        """A from B, shape (4, 4)."""
        out = np.eye(4)
        out[:2, :2] = _turn(self.turn_rad)
        out[:3, 3] = self.shift_m
        return out


@dataclass(frozen=True, slots=True)
class _Relief:
    """Tops of cells, and their relief; cells without points have 0 and are not in `known`."""

    top: Sheet
    relief: Sheet
    known: npt.NDArray[np.bool_]
    column: int
    row: int


@dataclass(frozen=True, slots=True)
class _Candidate:
    turn_rad: float
    shift: Array
    sigmas: float
    correlation: float


def search(a_m: Array, b_m: Array, what: str) -> Found:
    """Find where B lies on A.

    Parameters
    ----------
    a_m, b_m : ndarray, shape (n, 3)
        Samples of both, upright.
    what : str
        For the sentence.

    Raises
    ------
    CoverageError
        Nowhere, or at several places alike.
    """
    a, b = _thinned(a_m, _MOST_POINTS), _thinned(b_m, _MOST_POINTS)
    about_a, about_b = a.mean(axis=0), b.mean(axis=0)
    a, b = a - about_a, b - about_b
    longest = max(np.ptp(each[:, axis]) for each in (a, b) for axis in (0, 1))
    cell_m = max(longest / _CELLS, _LEAST_CELL_M)
    candidates = _coarse(_thinned(a, _COARSE_POINTS), _thinned(b, _COARSE_POINTS), cell_m)
    if not candidates:
        raise CoverageError(
            f"{what}: too little relief to find one on the other; expected houses, trees or hollows on both"
        )
    refined = _distinct([_refined(a, b, each, cell_m / 2.0) for each in candidates], cell_m)
    best = refined[0]
    if best.sigmas < _SURE:
        raise CoverageError(
            f"{what}: no place of the second on the first is likely (correlation {best.correlation:.2f}, {best.sigmas:.1f} sigmas of "
            f"chance, expected {_SURE:g}): are they of one place?"
        )
    if len(refined) > 1 and refined[1].sigmas > _RIVAL * best.sigmas:
        rival = refined[1]
        apart = np.hypot(*(rival.shift - best.shift))
        raise CoverageError(
            f"{what}: the second lies on the first at two places alike (correlation {best.correlation:.2f} and {rival.correlation:.2f}, "
            f"{apart:.1f} m and {np.rad2deg(_wrapped(rival.turn_rad - best.turn_rad)):.0f} deg apart), so that none is chosen; "
            "more of the surroundings would tell"
        )
    height_m = _height(a, b, best, cell_m / 2.0)
    turn = np.eye(3)
    turn[:2, :2] = _turn(best.turn_rad)
    shift = np.array([*best.shift, height_m]) + about_a - turn @ about_b
    return Found(best.turn_rad, shift, best.correlation, best.sigmas)


def _thinned(xyz: Array, most: int) -> Array:
    return np.asarray(xyz[:: max(1, -(-len(xyz) // most))], np.float64)


def _turn(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _turned(xyz: Array, angle: float) -> Array:
    return np.column_stack([xyz[:, :2] @ _turn(angle).T, xyz[:, 2]])


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _relief_of(xyz: Array, cell_m: float) -> _Relief:
    place = np.floor(xyz[:, :2] / cell_m).astype(np.int64)
    column, row = (int(each) for each in place.min(axis=0))
    columns, rows = (int(each) for each in place.max(axis=0) - (column, row) + 1)
    top = np.full((rows, columns), -np.inf, np.float32)
    np.maximum.at(top, (place[:, 1] - row, place[:, 0] - column), xyz[:, 2].astype(np.float32))
    known = np.isfinite(top)
    top = np.where(known, top, np.float32(0.0))
    weight = gaussian_filter(known.astype(np.float32), _SMOOTH_CELLS, mode="constant")
    smooth = gaussian_filter(top, _SMOOTH_CELLS, mode="constant") / np.maximum(weight, 1e-6)
    relief = np.where(known, np.clip(top - smooth, -_CLIP_M, _CLIP_M), 0.0).astype(np.float32)
    return _Relief(top, relief, known, column, row)


def _spread(relief: _Relief) -> float:
    """Cells that are one independent place: the sum of the squared autocorrelation."""
    shape = [fft.next_fast_len(2 * size) for size in relief.relief.shape]
    values = relief.relief - relief.relief[relief.known].mean() * relief.known
    power = np.abs(fft.rfft2(values, shape)) ** 2
    alike = fft.irfft2(power, shape)
    return float(np.sum((alike / alike[0, 0]) ** 2)) if alike[0, 0] > 0.0 else float("inf")


class _Correlator:
    """Masked correlation of one relief with others."""

    def __init__(self, a: _Relief, largest: int) -> None:
        self._a = a
        self._shape = [fft.next_fast_len(size + largest, real=True) for size in a.relief.shape]
        known = a.known.astype(np.float32)
        self._of_a = [fft.rfft2(each, self._shape) for each in (known, a.relief, a.relief**2)]

    def best(self, b: _Relief, fewest: float, spread: float) -> tuple[float, float, int, int] | None:
        """Sigmas and correlation at the likeliest shift, and that in cells (columns, rows)."""
        known = b.known.astype(np.float32)
        mask, value, square = (np.conj(fft.rfft2(each, self._shape)) for each in (known, b.relief, b.relief**2))

        def together(first: Spectrum, second: Spectrum) -> Sheet:
            return np.asarray(fft.irfft2(first * second, self._shape))

        both = np.maximum(together(self._of_a[0], mask), 1.0)
        sum_a, sum_b = together(self._of_a[1], mask), together(self._of_a[0], value)
        var_a = together(self._of_a[2], mask) - sum_a**2 / both
        var_b = together(self._of_a[0], square) - sum_b**2 / both
        joint = together(self._of_a[1], value) - sum_a * sum_b / both
        floor = 1e-4 * both  # a relief of a centimetre is none
        good = (both >= fewest) & (var_a > floor) & (var_b > floor)
        if not good.any():
            return None
        correlation = np.clip(np.where(good, joint / np.sqrt(np.where(good, var_a * var_b, 1.0)), 0.0), -0.999, 0.999)
        sigmas = np.arctanh(correlation) * np.sqrt(both / spread)
        place = np.unravel_index(int(np.argmax(sigmas)), sigmas.shape)
        down, right = (int(at) - (size if at > size - length else 0) for at, size, length in zip(
            place, self._shape, b.relief.shape, strict=True))  # fmt: skip
        return float(sigmas[place]), float(correlation[place]), right, down


def _coarse(a: Array, b: Array, cell_m: float) -> list[_Candidate]:
    """The likeliest places of all headings, apart from each other."""
    first = _relief_of(a, cell_m)
    reach = float(np.linalg.norm(b[:, :2], axis=1).max())
    correlator = _Correlator(first, int(2.0 * reach / cell_m) + 2)
    spread = _spread(first)
    if not np.isfinite(spread):
        return []
    headings = max(int(np.ceil(2.0 * np.pi * 0.6 * reach / cell_m)), 36)
    found = []
    for turn in np.arange(headings) * 2.0 * np.pi / headings:
        other = _relief_of(_turned(b, turn), cell_m)
        fewest = _LEAST_SHARE * min(int(first.known.sum()), int(other.known.sum()))
        best = correlator.best(other, fewest, spread)
        if best is not None:
            sigmas, correlation, right, down = best
            shift = np.array([first.column - other.column + right, first.row - other.row + down]) * cell_m
            found.append(_Candidate(_wrapped(float(turn)), shift, sigmas, correlation))
    return _distinct(found, cell_m)[:_CANDIDATES]


def _distinct(found: list[_Candidate], cell_m: float) -> list[_Candidate]:
    """The likeliest first, without those that are the same place as a likelier one."""
    kept: list[_Candidate] = []
    for each in sorted(found, key=lambda candidate: -candidate.sigmas):
        if not any(
            np.hypot(*(each.shift - other.shift)) < _SAME_CELLS * cell_m
            and abs(_wrapped(each.turn_rad - other.turn_rad)) < _SAME_RAD
            for other in kept
        ):
            kept.append(each)
    return kept


def _refined(a: Array, b: Array, candidate: _Candidate, cell_m: float) -> _Candidate:
    """A candidate with smaller cells, moved to where it is likeliest by halving steps."""
    first = _relief_of(a, cell_m)
    spread = _spread(first)
    reach = float(np.linalg.norm(b[:, :2], axis=1).max())
    step = np.array([2.0 * cell_m / (0.6 * reach), 2.0 * cell_m, 2.0 * cell_m])
    place = np.array([candidate.turn_rad, *candidate.shift])
    best = _at(first, b, place, cell_m, spread)
    while step[1] > 0.2 * cell_m:
        moved = False
        for axis in range(3):
            for sign in (-1.0, 1.0):
                trial = place.copy()
                trial[axis] += sign * step[axis]
                told = _at(first, b, trial, cell_m, spread)
                if told[0] > best[0]:
                    place, best, moved = trial, told, True
        if not moved:
            step *= 0.5
    return _Candidate(_wrapped(float(place[0])), place[1:], *best)


def _common(first: _Relief, other: _Relief) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
    """The cells of both that lie on each other."""
    low = max(first.column, other.column), max(first.row, other.row)
    high = (
        min(first.column + first.known.shape[1], other.column + other.known.shape[1]),
        min(first.row + first.known.shape[0], other.row + other.known.shape[0]),
    )
    if low[0] >= high[0] or low[1] >= high[1]:
        return None
    a, b = (
        (slice(low[1] - each.row, high[1] - each.row), slice(low[0] - each.column, high[0] - each.column))
        for each in (first, other)
    )
    return a, b


def _at(first: _Relief, b: Array, place: Array, cell_m: float, spread: float) -> tuple[float, float]:
    """Sigmas and correlation at one place."""
    other = _relief_of(_turned(b, place[0]) + np.array([place[1], place[2], 0.0]), cell_m)
    common = _common(first, other)
    if common is None:
        return 0.0, 0.0
    both = first.known[common[0]] & other.known[common[1]]
    if both.sum() < _LEAST_SHARE * min(first.known.sum(), other.known.sum()):
        return 0.0, 0.0
    u, v = first.relief[common[0]][both].astype(np.float64), other.relief[common[1]][both].astype(np.float64)
    u, v = u - u.mean(), v - v.mean()
    scale = np.sqrt((u @ u) * (v @ v))
    if scale <= 1e-4 * len(u):
        return 0.0, 0.0
    correlation = float(np.clip(u @ v / scale, -0.999, 0.999))
    return float(np.arctanh(correlation) * np.sqrt(len(u) / spread)), correlation


def _height(a: Array, b: Array, best: _Candidate, cell_m: float) -> float:
    """How far A lies above B, by the tops of the cells that both have."""
    first, other = _relief_of(a, cell_m), _relief_of(_turned(b, best.turn_rad) + np.array([*best.shift, 0.0]), cell_m)
    common = _common(first, other)
    assert common is not None
    both = first.known[common[0]] & other.known[common[1]]
    return float(np.median(first.top[common[0]][both] - other.top[common[1]][both]))
