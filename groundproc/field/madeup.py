"""A made-up flight of some seconds in a bare room: not a measurement of anything, but a log that every stage takes for a flight.

The simulator belongs to those who develop; this is for `swath warmup`, wherever `swath` is installed.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pymavlink.dialects.v20 import ardupilotmega

from flightlog import frames, records
from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US, STANDARD_GRAVITY_M_S2
from flightlog.hdl32e import (
    ACCEL_LSB_G,
    AZIMUTH_STEPS,
    BLOCK_FLAG,
    BLOCKS,
    DATA_DTYPE,
    ELEVATION_DEG,
    FIRING_NS,
    GYRO_LSB_DEG_S,
    LASERS,
    POSITION_DTYPE,
    PRODUCT_ID,
    RANGE_LSB_M,
    SENSOR_FROM_GYROS,
    STAMP_WRAP_US,
    ReturnMode,
    packet_ns,
)
from flightlog.logwriter import LogWriter
from flightlog.mount import Mount

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

ROOM_M: Final = np.array([[-14.0, -12.0, 0.0], [15.0, 13.0, 9.0]])
"""Two opposite corners; the local frame is east, north, up."""
LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 58.4, 15.6, 60.0
_METRES_PER_DEG: Final = 111_200.0
START_NS: Final = 1_700_000_000 * NS_PER_S
CHUNK_NS: Final = 100_000_000
_TURN_NS: Final = 100_000_000
_SAMPLE_NS: Final = 5_000_000
_LATE_NS: Final = 2_000_000
_BOOT_NS: Final = 77 * NS_PER_S
"""The autopilot was started so long before the log begins."""


def write_flight(path: Path, seconds: float, mode: ReturnMode = ReturnMode.STRONGEST) -> None:
    """Write a flight log of an HDL-32E that slowly moves through the room, with the messages of an autopilot.

    Parameters
    ----------
    path : Path
    seconds : float
    mode : ReturnMode
        Of the lidar; with DUAL the second return is the first once more.
    """
    mount = Mount()
    autopilot = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    with path.open("wb") as file:
        writer = LogWriter(file, metadata={}, attachments={"mount.yaml": mount.yaml().encode()})
        for chunk in range(round(seconds * NS_PER_S) // CHUNK_NS):
            begin_ns, end_ns = chunk * CHUNK_NS, (chunk + 1) * CHUNK_NS
            log_ns = START_NS + end_ns + _LATE_NS
            packets = _packets(begin_ns, end_ns, mount, mode)
            writer.write(records.LIDAR.topic, log_ns, records.encode_scan(log_ns, packets))
            position = _position_packets(np.arange(begin_ns, end_ns, _SAMPLE_NS), mount)
            writer.write(records.POSITION.topic, log_ns, records.encode_raw(log_ns, position, "velodyne"))
            messages = _messages(np.arange(begin_ns, end_ns, 4 * _SAMPLE_NS), autopilot)
            writer.write(records.MAVLINK.topic + "ins", log_ns, records.encode_raw(log_ns, messages, "ins"))
        writer.finish()


# The motion ----------------------------------------------------------------------------------------------------------


def _poses(time_ns: Times) -> tuple[Array, Array]:
    """Position of the ins frame and "local from ins", shape (n, 3) and (n, 3, 3)."""
    t = time_ns * 1e-9
    place = np.stack([2.0 * np.sin(0.5 * t), 0.6 * t - 3.0, 4.0 + 0.5 * np.sin(0.9 * t)], axis=-1)
    return place, frames.mat_local_ins(0.3 + 0.5 * np.sin(1.1 * t), 0.08 * np.sin(1.7 * t), 0.1 * np.sin(2.3 * t))


def _felt(time_ns: Times) -> tuple[Array, Array]:
    """Rates [rad/s] and specific force [m/s^2] in the ins frame, shape (n, 3) each."""
    step_ns, step_s = NS_PER_MS, 1e-3
    (before, _), (now, mat), (after, next_mat) = (_poses(time_ns + k * step_ns) for k in (-1, 0, 1))
    rate = frames.quat_log(frames.quat_from_mat(np.swapaxes(mat, 1, 2) @ next_mat)) / step_s
    force = (after - 2.0 * now + before) / step_s**2 + np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
    return rate, np.einsum("nji,nj->ni", mat, force)


# The lidar -----------------------------------------------------------------------------------------------------------


def _packets(begin_ns: int, end_ns: int, mount: Mount, mode: ReturnMode) -> npt.NDArray[np.void]:
    """Data packets whose first firing is in a time, of SCAN_PACKET_DTYPE."""
    each_ns = packet_ns(mode)
    numbers = np.arange(-(-begin_ns // each_ns), -(-end_ns // each_ns))
    firings = each_ns // FIRING_NS
    time_ns = (numbers[:, None] * each_ns + np.arange(firings) * FIRING_NS).ravel()
    turn = (time_ns % _TURN_NS) / _TURN_NS
    range_m = _ranges(time_ns, 2.0 * np.pi * turn, mount)
    data = np.zeros(len(numbers), DATA_DTYPE)
    again = BLOCKS // firings
    shape = (len(numbers), BLOCKS)
    data["blocks"]["flag"] = BLOCK_FLAG
    data["blocks"]["azimuth"] = np.repeat(np.rint(turn * AZIMUTH_STEPS) % AZIMUTH_STEPS, again).reshape(shape)
    steps = np.repeat(np.rint(range_m / RANGE_LSB_M), again, axis=0).reshape(*shape, LASERS)
    data["blocks"]["returns"]["range"] = steps
    data["blocks"]["returns"]["intensity"] = 20 + (steps / 50.0).astype(np.int64) % 60
    data["stamp_us"] = numbers * each_ns // NS_PER_US % STAMP_WRAP_US
    data["return_mode"], data["product"] = mode, PRODUCT_ID
    packets = np.zeros(len(numbers), records.SCAN_PACKET_DTYPE)
    packets["data"] = data
    records.set_receive_time_ns(packets, START_NS + numbers * each_ns + _LATE_NS)
    return packets


def _ranges(time_ns: Times, azimuth_rad: Array, mount: Mount) -> Array:
    """Distances to the walls of the room [m], shape (firings, LASERS), with 1 cm of noise."""
    place, mat = _poses(time_ns)
    start = place + mat @ mount.lidar_position_m()
    elevation = np.deg2rad(ELEVATION_DEG)
    along = np.stack(
        [
            np.sin(azimuth_rad)[:, None] * np.cos(elevation),
            np.cos(azimuth_rad)[:, None] * np.cos(elevation),
            np.broadcast_to(np.sin(elevation), (len(azimuth_rad), LASERS)),
        ],
        axis=-1,
    ) @ np.swapaxes(mat @ mount.mat_ins_lidar(), 1, 2)
    with np.errstate(divide="ignore"):
        to_walls = (np.where(along > 0.0, ROOM_M[1], ROOM_M[0]) - start[:, None]) / along
    noise = np.random.default_rng(int(time_ns[0])).normal(0.0, 0.01, to_walls.shape[:2])
    return np.asarray(to_walls.min(axis=-1) + noise)


def _position_packets(time_ns: Times, mount: Mount) -> list[tuple[int, bytes]]:
    """Packets of the lidar's own inertial unit, with their receive times."""
    rate, force = _felt(time_ns)
    mat = mount.mat_ins_lidar()
    x, y, z = (force @ mat).T / STANDARD_GRAVITY_M_S2
    words = np.empty((len(time_ns), 12))
    words[:, [0, 4, 8]] = np.rad2deg(rate @ mat) @ SENSOR_FROM_GYROS.astype(np.float64) / GYRO_LSB_DEG_S
    words[:, [1, 5, 9]] = 0.0
    words[:, [2, 3, 6, 7, 10, 11]] = np.stack([z, -x, z, -y, x, -y], axis=1) / ACCEL_LSB_G
    rng = np.random.default_rng(int(time_ns[0]) + 1)
    packets = np.zeros(len(time_ns), POSITION_DTYPE)
    signed = np.rint(words + rng.normal(0.0, 0.5, words.shape)).astype(np.int64)
    packets["words"] = np.tile(np.arange(4), 3) << 12 | signed & 0xFFF
    packets["stamp_us"] = time_ns // NS_PER_US % STAMP_WRAP_US
    return [(int(t) + START_NS + _LATE_NS, packet.tobytes()) for t, packet in zip(time_ns, packets, strict=True)]


