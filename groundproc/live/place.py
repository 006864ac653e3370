"""What a live session finds: a place a slice, and what is counted over the whole of it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groundproc.estimation.odometry.spline import Path
from groundproc.live.slicer import Shots

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Place:
    """Where the sensor was at the end of a slice, and what told it.

    Attributes
    ----------
    end_ns : int
        Lidar time.
    utc_ns : int
    position_m : ndarray, shape (3,)
        Of the ins frame, east, north, up.
    quat_local_ins_wxyz : ndarray, shape (4,)
    velocity_m_s : ndarray, shape (3,)
        Of the sensor.
    sigma_m, sigma_rad : ndarray, shape (3,)
    matched, seen : int
        Clusters that found a plane, and all.
    residual_m : float
    shots : Shots
    path : Path
        The sensor's over the slice.
    """

    end_ns: int
    utc_ns: int
    position_m: Array
    quat_local_ins_wxyz: Array
    velocity_m_s: Array
    sigma_m: Array
    sigma_rad: Array
    matched: int
    seen: int
    residual_m: float
    shots: Shots
    path: Path


@dataclass(slots=True)
class Figures:
    """What is counted over the whole session."""

    slices: int = 0
    blind_slices: int = 0
    """Without a return of the lidar."""
    skipped_slices: int = 0
    """Whose returns were dropped because the computer is too slow."""
    thinned_slices: int = 0
    filled_steps: int = 0
    """Steps of 5 ms without inertial data."""
    restarts: int = 0
    clock_jumps: int = 0
    fixes: int = 0
    old_fixes: int = 0
    """Positions too late to be used."""
