"""ROS 2 messages as CDR bytes, serialised by rosbags; what is not known is said in the way that each message has for it."""

from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore

from flightlog import frames
from flightlog.constants import NS_PER_S
from groundproc.trajectory.covariance import mat_attitude_turn

Array = npt.NDArray[np.float64]

_STORE: Final = get_typestore(Stores.ROS2_HUMBLE)
_TYPES: Final = _STORE.types

QUAT_RFU_FLU: Final = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""Turns vectors of axes forward, left, up into such of right, forward, up."""
POINT: Final = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
"""A point as the Velodyne drivers of ROS publish it; `time` is seconds since the cloud's stamp."""
_UINT16, _FLOAT32 = 4, 7
_UNKNOWN: Final = -1.0
"""First element of a covariance whose quantity is not there at all (sensor_msgs/Imu)."""


@cache
def definition(kind: str) -> str:
    """The definition of a message with those it depends on, as MCAP's ros2msg encoding wants them."""
    text: str = _STORE.generate_msgdef(kind, ros_version=2)[0]
    return text


def _bytes(message: Any) -> bytes:
    return bytes(_STORE.serialize_cdr(message, message.__msgtype__))


def _new(kind: str, **values: Any) -> Any:
    return _TYPES[kind](**values)


def _time(time_ns: int) -> Any:
    sec, nanosec = divmod(int(time_ns), NS_PER_S)
    return _new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def _header(time_ns: int, frame: str) -> Any:
    return _new("std_msgs/msg/Header", stamp=_time(time_ns), frame_id=frame)


def _vector(values: Sequence[float] | Array) -> Any:
    x, y, z = map(float, values)
    return _new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(wxyz: Array) -> Any:
    w, x, y, z = map(float, wxyz)
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(position_m: Array, quat_wxyz: Array) -> Any:
    x, y, z = map(float, position_m)
    point = _new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return _new("geometry_msgs/msg/Pose", position=point, orientation=_quaternion(quat_wxyz))


def flu_from_rfu(vectors: Array) -> Array:
    """Vectors of axes right, forward, up in forward, left, up, shape (..., 3)."""
    v = np.asarray(vectors)
    return np.stack([v[..., 1], -v[..., 0], v[..., 2]], axis=-1)


def body_quat(quat_a_rfu: Array) -> Array:
    """Attitudes of a body with axes forward, left, up of those of the same with right, forward, up, shape (..., 4)."""
    return frames.quat_multiply(quat_a_rfu, QUAT_RFU_FLU)


def cloud(time_ns: int, frame: str, points: npt.NDArray[np.void]) -> bytes:
    """A PointCloud2 of points of `POINT`, shape (n,), one row of it."""
    names = POINT.names or ()
    fields = [
        _new("sensor_msgs/msg/PointField", name=name, offset=POINT.fields[name][1],  # type: ignore[index]
             datatype=_UINT16 if name == "ring" else _FLOAT32, count=1)
        for name in names
    ]  # fmt: skip
    return _bytes(
        _new(
            "sensor_msgs/msg/PointCloud2",
            header=_header(time_ns, frame),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=POINT.itemsize * len(points),
            data=points.view(np.uint8).reshape(-1),
            is_dense=True,
        )
    )


def imu(
    time_ns: int, frame: str, *, rate: Array | None = None, force: Array | None = None, quat: Array | None = None
) -> bytes:
    """An Imu of what there is: rates [rad/s] and specific force [m/s^2] about forward, left, up, attitude in east, north, up."""

    def covariance(known: bool) -> Array:
        found = np.zeros(9)
        found[0] = 0.0 if known else _UNKNOWN
        return found

    return _bytes(
        _new(
            "sensor_msgs/msg/Imu",
            header=_header(time_ns, frame),
            orientation=_quaternion(np.array([1.0, 0.0, 0.0, 0.0]) if quat is None else quat),
            orientation_covariance=covariance(quat is not None),
            angular_velocity=_vector(np.zeros(3) if rate is None else rate),
            angular_velocity_covariance=covariance(rate is not None),
            linear_acceleration=_vector(np.zeros(3) if force is None else force),
            linear_acceleration_covariance=covariance(force is not None),
        )
    )


