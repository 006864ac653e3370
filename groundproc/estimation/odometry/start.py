"""Where the odometry begins, and begins anew after it lost the path: at a rough pose of the autopilot."""

from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import STANDARD_GRAVITY_M_S2
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.motion import MotionGrid
from groundproc.estimation.odometry.state import State
from groundproc.trajectory.trajectory import Poses

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

START_SIGMA: Final = {
    "attitude_deg": 0.02,
    "velocity_m_s": 1.0,
    "gyro_deg_s": 1.0,
    "accel_m_s2": 0.3,
    "gravity_m_s2": 0.3,
}
"""What is known where the odometry begins. The map takes its axes from the first attitude, so that is exact, and gravity is not."""
VELOCITY_OVER_NS: Final = 250_000_000
"""The first velocity is the mean over this time before and after."""


class RoughPoses(Protocol):
    """Poses of the ins frame to begin from: a `Trajectory`, or what has been heard of one so far."""

    def where_covered(self, time_ns: Ints) -> tuple[Poses, npt.NDArray[np.bool_]]:
        """Poses at times, shape (n,), and which of them are covered."""


def state_at(
    number: int, motion: MotionGrid, rough: RoughPoses, mat_ins_lidar: Array, lever_m: Array, gyro_bias: Array
) -> State | None:
    """State of the sensor at the start of a slice; None where rough poses or inertial data are missing.

    Parameters
    ----------
    number : int
        Of the slice.
    motion : MotionGrid
    rough : RoughPoses
    mat_ins_lidar, lever_m : ndarray, shape (3, 3), (3,)
        Nominal mount.
    gyro_bias : ndarray, shape (3,)
        As far as it is known [rad/s].
    """
    time_ns = motion.start_ns + number * SLICE_NS
    if number * STEPS >= len(motion) or not motion.known[number * STEPS]:
        return None
    around = np.array([time_ns, time_ns - VELOCITY_OVER_NS, time_ns + VELOCITY_OVER_NS])
    poses, covered = rough.where_covered(around)
    if not covered[0]:
        return None
    mats = frames.mat_from_quat(poses.quat_local_ins_wxyz)
    places = poses.position_m + mats @ lever_m
    s = START_SIGMA
    sigma = np.concatenate(
        [
            np.full(3, np.deg2rad(s["attitude_deg"])), np.full(3, 1e-3), np.full(3, s["velocity_m_s"]),
            np.full(3, np.deg2rad(s["gyro_deg_s"])), np.full(3, s["accel_m_s2"]),
            np.array([s["gravity_m_s2"], s["gravity_m_s2"], 1e-4]),
        ]
    )  # fmt: skip
    quat = frames.quat_from_mat((mats[0] @ mat_ins_lidar)[None])[0]
    gravity = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
    velocity = _velocity(places, covered)
    return State(quat, places[0].copy(), velocity, gyro_bias.copy(), np.zeros(3), gravity, np.diag(sigma**2))


def _velocity(places_m: Array, covered: npt.NDArray[np.bool_]) -> Array:
    """Mean velocity from the places now, before and after, shape (3, 3), as far as they are covered."""
    over_s = VELOCITY_OVER_NS * 1e-9
    if covered.all():
        return np.asarray((places_m[2] - places_m[1]) / (2.0 * over_s))
    if covered[2]:
        return np.asarray((places_m[2] - places_m[0]) / over_s)
    if covered[1]:
        return np.asarray((places_m[1] - places_m[0]) / -over_s)
    return np.zeros(3)
