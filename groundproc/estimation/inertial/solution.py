"""What the smoother hands over."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groundproc.estimation.inertial.readings import Readings
from groundproc.estimation.observations.states import Model

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Solution:
    """Smoothed states of one leg.

    Attributes
    ----------
    readings : Readings
    model : Model
        With what was learnt.
    time_ns : ndarray of int64, shape (n,)
        UTC of the nodes.
    position_m, velocity_m_s, quat, rate_rad_s : ndarray, shape (n, 3), (n, 3), (n, 4), (n, 3)
    covered : ndarray of bool, shape (n,)
    kept_ns : ndarray of int64, shape (k,)
        UTC of what follows.
    states : ndarray, shape (k, STATES)
        Smoothed; position, velocity and attitude are what was left to correct in the last iteration.
    covariance : ndarray of float32, shape (k, 9, 9)
        Of position, velocity and attitude.
    variance : ndarray, shape (k, STATES)
        Of all states.
    residual_rms, rows, outliers : dict of str to float or int
        By the kind of the measurement.
    stands_s : float
        How long the vehicle stood.
    driving : bool
        It goes where it points.
    iterations : int
    last_step_m, last_step_rad : float
        Largest correction of the last iteration.
    """

    readings: Readings
    model: Model
    time_ns: npt.NDArray[np.int64]
    position_m: Array
    velocity_m_s: Array
    quat: Array
    rate_rad_s: Array
    covered: Mask
    kept_ns: npt.NDArray[np.int64]
    states: Array
    covariance: npt.NDArray[np.float32]
    variance: Array
    residual_rms: dict[str, float]
    rows: dict[str, int]
    outliers: dict[str, int]
    stands_s: float
    driving: bool
    iterations: int
    last_step_m: float
    last_step_rad: float