# The autopilot -------------------------------------------------------------------------------------------------------


def _messages(time_ns: Times, autopilot: Any) -> list[tuple[int, bytes]]:
    """MAVLink of an ArduPilot board with their receive times: attitude and RAW_IMU at 50 Hz, positions at 5, the rest at 1."""
    found: list[tuple[int, bytes]] = []
    place, mat = _poses(time_ns)
    after, _ = _poses(time_ns + NS_PER_MS)
    velocity = (after - place) / 1e-3
    rate, force = (frames.ins_from_frd(each) for each in _felt(time_ns))  # the way back is the same
    heading, pitch, roll = frames.attitude_of(mat)
    for i, now_ns in enumerate(time_ns.tolist()):
        boot_ms = (now_ns + _BOOT_NS) // NS_PER_MS
        yaw = (float(heading[i]) + np.pi) % (2.0 * np.pi) - np.pi
        several = [
            ardupilotmega.MAVLink_attitude_message(boot_ms, float(roll[i]), float(pitch[i]), yaw, *rate[i].tolist()),
            ardupilotmega.MAVLink_raw_imu_message(
                boot_ms * 1000,
                *np.rint(force[i] / STANDARD_GRAVITY_M_S2 * 1e3).astype(int).tolist(),
                *np.rint(rate[i] * 1e3).astype(int).tolist(),
                0, 0, 0,
            ),
        ]  # fmt: skip
        if now_ns % (NS_PER_S // 5) == 0:
            several.append(_position(boot_ms, place[i], velocity[i], float(heading[i])))
        if now_ns % NS_PER_S == 0:
            several += _each_second(boot_ms, now_ns, place[i])
        found += [(START_NS + now_ns + _LATE_NS, bytes(message.pack(autopilot))) for message in several]
    return found


def _geodetic(place_m: Array) -> tuple[int, int, int]:
    east, north, up = place_m.tolist()
    longitude_deg = LONGITUDE_DEG + east / (_METRES_PER_DEG * float(np.cos(np.deg2rad(LATITUDE_DEG))))
    return (
        round((LATITUDE_DEG + north / _METRES_PER_DEG) * 1e7),
        round(longitude_deg * 1e7),
        round((HEIGHT_M + up) * 1e3),
    )


def _position(boot_ms: int, place_m: Array, velocity_m_s: Array, heading_rad: float) -> Any:
    east, north, up = np.rint(velocity_m_s * 100.0).astype(int).tolist()
    heading = round(np.rad2deg(heading_rad) * 100.0) % 36000
    return ardupilotmega.MAVLink_global_position_int_message(
        boot_ms, *_geodetic(place_m), round(place_m[2] * 1e3), north, east, -up, heading
    )


def _each_second(boot_ms: int, now_ns: int, place_m: Array) -> list[Any]:
    utc_us = (START_NS + now_ns) // NS_PER_US
    return [
        ardupilotmega.MAVLink_heartbeat_message(2, 3, 209, 3, 4, 3),
        ardupilotmega.MAVLink_system_time_message(utc_us, boot_ms),
        ardupilotmega.MAVLink_gps_raw_int_message(boot_ms * 1000, 3, *_geodetic(place_m), 120, 65535, 0, 0, 11),
    ]
