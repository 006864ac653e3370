"""The beams of points: from where in the world each came, and which way the aircraft flew then."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.mount import Mount
from groundproc.cloud.georeference import sensor_poses
from groundproc.numerics.memory import Pool
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

STEP_NS: Final = 5_000_000
"""Between these times [ns] the place of the sensor is interpolated linearly: at 10 m/s^2 right to 0.03 mm."""
_FLIES_M_S: Final = 1.0
"""Slower than this there is no line of flight: the way that the sensor looks takes its place."""
_MEMORY: Final = Pool()


@dataclass(frozen=True, slots=True)
class Beams:
    """Where the sensor was, at steps of time that hold all points of a piece.

    Attributes
    ----------
    first_ns : int
        Time of the first step.
    origin_m : ndarray, shape (m, 3)
        Place of the sensor in the local frame.
    right : ndarray, shape (m, 2)
        Unit vector (east, north) to the right of the line of flight.
    """

    first_ns: int
    origin_m: Array
    right: Array

    @classmethod
    def of(cls, time_ns: Times, trajectory: Trajectory, mount: Mount) -> "Beams":
        """For times, shape (n,), at least one of them, that the trajectory covers."""
        first_ns = int(time_ns.min()) // STEP_NS * STEP_NS
        steps = (int(time_ns.max()) - first_ns) // STEP_NS + 2
        asked = first_ns + STEP_NS * np.arange(steps, dtype=np.int64)
        # a step at the edge of what is covered has the pose of the nearest point beside it
        poses, covered = sensor_poses(asked, trajectory, mount)
        if not covered.all():
            nearest = _nearest(time_ns, asked)
            poses, _ = sensor_poses(nearest, trajectory, mount)
        return cls(first_ns, np.ascontiguousarray(poses[:, 9:]), _right(asked, trajectory, poses))

    def origins(self, time_ns: Times) -> Array:
        """Place of the sensor at each of the times, shape (n, 3)."""
        out = _MEMORY.empty((len(time_ns), 3), np.float64)
        _origins(time_ns, self.first_ns, self.origin_m, out)
        return out

    def scan_angle_deg(self, xyz_m: Array, time_ns: Times, origins_m: Array) -> npt.NDArray[np.float32]:
        """Angle of each beam off the vertical across the line of flight, right positive (LAS 1.4 R15, table 17), shape (n,).

        To half a degree: the line of flight is known no better, and a file with every step of 0.006 deg is 4 % larger.
        """
        out = np.empty(len(xyz_m), np.float32)
        _scan_angle(xyz_m, origins_m, (time_ns - self.first_ns) // STEP_NS, self.right, out)
        return out


def _nearest(time_ns: Times, asked: Times) -> Times:
    """Of the times of points, those nearest to what is asked, within a step or so; else what is asked."""
    known = np.sort(time_ns)
    after = np.clip(np.searchsorted(known, asked), 1, len(known) - 1) if len(known) > 1 else np.zeros(len(asked), int)
    before = np.maximum(after - 1, 0)
    closer = np.abs(known[after] - asked) < np.abs(known[before] - asked)
    return np.asarray(np.where(closer, known[after], known[before]))


def _right(time_ns: Times, trajectory: Trajectory, poses: Array) -> Array:
    """Unit vectors (east, north) to the right of the line of flight, shape (n, 2)."""
    seconds, knots_s = (time_ns - trajectory.time_ns[0]) * 1e-9, (trajectory.time_ns - trajectory.time_ns[0]) * 1e-9
    east, north = (np.interp(seconds, knots_s, trajectory.velocity_m_s[:, axis]) for axis in (0, 1))
    slow = np.hypot(east, north) < _FLIES_M_S
    # the sensor's forward axis is the second column of "local from sensor"
    east, north = np.where(slow, poses[:, 1], east), np.where(slow, poses[:, 4], north)
    length = np.maximum(np.hypot(east, north), 1e-12)
    return np.stack([north / length, -east / length], axis=1)


@njit(cache=True, nogil=True)
def _origins(time_ns: Any, first_ns: int, steps_m: Any, out: Any) -> None:
    for i in range(len(time_ns)):
        since = time_ns[i] - first_ns
        step = since // STEP_NS
        share = (since - step * STEP_NS) * (1.0 / STEP_NS)
        for axis in range(3):
            out[i, axis] = (1.0 - share) * steps_m[step, axis] + share * steps_m[step + 1, axis]


@njit(cache=True, nogil=True)
def _scan_angle(xyz: Any, origin: Any, step: Any, right: Any, out: Any) -> None:
    for i in range(len(xyz)):
        east, north = xyz[i, 0] - origin[i, 0], xyz[i, 1] - origin[i, 1]
        across = east * right[step[i], 0] + north * right[step[i], 1]
        out[i] = 0.5 * np.rint(2.0 * np.rad2deg(np.arctan2(across, origin[i, 2] - xyz[i, 2])))
