"""The true motion: position, attitude, rates and specific force at any time.

Attitude follows from the motion: a multirotor tilts its thrust into the acceleration it makes and against the drag of its speed. On
top comes vibration of the rotors, a sum of sines, which turns the frame but moves it nowhere.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline

from flightlog.constants import STANDARD_GRAVITY_M_S2
from flightlog.frames import mat_local_ins
from simulator.chance import generator
from simulator.config import FlightOptions
from simulator.route import Route, lay_out

Array = npt.NDArray[np.float64]

_VIBRATION_LINES: Final = 9
_WANDER_LINES: Final = 14
_GUST_LINES: Final = 12
_BUZZ_LINES: Final = 12
_GENTLE_S: Final = 3.0
_BLOCK: Final = 20_000
_SHARE: Final = {"copter": 1.0, "car": 0.35, "tripod": 0.0}
"""Of vibration and wander, by what carries the instrument."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of the INS: arrays of one length n.

    Attributes
    ----------
    time_s : shape (n,)
    position_m : shape (n, 3), local frame
    heading_rad, pitch_rad, roll_rad : shape (n,); the heading is continuous
    """

    time_s: Array
    position_m: Array
    heading_rad: Array
    pitch_rad: Array
    roll_rad: Array

    def mat_local_ins(self) -> Array:
        """Column matrices "local from ins", shape (n, 3, 3)."""
        return mat_local_ins(self.heading_rad, self.pitch_rad, self.roll_rad)


@dataclass(frozen=True, slots=True)
class _Sines:
    """Sums of sines on three axes: amplitude, frequency [Hz], phase, each of shape (lines, 3)."""

    amplitude: Array
    frequency_hz: Array
    phase: Array

    def at(self, time_s: Array, derivative: int = 0, gain: Callable[[Array], Array] | None = None) -> Array:
        """Values or a derivative, shape (n, 3); `gain` weighs each line by its frequency."""
        turn = 2 * np.pi * self.frequency_hz
        amplitude = self.amplitude * turn**derivative
        if gain is not None:
            amplitude = amplitude * gain(self.frequency_hz)
        time_s, phase = np.asarray(time_s), self.phase + derivative * np.pi / 2
        values = np.empty((len(time_s), 3))
        for first in range(0, len(time_s), _BLOCK):  # an hour of all lines at once would be half a gigabyte
            some = slice(first, first + _BLOCK)
            values[some] = (amplitude * np.sin(turn * time_s[some, None, None] + phase)).sum(axis=1)
        return values


def _sines(rng: np.random.Generator, lines: int, band_hz: tuple[float, float], rms: float) -> _Sines:
    low, high = band_hz
    shape = (lines, 3)
    strength = rng.uniform(0.5, 1.0, shape)
    strength *= rms * np.sqrt(2.0 / (strength**2).sum(axis=0))
    frequency = low * (high / low) ** rng.random(shape)
    return _Sines(strength, frequency, rng.uniform(0, 2 * np.pi, shape))


def _both(one: _Sines, other: _Sines) -> _Sines:
    """The sum of two sums."""
    parts = ("amplitude", "frequency_hz", "phase")
    return _Sines(*(np.concatenate([getattr(one, name), getattr(other, name)]) for name in parts))


def _shaking(options: FlightOptions, seed: int, share: float, slow: _Sines) -> _Sines:
    """Turns of the frame: vibration of 15 to 40 Hz, and what gusts and motors add where they are asked for."""
    if options.gust_deg > 0.0:
        rms = share * np.radians(options.gust_deg)
        slow = _both(slow, _sines(generator(seed, "gusts"), _GUST_LINES, (3.0, 20.0), rms))
    if any(options.buzz_deg_s):
        rates = _sines(generator(seed, "buzz"), _BUZZ_LINES, (85.0, 240.0), 1.0)
        amplitude = share * np.radians(options.buzz_deg_s) * rates.amplitude / (2.0 * np.pi * rates.frequency_hz)
        slow = _both(slow, _Sines(amplitude, rates.frequency_hz, rates.phase))
    return slow


def _smooth_step(share: Array) -> Array:
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def tilt_for(thrust: Array, heading_rad: Array) -> tuple[Array, Array]:
    """Pitch and roll [rad] that point the ins frame's z axis along `thrust`, shape (n, 3), at given headings."""
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    unit = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    right = cosine * unit[:, 0] - sine * unit[:, 1]
    ahead = sine * unit[:, 0] + cosine * unit[:, 1]
    return np.arctan2(-ahead, unit[:, 2]), np.arcsin(right)


