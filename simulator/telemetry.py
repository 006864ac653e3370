"""Position packets: the lidar's own gyros, accelerometers and GPS sentence, on its own clock.

Rates, offsets and noise are those measured on real units; axes and scales are the manual's (63-9113 Rev A, figure B2).
"""

from datetime import UTC, datetime
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import NS_PER_S, NS_PER_US, STANDARD_GRAVITY_M_S2
from flightlog.hdl32e import (
    ACCEL_LSB_G,
    GYRO_LSB_DEG_S,
    POSITION_DTYPE,
    SENSOR_FROM_GYROS,
    STAMP_WRAP_US,
    TEMPERATURE_LSB_C,
    TEMPERATURE_ZERO_C,
    PpsState,
)
from flightlog.mount import Mount
from simulator.chance import generator
from simulator.clocks import Clocks
from simulator.config import Options
from simulator.flight import Flight
from simulator.geodesy import Origin, geodetic
from simulator.imu import Triad, Wander

Array = npt.NDArray[np.float64]

_SHORTEST_S, _LONGEST_S = 0.0013, 0.0087
"""Between most packets; one in thirty comes up to 1 ms later [measured: 1.3 to 9.7 ms, 200 packets/s]."""
_SENT_AFTER_S: Final = 0.00025
_NMEA_LAG_S: Final = 0.45
"""A second's sentence shows up this long after the second began [measured: 0.4 s and less than 0.85 s]."""


def rmc_sentence(utc_ns: int, latitude_deg: float, longitude_deg: float) -> str:
    """A GPRMC sentence with checksum, line end included."""
    moment = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC)
    north, east = ("N" if latitude_deg >= 0 else "S"), ("E" if longitude_deg >= 0 else "W")
    (lat, lat_min), (lon, lon_min) = (divmod(abs(v) * 60.0, 60.0) for v in (latitude_deg, longitude_deg))
    body = (
        f"GPRMC,{moment:%H%M%S},A,{lat:02.0f}{lat_min:07.4f},{north},{lon:03.0f}{lon_min:07.4f},{east},"
        f"000.0,144.7,{moment:%d%m%y},005.9,E,D"
    )
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n"


class Telemetry:
    """Makes the position packets of one simulation.

    Parameters
    ----------
    flight, mount, clocks, options, seed
        `mount` is the true one.
    origin : Origin
        Of the local frame, for the GPS sentence.
    """

    def __init__(
        self, flight: Flight, mount: Mount, clocks: Clocks, options: Options, origin: Origin, seed: int
    ) -> None:
        self._flight, self._clocks, self._origin, self._seed = flight, clocks, origin, seed
        self._options, self._locked = options.gyros, options.clocks.lidar_gps
        self._mat_lidar_ins, self._lever_m = mount.mat_ins_lidar().T, mount.lidar_position_m()
        self.gyros = Triad.drawn(
            generator(seed, "telemetry gyros"),
            scale=options.gyros.scale,
            scale_fixed=options.gyros.scale_fixed,
            misalignment_deg=options.gyros.misalignment_deg,
            bias=np.array(options.gyros.offset_deg_s),
        )
        """Gyro 1, 2, 3 along the axes that the manual's figure gives them [deg/s]."""
        self.gyro_wander = Wander(
            generator(seed, "telemetry gyro walk"), flight.duration_s, options.gyros.offset_walk_deg_s
        )
        """On top of their zero offsets [deg/s]."""
        bias = generator(seed, "telemetry accelerometers").standard_normal(3)
        self.accel_bias_g = options.gyros.accel_bias_g * bias
        """Of the force, along the axes of the lidar."""
        self._rotor_hz = options.lidar.rpm / 60.0
        rng = generator(seed, "telemetry times")
        count = int(flight.duration_s / 0.004) + 100
        steps = rng.uniform(_SHORTEST_S, _LONGEST_S, count)
        steps[rng.random(count) < 0.03] += 0.001
        self._time_s = np.cumsum(steps)

    def between(self, start_s: float, end_s: float, chunk: int) -> tuple[npt.NDArray[np.void], Array]:
        """Packets of POSITION_DTYPE sampled in [start, end), and the true times at which they are sent."""
        low, high = np.searchsorted(self._time_s, [start_s, end_s])
        time_s = self._time_s[low:high]
        packets = np.zeros(len(time_s), POSITION_DTYPE)
        packets["words"] = self._words(time_s, generator(self._seed, "telemetry", chunk))
        stamp_us = self._clocks.lidar.shows_ns(time_s) // NS_PER_US
        packets["stamp_us"] = stamp_us % STAMP_WRAP_US
        if self._locked:
            packets["pps"] = PpsState.LOCKED
            packets["nmea"] = [self._sentence(float(t)) for t in time_s]
        return packets, time_s + _SENT_AFTER_S

    def _sentence(self, time_s: float) -> bytes:
        utc_ns = int(self._clocks.utc.shows_ns(time_s - _NMEA_LAG_S))
        position = self._flight.poses(np.array([time_s])).position_m
        latitude, longitude, _ = geodetic(position, self._origin)
        return rmc_sentence(utc_ns, float(latitude[0]), float(longitude[0])).encode()

    def _words(self, time_s: Array, rng: np.random.Generator) -> npt.NDArray[np.uint16]:
        """Gyro, temperature, accelerometer X and Y of the three chips, with channel tags, shape (n, 12)."""
        o = self._options
        felt_s = time_s - o.delay_s
        turn = 2 * np.pi * self._rotor_hz * time_s[:, None]
        rates = np.degrees(self._flight.rates_rad_s(felt_s)) @ self._mat_lidar_ins.T
        gyros = self.gyros.read(rates @ SENSOR_FROM_GYROS.astype(np.float64)) + self.gyro_wander.at(time_s)
        gyros = gyros + o.noise_deg_s * rng.standard_normal(gyros.shape)
        gyros = gyros + np.array(o.rotor_line_deg_s) * np.sin(turn + np.array([0.3, 1.9, 3.1]))
        force = self._flight.specific_force_m_s2(felt_s, self._lever_m) @ self._mat_lidar_ins.T / STANDARD_GRAVITY_M_S2
        # readings are the pull of gravity along the labelled arrow, minus the specific force: X up is -z on chips 1 and 2
        x, y, z = (force + self.accel_bias_g).T
        accel = np.stack([z, -x, z, -y, x, -y], axis=1)
        accel = accel + o.accel_noise_g * rng.standard_normal(accel.shape)
        # imbalance, seen a quarter turn later by the y axes than by the x axes
        phase = np.array([0.0, 0.0, 0.0, -np.pi / 2, np.pi, -np.pi / 2])
        accel = accel + o.accel_rotor_line_g * np.array([0, 1, 0, 1, 1, 1]) * np.sin(turn + phase)
        temperature = (38.0 + 0.2 * rng.standard_normal((len(time_s), 3)) - TEMPERATURE_ZERO_C) / TEMPERATURE_LSB_C
        words = np.empty((len(time_s), 12))
        words[:, [0, 4, 8]] = gyros / GYRO_LSB_DEG_S
        words[:, [1, 5, 9]] = temperature
        words[:, [2, 3, 6, 7, 10, 11]] = accel / ACCEL_LSB_G
        values = np.clip(np.rint(words), -2048, 2047).astype(np.int32) & 0xFFF
        return np.asarray(values | np.tile(np.arange(4) << 12, 3)).astype(np.uint16)
