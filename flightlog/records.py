"""The table of what a flight log holds: topic, type, meaning; and the bytes of each record, encode beside decode.

Every record is plain CDR (little endian, XCDR1) of a ROS 2 message type, so Foxglove, rosbags and ROS 2 can read a
log without conversion. Alignment counts from the byte after the 4-byte encapsulation header.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from operator import attrgetter
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.constants import FORMAT_VERSION as FORMAT_VERSION
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from flightlog.hdl32e import DATA_BYTES, DATA_DTYPE, POSITION_BYTES, POSITION_DTYPE

_CDR_LE: Final = b"\x00\x01\x00\x00"
_RULE: Final = "=" * 80

_TIME: Final = "int32 sec\nuint32 nanosec\n"
_HEADER: Final = "builtin_interfaces/Time stamp\nstring frame_id\n"
_HEADER_DEPENDENCIES: Final = {"std_msgs/Header": _HEADER, "builtin_interfaces/Time": _TIME}


def _definition(text: str, **others: str) -> str:
    """A message definition with those it depends on, as MCAP's ros2msg encoding wants them."""
    dependencies = {name.replace("__", "/"): body for name, body in others.items()} | _HEADER_DEPENDENCIES
    return text + "".join(f"{_RULE}\nMSG: {name}\n{body}" for name, body in dependencies.items())


@dataclass(frozen=True, slots=True)
class RecordType:
    """One row of the table.

    A topic that ends in a slash is a family: the name of the link (`ins`, `fc`) follows.
    """

    topic: str
    schema: str
    definition: str
    about: str


LIDAR: Final = RecordType(
    "/velodyne_packets",
    "velodyne_msgs/msg/VelodyneScan",
    _definition(
        "std_msgs/Header header\nVelodynePacket[] packets\n",
        velodyne_msgs__VelodynePacket="builtin_interfaces/Time stamp\nuint8[1206] data\n",
    ),
    "Lidar data packets as received, about 0.1 s in a message; each with its receive time. Blocks outside the field of view have "
    "range 0; packets wholly outside are left out and counted in /lidar_account.",
)
LIDAR_ACCOUNT: Final = RecordType(
    "/lidar_account",
    "swath_msgs/msg/LidarAccount",
    _definition(
        "std_msgs/Header header\n"
        "# since the message before, of the lidar port\n"
        "uint32 received\n"
        "uint32 kept\n"
        "# wholly outside the field of view, left out\n"
        "uint32 masked_packets\n"
        "# outside the field of view in a packet that straddles its edge, range set to 0\n"
        "uint32 masked_blocks\n"
        "uint32 rejected_length\n"
        "uint32 rejected_content\n"
        "# from others than the lidar; with what a filter in the kernel refused, whatever it was, which is in received too\n"
        "uint32 rejected_sender\n"
        "# lost in the socket's receive buffer, counted by the kernel\n"
        "uint32 kernel_drops\n"
        "# lost because the disk was too slow\n"
        "uint32 queue_drops\n"
        "# the window in force, clockwise from start to end through straight ahead [deg]; all 0: everything is kept\n"
        "float32 fov_start_deg\n"
        "float32 fov_end_deg\n"
    ),
    "What became of the packets of the /velodyne_packets message with the same log time.",
)
_RAW_BATCH: Final = _definition(
    "std_msgs/Header header\nRawChunk[] chunks\n",
    swath_msgs__RawChunk="# receive time\nbuiltin_interfaces/Time stamp\nuint8[] data\n",
)
POSITION: Final = RecordType(
    "/velodyne_position",
    "swath_msgs/msg/RawBatch",
    _RAW_BATCH,
    "Position packets of the lidar (gyros, accelerometers, GPS sentence), 512 bytes each, with receive times. Never masked.",
)
MAVLINK: Final = RecordType(
    "/mavlink/",
    "swath_msgs/msg/RawBatch",
    _RAW_BATCH,
    "Bytes of a MAVLink link exactly as received, one chunk per read or datagram, with receive times. A frame may straddle chunks.",
)
DATAFLASH: Final = RecordType(
    "/dataflash/",
    "swath_msgs/msg/RawBatch",
    _RAW_BATCH,
    "An autopilot's own dataflash log (.bin), byte for byte in order. The stamps say nothing but the order: a nanosecond from piece to "
    "piece, and more where another file begins.",
)
HOST_CLOCK: Final = RecordType(
    "/host_clock",
    "swath_msgs/msg/HostClock",
    _definition(
        "std_msgs/Header header\n"
        "# wall clock (UTC as the host believes), monotonic and boot clock at the same instant [ns]\n"
        "int64 realtime_ns\n"
        "int64 monotonic_ns\n"
        "int64 boottime_ns\n"
        "# the wall clock's step against the monotonic clock since the message before [ns]\n"
        "int64 step_ns\n"
    ),
    "Ties the log's time to the host's clocks. Log time is the wall clock at the start carried on by the monotonic clock: it never "
    "steps inside a log, and realtime_ns minus the header's stamp says how far the wall clock has moved.",
)

