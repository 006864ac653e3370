"""Instruments of a simulated flight drawn from what is stated of their classes: then errors are to be those that sigmas state."""

from dataclasses import replace

import numpy as np

from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.adjustment.skew import MISALIGNMENT_RAD
from groundproc.estimation.consensus import POSITION_TAU_S
from groundproc.estimation.observations.attitudes import ATTITUDE_SIGMA_RAD, COMPASS_PRIOR
from groundproc.estimation.observations.inertial import PRIORS
from simulator.config import Options

STATED_M = (3.0, 4.5)
"""What fixes of the simulator are stated to be right to, in plan and in height."""


def as_stated(options: Options, seed: int) -> Options:
    """Options with instruments drawn from what the method knows of them before.

    Tilts t_ij of single axes turn a triad by (t_ij - t_ji) / 2: their sigma is the turn's times the square root of two. The turn of the
    accelerometers against the gyros is known before, and both are turned against the board.
    """
    offset, amplitude = np.random.default_rng([seed, 7]).standard_normal(2)
    gyros_rad, against_rad = MISALIGNMENT_RAD, PRIORS["ins.accel_turn"]
    tilts_deg = np.rad2deg(np.sqrt(2.0) * np.array([gyros_rad, np.sqrt(against_rad**2 - gyros_rad**2)]))
    ins = replace(
        options.ins,
        gnss_sigma_m=STATED_M[0],
        height_bias_m=STATED_M[1],
        gnss_tau_s=float(POSITION_TAU_S[0]),
        tilt_sigma_deg=float(np.rad2deg(ATTITUDE_SIGMA_RAD[0])),
        heading_sigma_deg=float(np.rad2deg(ATTITUDE_SIGMA_RAD[2])),
        compass_offset_deg=float(np.rad2deg(COMPASS_PRIOR[0])) * float(offset),
        compass_bias_deg=float(np.rad2deg(COMPASS_PRIOR[1])) * abs(float(amplitude)),
        accel_bias_m_s2=PRIORS["ins.accel_bias"],
        gyro_misalignment_deg=float(tilts_deg[0]),
        accel_misalignment_deg=float(tilts_deg[1]),
    )
    gyros = replace(options.gyros, accel_bias_g=PRIORS["lidar.accel_bias"] / STANDARD_GRAVITY_M_S2)
    return replace(options, ins=ins, gyros=gyros)
