"""Shots and poses to points in the world: the source's equation, each shot with the pose of its own instant.

    p_ins = mat_ins_lidar p_lidar + lever arm;    p_local = mat_local_ins p_ins + position            (spec of the source, steps 1-3)

in column form. `project` puts local coordinates into a projected CRS.
"""

from typing import Any, Final, NamedTuple

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
    first, knots, begin = _stretches(shots.time_ns)
    poses, known = sensor_poses(knots * STRETCH_NS, trajectory, mount)
    whole = known[begin] & known[begin + 1]
    _place(shots.time_ns, shots.xyz_m, _Stretches(first, knots[begin] * STRETCH_NS, begin, whole), poses, xyz)
    edge = np.empty(0, np.int64) if whole.all() else np.flatnonzero(~np.repeat(whole, np.diff(first)))
    return _place_each(shots, trajectory, mount, xyz, edge)


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


class _Stretches(NamedTuple):
    """Runs of shots within one stretch.

    Attributes
    ----------
    first : ndarray of int64, shape (m + 1,)
        First shot of each run, and the end.
    begin_ns : ndarray of int64, shape (m,)
        When the stretch begins.
    pose : ndarray of int64, shape (m,)
        Which pose is that of its begin; the next is that of its end.
    whole : ndarray of bool, shape (m,)
        Whether both poses are known.
    """

    first: Times
    begin_ns: Times
    pose: Times
    whole: Mask


@njit(cache=True, nogil=True)
def _stretches(time_ns: Any) -> Any:
    """Cut times where they pass from one stretch to another.

    Returns
    -------
    first : ndarray of int64, shape (m + 1,)
        First shot of each run, and the end.
    knots : ndarray of int64, shape (k,)
        Begins and ends of the stretches, in their length since time 0. Neighbours share one.
    begin : ndarray of int64, shape (m,)
        Which knot is the begin of the run's stretch; the next is its end.
    """
    many = len(time_ns)
    # as long as can be: pages never touched cost nothing
    first, knots, begin = np.empty(many + 1, np.int64), np.empty(2 * many, np.int64), np.empty(many, np.int64)
    runs, count, begin_ns = 0, 0, np.int64(0)
    for i in range(many):
        if runs and 0 <= time_ns[i] - begin_ns < STRETCH_NS:
            continue
        number = time_ns[i] // STRETCH_NS
        begin_ns = number * STRETCH_NS
        if not count or knots[count - 1] != number:
            knots[count] = number
            count += 1
        knots[count] = number + 1
        first[runs], begin[runs] = i, count - 1
        count, runs = count + 1, runs + 1
    first[runs] = many
    return first[: runs + 1].copy(), knots[:count].copy(), begin[:runs].copy()


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
def _place_lane(time_ns: Any, begin_ns: int, xyz: Any, a: Any, b: Any, lane: Any, out: Any) -> None:
    """Place at most `_LANE` shots. `lane`, shape (7, _LANE), is room for time and coordinates before and after."""
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
    many = len(time_ns)
    for i in range(many):
        lane[0, i] = np.float64(np.int32(time_ns[i] - begin_ns))
    for i in range(many):
        lane[1, i], lane[2, i], lane[3, i] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    for i in range(many):
        u, x, y, z = lane[0, i], lane[1, i], lane[2, i], lane[3, i]
        lane[4, i] = a0 * x + a1 * y + a2 * z + a9 + u * (b0 * x + b1 * y + b2 * z + b9)
        lane[5, i] = a3 * x + a4 * y + a5 * z + a10 + u * (b3 * x + b4 * y + b5 * z + b10)
        lane[6, i] = a6 * x + a7 * y + a8 * z + a11 + u * (b6 * x + b7 * y + b8 * z + b11)
    for i in range(many):
        out[i, 0], out[i, 1], out[i, 2] = lane[4, i], lane[5, i], lane[6, i]


@njit(cache=True, nogil=True, fastmath=True)
def _place(time_ns: Any, xyz: Any, stretches: Any, poses: Any, out: Any) -> None:
    """Place the shots of whole stretches: (a + u b) applied to each, u the time since the stretch began."""
    lane = np.empty((7, _LANE))
    for run in range(len(stretches.whole)):
        if not stretches.whole[run]:
            continue
        begin_ns, pose = stretches.begin_ns[run], stretches.pose[run]
        a = poses[pose]
        b = (poses[pose + 1] - a) * (1.0 / STRETCH_NS)
        end = stretches.first[run + 1]
        for first in range(stretches.first[run], end, _LANE):
            last = min(first + _LANE, end)
            _place_lane(time_ns[first:last], begin_ns, xyz[first:last], a, b, lane, out[first:last])


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