CLOCK_SYNC: Final = RecordType(
    "/clock_sync",
    "swath_msgs/msg/ClockSync",
    _definition(
        "std_msgs/Header header\n"
        "# frame_id is whose clock: ins, fc (boot time of the autopilot of that link) or lidar (time past some hour)\n"
        "# that clock minus log time at the header's stamp [ns]\n"
        "int64 offset_ns\n"
        "# how much faster than log time it runs [1e-6]; 0 until that is known\n"
        "float64 skew_ppm\n"
        "# half of the shortest round trip, or what the samples show; the delay of a one-way link is not in it [ns]\n"
        "int64 uncertainty_ns\n"
        "# UTC minus log time at the header's stamp, as utc_source has it; 0 without one [ns]\n"
        "int64 utc_offset_ns\n"
        "uint32 samples\n"
        "# how often the clock jumped: the device was started again, or the lidar found its pulse\n"
        "uint32 restarts\n"
        "# 1 TIMESYNC, 2 envelope of (clock - receive time)\n"
        "uint8 method\n"
        "# 0 none, 1 SYSTEM_TIME, 2 GPRMC with a fix, 3 GPRMC without a fix\n"
        "uint8 utc_source\n"
    ),
    "How a device's clock stood to log time, as known aboard at that moment: for health, and for a first look on the ground. "
    "The raw stamps, receive times and TIMESYNC messages are in the other topics, and can be fitted better afterwards.",
)

LINE_SCAN: Final = RecordType(
    "/line_scan",
    "sensor_msgs/msg/LaserScan",
    _definition(
        "std_msgs/Header header\n"
        "# from the scanner's x (right) towards its y (forward), negative clockwise seen from above [rad]\n"
        "float32 angle_min\n"
        "float32 angle_max\n"
        "float32 angle_increment\n"
        "# from shot to shot, and from line to line [s]\n"
        "float32 time_increment\n"
        "float32 scan_time\n"
        "float32 range_min\n"
        "float32 range_max\n"
        "# not a number or 0: no return [m]\n"
        "float32[] ranges\n"
        "float32[] intensities\n"
    ),
    "A line of a line scanner, one in a message; the stamp is UTC of its first shot, on the time base of the whole kit. "
    "Only in logs that were imported.",
)

TABLE: Final = (LIDAR, LIDAR_ACCOUNT, POSITION, MAVLINK, DATAFLASH, HOST_CLOCK, CLOCK_SYNC, LINE_SCAN)
"""All record types, in the order of the documentation."""


def record_type(topic: str) -> RecordType | None:
    """Find the row of the table for a topic, None for a topic that is not ours."""
    for row in TABLE:
        if topic == row.topic or (row.topic.endswith("/") and topic.startswith(row.topic)):
            return row
    return None


def _pad(size: int, alignment: int) -> bytes:
    return bytes(-size % alignment)


def _header(stamp_ns: int, frame_id: str) -> bytes:
    """Encapsulation and std_msgs/Header, padded to 4 bytes."""
    name = frame_id.encode() + b"\x00"
    stamp = struct.pack("<iII", *divmod(stamp_ns, NS_PER_S), len(name))
    return _CDR_LE + stamp + name + _pad(len(name), 4)


