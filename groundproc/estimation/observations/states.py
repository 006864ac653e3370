"""The states of the estimate, and what is assumed of every sensor.

All states are small corrections to a reference trajectory (position, velocity, attitude), or quantities that are zero on average.
Attitude errors are rotation vectors in the local frame: `true = exp(error) reference`.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

POSITION: Final = 0
"""Position [m], 3."""
VELOCITY: Final = 3
"""Velocity [m/s], 3."""
ATTITUDE: Final = 6
"""Rotation vector in the local frame [rad], 3."""
GYRO_BIAS: Final = 9
"""Reading less truth, ins frame [rad/s], 3."""
FORCE_BIAS: Final = 12
"""Reading less truth, ins frame [m/s^2], 3."""
GYRO_MATRIX: Final = 15
"""Reading less truth for each unit of rate, row by row: scale on the diagonal, misalignment off it, ins frame, 9."""
FORCE_MATRIX: Final = 24
"""Reading less truth for each unit of specific force, row by row: scale on the diagonal, misalignment off it, ins frame, 9."""
FIX_POSITION: Final = 33
"""Correlated error of the position fixes [m], 3."""
FIX_VELOCITY: Final = 36
"""Correlated error of the velocities that come with them [m/s], 3."""
FIX_AGE: Final = 39
"""How much older fixes are than their stamps [s]."""
TILT: Final = 40
"""Error of the autopilot's pitch and roll [rad], 2: about the right and the forward axis of the heading."""
HEADING: Final = 42
"""What of the error of its heading is no function of heading [rad], clockwise."""
COMPASS: Final = 43
"""The compass curve [rad]: constant, sine and cosine of the heading, sine and cosine of twice the heading, 5."""
BARO: Final = 48
"""Error of the barometer's height [m]."""
COURSE: Final = 49
"""Angle from the direction a vehicle drives to its heading [rad], clockwise."""
OUTSIDE: Final = 50
"""Correlated error of the positions of a better receiver [m], 3."""
STATES: Final = 53
POSE: Final = 9
"""The first so many are position, velocity and attitude."""


@dataclass(frozen=True, slots=True)
class Model:
    """One sigma of everything; GM: a first-order Gauss-Markov process of that sigma and time constant.

    Those marked (learnt) are start values: the flight's own residuals correct them.

    Attributes
    ----------
    gyro_bias_rad_s, gyro_bias_walk : float
        At the start [rad/s], and its random walk [rad/s/sqrt(s)].
    force_bias_m_s2, force_bias_walk : float
        The same of the accelerometers [m/s^2], [m/s^2/sqrt(s)].
    gyro_scale, gyro_misalignment : float
        Relative, and [rad].
    force_scale, force_misalignment : float
        The same of the accelerometers: MEMS as sold have 3 % and 2 %, half of that or less once calibrated on six sides.
    fix_tau_s, fix_velocity_tau_s : float
        GM error of positions (sigma: as the fixes state it) and of velocities.
    fix_velocity_m_s : float
        GM error of velocities that are not those of the stated positions.
    fix_age_s : float
    fix_noise_m, fix_velocity_noise_m_s : float
        White noise (learnt).
    tilt_rad, tilt_tau_s, tilt_noise_rad : float
        The autopilot's pitch and roll: GM (learnt) and white noise (learnt).
    heading_rad, heading_tau_s, heading_noise_rad : float
        Error of its heading beyond the compass curve: GM (learnt) and white noise (learnt).
    compass_rad : tuple of float
        Constant, first and second harmonic of the compass curve.
    baro_m, baro_walk, baro_noise_m : float
        The barometer's level [m], its random walk [m/sqrt(s)] (weather, and air drawn past the box), white noise (learnt).
    course_rad, sideways_m_s : float
        A car's axis against its heading; its speed sideways.
    standing_m_s : float
        Speed of what stands.
    """

    gyro_bias_rad_s: float = np.deg2rad(1.0)
    gyro_bias_walk: float = np.deg2rad(0.003)
    force_bias_m_s2: float = 0.15
    force_bias_walk: float = 0.002
    gyro_scale: float = 0.01
    gyro_misalignment: float = 0.01
    force_scale: float = 0.015
    force_misalignment: float = np.deg2rad(0.7)
    fix_tau_s: float = 60.0
    fix_velocity_tau_s: float = 1.5
    fix_velocity_m_s: float = 0.3
    fix_age_s: float = 0.2
    fix_noise_m: float = 0.1
    fix_velocity_noise_m_s: float = 0.05
    tilt_rad: float = np.deg2rad(0.8)
    tilt_tau_s: float = 10.0
    tilt_noise_rad: float = np.deg2rad(0.1)
    heading_rad: float = np.deg2rad(1.5)
    heading_tau_s: float = 10.0
    heading_noise_rad: float = np.deg2rad(0.1)
    compass_rad: tuple[float, float, float] = (np.deg2rad(10.0), np.deg2rad(10.0), np.deg2rad(4.0))
    baro_m: float = 100.0
    baro_walk: float = 0.06
    baro_noise_m: float = 0.2
    course_rad: float = np.deg2rad(2.0)
    sideways_m_s: float = 0.15
    standing_m_s: float = 0.03


def start_covariance(model: Model, fix_sigma_m: Array, linked: bool, outside_sigma_m: Array) -> Array:
    """Covariance of the states at the start, shape (STATES, STATES); position, velocity and attitude are practically unknown."""
    sigma = np.zeros(STATES)
    sigma[POSITION : POSITION + 3] = 300.0
    sigma[VELOCITY : VELOCITY + 3] = 30.0
    sigma[ATTITUDE : ATTITUDE + 3] = np.deg2rad([15.0, 15.0, 90.0])
    sigma[GYRO_BIAS : GYRO_BIAS + 3] = model.gyro_bias_rad_s
    sigma[FORCE_BIAS : FORCE_BIAS + 3] = model.force_bias_m_s2
    sigma[GYRO_MATRIX : GYRO_MATRIX + 9] = model.gyro_misalignment
    sigma[GYRO_MATRIX : GYRO_MATRIX + 9 : 4] = model.gyro_scale
    sigma[FORCE_MATRIX : FORCE_MATRIX + 9] = model.force_misalignment
    sigma[FORCE_MATRIX : FORCE_MATRIX + 9 : 4] = model.force_scale
    sigma[FIX_POSITION : FIX_POSITION + 3] = fix_sigma_m
    sigma[FIX_VELOCITY : FIX_VELOCITY + 3] = fix_velocity_sigma(model, fix_sigma_m, linked)
    sigma[FIX_AGE] = model.fix_age_s
    sigma[TILT : TILT + 2] = model.tilt_rad
    sigma[HEADING] = model.heading_rad
    sigma[COMPASS : COMPASS + 5] = np.repeat(model.compass_rad, [1, 2, 2])
    sigma[BARO] = model.baro_m
    sigma[COURSE] = model.course_rad
    sigma[OUTSIDE : OUTSIDE + 3] = outside_sigma_m
    return np.diag(sigma**2)


def fix_velocity_sigma(model: Model, fix_sigma_m: Array, linked: bool) -> Array:
    """Sigma of the velocities' correlated error [m/s], shape (3,).

    If the velocities are those of the stated positions (linked), their error is the rate of change of the positions'
    error. A Gauss-Markov process of that sigma, passed through another of `fix_tau_s`, has the positions' sigma.
    """
    if not linked:
        return np.full(3, model.fix_velocity_m_s)
    tau, fast = model.fix_tau_s, model.fix_velocity_tau_s
    return np.asarray(fix_sigma_m * np.sqrt((tau + fast) / fast) / tau)
