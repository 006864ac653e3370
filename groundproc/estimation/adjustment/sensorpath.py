"""The path of the sensor as the trajectory of the ins frame, and whether the odometry lost it."""

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.mount import Mount
from groundproc.estimation.odometry.grid import STEP_NS
from groundproc.estimation.odometry.motion import Motion
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import Track, grid_ns
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]


def of_ins(
    path: Path, motion: Motion, frame: LocalFrame, mount: Mount, sigma_position_m: Array, sigma_attitude_rad: Array
) -> Trajectory:
    """The path of the sensor as the trajectory of the ins frame; sigmas on its grid."""
    mat_ins_lidar, lever = mount.mat_ins_lidar(), mount.lidar_position_m()
    back = frames.quat_from_mat(mat_ins_lidar.T[None])
    quat = frames.quat_multiply(path.quat, np.repeat(back, len(path.quat), axis=0))
    position = path.position_m - frames.mat_from_quat(quat) @ lever
    step_s = STEP_NS * 1e-9
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / step_s
    first = (path.start_ns - motion.start_ns) // STEP_NS
    return Trajectory(
        frame,
        grid_ns(path),
        position,
        np.gradient(position, step_s, axis=0),
        quat,
        np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]]),
        sigma_position_m,
        sigma_attitude_rad,
        np.append(motion.known[first : first + len(quat) - 1], False),
    )


def lost(track: Track) -> list[str]:
    """One sentence where the odometry lost its way."""
    if not track.restarts:
        return []
    return [
        f"the odometry lost its way {track.restarts} times and began anew from the autopilot's pose; the cloud is doubled there"
    ]