def _open_header(data: bytes | memoryview, what: str) -> tuple[int, str, int]:
    """Stamp [ns], frame id, and the offset of what follows, aligned to 4."""
    try:
        if bytes(data[:4]) != _CDR_LE:
            raise LogError(f"{what}: encapsulation {bytes(data[:4]).hex()}, expected little-endian CDR 00010000")
        sec, nanosec, size = struct.unpack_from("<iII", data, 4)
        if size < 1 or 16 + size > len(data):
            raise LogError(f"{what}: a frame id of {size} bytes in a record of {len(data)}")
        name = bytes(data[16 : 16 + size - 1]).decode(errors="replace")
    except struct.error:
        raise LogError(f"{what}: a record of {len(data)} bytes is too short for its header") from None
    end = 16 + size
    return sec * NS_PER_S + nanosec, name, end + -(end - 4) % 4


# Lidar data packets ---------------------------------------------------------------------------------------------------

SCAN_PACKET_DTYPE: Final = np.dtype(
    {
        "names": ["sec", "nanosec", "data"],
        "formats": ["<i4", "<u4", DATA_DTYPE],
        "offsets": [0, 4, 8],
        "itemsize": 1216,
    }
)
"""An element of VelodyneScan.packets with its 2 bytes of padding: a receiver may fill an array of these in place."""

_SCAN_PACKET_BYTES: Final = 8 + DATA_BYTES


def receive_time_ns(packets: npt.NDArray[np.void]) -> npt.NDArray[np.int64]:
    """Receive times of SCAN_PACKET_DTYPE [ns of log time], shape (n,)."""
    return np.asarray(packets["sec"].astype(np.int64) * NS_PER_S + packets["nanosec"])


def set_receive_time_ns(packets: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64]) -> None:
    """Write receive times [ns of log time], shape (n,), into SCAN_PACKET_DTYPE."""
    packets["sec"], packets["nanosec"] = np.divmod(time_ns, NS_PER_S)


def encode_scan(stamp_ns: int, packets: npt.NDArray[np.void], frame_id: str = "velodyne") -> bytes:
    """Encode packets of SCAN_PACKET_DTYPE, shape (n,), as a VelodyneScan."""
    head = _header(stamp_ns, frame_id) + struct.pack("<I", len(packets))
    if not len(packets):
        return head
    body = np.ascontiguousarray(packets).view(np.uint8).data
    # The last element carries no padding. One copy, and no more, leaves the array.
    return b"".join((head, body[: _SCAN_PACKET_BYTES - SCAN_PACKET_DTYPE.itemsize]))


def decode_scan(data: bytes | memoryview) -> npt.NDArray[np.void]:
    """Decode a VelodyneScan.

    Returns
    -------
    ndarray of SCAN_PACKET_DTYPE, shape (n,)
        A copy; may be changed.

    Raises
    ------
    LogError
        Bytes that are no VelodyneScan.
    """
    _, _, offset = _open_header(data, LIDAR.topic)
    count = _count(data, offset, LIDAR.topic)
    offset += 4
    expected = offset + max(0, count * SCAN_PACKET_DTYPE.itemsize - 2)
    if not count:
        return np.empty(0, SCAN_PACKET_DTYPE)
    if len(data) < expected:
        raise LogError(f"{LIDAR.topic}: {count} packets need {expected} bytes, the record has {len(data)}")
    out = np.empty(count, SCAN_PACKET_DTYPE)
    plain = out.view(np.uint8)
    plain[: expected - offset] = np.frombuffer(data, np.uint8, expected - offset, offset)
    plain[expected - offset :] = 0
    return out


def _count(data: bytes | memoryview, offset: int, what: str) -> int:
    if offset + 4 > len(data):
        raise LogError(f"{what}: a record of {len(data)} bytes ends before its sequence")
    return int(struct.unpack_from("<I", data, offset)[0])


# Raw bytes ------------------------------------------------------------------------------------------------------------


def encode_raw(stamp_ns: int, chunks: Sequence[tuple[int, bytes]], frame_id: str) -> bytes:
    """Encode chunks of (receive time [ns of log time], bytes) as a RawBatch."""
    parts = [_header(stamp_ns, frame_id), struct.pack("<I", len(chunks))]
    last = len(chunks) - 1
    for i, (time_ns, chunk) in enumerate(chunks):
        parts += (struct.pack("<iII", *divmod(time_ns, NS_PER_S), len(chunk)), chunk)
        if i != last:
            parts.append(_pad(len(chunk), 4))
    return b"".join(parts)


