"""The line of the spin: the reading of the lidar's own gyro at exactly the frequency of its rotor, as unknowns.

Where that gyro carries the motion between two knots, the line is in the path: one of a degree per second at 10 Hz
turns it by 16 mdeg to and fro. The turn over a slice of one revolution does not show it, and no spline with one knot a
revolution follows it. The path is therefore turned, about each axis of the sensor, by a sine and a cosine of the
rotor's azimuth. The lidar's rows are linear in these six unknowns. Surfaces that always stand at one azimuth show no
residual from them; turns of the vehicle reveal them.

The gyro itself determines the line's size and phase well. It cannot tell whether its reading is wrong, or whether the
head of the sensor does shake. The share that is wrong is one more unknown, which the surfaces have to determine.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.observations.rows import Factor, RowBuilder, Unknowns
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.spline import Path

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

NAME: Final = "lidar.spin"
SHARE: Final = "lidar.spin_share"
UNKNOWNS: Final = 6
PRIOR_RAD_S: Final = np.deg2rad(1.0)
"""What a gyro reads at the spin's frequency, one sigma of sine and cosine: an HDL-32E on a tripod shows 0.2 to 0.6 deg/s."""
EITHER: Final = 0.5
"""Of the line that the gyro reads, this share is its error, and the sigma of that: between none and all."""
BESIDE_HZ: Final = np.concatenate([-np.arange(0.5, 2.05, 0.15), np.arange(0.5, 2.05, 0.15)])
"""Beside the spin's frequency, where a gyro reads as much noise and motion."""
RATES_HZ: Final = np.arange(4.0, 26.0, 0.125)
"""Spins that are sought; lidars of this kind are specified for 5 to 20 Hz."""
SOUGHT: Final = 20
"""Slices on end that the spin is sought in."""
AT_ONCE: Final = 1 << 17
"""Clusters that are looked at together: a window has millions."""
CLEAR: Final = 0.9
"""Coherence of azimuth and time below which nothing spins evenly."""


@dataclass(slots=True)
class Spin:
    """The rotor, and what is known of its line.

    Attributes
    ----------
    azimuth_rad : ndarray, shape (n,)
        Of the rotor on a path's grid, unwrapped.
    rate_rad_s : float
        Mean.
    value_rad : ndarray, shape (6,)
        What the path has been turned by so far: sine and cosine of x, then of y, then of z.
    read_rad, read_sigma_rad : ndarray, shape (6,)
        What it would be, were all of the line that the gyro reads its error; and how well that is told.
    share : float
        Of it that is, so far.
    """

    azimuth_rad: Array
    rate_rad_s: float
    value_rad: Array = field(default_factory=lambda: np.zeros(UNKNOWNS))
    read_rad: Array = field(default_factory=lambda: np.zeros(UNKNOWNS))
    read_sigma_rad: Array = field(default_factory=lambda: np.full(UNKNOWNS, np.inf))
    share: float = EITHER

    def unknowns(self, unknowns: Unknowns) -> None:
        """The six, the gyro's error as the angle that it adds up to; and the share of what the gyro reads."""
        unknowns.add(NAME, np.full(UNKNOWNS, PRIOR_RAD_S / self.rate_rad_s), self.value_rad, unit="deg")
        unknowns.add(SHARE, np.array([EITHER]), np.array([self.share]), np.array([EITHER]))

    def read(self, rates_rad_s: Sequence[tuple[Array, Flags]]) -> None:
        """Find the line in readings on the grid's steps, shape (n, 3), with which of them are known: in those that tell it best."""
        for rate, known in rates_rad_s:
            line, sigma = _demodulated(rate, known, self.azimuth_rad)
            # the turn that undoes what a sine and a cosine of the rate add up to
            found = np.stack([-line[1], line[0]], axis=1).ravel() / self.rate_rad_s
            if sigma.sum() / self.rate_rad_s < self.read_sigma_rad[::2].sum():
                self.read_rad, self.read_sigma_rad = found, np.repeat(sigma, 2) / self.rate_rad_s

    def factors(self, unknowns: Unknowns) -> list[Factor]:
        """The line is a share of the one that was read."""
        if not np.isfinite(self.read_sigma_rad).all():
            return []
        builder = RowBuilder(UNKNOWNS, unknowns)
        builder.by(np.zeros(1, np.int64), NAME, np.eye(UNKNOWNS)[None])
        builder.by(np.zeros(1, np.int64), SHARE, -self.read_rad[None, :, None])
        residual = self.value_rad - self.share * self.read_rad
        return [Factor("spin line", residual, builder.matrix(), self.read_sigma_rad)]

    def take(self, part: Mapping[str, Array]) -> None:
        """Put a solution in."""
        self.value_rad = self.value_rad + part[NAME]
        self.share += float(part[SHARE][0])

    def turns(self, value_rad: Array, every: int = 1) -> Array:
        """Rotation vectors in the body on every `every`-th pose of the grid, shape (m, 3)."""
        azimuth = self.azimuth_rad[::every, None]
        return np.asarray(np.sin(azimuth) * value_rad[0::2] + np.cos(azimuth) * value_rad[1::2])

    def at_knots(self) -> Array:
        """What the path has been turned by at its knots, shape (intervals + 1, 3)."""
        return self.turns(self.value_rad, STEPS)


