"""What the INS believes: the truth with the errors of a low-cost autopilot."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from flightlog.frames import ins_from_frd
from simulator.chance import generator
from simulator.config import InsOptions
from simulator.flight import Flight

Array = npt.NDArray[np.float64]

_STEP_S: Final = 0.1
_TILT_TAU_S: Final = 8.0
_POSITION_SMOOTH_S: Final = 1.5
_MARGIN_S: Final = 10.0


def gauss_markov(rng: np.random.Generator, count: int, sigma: float, tau_s: float, step_s: float) -> Array:
    """A stationary first-order Gauss-Markov process, shape (count,)."""
    keep = np.exp(-step_s / tau_s)
    drive = rng.standard_normal(count) * sigma * np.sqrt(1 - keep**2)
    drive[0] = rng.standard_normal() * sigma
    return np.asarray(lfilter([1.0], [1.0, -keep], drive))


@dataclass(frozen=True, slots=True)
class Belief:
    """Estimates of the INS: arrays of one length n.

    Attributes
    ----------
    heading_rad, pitch_rad, roll_rad : shape (n,); the heading is continuous
    rates_frd_rad_s, force_frd_m_s2 : shape (n, 3), forward right down
    position_m, velocity_m_s : shape (n, 3), local frame
    """

    heading_rad: Array
    pitch_rad: Array
    roll_rad: Array
    rates_frd_rad_s: Array
    force_frd_m_s2: Array
    position_m: Array
    velocity_m_s: Array


class Ins:
    """The INS of one simulation."""

    def __init__(self, flight: Flight, options: InsOptions, seed: int) -> None:
        self._flight, self._options = flight, options
        rng = generator(seed, "ins")
        time_s = np.arange(-_MARGIN_S, flight.duration_s + _MARGIN_S, _STEP_S)
        count, o = len(time_s), options
        tilt = [gauss_markov(rng, count, np.radians(o.tilt_sigma_deg), _TILT_TAU_S, _STEP_S) for _ in range(2)]
        heading = gauss_markov(rng, count, np.radians(o.heading_sigma_deg), _TILT_TAU_S, _STEP_S)
        self._angle_error: BSpline = make_interp_spline(time_s, np.stack([heading, *tilt], axis=1), k=3)
        across = [gauss_markov(rng, count, o.gnss_sigma_m, o.gnss_tau_s, _STEP_S) for _ in range(2)]
        walk = np.cumsum(rng.standard_normal(count)) * o.baro_walk_m * np.sqrt(_STEP_S / 60.0)
        up = o.height_bias_m * rng.standard_normal() + walk - walk[round(_MARGIN_S / _STEP_S)]
        position = gaussian_filter1d(np.stack([*across, up], axis=1), _POSITION_SMOOTH_S / _STEP_S, axis=0)
        self._position_error: BSpline = make_interp_spline(time_s, position, k=3)
        self._velocity_error: BSpline = self._position_error.derivative(1)
        self._gyro_bias: Array = np.radians(o.gyro_bias_deg_s) * rng.standard_normal(3)
        self._compass_phase = rng.uniform(0, 2 * np.pi, 2)

    def compass_error_rad(self, heading_rad: Array) -> Array:
        """Error of the compass at a true heading: what metal on the frame does to it."""
        first = np.sin(heading_rad + self._compass_phase[0])
        second = 0.3 * np.sin(2 * heading_rad + self._compass_phase[1])
        o = self._options
        return np.asarray(np.radians(o.compass_offset_deg + o.compass_bias_deg * (first + second)))

    @property
    def compass_phase_rad(self) -> Array:
        """Phases of the two harmonics of the compass error, shape (2,)."""
        return self._compass_phase

    @property
    def gyro_bias_rad_s(self) -> Array:
        """Constant error of the gyros in the ins frame, shape (3,)."""
        return self._gyro_bias

    def _gain(self, frequency_hz: Array) -> Array:
        """Amplitude of a second-order Butterworth low-pass."""
        return np.asarray(1.0 / np.sqrt(1.0 + (frequency_hz / self._options.gyro_filter_hz) ** 4))

    def belief(self, time_s: Array, rng: np.random.Generator) -> Belief:
        """Estimates at true times, shape (n,); `rng` gives the white noise."""
        o = self._options
        # jitter and delay may point just outside the flight
        time_s = np.clip(time_s - o.gyro_delay_s, 0.0, self._flight.duration_s)
        poses = self._flight.poses(time_s)
        errors = np.asarray(self._angle_error(time_s))
        rates = self._flight.rates_rad_s(time_s, self._gain) + self._gyro_bias
        rates = rates + np.radians(o.gyro_noise_deg_s) * rng.standard_normal(rates.shape)
        force = self._flight.specific_force_m_s2(time_s)
        force = force + o.accel_noise_m_s2 * rng.standard_normal(force.shape)
        position = poses.position_m + self._position_error(time_s)
        return Belief(
            heading_rad=poses.heading_rad + errors[:, 0] + self.compass_error_rad(poses.heading_rad),
            pitch_rad=poses.pitch_rad + errors[:, 1],
            roll_rad=poses.roll_rad + errors[:, 2],
            rates_frd_rad_s=ins_from_frd(rates),  # its own inverse
            force_frd_m_s2=ins_from_frd(force),
            position_m=position + o.position_noise_m * rng.standard_normal(position.shape),
            velocity_m_s=self._flight.velocity_m_s(time_s) + self._velocity_error(time_s),
        )
