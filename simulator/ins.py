"""What the INS believes: the truth with the errors of a low-cost autopilot."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from flightlog.frames import ins_from_frd, mat_local_ins
from simulator.chance import generator
from simulator.config import FaultOptions, InsOptions
from simulator.faults import Glitch, Outage
from simulator.flight import Flight
from simulator.imu import Triad, Wander

Array = npt.NDArray[np.float64]

_STEP_S: Final = 0.1
_TILT_TAU_S: Final = 8.0
_POSITION_SMOOTH_S: Final = 1.5
_MARGIN_S: Final = 10.0
_FIELD_MGAUSS: Final = np.array([0.0, 160.0, -480.0])
"""The earth's field at 58 deg north: east, north, up. North is taken for true north."""
_RECOVERY_S: Final = 2.5
"""Time constant with which the position goes back to the fixes after an outage (AP_InertialNav of ArduCopter 3.1)."""


def gauss_markov(rng: np.random.Generator, count: int, sigma: float, tau_s: float, step_s: float) -> Array:
    """A stationary first-order Gauss-Markov process, shape (count,)."""
    keep = np.exp(-step_s / tau_s)
    drive = rng.standard_normal(count) * sigma * np.sqrt(1 - keep**2)
    drive[0] = rng.standard_normal() * sigma
    return np.asarray(lfilter([1.0], [1.0, -keep], drive))


def _multipath(flight: Flight, options: InsOptions, rng: np.random.Generator) -> BSpline | None:
    """What walls do to positions, by time, east, north, up [m]: it changes with the way that is driven, and stays while one stands."""
    if options.multipath_m <= 0.0:
        return None
    time_s = np.arange(-_MARGIN_S, flight.duration_s + _MARGIN_S, _STEP_S)
    speed = np.linalg.norm(flight.velocity_m_s(np.clip(time_s, 0.0, flight.duration_s)), axis=1)
    gone_m = np.cumsum(speed) * _STEP_S
    step_m = 0.05 * options.multipath_length_m
    count = int(gone_m[-1] / step_m) + 2
    across = [gauss_markov(rng, count, options.multipath_m, options.multipath_length_m, step_m) for _ in range(2)]
    by_time = [np.interp(gone_m, step_m * np.arange(count), each) for each in across]
    off_m = gaussian_filter1d(np.stack([*by_time, np.zeros(len(time_s))], axis=1), _POSITION_SMOOTH_S / _STEP_S, axis=0)
    return make_interp_spline(time_s, off_m, k=3)


@dataclass(frozen=True, slots=True)
class Belief:
    """Estimates of the INS: arrays of one length n.

    Attributes
    ----------
    heading_rad, pitch_rad, roll_rad : shape (n,); the heading is continuous
    field_frd_mgauss : shape (n, 3), the magnetometer's reading, forward right down
    rates_frd_rad_s, force_frd_m_s2 : shape (n, 3), forward right down
    position_m, velocity_m_s : shape (n, 3), local frame
        Of the GPS antenna where the position is not referred to the IMU.
    baro_height_m : shape (n,)
        That of the barometer, which no satellite leads astray.
    """

    heading_rad: Array
    pitch_rad: Array
    roll_rad: Array
    field_frd_mgauss: Array
    rates_frd_rad_s: Array
    force_frd_m_s2: Array
    position_m: Array
    velocity_m_s: Array
    baro_height_m: Array


