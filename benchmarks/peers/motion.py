"""How the lidar moves while it scans and to the next scan: what a peer predicts with and deskews by."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from flightlog import frames
from flightlog.mount import Mount
from groundproc.flight.timeline import Leg, LidarRun
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.table import from_poses
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

FAST_HZ = 40.0
"""An autopilot's gyro slower than this cannot follow a multirotor: the lidar's own is taken then."""
GRID_NS = 10_000_000


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the lidar at a time: mat_world_lidar of shape (3, 3), and its position [m]."""

    time_ns: int
    mat: Array
    position_m: Array

    def matrix(self) -> Array:
        """The same as a homogeneous matrix, shape (4, 4)."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.mat, self.position_m
        return out


class Motion(Protocol):
    """What is known of the motion before a scan is matched."""

    def turn(self, since: Pose, before: Pose | None, time_ns: Times) -> Rotation:
        """Rotations "body at `since` from body at each time", shape (n,)."""


class ConstantVelocity:
    """Goes on turning as from the last pose but one to the last."""

    def turn(self, since: Pose, before: Pose | None, time_ns: Times) -> Rotation:
        """See Motion."""
        if before is None:
            return Rotation.identity(len(time_ns))
        step = Rotation.from_matrix(before.mat.T @ since.mat).as_rotvec()
        share = (time_ns - since.time_ns) / (since.time_ns - before.time_ns)
        return Rotation.from_rotvec(share[:, None] * step)


class Gyros:
    """Turns as the gyros say.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
        Lidar time.
    rate_rad_s : ndarray, shape (n, 3)
        In the sensor frame, less its bias.
    """

    def __init__(self, time_ns: Times, rate_rad_s: Array) -> None:
        self._time_ns = time_ns
        step = 0.5 * (rate_rad_s[1:] + rate_rad_s[:-1]) * (np.diff(time_ns) * 1e-9)[:, None]
        quats = np.empty((len(time_ns), 4))
        quats[0] = 1.0, 0.0, 0.0, 0.0
        for i, turn in enumerate(frames.quat_exp(step)):
            quats[i + 1] = frames.quat_multiply(quats[i], turn)
        self._quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)

    def turn(self, since: Pose, before: Pose | None, time_ns: Times) -> Rotation:
        """See Motion."""
        del before
        return self.at(since.time_ns, time_ns)

    def at(self, since_ns: int, time_ns: Times) -> Rotation:
        """Rotations "body at a time from body at each of others", shape (n,)."""
        edges = np.array([min(since_ns, int(time_ns.min())), max(since_ns, int(time_ns.max()))])
        low, high = np.searchsorted(self._time_ns, edges) + np.array([-2, 2])
        part = slice(max(low, 0), max(high, 2))
        knots = (self._time_ns[part] - since_ns) * 1e-9
        quats = frames.quat_multiply(frames.quat_inverse(self._quats[part][:1]), self._quats[part])
        vectors = frames.quat_log(quats)  # over a scan or two: no angle near half a turn

        def vector(seconds: Array) -> Array:
            return np.stack([np.interp(seconds, knots, axis) for axis in vectors.T], axis=1)

        start = Rotation.from_rotvec(vector(np.zeros(1))[0])
        return start.inv() * Rotation.from_rotvec(vector((time_ns - since_ns) * 1e-9))


def gyros(leg: Leg, run: LidarRun, mount: Mount) -> Gyros:
    """The gyros of a flight on the lidar's clock: the autopilot's if they are fast enough, else the lidar's own.

    The lidar's have zero offsets of tens of deg/s: what they read on average above the autopilot's is taken off.
    """
    track = max(leg.boot.gyros(), key=lambda each: each.rate_hz)
    time_ns = leg.utc_from_boot(track.time_ns)
    for line in reversed(leg.lidar_line):
        time_ns = line.inverse()(time_ns)
    rate = track.rate_rad_s @ mount.mat_ins_lidar()
    if track.rate_hz >= FAST_HZ or run.gyro is None:
        return Gyros(time_ns, rate)
    own = run.gyro
    common = (own.time_ns >= time_ns[0]) & (own.time_ns <= time_ns[-1])
    offset = own.rate_rad_s[common].mean(axis=0) - rate.mean(axis=0)
    return Gyros(own.time_ns, own.rate_rad_s - offset)


def dense(poses: list[Pose], motion: Gyros | None, mount: Mount, frame: LocalFrame) -> Trajectory:
    """A trajectory of the INS origin every 10 ms through poses of the lidar, on the lidar's clock, in a local frame by name only.

    Between scans the position is a cubic spline; the attitude is what the gyros say, bent to meet the next scan, or else a spline.
    """
    knots = np.array([pose.time_ns for pose in poses], np.int64)
    grid = np.arange(-(-int(knots[0]) // GRID_NS) * GRID_NS, int(knots[-1]), GRID_NS, dtype=np.int64)
    seconds, at = (knots - knots[0]) * 1e-9, (grid - knots[0]) * 1e-9
    position = CubicSpline(seconds, np.stack([pose.position_m for pose in poses]))(at)
    turns = Rotation.from_matrix(np.stack([pose.mat for pose in poses]))
    if motion is None:
        attitude = RotationSpline(seconds, turns)(at).as_matrix()
    else:
        attitude = np.empty((len(grid), 3, 3))
        interval = np.clip(np.searchsorted(knots, grid, side="right") - 1, 0, len(knots) - 2)
        for number in range(len(knots) - 1):
            chosen = np.flatnonzero(interval == number)
            if len(chosen):
                said = motion.at(int(knots[number]), np.append(grid[chosen], knots[number + 1]))
                missed = (turns[number] * said[-1]).inv() * turns[number + 1]
                share = (grid[chosen] - knots[number]) / (knots[number + 1] - knots[number])
                bent = Rotation.from_rotvec(share[:, None] * missed.as_rotvec())
                attitude[chosen] = (turns[number] * said[:-1] * bent).as_matrix()
    ins = attitude @ mount.mat_ins_lidar().T
    none = np.full((len(grid), 3), np.nan)
    origin = position - ins @ mount.lidar_position_m()
    return from_poses(frame, grid, origin, frames.quat_from_mat(ins), none, none)
