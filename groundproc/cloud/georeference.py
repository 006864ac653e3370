"""Shots and poses to points in the world: the source's equation, each shot with the pose of its own instant.

    p_ins = mat_ins_lidar p_lidar + lever arm;    p_local = mat_local_ins p_ins + position            (spec of the source, steps 1-3)

in column form. `project` puts local coordinates into a projected CRS.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.mount import Mount
from groundproc.cloud.points import Dropped, Points
from groundproc.geodesy import Polynomial
from groundproc.sensors.shots import Shots
from groundproc.trajectory.trajectory import HOLD, Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

STRETCH_NS: Final = 500_000
"""Within so long a stretch [ns] the pose is interpolated linearly between its ends. That is right to h^2/8 times the second derivative:
at 10 m/s^2 and 1000 deg/s^2 to 3e-7 m and 5e-7 rad; the chord of a turn at 300 deg/s shortens a vector by 9e-7 of its length."""
_PIECE: Final = 1 << 16
"""Shots for which every pose is asked at once: bounds the memory."""


def georeference(shots: Shots, trajectory: Trajectory, mount: Mount) -> Points:
    """Place shots in the trajectory's local frame.

    Parameters
    ----------
    shots : Shots
        With times on the trajectory's scale [ns].
    trajectory : Trajectory
    mount : Mount

    Returns
    -------
    Points
        Those that the trajectory covers.
    """
    xyz = np.empty((len(shots), 3))
    if trajectory.interpolation == HOLD:
        covered = _place_each(shots, trajectory, mount, xyz, np.arange(len(shots)))
    else:
        covered = _place_stretches(shots, trajectory, mount, xyz)
    missing = len(shots) - int(np.count_nonzero(covered))
    kept, xyz = (shots[covered], xyz[covered]) if missing else (shots, xyz)
    gated = shots.gated
    dropped = Dropped(missing, gated.outside_fov, gated.no_return, gated.out_of_range)
    columns = {
        "intensity": kept.intensity,
        "return_number": kept.returns & 0x0F,
        "number_of_returns": kept.returns >> 4,
        "laser": kept.laser,
        "range": kept.range_m,
    }
    return Points(kept.time_ns, xyz, columns, dropped)


def sensor_poses(time_ns: Times, trajectory: Trajectory, mount: Mount) -> tuple[Array, Mask]:
    """Poses of the sensor at times, shape (n,).

    Returns
    -------
    poses : ndarray, shape (n, 12)
        Rows of the matrix "local from sensor", then the position [m].
    covered : ndarray of bool, shape (n,)
    """
    poses, covered = trajectory.where_covered(time_ns)
    out = np.empty((len(time_ns), 12))
    _sensor_poses(poses.position_m, poses.quat_local_ins_wxyz, mount.mat_ins_lidar(), mount.lidar_position_m(), out)
    return out, covered


def project(xyz_m: Array, polynomial: Polynomial) -> None:
    """Put local coordinates, shape (n, 3), into the projected CRS, in place."""
    _project(xyz_m, polynomial.centre_m, polynomial.coefficients)


def _place_stretches(shots: Shots, trajectory: Trajectory, mount: Mount, xyz: Array) -> Mask:
    """Place shots with poses interpolated linearly within stretches; those at an edge of the coverage each with its own."""
    first, slot = _stretches(shots.time_ns, STRETCH_NS)
    poses, known = sensor_poses((slot[:, None] + np.array([0, 1])).ravel() * STRETCH_NS, trajectory, mount)
    whole = known.reshape(-1, 2).all(axis=1)
    _place(shots.time_ns, shots.xyz_m, first, slot, whole, poses.reshape(-1, 2, 12), STRETCH_NS, xyz)
    covered = np.ones(len(shots), np.bool_)
    if not whole.all():
        edge = np.flatnonzero(~np.repeat(whole, np.diff(first)))
        covered[edge] = _place_each(shots, trajectory, mount, xyz, edge)
    return covered


def _place_each(shots: Shots, trajectory: Trajectory, mount: Mount, xyz: Array, chosen: Times) -> Mask:
    """Place chosen shots, shape (n,), each with a pose asked for; which of them are covered."""
    covered = np.zeros(len(chosen), np.bool_)
    for start in range(0, len(chosen), _PIECE):
        some = chosen[start : start + _PIECE]
        poses, known = sensor_poses(shots.time_ns[some], trajectory, mount)
        covered[start : start + _PIECE] = known
        # poses outside the trajectory are no numbers to reckon with
        some, poses = some[known], poses[known]
        mats = poses[:, :9].reshape(-1, 3, 3)
        xyz[some] = np.einsum("nij,nj->ni", mats, shots.xyz_m[some].astype(np.float64)) + poses[:, 9:]
    return covered


@njit(cache=True, nogil=True)
def _stretches(time_ns: Any, length_ns: int) -> Any:
    """Cut times where they pass from one stretch to another.

    Returns the first shot of each run, and the end, shape (m + 1,); and the number of its stretch, counted from time 0, shape (m,).
    """
    many = len(time_ns)
    first, slot = (
        np.empty(many + 1, np.int64),
        np.empty(many, np.int64),
    )  # as long as can be: pages never touched cost nothing
    count, start, end = 0, np.int64(0), np.int64(0)
    for i in range(many):
        if not start <= time_ns[i] < end:
            number = time_ns[i] // length_ns
            start = number * length_ns
            end = start + length_ns
            first[count], slot[count] = i, number
            count += 1
    first[count] = many
    return first[: count + 1].copy(), slot[:count].copy()


@njit(cache=True, nogil=True)
def _sensor_poses(position: Any, quat: Any, mat_ins_lidar: Any, lever: Any, out: Any) -> None:
    """Rows of a matrix "local from sensor" and the sensor's position for each pose; `out` has shape (n, 12)."""
    for i in range(len(out)):
        w, x, y, z = quat[i]
        m = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        pose = out[i]
        for row in range(3):
            a, b, c = m[row]
            for column in range(3):
                pose[3 * row + column] = (
                    a * mat_ins_lidar[0, column] + b * mat_ins_lidar[1, column] + c * mat_ins_lidar[2, column]
                )
            pose[9 + row] = position[i, row] + a * lever[0] + b * lever[1] + c * lever[2]


