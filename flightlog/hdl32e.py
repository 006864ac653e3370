"""The Velodyne HDL-32E on the wire: its two UDP packets as numpy dtypes, its elevations, its timing.

Sources: HDL-32E user's manual 63-9113 Rev A (2011, "M-A") and Rev E (2012, "M-E"); what recordings show is marked [measured].
All fields are little endian. The sensor frame has x right (the cable's side), y forward (azimuth 0) and z up along the spin axis;
azimuth grows clockwise seen from above (M-A appendix C).
"""

from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import HDL32E_DATA_PORT, HDL32E_POSITION_PORT
from flightlog.errors import PacketError, WrongSensorError

DATA_PORT: Final = HDL32E_DATA_PORT
POSITION_PORT: Final = HDL32E_POSITION_PORT
DATA_BYTES: Final = 1206
POSITION_BYTES: Final = 512

BLOCKS: Final = 12
LASERS: Final = 32
BLOCK_FLAG: Final = 0xEEFF
LOWER_BLOCK_FLAG: Final = 0xDDFF
"""Flag of the blocks of the lower 32 lasers of an HDL-64E, which has no product byte (63-HDL64ES3 Rev K, appendix E)."""
HDL_64E: Final = "HDL-64E"
PRODUCT_ID: Final = 0x21
"""Byte 1205 of a data packet. Necessary, not sufficient: a VLP-16 prototype sent it too [measured]."""
OTHER_PRODUCTS: Final = {
    0x22: "VLP-16",
    0x23: "VLP-32A/B",
    0x24: "Puck Hi-Res",
    0x28: "VLP-32C",
    0x31: "Velarray",
    0xA1: "VLS-128",
}

RANGE_LSB_M: Final = 0.002
"""Range step [m] (M-A p. 11). Range 0 is no return, whatever the intensity says [measured]."""
AZIMUTH_STEPS: Final = 36_000
"""Azimuth steps of 0.01 deg in a turn. The sensor does send 36000 itself [measured]: take it modulo this."""
LASER_NS: Final = 1_152
"""From one laser to the next within a firing [ns] (M-A p. 9)."""
FIRING_NS: Final = 46_080
"""From one firing of all 32 lasers to the next [ns]: 32 lasers and 8 idle slots (M-A p. 9)."""
PACKET_NS: Final = BLOCKS * FIRING_NS
"""From one data packet to the next in single return mode [ns]; half of it in dual return mode."""
STAMP_WRAP_US: Final = 3_600_000_000
"""The stamp counts microseconds past the hour; it has been seen to run on for a while before it resets."""

ELEVATION_DEG: Final[npt.NDArray[np.float64]] = np.array(
    [
        [-30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33],
        [-25.33, -4.00, -24.00, -2.67, -22.67, -1.33, -21.33, 0.00],
        [-20.00, 1.33, -18.67, 2.67, -17.33, 4.00, -16.00, 5.33],
        [-14.67, 6.67, -13.33, 8.00, -12.00, 9.33, -10.67, 10.67],
    ]
).ravel()
"""Elevation of each laser in firing order [deg], shape (32,) (M-A p. 10; -6.67 and -26.67 as the other lasers' spacing demands)."""
ELEVATION_DEG.setflags(write=False)

RING: Final[npt.NDArray[np.uint8]] = np.argsort(np.argsort(ELEVATION_DEG)).astype(np.uint8)
"""Rank of each laser from the lowest (0) to the highest (31), shape (32,)."""
RING.setflags(write=False)

GYRO_LSB_DEG_S: Final = 0.09766
ACCEL_LSB_G: Final = 0.001221
TEMPERATURE_LSB_C: Final = 0.1453
TEMPERATURE_ZERO_C: Final = 25.0

RETURN_DTYPE: Final = np.dtype([("range", "<u2"), ("intensity", "u1")])
BLOCK_DTYPE: Final = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", RETURN_DTYPE, (LASERS,))])
DATA_DTYPE: Final = np.dtype(
    [("blocks", BLOCK_DTYPE, (BLOCKS,)), ("stamp_us", "<u4"), ("return_mode", "u1"), ("product", "u1")]
)
"""A data packet, 1206 bytes (M-A appendix E).

The stamp is that of the first firing: M-A says both first (p. 9) and last (appendix E); the arrival times of data against position
packets say first [measured].
"""

POSITION_DTYPE: Final = np.dtype(
    {
        "names": ["zeros", "words", "stamp_us", "pps", "nmea"],
        "formats": ["V14", ("<u2", (12,)), "<u4", "u1", "S306"],
        "offsets": [0, 14, 198, 202, 206],
        "itemsize": POSITION_BYTES,
    }
)
"""A position packet, 512 bytes (M-E appendix E). words: gyro, temperature, accel X, accel Y of each of three chips."""

SENSOR_FROM_GYROS: Final[npt.NDArray[np.int8]] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=np.int8)
"""Turns the readings (gyro1, gyro2, gyro3) into the sensor frame (x right, y forward, z up); shape (3, 3) (M-A fig. B2).

Another driver has the opposite sign on z, and no recording at hand turns, so the ground solves signs from data where it can.
"""
SENSOR_FROM_GYROS.setflags(write=False)


class ReturnMode(IntEnum):
    """Byte 1204 of a data packet. Old firmware may leave it 0: a single return, which one is not said."""

    UNKNOWN = 0x00
    STRONGEST = 0x37
    LAST = 0x38
    DUAL = 0x39