class Flight:
    """The motion of one simulation, from 0 to `duration_s`.

    Parameters
    ----------
    route : Route
    duration_s : float
    options : FlightOptions
    seed : int
    """

    def __init__(self, route: Route, duration_s: float, options: FlightOptions, seed: int) -> None:
        rng = generator(seed, "flight")
        share = _SHARE[route.kind]
        if options.speed_m_s > 0:
            route = dataclasses.replace(route, speed_m_s=options.speed_m_s)
        if options.higher_m:
            points = tuple((x, y, z + options.higher_m) for x, y, z in route.points_m)
            route = dataclasses.replace(route, points_m=points)
        self.duration_s = duration_s
        slow = _sines(rng, _VIBRATION_LINES, (15.0, 40.0), share * np.radians(options.vibration_deg))
        self._vibration = _shaking(options, seed, share, slow)
        tilt = _sines(rng, _WANDER_LINES, (0.2, 3.0), share * np.radians(options.wander_deg))
        wander = _Sines(
            STANDARD_GRAVITY_M_S2 * tilt.amplitude / (2 * np.pi * tilt.frequency_hz) ** 2, tilt.frequency_hz, tilt.phase
        )
        yaw = _sines(rng, _WANDER_LINES, (0.15, 1.5), share * np.radians(options.wander_deg))
        time_s, position_m, heading = lay_out(route, duration_s)
        ramp = _smooth_step(time_s / _GENTLE_S)[:, None] * np.array([1.0, 1.0, 0.3])
        position_m = position_m + ramp * wander.at(time_s)
        heading = heading + ramp[:, 0] * yaw.at(time_s)[:, 2]
        self._position = make_interp_spline(time_s, position_m, k=5)
        thrust = self._position.derivative(2)(time_s) + options.drag_1_s * self._position.derivative(1)(time_s)
        thrust[:, 2] = STANDARD_GRAVITY_M_S2 + self._position.derivative(2)(time_s)[:, 2]
        pitch, roll = tilt_for(thrust, heading)
        if route.kind != "copter":  # springs: a little of the same motion, the other way
            pitch, roll = -0.05 * pitch, -0.15 * roll
        self._angles = make_interp_spline(time_s, np.stack([heading, pitch, roll], axis=1), k=5)
        self._velocity: BSpline = self._position.derivative(1)
        self._acceleration: BSpline = self._position.derivative(2)
        self._angle_rates: BSpline = self._angles.derivative(1)

    def poses(self, time_s: Array) -> Poses:
        """True poses at times within the flight, shape (n,)."""
        angles = self._angles(time_s) + self._vibration.at(time_s)
        return Poses(np.asarray(time_s), self._position(time_s), *angles.T)

    def velocity_m_s(self, time_s: Array) -> Array:
        """Velocity in the local frame, shape (n, 3)."""
        return np.asarray(self._velocity(time_s))

    def rates_rad_s(self, time_s: Array, gain: Callable[[Array], Array] | None = None) -> Array:
        """Angular rate in the ins frame, shape (n, 3).

        `gain` weighs the lines of the vibration by their frequency [Hz]: the low-pass of a gyro. It leaves the slower motion alone.
        """
        angles = self._angles(time_s) + self._vibration.at(time_s, 0, gain)
        heading_rate, pitch_rate, roll_rate = (self._angle_rates(time_s) + self._vibration.at(time_s, 1, gain)).T
        _, pitch, roll = angles.T
        # mat_local_ins is Rz(-heading) Rx(pitch) Ry(roll): each rate is taken to the frame of the last rotation
        x = pitch_rate * np.cos(roll) + heading_rate * np.cos(pitch) * np.sin(roll)
        y = roll_rate - heading_rate * np.sin(pitch)
        z = pitch_rate * np.sin(roll) - heading_rate * np.cos(pitch) * np.cos(roll)
        return np.stack([x, y, z], axis=1)

    def specific_force_m_s2(self, time_s: Array, lever_m: Array | None = None) -> Array:
        """What an ideal accelerometer reads, ins frame, shape (n, 3): at the INS, or at a lever arm from it [m]."""
        force = self._acceleration(time_s) + np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
        felt = np.einsum("nij,ni->nj", self.poses(time_s).mat_local_ins(), force)
        if lever_m is not None:
            rate, half_s = self.rates_rad_s(time_s), 1e-4
            turning = (self.rates_rad_s(time_s + half_s) - self.rates_rad_s(time_s - half_s)) / (2.0 * half_s)
            felt = felt + np.cross(turning, lever_m) + np.cross(rate, np.cross(rate, lever_m))
        return np.asarray(felt)