@dataclass(slots=True)
class SpinColumns:
    """The lidar's rows by the six unknowns.

    Attributes
    ----------
    turning : ndarray of float32, shape (n, 3)
        Rows by a turn in the body [m/rad].
    circle : ndarray of float32, shape (n, 2)
        Sine and cosine of the azimuth of each row's cluster.
    """

    UNKNOWNS: ClassVar[int] = UNKNOWNS

    turning: Singles
    circle: Singles

    def column(self, number: int) -> Array:
        """The rows by one unknown, shape (n,)."""
        axis, part = divmod(number, 2)
        return np.multiply(self.turning[:, axis], self.circle[:, part], dtype=np.float64)

    def along(self, value: Array) -> Array:
        """The rows times the unknowns, shape (6,): shape (n,)."""
        out = np.empty(len(self.circle))
        _along(self.turning, self.circle, value, out)
        return out

    def gradient(self, projected: Array) -> Array:
        """Columns times weighed values less their planes, shape (n,): shape (6,)."""
        out = np.zeros(UNKNOWNS)
        _gradient(self.turning, self.circle, projected, out)
        return out


@njit(cache=True, nogil=True, fastmath=True)
def _along(turning: Any, circle: Any, value: Any, out: Any) -> None:
    for n in range(len(out)):
        sine, cosine = np.float64(circle[n, 0]), np.float64(circle[n, 1])
        x, y, z = (
            sine * value[0] + cosine * value[1],
            sine * value[2] + cosine * value[3],
            sine * value[4] + cosine * value[5],
        )
        out[n] = turning[n, 0] * x + turning[n, 1] * y + turning[n, 2] * z


@njit(cache=True, nogil=True, fastmath=True)
def _gradient(turning: Any, circle: Any, projected: Any, out: Any) -> None:
    """All six in one pass: the rows are many more than the cache holds."""
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(projected)):
        sine, cosine = circle[n, 0] * projected[n], circle[n, 1] * projected[n]
        x, y, z = np.float64(turning[n, 0]), np.float64(turning[n, 1]), np.float64(turning[n, 2])
        a += x * sine
        b += x * cosine
        c += y * sine
        d += y * cosine
        e += z * sine
        f += z * cosine
    out[0], out[1], out[2], out[3], out[4], out[5] = a, b, c, d, e, f