def fix(time_ns: int, frame: str, place: tuple[float, float, float], sigma_m: Array | None, fixed: bool) -> bytes:
    """A NavSatFix of latitude and longitude [deg] and height [m], above the ellipsoid or not a number; sigmas of east, north, up."""
    latitude_deg, longitude_deg, height_m = place
    status = _new("sensor_msgs/msg/NavSatStatus", status=0 if fixed else -1, service=1)
    covariance = np.zeros((3, 3)) if sigma_m is None else np.diag(np.square(sigma_m))
    return _bytes(
        _new(
            "sensor_msgs/msg/NavSatFix",
            header=_header(time_ns, frame),
            status=status,
            latitude=float(latitude_deg),
            longitude=float(longitude_deg),
            altitude=float(height_m),
            position_covariance=covariance.reshape(-1),
            position_covariance_type=0 if sigma_m is None else 1,  # unknown, approximated
        )
    )


def transforms(time_ns: int, parents: Sequence[tuple[str, str, Array, Array]]) -> bytes:
    """A TFMessage of (parent, child, position of the child's origin, attitude parent from child)."""
    found = []
    for parent, child, position_m, quat in parents:
        moved = _new("geometry_msgs/msg/Transform", translation=_vector(position_m), rotation=_quaternion(quat))
        found.append(
            _new(
                "geometry_msgs/msg/TransformStamped",
                header=_header(time_ns, parent),
                child_frame_id=child,
                transform=moved,
            )
        )
    return _bytes(_new("tf2_msgs/msg/TFMessage", transforms=found))


def odometry(
    time_ns: int, frames_of: tuple[str, str], position_m: Array, quat: Array, covariance: Array, velocity: Array, rate: Array
) -> bytes:  # fmt: skip
    """An Odometry: pose of the body with its covariance about the map's fixed axes, velocity and rate in the body; of these none is stated.

    Parameters
    ----------
    time_ns : int
    frames_of : tuple of str
        Map and body.
    position_m, quat : ndarray, shape (3,) and (4,)
    covariance : ndarray, shape (6, 6)
        Of position and of a rotation vector; not a number where nobody states it.
    velocity, rate : ndarray, shape (3,)
    """
    unknown = np.zeros(36)
    unknown[0] = _UNKNOWN
    stated = covariance.reshape(-1) if np.isfinite(covariance).all() else unknown
    pose = _new("geometry_msgs/msg/PoseWithCovariance", pose=_pose(position_m, quat), covariance=stated)
    twist = _new("geometry_msgs/msg/Twist", linear=_vector(velocity), angular=_vector(rate))
    twists = _new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown)
    return _bytes(
        _new(
            "nav_msgs/msg/Odometry",
            header=_header(time_ns, frames_of[0]),
            child_frame_id=frames_of[1],
            pose=pose,
            twist=twists,
        )
    )


def rotation_covariance(covariance: Array, heading_rad: Array, pitch_rad: Array) -> Array:
    """Covariances of poses, shape (n, 6, 6), of east, north, up, roll, pitch, heading as such of a turn about east, north, up."""
    turn = np.zeros_like(covariance)
    turn[:, :3, :3] = np.eye(3)
    turn[:, 3:, 3:] = np.linalg.inv(mat_attitude_turn(heading_rad, pitch_rad))
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def path(time_ns: npt.NDArray[np.int64], frame: str, position_m: Array, quat: Array) -> bytes:
    """A Path of poses, shape (n, ...)."""
    poses = [
        _new("geometry_msgs/msg/PoseStamped", header=_header(stamp, frame), pose=_pose(place, turn))
        for stamp, place, turn in zip(time_ns.tolist(), position_m, quat, strict=True)
    ]
    return _bytes(_new("nav_msgs/msg/Path", header=_header(int(time_ns[0]), frame), poses=poses))
