"""Series of gyro samples, and the filter that all of them go through."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from flightlog.constants import NS_PER_S

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GyroTrack:
    """Samples of a gyro.

    Attributes
    ----------
    name : str
    time_ns : ndarray of int64, shape (n,)
        On the device's own clock, increasing.
    rate_rad_s : ndarray, shape (n, 3)
        In the device's own axes. Constant offsets, however large, do no harm.
    stamp_step_ns : int
        Resolution of the stamps. Whether they are cut or rounded to it is not known for sure, and goes into the sigma.
    """

    name: str
    time_ns: npt.NDArray[np.int64]
    rate_rad_s: Array
    stamp_step_ns: int = 1

    @property
    def rate_hz(self) -> float:
        """Median sample rate [Hz]."""
        return float(NS_PER_S / np.median(np.diff(self.time_ns))) if len(self.time_ns) > 1 else 0.0


def low_pass(values: Array, cutoff_hz: float, rate_hz: float) -> Array:
    """Gaussian low-pass with half power at the cut-off, along the first axis."""
    sigma = rate_hz * np.sqrt(np.log(2.0) / 2.0) / (np.pi * cutoff_hz) / np.sqrt(2.0)
    return np.asarray(ndimage.gaussian_filter1d(values, sigma, axis=0, mode="nearest"))