def decode_raw(data: bytes | memoryview) -> list[tuple[int, bytes]]:
    """Decode a RawBatch to chunks of (receive time [ns of log time], bytes).

    Raises
    ------
    LogError
        Bytes that are no RawBatch.
    """
    _, _, offset = _open_header(data, "RawBatch")
    count = _count(data, offset, "RawBatch")
    offset += 4
    chunks = []
    try:
        for _ in range(count):
            sec, nanosec, size = struct.unpack_from("<iII", data, offset)
            offset += 12
            if offset + size > len(data):
                raise LogError(f"RawBatch: a chunk of {size} bytes at {offset} in a record of {len(data)}")
            chunks.append((sec * NS_PER_S + nanosec, bytes(data[offset : offset + size])))
            offset += size + -size % 4
    except struct.error:
        raise LogError(f"RawBatch: {count} chunks announced, {len(chunks)} found") from None
    return chunks


def decode_position(data: bytes | memoryview) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Decode a RawBatch of position packets.

    Returns
    -------
    time_ns : ndarray of int64, shape (n,)
        Receive times [ns of log time].
    packets : ndarray of POSITION_DTYPE, shape (n,)
        Chunks of another length than 512 bytes are left out.
    """
    chunks = [chunk for chunk in decode_raw(data) if len(chunk[1]) == POSITION_BYTES]
    packets = np.frombuffer(b"".join(chunk for _, chunk in chunks), POSITION_DTYPE)
    return np.array([time_ns for time_ns, _ in chunks], np.int64), packets


# Lines of a line scanner ----------------------------------------------------------------------------------------------


def line_dtype(shots: int) -> np.dtype[np.void]:
    """A line of so many shots; angles in rad as in the definition of /line_scan, times in s, ranges in m."""
    values = ("<f4", (shots,))
    return np.dtype([
        ("time_ns", "<i8"), ("angle_min", "<f4"), ("angle_increment", "<f4"), ("time_increment", "<f4"),
        ("scan_time", "<f4"), ("ranges", *values), ("intensities", *values),
    ])  # fmt: skip


_LINE: Final = struct.Struct("<7f")


def encode_line(line: npt.NDArray[np.void]) -> bytes:
    """Encode one line, an array of `line_dtype` of shape ()."""
    ranges, intensities = line["ranges"], line["intensities"]
    first, step = float(line["angle_min"]), float(line["angle_increment"])
    seen = ranges[np.isfinite(ranges) & (ranges > 0.0)]
    near, far = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 0.0)
    last = first + (len(ranges) - 1) * step
    fixed = _LINE.pack(first, last, step, float(line["time_increment"]), float(line["scan_time"]), near, far)
    count = struct.pack("<I", len(ranges))
    head = _header(int(line["time_ns"]), "line_scanner")
    return b"".join((head, fixed, count, ranges.tobytes(), count, intensities.tobytes()))


def decode_line(data: bytes | memoryview) -> npt.NDArray[np.void]:
    """Decode a LaserScan to an array of `line_dtype` of shape (1,).

    Raises
    ------
    LogError
        Bytes that are no LaserScan, or one with other numbers of ranges and intensities.
    """
    time_ns, _, offset = _open_header(data, LINE_SCAN.topic)
    end = offset + _LINE.size
    if end > len(data):
        raise LogError(f"{LINE_SCAN.topic}: {len(data)} bytes, expected at least {end}")
    first, _, step, time_step, scan_time, _, _ = _LINE.unpack_from(data, offset)
    shots = _count(data, end, LINE_SCAN.topic)
    if len(data) < end + 8 + 8 * shots or _count(data, end + 4 + 4 * shots, LINE_SCAN.topic) != shots:
        raise LogError(f"{LINE_SCAN.topic}: {len(data)} bytes, expected {end + 8 + 8 * shots} for {shots} shots")
    line = np.zeros(1, line_dtype(shots))
    line["time_ns"], line["angle_min"], line["angle_increment"] = time_ns, first, step
    line["time_increment"], line["scan_time"] = time_step, scan_time
    line["ranges"] = np.frombuffer(data, "<f4", shots, end + 4)
    line["intensities"] = np.frombuffer(data, "<f4", shots, end + 8 + 4 * shots)
    return line


# Accounts and clocks --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LidarAccount:
    """What became of the packets of one batch; see the definition of /lidar_account."""

    received: int = 0
    kept: int = 0
    masked_packets: int = 0
    masked_blocks: int = 0
    rejected_length: int = 0
    rejected_content: int = 0
    rejected_sender: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    fov_start_deg: float = 0.0
    fov_end_deg: float = 0.0


_ACCOUNT: Final = struct.Struct("<9I2f")
_ACCOUNT_VALUES: Final = attrgetter(*(field.name for field in fields(LidarAccount)))
_HOST_CLOCK: Final = struct.Struct("<4q")


def encode_account(stamp_ns: int, account: LidarAccount) -> bytes:
    """Encode a LidarAccount."""
    return _header(stamp_ns, "velodyne") + _ACCOUNT.pack(*_ACCOUNT_VALUES(account))


def decode_account(data: bytes | memoryview) -> LidarAccount:
    """Decode a LidarAccount; raises LogError for other bytes."""
    _, _, offset = _open_header(data, LIDAR_ACCOUNT.topic)
    if offset + _ACCOUNT.size > len(data):
        raise LogError(f"{LIDAR_ACCOUNT.topic}: {len(data)} bytes, expected {offset + _ACCOUNT.size}")
    return LidarAccount(*_ACCOUNT.unpack_from(data, offset))


@dataclass(frozen=True, slots=True)
class HostClock:
    """The host's clocks at one instant of log time; see the definition of /host_clock."""

    log_ns: int
    realtime_ns: int
    monotonic_ns: int
    boottime_ns: int
    step_ns: int = 0