class Ins:
    """The INS of one simulation.

    Parameters
    ----------
    flight : Flight
    options : InsOptions
    seed : int
    antenna_m : tuple of float, optional
        True place of the GPS antenna in the ins frame, to which positions belong [m]; none: to the IMU.
    faults : FaultOptions, optional
        When there is no GPS, and when its positions are wrong.
    """

    def __init__(
        self,
        flight: Flight,
        options: InsOptions,
        seed: int,
        antenna_m: tuple[float, float, float] | None = None,
        faults: FaultOptions | None = None,
    ) -> None:
        self._flight, self._options = flight, options
        faults = FaultOptions() if faults is None else faults
        self._glitch, outage = Glitch.of(faults), Outage.of(faults)
        self._antenna_m = None if antenna_m is None else np.array(antenna_m)
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
        gyro_bias = np.radians(o.gyro_bias_deg_s) * rng.standard_normal(3)
        self._compass_phase = rng.uniform(0, 2 * np.pi, 2)
        if o.compass_phase_deg is not None:
            self._compass_phase = np.radians(o.compass_phase_deg)
        self.gyros = Triad.drawn(
            generator(seed, "ins gyros"),
            scale=o.gyro_scale,
            scale_fixed=o.gyro_scale_fixed,
            misalignment_deg=o.gyro_misalignment_deg,
            bias=gyro_bias,
        )
        """Gyros in the ins frame [rad/s]."""
        self.accelerometers = Triad.drawn(
            generator(seed, "ins accelerometers"),
            scale=o.accel_scale,
            scale_fixed=o.accel_scale_fixed,
            misalignment_deg=o.accel_misalignment_deg,
            bias=o.accel_bias_m_s2,
        )
        """Accelerometers in the ins frame [m/s^2]."""
        self.gyro_wander = Wander(generator(seed, "ins gyro walk"), flight.duration_s, np.radians(o.gyro_walk_deg_s))
        """On top of the gyros' biases [rad/s]."""
        self.accel_wander = Wander(generator(seed, "ins accelerometer walk"), flight.duration_s, o.accel_walk_m_s2)
        """On top of the accelerometers' biases [m/s^2]."""
        if outage.start_s > 0:
            position = self._coasting(time_s, position, outage)
        self._position_error: BSpline = make_interp_spline(time_s, position, k=3)
        self._velocity_error: BSpline = self._position_error.derivative(1)
        self._multipath = _multipath(flight, options, generator(seed, "multipath"))

    def _coasting(self, time_s: Array, error_m: Array, outage: Outage) -> Array:
        """Errors of position where an outage is bridged by the accelerometers, shape (n, 3) [m].

        The error of velocity at its start goes on, and gravity leaks in through the error of the tilt, as does the accelerometers' bias.
        Afterwards the position goes back to the fixes. Heights are the barometer's throughout.
        """
        first, last = np.searchsorted(time_s, [outage.start_s, outage.end_s])
        inside = slice(first, last + 1)
        within_s = np.clip(time_s[inside], 0.0, self._flight.duration_s)
        force = self._flight.specific_force_m_s2(within_s)
        read = self.accelerometers.read(force) + self.accel_wander.at(within_s)
        believed = mat_local_ins(*self._angles(within_s)) @ read[..., None]
        true = self._flight.poses(within_s).mat_local_ins() @ force[..., None]
        start_m_s = (error_m[first] - error_m[first - 1]) / _STEP_S
        velocity = start_m_s + np.cumsum((believed - true)[..., 0], axis=0) * _STEP_S
        drift = np.cumsum(velocity, axis=0) * _STEP_S
        coasted = error_m.copy()
        coasted[inside, :2] = (error_m[first] + drift - drift[0])[:, :2]
        left_s = (time_s[last + 1 :] - outage.end_s)[:, None]
        away, speed = (coasted - error_m)[inside][-1, :2], velocity[-1, :2]
        coasted[last + 1 :, :2] += (away + (speed + away / _RECOVERY_S) * left_s) * np.exp(-left_s / _RECOVERY_S)
        return coasted

    def _angles(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Heading, pitch and roll as believed [rad], shape (n,) each."""
        poses, errors = self._flight.poses(time_s), np.asarray(self._angle_error(time_s))
        return (
            poses.heading_rad + errors[:, 0] + self.compass_error_rad(poses.heading_rad),
            poses.pitch_rad + errors[:, 1],
            poses.roll_rad + errors[:, 2],
        )

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

    def _gain(self, frequency_hz: Array) -> Array:
        """Amplitude of a second-order Butterworth low-pass."""
        return np.asarray(1.0 / np.sqrt(1.0 + (frequency_hz / self._options.gyro_filter_hz) ** 4))

    def belief(self, time_s: Array, rng: np.random.Generator) -> Belief:
        """Estimates at true times, shape (n,); `rng` gives the white noise."""
        o = self._options
        # jitter and delay may point just outside the flight
        time_s = np.clip(time_s - o.gyro_delay_s, 0.0, self._flight.duration_s)
        heading, pitch, roll = self._angles(time_s)
        rates = self.gyros.read(self._flight.rates_rad_s(time_s, self._gain)) + self.gyro_wander.at(time_s)
        rates = rates + np.radians(o.gyro_noise_deg_s) * rng.standard_normal(rates.shape)
        force = self.accelerometers.read(self._flight.specific_force_m_s2(time_s)) + self.accel_wander.at(time_s)
        force = force + o.accel_noise_m_s2 * rng.standard_normal(force.shape)
        place_s = time_s if not o.position_delay_s else np.clip(time_s - o.position_delay_s, 0.0, None)
        position, velocity = self._place(place_s)
        position = position + o.position_noise_m * rng.standard_normal(position.shape)
        return Belief(
            heading_rad=heading,
            pitch_rad=pitch,
            roll_rad=roll,
            field_frd_mgauss=ins_from_frd(self._field(time_s)),
            rates_frd_rad_s=ins_from_frd(rates),  # its own inverse
            force_frd_m_s2=ins_from_frd(force),
            position_m=position,
            velocity_m_s=velocity,
            baro_height_m=position[:, 2] - self._glitch.at(place_s)[:, 2],
        )

    def _field(self, time_s: Array) -> Array:
        """What the magnetometer reads in the ins frame, shape (n, 3) [mgauss]: the earth's field turned by the compass error."""
        poses = self._flight.poses(time_s)
        heading = poses.heading_rad + self.compass_error_rad(poses.heading_rad)
        mat = mat_local_ins(heading, poses.pitch_rad, poses.roll_rad)
        return np.asarray(np.einsum("nij,i->nj", mat, _FIELD_MGAUSS))

    def _place(self, time_s: Array) -> tuple[Array, Array]:
        """Position and velocity as believed, without white noise, shape (n, 3) each."""
        poses = self._flight.poses(time_s)
        position, velocity = poses.position_m, self._flight.velocity_m_s(time_s)
        if self._antenna_m is not None:
            mat = poses.mat_local_ins()
            position = position + mat @ self._antenna_m
            swing = np.cross(self._flight.rates_rad_s(time_s, self._gain), self._antenna_m)
            velocity = velocity + np.einsum("nij,nj->ni", mat, swing)
        off = self._position_error(time_s) + self._glitch.at(time_s)
        if self._multipath is not None:
            off = off + np.asarray(self._multipath(time_s))
        return position + off, velocity + self._velocity_error(time_s) + self._glitch.speed_at(time_s)
