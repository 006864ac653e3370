"""Shots and poses to points in the world: the source's equation, one pose for each firing.

    p_ins = mat_ins_lidar p_lidar + lever arm;    p_local = mat_local_ins p_ins + position            (spec of the source, steps 1-3)

in column form. One fused kernel goes from packet bytes to local coordinates; a second puts them into a projected CRS.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import hdl32e
from flightlog.hdl32e import BLOCKS, FIRING_NS, LASER_NS, LASERS, RANGE_LSB_M
from flightlog.mount import Mount
from groundproc.cloud.points import Dropped, Points
from groundproc.geodesy import Polynomial
from groundproc.sensors import hdl32e as decode
from groundproc.sensors.hdl32e import Gate, LaserTable
from groundproc.trajectory.trajectory import HOLD, Trajectory

Array = npt.NDArray[np.float64]

MID_FIRING_NS: Final = (LASERS - 1) * LASER_NS // 2
"""From a firing's first laser to its middle [ns]: the instant whose pose all 32 share. At 50 deg/s and 50 m it is right to 0.8 mm."""

_BLOCK_BYTES: Final = hdl32e.BLOCK_DTYPE.itemsize


def georeference(
    packets: npt.NDArray[np.void],
    time_ns: npt.NDArray[np.int64],
    trajectory: Trajectory,
    mount: Mount,
    gate: Gate | None = None,
    lasers: LaserTable | None = None,
) -> Points:
    """Place the returns of data packets in the trajectory's local frame.

    Parameters
    ----------
    packets : ndarray of SCAN_PACKET_DTYPE or DATA_DTYPE, shape (n,)
        All of one return mode.
    time_ns : ndarray of int64, shape (n,)
        Time of each packet's stamp on the trajectory's scale [ns].
    trajectory : Trajectory
    mount : Mount
    gate : Gate, optional
        Default: every return.
    lasers : LaserTable, optional
        Default: the manual's.
    """
    data = packets["data"] if packets.dtype.names and "data" in packets.dtype.names else packets
    (raw, head), dual = decode.raw_bytes(packets), decode.is_dual(data)
    lasers = lasers or LaserTable.nominal()
    sensor, covered = sensor_poses(time_ns, BLOCKS // 2 if dual else BLOCKS, trajectory, mount)
    size = len(raw) * BLOCKS * LASERS
    out = (
        np.empty(size, np.int64),
        np.empty((size, 3)),
        np.empty(size, np.uint16),
        np.empty(size, np.uint8),
        np.empty(size, np.uint8),
        np.empty(size, np.uint8),
    )
    table = np.stack([np.cos(lasers.elevation_rad), np.sin(lasers.elevation_rad), lasers.range_offset_m])
    limits = (gate or Gate()).steps()
    place = _place_dual if dual else _place_single
    counters = np.zeros(4, np.int64)
    count = place(raw, head, time_ns, table, *limits, covered, sensor, out, counters)
    stamps, xyz, ranges, intensity, laser, returns = out
    columns = {
        "intensity": intensity[:count],
        "return_number": returns[:count] & 0x0F,
        "number_of_returns": returns[:count] >> 4,
        "laser": laser[:count],
        "range": np.multiply(ranges[:count], RANGE_LSB_M, dtype=np.float32),
    }
    return Points(stamps[:count], xyz[:count], columns, Dropped(*counters.tolist()))


def project(xyz_m: Array, polynomial: Polynomial) -> None:
    """Put local coordinates, shape (n, 3), into the projected CRS, in place."""
    _project(xyz_m, polynomial.centre_m, polynomial.coefficients)


def sensor_poses(
    time_ns: npt.NDArray[np.int64], firings: int, trajectory: Trajectory, mount: Mount
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Pose of the sensor at the middle of each firing.

    The trajectory is asked at the first and the last firing of each packet, and what lies between, half a millisecond, is filled
    linearly: at 1000 deg/s^2 and 10 m/s^2 that is right to 1e-6 rad and 1e-6 m. A held pose grid is asked for every firing.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (n,)
        Stamps of the packets [ns] on the trajectory's scale.
    firings : int
        In a packet.
    trajectory, mount

    Returns
    -------
    poses : ndarray, shape (n * firings, 12)
        Rows of the matrix "local from sensor", then the position [m].
    covered : ndarray of bool, shape (n * firings,)
    """
    asked = np.arange(firings) if trajectory.interpolation == HOLD else np.array([0, firings - 1])
    times = (time_ns[:, None] + asked * FIRING_NS + MID_FIRING_NS).ravel()
    poses, known = trajectory.where_covered(times)
    at_asked = np.empty((len(times), 12))
    _sensor_poses(
        poses.position_m, poses.quat_local_ins_wxyz, mount.mat_ins_lidar(), mount.lidar_position_m(), at_asked
    )
    if len(asked) == firings:
        return at_asked, known
    out, covered = np.empty((len(time_ns) * firings, 12)), np.empty(len(time_ns) * firings, np.bool_)
    _fill(at_asked, known, firings, out, covered)
    return out, covered


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


@njit(cache=True, nogil=True)
def _fill(ends: Any, known: Any, firings: int, out: Any, covered: Any) -> None:
    """Poses between the first and the last firing of each packet."""
    for packet in range(len(ends) // 2):
        both = known[2 * packet] and known[2 * packet + 1]
        for firing in range(firings):
            covered[packet * firings + firing] = both
            if both:
                part = firing / (firings - 1)
                for i in range(12):
                    out[packet * firings + firing, i] = (1 - part) * ends[2 * packet, i] + part * ends[
                        2 * packet + 1, i
                    ]


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _axes(pose: Any, azimuth: float) -> Any:
    """For x, y and z of the world: the sensor's forward and right turned to a block's azimuth, its up, its position."""
    cosine, sine = np.cos(azimuth * decode.STEP_RAD), np.sin(azimuth * decode.STEP_RAD)
    fx, rx = pose[0] * sine + pose[1] * cosine, pose[0] * cosine - pose[1] * sine
    fy, ry = pose[3] * sine + pose[4] * cosine, pose[3] * cosine - pose[4] * sine
    fz, rz = pose[6] * sine + pose[7] * cosine, pose[6] * cosine - pose[7] * sine
    return fx, rx, pose[2], pose[9], fy, ry, pose[5], pose[10], fz, rz, pose[8], pose[11]


@njit(cache=True, nogil=True, fastmath=True)
def _place_single(
    raw: Any,
    head: int,
    time_ns: Any,
    lasers: Any,
    start: float,
    width: float,
    low: int,
    high: int,
    covered: Any,
    sensor: Any,
    out: Any,
    counters: Any,
) -> int:
    out_time, out_xyz, out_range, out_intensity, out_laser, out_returns = out
    count = 0
    steps, directions = np.empty(BLOCKS), np.empty((2, LASERS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = decode.azimuth_step(row, 1, steps)
        decode.laser_directions(step, lasers, directions)
        for block in range(BLOCKS):
            if not covered[packet * BLOCKS + block]:
                counters[0] += LASERS
                continue
            pose = sensor[packet * BLOCKS + block]
            azimuth = float(decode.u16(row, block * _BLOCK_BYTES + 2) % 36_000)
            if decode.block_is_outside(azimuth, step, start, width):
                counters[1] += LASERS
                continue
            inside = decode.block_is_inside(azimuth, step, start, width)
            fx, rx, ux, tx, fy, ry, uy, ty, fz, rz, uz, tz = _axes(pose, azimuth)
            firing_ns = time_ns[packet] + block * FIRING_NS
            at = block * _BLOCK_BYTES + 1
            for k in range(LASERS):
                at += 3
                range_steps = decode.u16(row, at)
                if not inside and (azimuth + step * decode.LASER_FRACTION * k - start) % decode.AZIMUTH_TURN > width:
                    counters[1] += 1
                    continue
                if range_steps < low or range_steps > high:
                    counters[2 if range_steps == 0 else 3] += 1
                    continue
                distance = range_steps * RANGE_LSB_M + lasers[2, k]
                p, q, r = distance * directions[0, k], distance * directions[1, k], distance * lasers[1, k]
                out_time[count] = firing_ns + k * LASER_NS
                out_xyz[count, 0] = tx + p * fx + q * rx + r * ux
                out_xyz[count, 1] = ty + p * fy + q * ry + r * uy
                out_xyz[count, 2] = tz + p * fz + q * rz + r * uz
                out_range[count] = range_steps
                out_intensity[count] = row[at + 2]
                out_laser[count] = k
                count += 1
    out_returns[:count] = decode.SINGLE_RETURN
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _place_dual(
    raw: Any,
    head: int,
    time_ns: Any,
    lasers: Any,
    start: float,
    width: float,
    low: int,
    high: int,
    covered: Any,
    sensor: Any,
    out: Any,
    counters: Any,
) -> int:
    out_time, out_xyz, out_range, out_intensity, out_laser, out_returns = out
    count = 0
    steps, directions = np.empty(BLOCKS), np.empty((2, LASERS))
    for packet in range(raw.shape[0]):
        row = raw[packet, head:]
        step = decode.azimuth_step(row, 2, steps)
        decode.laser_directions(step, lasers, directions)
        for firing in range(BLOCKS // 2):
            if not covered[packet * (BLOCKS // 2) + firing]:
                counters[0] += LASERS
                continue
            pose = sensor[packet * (BLOCKS // 2) + firing]
            azimuth = float(decode.u16(row, 2 * firing * _BLOCK_BYTES + 2) % 36_000)
            if decode.block_is_outside(azimuth, step, start, width):
                counters[1] += LASERS
                continue
            inside = decode.block_is_inside(azimuth, step, start, width)
            fx, rx, ux, tx, fy, ry, uy, ty, fz, rz, uz, tz = _axes(pose, azimuth)
            firing_ns = time_ns[packet] + firing * FIRING_NS
            for k in range(LASERS):
                if not inside and (azimuth + step * decode.LASER_FRACTION * k - start) % decode.AZIMUTH_TURN > width:
                    counters[1] += 1
                    continue
                last = 2 * firing * _BLOCK_BYTES + 4 + 3 * k
                first, second, returns = decode.pair_returns(row, last, last + _BLOCK_BYTES, low, high)
                if returns == 0:
                    counters[3 if row[last] or row[last + 1] else 2] += 1
                for number in range(returns):
                    at = first if number == 0 else second
                    range_steps = decode.u16(row, at)
                    distance = range_steps * RANGE_LSB_M + lasers[2, k]
                    p, q, r = distance * directions[0, k], distance * directions[1, k], distance * lasers[1, k]
                    out_time[count] = firing_ns + k * LASER_NS
                    out_xyz[count, 0] = tx + p * fx + q * rx + r * ux
                    out_xyz[count, 1] = ty + p * fy + q * ry + r * uy
                    out_xyz[count, 2] = tz + p * fz + q * rz + r * uz
                    out_range[count] = range_steps
                    out_intensity[count] = row[at + 2]
                    out_laser[count] = k
                    out_returns[count] = decode.SINGLE_RETURN if returns == 1 else decode.FIRST_OF_TWO + number
                    count += 1
    return count


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
