"""The line of the spin, in time: the reading of the lidar's gyro at the frequency of its rotor, from all data so far.

A line of a degree per second at 10 Hz turns the path by 16 mdeg to and fro, within each slice alike. The azimuth of
the returns says where the rotor is. A sine and a cosine of it are fitted to the readings, less their mean over one
revolution: that keeps the line and removes what is slow. Gusts at that frequency are no line, and average out. Until
they have, the line is believed to the extent that it stands out.

All of it is taken to be the gyro's error. Only the adjustment can tell, by surfaces, whether the head really shakes.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.motion import MotionGrid
from groundproc.estimation.odometry.slices import Slice

Array = npt.NDArray[np.float64]

EVERY: Final = 8
"""Of the returns of a slice one in so many says where the rotor is."""
BASE_NS: Final = (1_000_000, 6_000_000)
"""Between returns so far apart its rate is told: some tens of degrees."""
RATES_RAD_S: Final = (2.0 * np.pi * 8.0, 2.0 * np.pi * 30.0)
"""Rates of the rotor whose line is sought. Slower ones are where gusts and control move the vehicle: at 300 rpm, 119 mdeg with the line and
87 without."""
FEWEST: Final = 50
"""Returns that say where the rotor is."""
EVENLY: Final = 0.98
"""Coherence of azimuth and time in a slice, from which on it is a rotor."""
FEWEST_SLICES: Final = 20
"""Slices that tell how large the line is."""


@dataclass(slots=True)
class Line:
    """Sine and cosine of the rotor's azimuth in the readings of a gyro, as known so far.

    Attributes
    ----------
    count : int
        Slices.
    total : ndarray of complex128, shape (3,)
        Sum of what each tells.
    square : ndarray, shape (3,)
        Sum of its squares.
    """

    count: int = 0
    total: npt.NDArray[np.complex128] = field(default_factory=lambda: np.zeros(3, np.complex128))
    square: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def value_rad_s(self) -> npt.NDArray[np.complex128]:
        """The line, shape (3,): its real part goes with the cosine, its imaginary part with minus the sine."""
        if self.count < FEWEST_SLICES:
            return np.zeros(3, np.complex128)
        mean = self.total / self.count
        size = np.abs(mean) ** 2
        noise = np.maximum(self.square / self.count - size, 0.0) / self.count
        return np.asarray(mean * np.maximum(size - noise, 0.0) / np.maximum(size, 1e-18))

    def reversed(self) -> "Line":
        """The line of the same readings with time reversed: their signs change."""
        return Line(self.count, -self.total, self.square.copy())

    def read(self, motion: MotionGrid, piece: Slice) -> Array:
        """Take the readings up to the end of a slice; what the line makes of each of its steps, shape (STEPS, 3) [rad/s]."""
        found = rotor(piece, motion.start_ns)
        if found is None:
            return np.zeros((STEPS, 3))
        azimuth, rate = found
        first = piece.number * STEPS
        turn = 2.0 * np.pi / abs(rate) / (STEP_NS * 1e-9)
        begin = first - int(np.ceil(0.5 * turn))
        low, high = begin - int(np.ceil(0.5 * turn)), first + STEPS
        if low >= 0 and motion.known[low:high].all():
            sums = np.zeros((high - low + 1, 3))
            np.cumsum(motion.rate_rad_s[low:high], axis=0, out=sums[1:])
            steps = np.arange(STEPS, dtype=np.float64) + (begin - low)
            level = _at(sums, steps + 0.5 + 0.5 * turn) - _at(sums, steps + 0.5 - 0.5 * turn)
            lively = motion.rate_rad_s[begin : begin + STEPS] - level / turn
            angle = azimuth + rate * (np.arange(STEPS) + begin - first) * (STEP_NS * 1e-9)
            told = 2.0 / STEPS * np.exp(-1j * angle) @ lively
            self.count += 1
            self.total += told
            self.square += np.abs(told) ** 2
        angle = azimuth + rate * np.arange(STEPS) * (STEP_NS * 1e-9)
        return np.asarray((self.value_rad_s * np.exp(1j * angle)[:, None]).real)


def rotor(piece: Slice, start_ns: int) -> tuple[float, float] | None:
    """Azimuth of the rotor in the middle of a slice's first step, and its rate [rad/s]; None where nothing turns evenly."""
    some = piece.xyz_m[::EVERY].astype(np.float64)
    since_ns = piece.time_ns[::EVERY] - (start_ns + piece.number * SLICE_NS + STEP_NS // 2)
    if len(some) < FEWEST:
        return None
    azimuth = np.arctan2(some[:, 0], some[:, 1])
    later = np.searchsorted(since_ns, since_ns + BASE_NS[0])
    inside = later < len(some)
    apart = since_ns[later[inside]] - since_ns[inside]
    near = apart < BASE_NS[1]
    if near.sum() < FEWEST:
        return None
    turned = np.angle(np.exp(1j * (azimuth[later[inside]] - azimuth[inside])))[near]
    rate = float(np.median(turned / (apart[near] * 1e-9)))
    if not RATES_RAD_S[0] < abs(rate) < RATES_RAD_S[1]:
        return None
    together = np.exp(1j * (azimuth - rate * since_ns * 1e-9)).mean()
    return (float(np.angle(together)), rate) if abs(together) > EVENLY else None


def _at(sums: Array, place: Array) -> Array:
    """Sums of rows up to places between them, shape (n, 3)."""
    index = np.clip(place.astype(np.int64), 0, len(sums) - 2)
    return np.asarray(sums[index] + (place - index)[:, None] * (sums[index + 1] - sums[index]))
