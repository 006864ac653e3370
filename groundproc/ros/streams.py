"""Each topic as messages in the order of their time."""

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_MS, STANDARD_GRAVITY_M_S2
from flightlog.mount import Mount
from groundproc.flight.timeline import ClockTie, LidarRun
from groundproc.ros import messages
from groundproc.ros.clouds import clouds
from groundproc.ros.messages import QUAT_RFU_FLU, body_quat, flu_from_rfu
from groundproc.ros.scale import Pilot
from groundproc.sensors.shots import Shots
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

MAP: Final = "map"
BODY: Final = "base_link"
LIDAR: Final = "velodyne"
ANTENNA: Final = "gps"

POINTS: Final = "/points"
LIDAR_IMU: Final = "/lidar/imu"
IMU: Final = "/autopilot/imu"
ATTITUDE: Final = "/autopilot/attitude"
FIX: Final = "/autopilot/fix"
TF: Final = "/tf"
TF_STATIC: Final = "/tf_static"

KINDS: Final = {
    POINTS: "sensor_msgs/msg/PointCloud2",
    LIDAR_IMU: "sensor_msgs/msg/Imu",
    IMU: "sensor_msgs/msg/Imu",
    ATTITUDE: "sensor_msgs/msg/Imu",
    FIX: "sensor_msgs/msg/NavSatFix",
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
}
ODOMETRY_KIND: Final = "nav_msgs/msg/Odometry"
PATH_KIND: Final = "nav_msgs/msg/Path"

POSE_STEP_NS: Final = 10 * NS_PER_MS
"""Spacing of poses in /tf and odometry: tools interpolate on straight lines, and over 10 ms a multirotor leaves these by 0.1 mrad."""
PATH_STEP_NS: Final = 100 * NS_PER_MS
"""Spacing of poses in a path, which is one message: an hour takes 4 MB."""
_CHUNK: Final = 4096
_LEAST_FIX: Final = 2
"""GPS_FIX_TYPE_2D_FIX."""


class Record(NamedTuple):
    """One message of the bag."""

    time_ns: int
    topic: str
    data: bytes


def points(pieces: Iterable[Shots]) -> Iterator[Record]:
    """The clouds, one a turn."""
    for time_ns, rows in clouds(pieces):
        yield Record(time_ns, POINTS, messages.cloud(time_ns, LIDAR, rows))


def lidar_imu(run: LidarRun, tie: ClockTie) -> Iterator[Record]:
    """Gyros and accelerometers of the lidar in one run of its clock; the gyros have large offsets."""
    if run.gyro is None:
        return
    time_ns, rate = tie.utc_from_lidar(run.gyro.time_ns), flu_from_rfu(run.gyro.rate_rad_s)
    force = None if run.force_m_s2 is None else flu_from_rfu(run.force_m_s2)
    for i, stamp_ns in enumerate(time_ns.tolist()):
        data = messages.imu(stamp_ns, LIDAR, rate=rate[i], force=None if force is None else force[i])
        yield Record(stamp_ns, LIDAR_IMU, data)


_IMU_UNITS: Final = {
    "HIGHRES_IMU": (1.0, 1.0),
    "SCALED_IMU": (1e-3, 1e-3 * STANDARD_GRAVITY_M_S2),
    "RAW_IMU": (1e-3, 1e-3 * STANDARD_GRAVITY_M_S2),
}
"""Of gyros [rad/s] and accelerometers [m/s^2]; ArduPilot sends RAW_IMU in the units of SCALED_IMU."""


def imu(pilot: Pilot) -> Iterator[Record]:
    """The message of the autopilot's IMU that came most often."""
    boot = pilot.boot
    there = [name for name in _IMU_UNITS if boot.has(name, 1)]
    if not there:
        return
    name = max(there, key=lambda name: len(boot.tables[name]))
    table, (gyro, accel) = boot.tables[name], _IMU_UNITS[name]
    rate, force = (
        flu_from_rfu(frames.ins_from_frd(np.stack([table[f].astype(np.float64) for f in fields], axis=1) * unit))
        for fields, unit in ((("xgyro", "ygyro", "zgyro"), gyro), (("xacc", "yacc", "zacc"), accel))
    )
    for i, stamp_ns in enumerate(pilot.to_scale(boot.stamps_ns[name]).tolist()):
        yield Record(stamp_ns, IMU, messages.imu(stamp_ns, BODY, rate=rate[i], force=force[i]))


