"""What a synchronisation found, and how it turns lidar time into autopilot time."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sync:
    """How to turn lidar time into autopilot time: t_ins = t_lidar + offset + drift (t_lidar - reference).

    Attributes
    ----------
    method : str
        "gyro", or "host" where only receive times were to be had.
    offset_ns, sigma_offset_ns : int, float
        At the reference.
    reference_ns : int
        Lidar time of the middle of what was used.
    drift_ppm, sigma_drift_ppm : float
    peak : float
        Normalised correlation at the peak, 0 to 1.
    rival : float
        Highest correlation more than 1 s from the peak.
    residual_rad_s : float
        RMS of the fit, all axes.
    samples : int
        INS samples used.
    mat_ins_lidar : ndarray, shape (3, 3), or None
        Rotation (or reflection, where a gyro axis has the opposite sign) between the gyros as solved.
    mount_angle_deg : float or None
        Angle between that rotation and the mount's.
    note : str
        What a reader must know: a reflection, a fallback and why.
    """

    method: str
    offset_ns: int
    sigma_offset_ns: float
    reference_ns: int
    drift_ppm: float = 0.0
    sigma_drift_ppm: float = 0.0
    peak: float = 0.0
    rival: float = 0.0
    residual_rad_s: float = 0.0
    samples: int = 0
    mat_ins_lidar: Array | None = None
    mount_angle_deg: float | None = None
    note: str = ""
    curve: tuple[Array, Array] | None = field(default=None, repr=False, compare=False)

    def ins_time_ns(self, lidar_time_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Autopilot time [ns] of lidar times, shape (n,)."""
        since = lidar_time_ns - self.reference_ns
        return np.asarray(lidar_time_ns + self.offset_ns + np.rint(since * (self.drift_ppm * 1e-6)).astype(np.int64))