def encode_host_clock(clock: HostClock) -> bytes:
    """Encode a HostClock; its log time is the stamp."""
    head = _header(clock.log_ns, "host")
    head += _pad(len(head) - 4, 8)
    return head + _HOST_CLOCK.pack(clock.realtime_ns, clock.monotonic_ns, clock.boottime_ns, clock.step_ns)


def decode_host_clock(data: bytes | memoryview) -> HostClock:
    """Decode a HostClock; raises LogError for other bytes."""
    stamp_ns, _, offset = _open_header(data, HOST_CLOCK.topic)
    offset += -(offset - 4) % 8
    if offset + _HOST_CLOCK.size > len(data):
        raise LogError(f"{HOST_CLOCK.topic}: {len(data)} bytes, expected {offset + _HOST_CLOCK.size}")
    return HostClock(stamp_ns, *_HOST_CLOCK.unpack_from(data, offset))


class SyncMethod(IntEnum):
    """How a clock is tied to log time."""

    TIMESYNC = 1
    ENVELOPE = 2


class UtcSource(IntEnum):
    """Who says what UTC is."""

    NONE = 0
    SYSTEM_TIME = 1
    RMC_FIX = 2
    RMC_NO_FIX = 3


@dataclass(frozen=True, slots=True)
class ClockSync:
    """How a device's clock stands to log time; see the definition of /clock_sync."""

    log_ns: int
    clock: str
    offset_ns: int
    skew_ppm: float
    uncertainty_ns: int
    utc_offset_ns: int
    samples: int
    restarts: int
    method: SyncMethod
    utc_source: UtcSource = UtcSource.NONE


_CLOCK_SYNC: Final = struct.Struct("<qdqqIIBB")


def encode_clock_sync(sync: ClockSync) -> bytes:
    """Encode a ClockSync; its log time is the stamp."""
    head = _header(sync.log_ns, sync.clock)
    head += _pad(len(head) - 4, 8)
    values = [getattr(sync, field.name) for field in fields(sync)[2:]]
    return head + _CLOCK_SYNC.pack(*values)


def decode_clock_sync(data: bytes | memoryview) -> ClockSync:
    """Decode a ClockSync; raises LogError for other bytes."""
    stamp_ns, clock, offset = _open_header(data, CLOCK_SYNC.topic)
    offset += -(offset - 4) % 8
    if offset + _CLOCK_SYNC.size > len(data):
        raise LogError(f"{CLOCK_SYNC.topic}: {len(data)} bytes, expected {offset + _CLOCK_SYNC.size}")
    *values, method, source = _CLOCK_SYNC.unpack_from(data, offset)
    try:
        methods = SyncMethod(method), UtcSource(source)
    except ValueError as error:
        raise LogError(f"{CLOCK_SYNC.topic}: {error}") from None
    return ClockSync(stamp_ns, clock, values[0], values[1], values[2], values[3], values[4], values[5], *methods)
