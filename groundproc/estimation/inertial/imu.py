"""The gyros and accelerometers of autopilot and lidar, made into one IMU on one grid of time.

The autopilot's sensors are better, but a slow link sends few of their samples, with stamps that jitter. The lidar's
come 200 times a second. A least-squares fit finds the matrix and the offset that bring the lidar's readings to the
autopilot's (mount, scale, misalignment and a sensor of the wrong sign included). The combination follows the lidar's
readings in fast motion. At low frequency it is pulled towards the autopilot's by the share that leaves the least
noise, which follows from the difference of the two (Wiener).
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import Akima1DInterpolator, CubicSpline
from scipy.ndimage import gaussian_filter1d

from groundproc.flight.sync.tracks import low_pass
from groundproc.machine.aside import aside
from groundproc.numerics import robust
from groundproc.numerics.filters import butterworth, forward_and_back, spectrum

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LONGEST_HOLE_S: Final = 0.05
"""Between samples of the lidar; over more than this it is not followed."""
LONGEST_SLOW_HOLE_S: Final = 0.3
"""Between samples of the autopilot."""
SHARED_HZ: Final = 20.0
"""Band in which the two are compared."""
ALIGNED_HZ: Final = 5.0
"""Band in which the lidar's are fitted: beyond it filters and jittering stamps take from the autopilot's readings, and a fit would take
that for a scale. What a slow link aliases is no bias there, only noise."""
SWUNG_HZ: Final = 10.0
"""Up to here the force of the lidar's swinging about the INS is taken off; beyond, it moves nothing far."""
BLOCKS_S: Final = (0.4, 1.0, 2.5)
"""Lengths over which differences are averaged to tell their noise at low frequency; the worst counts: vibration aliases to lines."""
NOISE_S: Final = 5.0
"""Stretch over which noise is learnt."""
FLOOR_HZ: Final = (5.0, 25.0)
FLOOR_QUANTILE: Final = 0.25
"""The fast sensor's spectrum shows its noise above what an aircraft does and below where means over steps take some of it away, and between
the lines and bands that rotors make: in the quiet quarter."""
FLOOR_STEPS: Final = 512
"""Of a piece of which a spectrum is made; shorter signals than two of them show none."""
LEAST_COMMON: Final = 50
MOST_ALIGNED: Final = 40_000
"""Samples of a fit."""
LEVER_SIGMA_M: Final = 0.1
"""Where in its housing the lidar has its accelerometers, and whether its readings are theirs at all."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of three sensors at right angles.

    Attributes
    ----------
    name : str
    time_s : ndarray, shape (n,)
        Increasing.
    value : ndarray, shape (n, 3)
    """

    name: str
    time_s: Array
    value: Array

    @property
    def rate_hz(self) -> float:
        """Median rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.time_s)))


@dataclass(frozen=True, slots=True)
class Alignment:
    """How the lidar's readings become the autopilot's: matrix @ reading + offset.

    Attributes
    ----------
    matrix : ndarray, shape (3, 3)
    offset : ndarray, shape (3,)
    lever_m : ndarray, shape (3,)
        Place of the lidar's accelerometers in the ins frame as the fit has it; zero for gyros.
    """

    matrix: Array
    offset: Array
    lever_m: Array


@dataclass(frozen=True, slots=True)
class Signal:
    """One quantity on the grid: its mean over each step.

    Attributes
    ----------
    mean : ndarray, shape (n, 3)
    density : ndarray, shape (n,)
        Power spectral density of its noise: the variance of its integral grows by this in a second.
    known : ndarray of bool, shape (n,)
        Whether a sensor was there.
    sources : str
    share : float
        How much of the autopilot's sensor is in it at low frequency; 1 where the lidar's is not there.
    alignment : Alignment or None
    """

    mean: Array
    density: Array
    known: Mask
    sources: str
    share: float = 1.0
    alignment: Alignment | None = None

    def set_aside(self) -> "Signal":
        """The same in a file, of which is in memory what is read."""
        mean, density, known = aside(self.mean, self.density, self.known)
        return replace(self, mean=mean, density=density, known=known)


def noise_density(samples: Samples, time_s: Array) -> Array:
    """Power spectral density of the noise about some times, shape as these: the residual of a cubic through six samples.

    The residual is taken as white. Motion that the samples are too slow for counts as noise, because it is what
    integrating them will miss. It changes in flight, so the mean is over `NOISE_S` around each time.
    """
    count = len(samples.time_s) // 6
    if count < 5:
        return np.full(len(time_s), 1e3)
    stamp_s = samples.time_s[: 6 * count].reshape(count, 6)
    value = samples.value[: 6 * count].reshape(count, 6, 3)
    span = stamp_s[:, -1:] - stamp_s[:, :1]
    basis = ((stamp_s - stamp_s[:, :1]) / span)[..., None] ** np.arange(4)
    fitted, _ = np.linalg.qr(basis)
    left = value - fitted @ (np.swapaxes(fitted, 1, 2) @ value)
    density = np.square(left).sum(axis=(1, 2)) / 2.0 / 3.0 * span[:, 0] / 5.0
    # groups of samples with a hole among them tell nothing
    whole = span[:, 0] < 2.0 * np.median(span)
    middle_s, density = stamp_s[whole, 2], density[whole]
    around = max(NOISE_S / (6.0 * float(np.median(np.diff(samples.time_s)))), 1.5)
    return np.interp(time_s, middle_s, gaussian_filter1d(density, around / 2.0, mode="nearest"))


def white_share(mean: Array, good: Mask, step_s: float, density: float) -> float:
    """The share of a density that is white, and so continues down to the slowest motion; the rest is vibration.

    Vibration integrates to nothing. Rotors push accelerometers by 1 to 2 m/s^2 between 10 and 40 Hz, the lidar's own
    by 0.4. Taken for white, that was 20 times their noise: matrices came out 1.1 to 1.3 times too large, the noisier
    readings were followed, and heights went astray in turns.

    Parameters
    ----------
    mean : ndarray, shape (n, 3)
        Over the steps.
    good : ndarray of bool, shape (n,)
    step_s : float
    density : float
        What `noise_density` makes of the samples, on average.
    """
    if len(mean) < 2 * FLOOR_STEPS or not good.any():
        return 1.0
    at_hz, one_sided = spectrum(mean, 1.0 / step_s, FLOOR_STEPS)
    inside = (at_hz > FLOOR_HZ[0]) & (at_hz < FLOOR_HZ[1])
    quiet = float(np.quantile(one_sided[inside].mean(axis=1), FLOOR_QUANTILE))
    floor = 0.5 * quiet / float(good.mean())
    return float(np.clip(floor / density, 0.01, 1.0))


def step_means(samples: Samples, nodes_s: Array, longest_s: float, smooth: bool) -> tuple[Array, Mask]:
    """Mean over each step between nodes, shape (n - 1, 3), and where the samples have no hole.

    The curve between samples is piecewise cubic: a linear one would add 0.025 deg/sqrt(s) where rotors shake a sensor
    that is read irregularly. With `smooth` it is the spline of continuous curvature, for samples that are few.
    """
    time_s, value = samples.time_s, samples.value
    within = np.clip(nodes_s, time_s[0], time_s[-1])
    # Akima's is local: a hole spoils nothing beyond its neighbours
    curve = CubicSpline(time_s, value, axis=0) if smooth else Akima1DInterpolator(time_s, value, axis=0)
    integral = curve.antiderivative()(within)
    mean = np.diff(integral, axis=0) / np.diff(nodes_s)[:, None]
    left = np.clip(np.searchsorted(time_s, nodes_s, side="right") - 1, 0, len(time_s) - 2)
    inside = (nodes_s >= time_s[0]) & (nodes_s <= time_s[-1])
    good = inside & (time_s[left + 1] - time_s[left] <= longest_s)
    return mean, good[1:] & good[:-1]


def lever_matrices(rate_rad_s: Array, turning_rad_s2: Array) -> Array:
    """Matrices that give, times a lever arm, the acceleration of its end against that of its origin, shape (n, 3, 3)."""
    w, a = rate_rad_s, turning_rad_s2
    square = np.einsum("ni,nj->nij", w, w) - np.square(w).sum(axis=1)[:, None, None] * np.eye(3)
    zero = np.zeros(len(w))
    cross = np.stack(
        [
            np.stack([zero, -a[:, 2], a[:, 1]], axis=1),
            np.stack([a[:, 2], zero, -a[:, 0]], axis=1),
            np.stack([-a[:, 1], a[:, 0], zero], axis=1),
        ],
        axis=1,
    )
    return np.asarray(square + cross)


def flat_low_pass(values: Array, cutoff_hz: float, rate_hz: float) -> Array:
    """Low-pass along the first axis that leaves slow motion its size: Butterworth of fourth order, forward and back."""
    sections = butterworth(min(cutoff_hz, 0.45 * rate_hz), rate_hz)
    padding = min(round(3 * rate_hz / cutoff_hz), len(values) - 1)
    return forward_and_back(sections, values, padding)


def align(
    slow: Array,
    fast: Array,
    gentle: Array,
    noise: float,
    prior: Array,
    prior_sigma: float,
    levers: Array | None,
    lever_m: Array,
) -> Alignment:
    """Fit slow = matrix @ fast + offset - levers @ lever, robustly.

    The slow part of the fast readings is the instrument of the fit (instrumental variables). Otherwise, the fast
    motion that is lost to jittering stamps and filters would be taken for a scale error.

    Parameters
    ----------
    slow, fast, gentle : ndarray, shape (n, 3)
        At the same instants; `gentle` is the slow part of `fast`.
    noise : float
        Covariance of the noise in the last two, which would shrink the matrix.
    prior, prior_sigma : ndarray of shape (3, 3), float
        The matrix as the mount has it; an axis that hardly moved keeps it.
    levers : ndarray, shape (n, 3, 3), or None
        From `lever_matrices`: accelerations at the other sensor differ by these times the lever arm.
    lever_m : ndarray, shape (3,)
        Nominal.
    """
    if len(slow) > MOST_ALIGNED:
        pick = np.linspace(0, len(slow) - 1, MOST_ALIGNED).astype(int)
        slow, fast, gentle = slow[pick], fast[pick], gentle[pick]
        levers = None if levers is None else levers[pick]
    centre = fast.mean(axis=0)
    count, unknowns = len(slow), 15 if levers is not None else 12
    design, instrument = np.zeros((count, 3, unknowns)), np.zeros((count, 3, unknowns))
    for matrix, values in ((design, fast), (instrument, gentle)):
        for axis in range(3):
            matrix[:, axis, 3 * axis : 3 * axis + 3] = values - centre
            matrix[:, axis, 9 + axis] = 1.0
        if levers is not None:
            matrix[:, :, 12:] = -levers
    expected = np.concatenate([prior.ravel(), slow.mean(axis=0), lever_m])[:unknowns]
    trust = np.concatenate([np.full(9, prior_sigma**-2.0), np.full(3, 1e-12), np.full(3, LEVER_SIGMA_M**-2.0)])[
        :unknowns
    ]
    found = expected
    for _ in range(4):
        left = slow - design @ found
        spread = np.maximum(robust.sigma_of_columns(left), 1e-9)
        weight = robust.cauchy(left / (3.0 * spread)) / spread**2
        normal = np.einsum("nai,na,naj->ij", instrument, weight, design)
        for axis in range(3):
            part = slice(3 * axis, 3 * axis + 3)
            normal[part, part] -= weight[:, axis].sum() * noise * np.eye(3)
        right = np.einsum("nai,na,na->i", instrument, weight, slow) + trust * expected
        found = np.linalg.solve(normal + np.diag(trust), right)
    turned = found[:9].reshape(3, 3)
    return Alignment(turned, found[9:12] - turned @ centre, found[12:] if levers is not None else np.zeros(3))


def _low_frequency_density(time_s: Array, difference: Array) -> Array:
    """Power spectral density at low frequency, shape (3,): the largest of `BLOCKS_S`."""
    found = np.stack([_allan_density(time_s, difference, block_s) for block_s in BLOCKS_S])
    return np.asarray(np.where(np.isfinite(found[0]), np.where(np.isfinite(found), found, 0.0).max(axis=0), np.inf))


def _allan_density(time_s: Array, difference: Array, block_s: float) -> Array:
    block = ((time_s - time_s[0]) / block_s).astype(int)
    number = np.bincount(block)
    mean = np.stack([np.bincount(block, axis) for axis in difference.T], axis=1) / np.maximum(number, 1)[:, None]
    whole = number >= 0.5 * np.median(number[number > 0])
    pairs = whole[1:] & whole[:-1]
    if pairs.sum() < 5:
        return np.full(3, np.inf)
    step = np.square(np.diff(mean, axis=0)[pairs])
    return np.asarray(np.median(step, axis=0) / 0.455 / 2.0 * block_s)


def combine(
    nodes_s: Array,
    slow: Samples | None,
    fast: Samples | None,
    mat_ins_fast: Array,
    prior_sigma: float,
    rate_rad_s: Array | None = None,
    lever_m: Array | None = None,
) -> Signal | None:
    """One signal of the autopilot's samples and the lidar's; None where there are neither.

    Parameters
    ----------
    nodes_s : ndarray, shape (n,)
        A regular grid.
    slow, fast : Samples or None
        The autopilot's in the ins frame, the lidar's in its own.
    mat_ins_fast, prior_sigma : ndarray of shape (3, 3), float
        What the mount says of the lidar's axes, and by how much each element may differ.
    rate_rad_s, lever_m : ndarray, optional
        For accelerometers: body rate over each step, shape (n - 1, 3), and nominal place of the lidar in the ins frame.
    """
    step_s = float(nodes_s[1] - nodes_s[0])
    if fast is None:
        return None if slow is None else _alone(nodes_s, slow)
    mean, good = step_means(fast, nodes_s, LONGEST_HOLE_S, smooth=False)
    middle_s = nodes_s[:-1] + 0.5 * step_s
    density = noise_density(fast, middle_s)
    levers = None
    if rate_rad_s is not None and lever_m is not None:
        gentle = flat_low_pass(rate_rad_s, SWUNG_HZ, 1.0 / step_s)
        levers = lever_matrices(gentle, np.gradient(gentle, step_s, axis=0))
        density *= white_share(mean, good, step_s, float(density.mean()))
    own = float(density.mean())
    common = None if slow is None else _common(slow, middle_s, good)
    if slow is None or common is None:
        alignment = Alignment(mat_ins_fast, np.zeros(3), np.zeros(3) if lever_m is None else lever_m)
        told = mean @ alignment.matrix.T
        if levers is not None:
            told -= levers @ alignment.lever_m
        return Signal(told, density, good, fast.name, 0.0, alignment)
    time_s, place, chosen = common
    cutoff_hz = min(SHARED_HZ, 0.4 * slow.rate_hz)
    at = CubicSpline(middle_s, flat_low_pass(mean, cutoff_hz, 1.0 / step_s), axis=0)(time_s)
    shared_at = CubicSpline(middle_s, flat_low_pass(mean, SHARED_HZ, 1.0 / step_s), axis=0)(time_s)
    gentle_at = CubicSpline(middle_s, flat_low_pass(mean, ALIGNED_HZ, 1.0 / step_s), axis=0)(time_s)
    shared_noise = own * 2.0 * ALIGNED_HZ
    lever_rows = None if levers is None else levers[place]
    nominal = np.zeros(3) if lever_m is None else lever_m
    slow_value = slow.value[chosen]
    alignment = align(slow_value, shared_at, gentle_at, shared_noise, mat_ins_fast, prior_sigma, lever_rows, nominal)
    told = mean @ alignment.matrix.T + alignment.offset
    predicted = at @ alignment.matrix.T + alignment.offset
    if levers is not None and lever_rows is not None:
        told -= levers @ alignment.lever_m
        predicted -= lever_rows @ alignment.lever_m
    difference = slow_value - predicted
    centre = np.median(difference, axis=0)
    limit = 6.0 * robust.sigma_of_columns(difference, centre)
    difference = np.clip(difference, centre - limit, centre + limit)
    both = _low_frequency_density(time_s, difference)
    other = np.maximum(both - own, 0.02 * own)
    weight = np.where(np.isfinite(both), own / (own + other), 0.0)
    on_grid = np.stack([np.interp(middle_s, time_s, axis) for axis in difference.T], axis=1)
    told += weight * low_pass(on_grid, float(np.clip(0.12 * slow.rate_hz, 0.5, 15.0)), 1.0 / step_s)
    share = float(weight.mean())
    fused = Signal(told, density * (1.001 - share), good, f"{slow.name}, {fast.name}", share, alignment)
    return fused if good.all() else _filled(fused, _alone(nodes_s, slow))


def _common(slow: Samples, middle_s: Array, good: Mask) -> tuple[Array, npt.NDArray[np.int64], Mask] | None:
    """Times of the slow samples that lie where the fast ones are good, the steps they lie in, and which they are."""
    place = np.clip(np.searchsorted(middle_s, slow.time_s), 0, len(middle_s) - 1)
    share = (slow.time_s > middle_s[0]) & (slow.time_s < middle_s[-1]) & good[place]
    if share.sum() < LEAST_COMMON:
        return None
    return slow.time_s[share], place[share], share


def _alone(nodes_s: Array, slow: Samples) -> Signal:
    mean, good = step_means(slow, nodes_s, max(LONGEST_SLOW_HOLE_S, 3.0 / slow.rate_hz), smooth=True)
    return Signal(mean, noise_density(slow, 0.5 * (nodes_s[1:] + nodes_s[:-1])), good, slow.name)


def _filled(signal: Signal, other: Signal) -> Signal:
    """A signal with another in its holes."""
    return Signal(
        np.where(signal.known[:, None], signal.mean, other.mean),
        np.where(signal.known, signal.density, other.density),
        signal.known | other.known,
        signal.sources,
        signal.share,
        signal.alignment,
    )
