"""What the autopilot states of the path, in the local frame: positions and attitudes, whose errors last."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(slots=True)
class Positions:
    """Positions in the local frame.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC.
    position_m, sigma_m : ndarray, shape (n, 3)
    lever_m : ndarray, shape (3,)
        From the sensor to the point that they are of, sensor frame.
    tau_s : ndarray, shape (3,)
        How long their errors last.
    white_m : float
        The part of them that is new in each second.
    """

    time_ns: Ints
    position_m: Array
    sigma_m: Array
    lever_m: Array
    tau_s: Array
    white_m: float


@dataclass(slots=True)
class Attitudes:
    """Attitudes of the ins frame.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC.
    quat : ndarray, shape (n, 4)
        Local from ins.
    sigma_rad : ndarray, shape (3,)
        About east, north, up.
    tau_s : float
    """

    time_ns: Ints
    quat: Array
    sigma_rad: Array
    tau_s: float