def attitude(pilot: Pilot) -> Iterator[Record]:
    """Attitudes and rates of the autopilot's AHRS."""
    boot = pilot.boot
    if not boot.has("ATTITUDE", 1):
        return
    table = boot.tables["ATTITUDE"]
    angles = (table[name].astype(np.float64) for name in ("yaw", "pitch", "roll"))
    quat = body_quat(frames.quat_from_mat(frames.mat_local_ins(*angles)))
    frd = np.stack([table[name].astype(np.float64) for name in ("rollspeed", "pitchspeed", "yawspeed")], axis=1)
    rate = flu_from_rfu(frames.ins_from_frd(frd))
    for i, stamp_ns in enumerate(pilot.to_scale(boot.stamps_ns["ATTITUDE"]).tolist()):
        yield Record(stamp_ns, ATTITUDE, messages.imu(stamp_ns, BODY, rate=rate[i], quat=quat[i]))


def fixes(pilot: Pilot) -> Iterator[Record]:
    """Positions of the receiver; heights above the ellipsoid where it states them, else not a number."""
    boot = pilot.boot
    if not boot.has("GPS_RAW_INT", 1):
        return
    table = boot.tables["GPS_RAW_INT"]
    for row, stamp_ns in zip(table, pilot.to_scale(boot.stamps_ns["GPS_RAW_INT"]).tolist(), strict=True):
        fixed = bool(row["fix_type"] >= _LEAST_FIX)
        stated = row["h_acc"] > 0 and row["v_acc"] > 0
        sigma_m = np.array([row["h_acc"], row["h_acc"], row["v_acc"]]) * 1e-3 if stated else None
        latitude, longitude = (row["lat"] * 1e-7, row["lon"] * 1e-7) if fixed else (np.nan, np.nan)
        height_m = row["alt_ellipsoid"] * 1e-3 if fixed and row["alt_ellipsoid"] else np.nan
        yield Record(stamp_ns, FIX, messages.fix(stamp_ns, ANTENNA, (latitude, longitude, height_m), sigma_m, fixed))


def mounted(time_ns: int, mount: Mount) -> Record:
    """Where lidar and antenna sit on the body, once and for all."""
    back = frames.quat_inverse(QUAT_RFU_FLU)
    turn = frames.quat_multiply(frames.quat_multiply(back, frames.quat_from_mat(mount.mat_ins_lidar())), QUAT_RFU_FLU)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    antenna = np.zeros(3) if mount.gps_position_m is None else np.array(mount.gps_position_m)
    parents = [
        (BODY, LIDAR, flu_from_rfu(mount.lidar_position_m()), turn),
        (BODY, ANTENNA, flu_from_rfu(antenna), level),
    ]
    return Record(time_ns, TF_STATIC, messages.transforms(time_ns, parents))


def thinned(trajectory: Trajectory, step_ns: int) -> npt.NDArray[np.int64]:
    """Knots about a step apart, and the last one, shape (n,)."""
    slot = (trajectory.time_ns - trajectory.time_ns[0]) // step_ns
    chosen = np.append(True, np.diff(slot) > 0)
    chosen[-1] = True
    return np.flatnonzero(chosen)


def path(trajectory: Trajectory, topic: str) -> Record:
    """The whole way in one message, at its beginning, so that viewers show it at once."""
    rows = thinned(trajectory, PATH_STEP_NS)
    time_ns, quat = trajectory.time_ns[rows], body_quat(trajectory.quat_local_ins_wxyz[rows])
    data = messages.path(time_ns, MAP, trajectory.position_m[rows], quat)
    return Record(int(time_ns[0]), topic, data)


def poses(trajectory: Trajectory, topic: str) -> Iterator[Record]:
    """The body in the map: as a transform, and as odometry with covariance."""
    rows = thinned(trajectory, POSE_STEP_NS)
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        time_ns, position = trajectory.time_ns[part], trajectory.position_m[part]
        mat = frames.mat_from_quat(trajectory.quat_local_ins_wxyz[part])
        quat = body_quat(trajectory.quat_local_ins_wxyz[part])
        heading, pitch, _ = frames.attitude_of(mat)
        covariance = messages.rotation_covariance(trajectory.covariance_at(time_ns), heading, pitch)
        velocity = flu_from_rfu(np.einsum("nji,nj->ni", mat, trajectory.velocity_m_s[part]))
        rate = flu_from_rfu(trajectory.rate_rad_s[part])
        for i, stamp_ns in enumerate(time_ns.tolist()):
            yield Record(stamp_ns, TF, messages.transforms(stamp_ns, [(MAP, BODY, position[i], quat[i])]))
            data = messages.odometry(stamp_ns, (MAP, BODY), position[i], quat[i], covariance[i], velocity[i], rate[i])
            yield Record(stamp_ns, topic, data)