class PpsState(IntEnum):
    """Byte 202 of a position packet. Firmware of 2012 leaves it 0 even when locked [measured]: absent proves nothing."""

    ABSENT = 0
    SYNCHRONISING = 1
    LOCKED = 2
    ERROR = 3


def firing_index(return_mode: int) -> npt.NDArray[np.int64]:
    """Which firing of the packet each block belongs to, shape (12,); two blocks share a firing in dual return mode."""
    blocks = np.arange(BLOCKS, dtype=np.int64)
    return blocks // 2 if return_mode == ReturnMode.DUAL else blocks


def packet_ns(return_mode: int) -> int:
    """From one data packet to the next [ns]."""
    return PACKET_NS // 2 if return_mode == ReturnMode.DUAL else PACKET_NS


def is_data(packets: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Which packets of DATA_DTYPE are an HDL-32E's: all block flags right, known return mode and product; shape (n,)."""
    flags = (packets["blocks"]["flag"] == BLOCK_FLAG).all(axis=1)
    mode = packets["return_mode"]
    known = (mode == ReturnMode.STRONGEST) | (mode == ReturnMode.LAST) | (mode == ReturnMode.DUAL)
    product = packets["product"]
    blank = (mode == 0) & (product == 0)
    return np.asarray(flags & ((known & (product == PRODUCT_ID)) | blank))


def is_hdl64e(packets: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Which packets of DATA_DTYPE are an HDL-64E's: blocks of upper and lower lasers, and no other; shape (n,)."""
    flags = packets["blocks"]["flag"]
    lower = flags == LOWER_BLOCK_FLAG
    return np.asarray((lower | (flags == BLOCK_FLAG)).all(axis=1) & lower.any(axis=1) & ~lower.all(axis=1))


def check_data(payload: bytes, place: str) -> None:
    """Refuse what is not a data packet of an HDL-32E.

    Parameters
    ----------
    payload : bytes
        UDP payload.
    place : str
        Where it came from, for the message.

    Raises
    ------
    WrongSensorError
        A Velodyne data packet of another model, named.
    PacketError
        Anything else.
    """
    if len(payload) != DATA_BYTES:
        raise PacketError(f"{place}: a data packet has {DATA_BYTES} bytes, this one {len(payload)}")
    packet = np.frombuffer(payload, DATA_DTYPE)
    if is_hdl64e(packet)[0]:
        raise WrongSensorError(f"{place}: blocks that start with FF DD are an {HDL_64E}'s; an HDL-32E is needed")
    if not (packet["blocks"]["flag"] == BLOCK_FLAG).all():
        raise PacketError(f"{place}: 1206 bytes, but not every block starts with FF EE")
    product = int(packet["product"][0])
    if product != PRODUCT_ID and (product or int(packet["return_mode"][0])):
        name = OTHER_PRODUCTS.get(product, "an unknown sensor")
        raise WrongSensorError(f"{place}: product id 0x{product:02x} is {name}; an HDL-32E (0x21) is needed")
    if not is_data(packet)[0]:
        mode = int(packet["return_mode"][0])
        raise PacketError(f"{place}: return mode 0x{mode:02x}; 0x37, 0x38 or 0x39 are known")


def is_position(packets: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Which packets of POSITION_DTYPE are a Velodyne's: leading zeros, and channel tags 0 1 2 3 or an idle IMU; shape (n,)."""
    head = np.frombuffer(packets["zeros"].tobytes(), np.uint8).reshape(len(packets), 14)
    tags = packets["words"] >> 12
    tagged = (tags == np.tile(np.arange(4), 3)).all(axis=1)
    return np.asarray(~head.any(axis=1) & (tagged | ~packets["words"].any(axis=1)))


def has_imu(packets: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Which packets of POSITION_DTYPE carry gyro words at all (a VLP-16 sends zeros); shape (n,)."""
    return np.asarray((packets["words"] >> 12 == np.tile(np.arange(4), 3)).all(axis=1))


def _signed(words: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    """The low 12 bits as two's complement."""
    return (((words.astype(np.int32) & 0xFFF) ^ 0x800) - 0x800).astype(np.float64)


def gyro_deg_s(packets: npt.NDArray[np.void]) -> npt.NDArray[np.float64]:
    """Angular rate in the sensor frame [deg/s], shape (n, 3). Zero offsets of tens of deg/s are normal [measured]."""
    return _signed(packets["words"][:, [0, 4, 8]]) * GYRO_LSB_DEG_S @ SENSOR_FROM_GYROS.T


def accel_g(packets: npt.NDArray[np.void]) -> npt.NDArray[np.float64]:
    """Specific force in the sensor frame [g], shape (n, 3): at rest and upright (0, 0, +1).

    Each axis has two accelerometers (M-A fig. B2); their mean is taken. Readings are gravity on the labelled axes, that is minus
    the specific force [measured on z]; the horizontal signs follow from the same rule and are not verified.
    """
    x1, y1, x2, y2, x3, y3 = _signed(packets["words"][:, [2, 3, 6, 7, 10, 11]]).T * ACCEL_LSB_G
    return np.stack([(x3 - y1) / 2.0, -(y2 + y3) / 2.0, (x1 + x2) / 2.0], axis=1)


def temperature_c(packets: npt.NDArray[np.void]) -> npt.NDArray[np.float64]:
    """Temperature of the three gyro chips [deg C], shape (n, 3)."""
    return _signed(packets["words"][:, [1, 5, 9]]) * TEMPERATURE_LSB_C + TEMPERATURE_ZERO_C