@njit(cache=True, nogil=True, fastmath=True)
def _place(time_ns: Any, xyz: Any, first: Any, slot: Any, whole: Any, ends: Any, length_ns: int, out: Any) -> None:
    """Place the shots of whole stretches: (a + u b) applied to each, u the time since the stretch began."""
    per_ns = 1.0 / length_ns
    for run in range(len(slot)):
        if not whole[run]:
            continue
        begin_ns = slot[run] * length_ns
        p, b = ends[run, 0], (ends[run, 1] - ends[run, 0]) * per_ns
        # scalars and slices: the compiler then knows that no store changes them and that no index is negative
        a0, a1, a2, a3, a4, a5 = p[0], p[1], p[2], p[3], p[4], p[5]
        a6, a7, a8, a9, a10, a11 = p[6], p[7], p[8], p[9], p[10], p[11]
        b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
        b6, b7, b8, b9, b10, b11 = b[6], b[7], b[8], b[9], b[10], b[11]
        span = slice(first[run], first[run + 1])
        times, sensor, world = time_ns[span], xyz[span], out[span]
        for i in range(len(times)):
            u = np.float64(np.int32(times[i] - begin_ns))
            x, y, z = np.float64(sensor[i, 0]), np.float64(sensor[i, 1]), np.float64(sensor[i, 2])
            world[i, 0] = a0 * x + a1 * y + a2 * z + a9 + u * (b0 * x + b1 * y + b2 * z + b9)
            world[i, 1] = a3 * x + a4 * y + a5 * z + a10 + u * (b3 * x + b4 * y + b5 * z + b10)
            world[i, 2] = a6 * x + a7 * y + a8 * z + a11 + u * (b6 * x + b7 * y + b8 * z + b11)


@njit(cache=True, nogil=True, fastmath=True)
def _project(xyz: Any, centre: Any, coefficients: Any) -> None:
    for i in range(xyz.shape[0]):
        e, n, u = xyz[i, 0] - centre[0], xyz[i, 1] - centre[1], xyz[i, 2] - centre[2]
        for axis in range(3):
            c = coefficients[axis]
            of_east = c[1] + c[4] * e + c[7] * n + c[8] * u
            of_north = c[2] + c[5] * n + c[9] * u
            of_up = c[3] + c[6] * u
            xyz[i, axis] = c[0] + e * of_east + n * of_north + u * of_up


@njit(cache=True, nogil=True)
def extent(xyz_m: Any) -> Any:
    """Least and largest coordinates of points, shape (n, 3): two arrays of shape (3,). numpy takes twice as long."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(xyz_m.shape[0]):
        for axis in range(3):
            low[axis] = min(low[axis], xyz_m[i, axis])
            high[axis] = max(high[axis], xyz_m[i, axis])
    return low, high