def spin_columns(jacobian: Singles, xyz_m: Singles) -> SpinColumns:
    """Columns of rows, by their turns in the body, and their clusters in the sensor frame."""
    reach = np.maximum(np.hypot(xyz_m[:, 0], xyz_m[:, 1]), 1e-6)[:, None]
    return SpinColumns(jacobian[:, :3], (xyz_m[:, :2] / reach).astype(np.float32))


def spin_of(clusters: Clusters, path: Path) -> Spin | None:
    """The rotor of a lidar all of whose lasers look along one azimuth; None where nothing turns evenly."""
    if not len(clusters):
        return None
    slot = np.empty(len(clusters), np.int32)
    parts = [slice(begin, begin + AT_ONCE) for begin in range(0, len(clusters), AT_ONCE)]
    count = np.zeros(path.intervals)
    for part in parts:
        slot[part] = np.clip((clusters.time_ns[part] - path.start_ns) // (STEPS * path.step_ns), 0, path.intervals - 1)
        count += np.bincount(slot[part], minlength=path.intervals)
    first = int(count.argmax())
    rate = _sought(*_turning(clusters, path, np.flatnonzero((slot >= first) & (slot < first + SOUGHT))))
    if rate is None:
        return None
    east, north = np.zeros((2, path.intervals))
    for part in parts:
        since_s, azimuth = _turning(clusters, path, part)
        off = azimuth - rate * since_s
        east += np.bincount(slot[part], np.sin(off), path.intervals)
        north += np.bincount(slot[part], np.cos(off), path.intervals)
    seen = np.flatnonzero(count)
    if np.hypot(east, north)[seen].sum() < CLEAR * count.sum():
        return None
    phase = np.unwrap(np.arctan2(east[seen], north[seen]))
    grid = np.arange(len(path.quat))
    whole = rate * grid * path.step_ns * 1e-9 + np.interp(grid, (seen + 0.5) * STEPS, phase)
    return Spin(whole, float((whole[-1] - whole[0]) / (len(grid) - 1) / (path.step_ns * 1e-9)))


def _demodulated(rate: Array, known: Flags, azimuth: Array) -> tuple[Array, Array]:
    """Sine and cosine of the azimuth in readings, shape (2, 3), and their sigma, shape (3,), by what is beside that frequency."""
    count = min(len(rate), len(azimuth) - 1)
    weight = np.hanning(count) * known[:count]
    total = weight.sum()
    if total < 1.0:
        return np.zeros((2, 3)), np.full(3, np.inf)
    middle = 0.5 * (azimuth[1 : count + 1] + azimuth[:count])
    level = rate[:count] - (weight @ rate[:count]) / total
    time_s = np.arange(count) * STEP_NS * 1e-9
    line = 2.0 / total * (weight * np.exp(-1j * middle)) @ level
    beside = np.exp(-2j * np.pi * BESIDE_HZ[:, None] * time_s)
    noise = 2.0 / total * (beside * (weight * np.exp(-1j * middle))) @ level
    return np.stack([-line.imag, line.real]), np.sqrt(np.mean(np.abs(noise) ** 2, axis=0) / 2.0)


def _turning(clusters: Clusters, path: Path, which: Any) -> tuple[Array, Array]:
    """Times of some clusters since a path's begin [s], and their azimuths [rad], shape (n,) each."""
    since_s = (clusters.time_ns[which] - path.start_ns) * 1e-9
    return since_s, np.arctan2(*clusters.xyz_m[which, :2].astype(np.float64).T)


def _sought(since_s: Array, azimuth: Array) -> float | None:
    """Rate of the rotor [rad/s] in some slices on end: that by which azimuths and times go together best."""
    every = max(len(since_s) // 4000, 1)
    since_s, azimuth = since_s[::every], azimuth[::every]
    rates = 2.0 * np.pi * RATES_HZ
    together = np.abs(np.exp(1j * (azimuth - rates[:, None] * since_s)).sum(axis=1))
    best = int(together.argmax())
    return float(rates[best]) if together[best] > 0.5 * len(since_s) else None
