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
from groundproc.numerics.memory import Pool
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
_LANE: Final = 64
"""Shots placed side by side: as arrays of single coordinates, the compiler makes four or eight of them one."""
_FEW: Final = 1 << 14
"""Poses that are asked for stretch by stretch even where fewer shots lie within them."""
_MEMORY: Final = Pool()


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
    xyz = _MEMORY.empty((len(shots), 3), np.float64)
    if trajectory.interpolation == HOLD:
        missing = _place_each(shots, trajectory, mount, xyz, np.arange(len(shots)))
    else:
        missing = _place_stretches(shots, trajectory, mount, xyz)
    kept, gated = shots, shots.gated
    if len(missing):
        covered = np.ones(len(shots), np.bool_)
        covered[missing] = False
        kept, xyz = shots[covered], xyz[covered]
    dropped = Dropped(len(missing), gated.outside_fov, gated.no_return, gated.out_of_range)
    columns = {
        "intensity": kept.intensity,
        "return_number": np.bitwise_and(kept.returns, 0x0F, out=_MEMORY.empty(len(kept), np.uint8)),
        "number_of_returns": np.right_shift(kept.returns, 4, out=_MEMORY.empty(len(kept), np.uint8)),
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


def _place_stretches(shots: Shots, trajectory: Trajectory, mount: Mount, xyz: Array) -> Times:
    """Place shots with poses interpolated linearly within stretches; those at an edge of the coverage each with its own.

    Gives which ones are not covered.
    """
    if not len(shots):
        return np.empty(0, np.int64)
    first, last = (int(time_ns) // STRETCH_NS for time_ns in shots.time_ns[[0, -1]])
    if last - first > max(len(shots), _FEW):
        return _place_each(shots, trajectory, mount, xyz, np.arange(len(shots)))
    poses, known = sensor_poses(np.arange(first, last + 2) * STRETCH_NS, trajectory, mount)
    left = _place(shots.time_ns, shots.xyz_m, first, poses, known, xyz)
    return _place_each(shots, trajectory, mount, xyz, left)


def _place_each(shots: Shots, trajectory: Trajectory, mount: Mount, xyz: Array, chosen: Times) -> Times:
    """Place chosen shots, shape (n,), each with a pose asked for; which ones are not covered."""
    missing = [np.empty(0, np.int64)]
    for start in range(0, len(chosen), _PIECE):
        some = chosen[start : start + _PIECE]
        poses, known = sensor_poses(shots.time_ns[some], trajectory, mount)
        missing.append(some[~known])
        # poses outside the trajectory are no numbers to reckon with
        some, poses = some[known], poses[known]
        mats = poses[:, :9].reshape(-1, 3, 3)
        xyz[some] = np.einsum("nij,nj->ni", mats, shots.xyz_m[some].astype(np.float64)) + poses[:, 9:]
    return np.concatenate(missing)


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


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _place_lane(lane: Any, a: Any, b: Any, xyz: Any, out: Any) -> None:
    """Apply (a + u b) to at most `_LANE` shots; `lane` has u in its row 0, and room for coordinates before and after in the others."""
    # scalars: the compiler then knows that no store changes them
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11 = (
        a[0],
        a[1],
        a[2],
        a[3],
        a[4],
        a[5],
        a[6],
        a[7],
        a[8],
        a[9],
        a[10],
        a[11],
    )
    b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11 = (
        b[0],
        b[1],
        b[2],
        b[3],
        b[4],
        b[5],
        b[6],
        b[7],
        b[8],
        b[9],
        b[10],
        b[11],
    )
    for i in range(len(out)):
        lane[1, i], lane[2, i], lane[3, i] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    for i in range(len(out)):
        u, x, y, z = lane[0, i], lane[1, i], lane[2, i], lane[3, i]
        lane[4, i] = a0 * x + a1 * y + a2 * z + a9 + u * (b0 * x + b1 * y + b2 * z + b9)
        lane[5, i] = a3 * x + a4 * y + a5 * z + a10 + u * (b3 * x + b4 * y + b5 * z + b10)
        lane[6, i] = a6 * x + a7 * y + a8 * z + a11 + u * (b6 * x + b7 * y + b8 * z + b11)
    for i in range(len(out)):
        out[i, 0], out[i, 1], out[i, 2] = lane[4, i], lane[5, i], lane[6, i]


@njit(cache=True, nogil=True, fastmath=True)
def _place(time_ns: Any, xyz: Any, first_stretch: int, poses: Any, known: Any, out: Any) -> Any:
    """Place the shots of stretches whose poses at both ends are known; which ones are left, shape (k,).

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
    xyz : ndarray of float32, shape (n, 3)
    first_stretch : int
        Number of the first pose's stretch, counted from time 0.
    poses : ndarray, shape (m, 12)
        At the begins of stretches one after another.
    known : ndarray of bool, shape (m,)
    out : ndarray, shape (n, 3)
    """
    many = len(time_ns)
    left, count = np.empty(many, np.int64), 0  # as long as can be: pages never touched cost nothing
    lane = np.empty((7, _LANE))
    pose, begin_ns, whole = 0, np.int64(0), False
    begin, first = np.empty(12), 0
    drift = np.empty(12)
    while first < many:
        if first == 0 or not 0 <= time_ns[first] - begin_ns < STRETCH_NS:
            number = time_ns[first] // STRETCH_NS
            begin_ns, pose = number * STRETCH_NS, number - first_stretch
            whole = 0 <= pose < len(poses) - 1 and known[pose] and known[pose + 1]
            if whole:
                for i in range(12):
                    begin[i], drift[i] = poses[pose, i], (poses[pose + 1, i] - poses[pose, i]) * (1.0 / STRETCH_NS)
        times, strangers = time_ns[first : first + _LANE], 0
        for i in range(len(times)):
            since_ns = times[i] - begin_ns
            strangers += not 0 <= since_ns < STRETCH_NS
            lane[0, i] = np.int32(since_ns)
        last = min(first + _LANE, many)
        if strangers:
            last = first + 1
            while 0 <= time_ns[last] - begin_ns < STRETCH_NS:
                last += 1
        if whole:
            _place_lane(lane, begin, drift, xyz[first:last], out[first:last])
        else:
            for i in range(first, last):
                left[count] = i
                count += 1
        first = last
    return left[:count].copy()


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


@njit(cache=True, nogil=True)
def strays(xyz_m: Any, most_m: float) -> Any:
    """Number of points, shape (n, 3), with a coordinate that is no number or beyond so much either way."""
    found = 0
    for i in range(xyz_m.shape[0]):
        if not (abs(xyz_m[i, 0]) <= most_m and abs(xyz_m[i, 1]) <= most_m and abs(xyz_m[i, 2]) <= most_m):
            found += 1
    return found
