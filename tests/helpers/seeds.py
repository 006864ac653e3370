"""Small files of every kind that a command reads, to be mutated."""

import io
import json
import random
import struct
import zipfile
from pathlib import Path

import laspy
import numpy as np
from lidar_stream import packet
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import hdl32e, records
from flightlog.logwriter import LogWriter
from flightlog.nmea import checksum
from flightlog.records import HostClock, LidarAccount

START_NS = 1_714_557_600_000_000_000
"""2024-05-01T10:00:00Z."""
STEP_NS = 552_960
HOSTILE = b"\x1b[31mred\x07\x1b]0;title\x07\r\nswath: all is well\n\xe2\x80\xaefdp.\xe2\x80\x8b\x9b2J\x00\xff"
"""Escapes, a bell, a forged line, a change of direction, an invisible character, C1, a zero, wrong UTF-8."""
WRONG_FLOATS = (float("nan"), float("inf"), float("-inf"), 1e300, -1e300, 1e30, 0.0, 1e-300)


def sentence(body: str) -> str:
    return f"${body}*{checksum(body):02X}\r\n"


def position_packet(number: int, text: bytes) -> bytes:
    raw = bytearray(hdl32e.POSITION_BYTES)
    struct.pack_into("<12H", raw, 14, *[tag << 12 for tag in range(4)] * 3)
    struct.pack_into("<I", raw, 198, number * 5000)
    raw[206 : 206 + len(text[:72])] = text[:72]
    return bytes(raw)


def messages(dice: random.Random | None = None) -> list[tuple[int, bytes]]:
    """MAVLink of one second at 10 Hz; with dice, with values that may be anything."""
    link, found = dialect.MAVLink(None, srcSystem=1, srcComponent=1), []

    def value(good: float, most: float) -> float:
        return dice.choice([*WRONG_FLOATS[:3], 1e30, -1e30, most]) if dice and dice.random() < 0.2 else good

    def whole(good: int, low: int, high: int) -> int:
        return dice.choice((low, high)) if dice and dice.random() < 0.2 else good

    for i in range(20):
        time_ns, ms = START_NS + i * 50_000_000, whole(60_000 + 50 * i, 0, 2**32 - 1)
        angles = [np.float32(value(0.01 * j, 3e38)) for j in range(6)]
        kinds = [
            dialect.MAVLink_attitude_message(ms, *angles),
            dialect.MAVLink_global_position_int_message(
                ms, whole(583_940_000, -(2**31), 2**31 - 1), whole(155_740_000, -(2**31), 2**31 - 1),
                whole(80_000, -(2**31), 2**31 - 1), whole(10_000, -(2**31), 2**31 - 1), 100, 0, 0, 9000,
            ),
            dialect.MAVLink_gps_raw_int_message(
                whole(60_000_000 + 50_000 * i, 0, 2**64 - 1), whole(3, 0, 255), whole(583_940_000, -(2**31), 2**31 - 1), 155_740_000,
                whole(80_000, -(2**31), 2**31 - 1), 100, 100, 100, 9000, 12, alt_ellipsoid=110_000, h_acc=whole(900, 0, 2**32 - 1),
            ),
            dialect.MAVLink_highres_imu_message(
                60_000_000 + 50_000 * i, *[np.float32(value(0.1, 3e38)) for _ in range(13)], 0x3F
            ),
            dialect.MAVLink_scaled_pressure_message(ms, np.float32(value(1000.0, 3e38)), 0.0, 2500),
        ]  # fmt: skip
        if i % 10 == 0:
            usec = whole((START_NS + i * 50_000_000) // 1000, 0, 2**64 - 1)
            kinds += [
                dialect.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3),
                dialect.MAVLink_system_time_message(usec, ms),
                dialect.MAVLink_statustext_message(6, HOSTILE[:50] if dice else b"EKF3 IMU0 is using GPS"),
                dialect.MAVLink_param_value_message(
                    HOSTILE[:16] if dice else b"SR2_POSITION", value(1.0, 3e38), 9, 1, 0
                ),
            ]
        for message in kinds:
            found.append((time_ns, bytes(message.pack(link))))
            link.seq = (link.seq + 1) % 256
    return found


def log(dice: random.Random | None = None, compression: str = "zstd") -> bytes:
    """A flight log of a second; with dice, hostile words in it, values that may be anything, and messages with bytes changed."""
    stream, words = io.BytesIO(), HOSTILE.decode("utf-8", errors="replace") if dice else "swathd"
    session = {"version": words, "boot_id": words, "software": words, "origin": words, "log_minus_monotonic_ns": "0"}
    writer = LogWriter(
        stream, metadata={"swath.session": session}, attachments={"mount.yaml": b"lidar: {}\n", words[:40]: b"x"},
        compression=compression, library=words,
    )  # fmt: skip

    def write(topic: str, time_ns: int, data: bytes) -> None:
        raw = bytearray(data)
        if dice and dice.random() < 0.1:
            raw = bytearray(mutated(bytes(raw), dice))
        writer.write(topic, time_ns, bytes(raw))

    for i in range(10):
        time_ns = START_NS + i * 100_000_000
        if dice and dice.random() < 0.1:
            time_ns = dice.choice((0, 1, (2**31 - 1) * 10**9))
        scan = np.zeros(10, records.SCAN_PACKET_DTYPE)
        raw = b"".join(packet(k + 181 * i) for k in range(10))
        scan["data"] = np.frombuffer(raw, hdl32e.DATA_DTYPE)
        records.set_receive_time_ns(scan, time_ns + STEP_NS * np.arange(10))
        write(records.LIDAR.topic, time_ns, records.encode_scan(time_ns, scan))
        write(records.LIDAR_ACCOUNT.topic, time_ns, records.encode_account(time_ns, LidarAccount(10, 10)))
        text = HOSTILE if dice else sentence("GPRMC,100000.00,A,5823.64,N,01534.44,E,0.1,84.4,010524,,,A").encode()
        chunk = (time_ns, position_packet(20 * i, text))
        write(records.POSITION.topic, time_ns, records.encode_raw(time_ns, [chunk], "velodyne"))
        write(records.HOST_CLOCK.topic, time_ns, records.encode_host_clock(HostClock(time_ns, time_ns, 0, 0)))
    beats = messages(dice)
    for k in range(0, len(beats), 10):
        piece = beats[k : k + 10]
        write("/mavlink/ins", piece[-1][0], records.encode_raw(piece[-1][0], piece, "ins"))
    writer.finish()
    return stream.getvalue()


def ethernet(payload: bytes, port: int) -> bytes:
    udp = struct.pack(">HHHH", 443, port, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 1, 0, 64, 17, 0, bytes((192, 168, 1, 201)), b"\xff" * 4)
    return b"\xff" * 6 + b"\x60\x76\x88\x00\x00\x01" + b"\x08\x00" + ip + udp


def frames(packets: int = 12) -> list[tuple[int, bytes]]:
    found = [(START_NS + k * STEP_NS, ethernet(packet(k), 2368)) for k in range(packets)]
    found += [(START_NS + k * 5_000_000, ethernet(position_packet(k, HOSTILE), 8308)) for k in range(2)]
    found += [(time_ns, ethernet(data, 14550)) for time_ns, data in messages()[:40]]
    return sorted(found)


def pcap(packets: int = 12) -> bytes:
    out = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for time_ns, data in frames(packets):
        out += struct.pack("<IIII", time_ns // 10**9, time_ns % 10**9 // 1000, len(data), len(data)) + data
    return out


def pcapng() -> bytes:
    def block(kind: int, body: bytes) -> bytes:
        return struct.pack("<II", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    out = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + block(1, struct.pack("<HHI", 1, 0, 0))
    for time_ns, data in frames():
        ticks = time_ns // 1000
        head = struct.pack("<5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data))
        out += block(6, head + data + bytes(-len(data) % 4))
    return out


def tlog(dice: random.Random | None = None) -> bytes:
    return b"".join((time_ns // 1000).to_bytes(8, "big") + data for time_ns, data in messages(dice))


def dataflash() -> bytes:
    def declared(number: int, name: bytes, letters: bytes, size: int, labels: bytes) -> bytes:
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, name, letters, labels)

    out = declared(128, b"FMT", b"BBnNZ", 89, b"Type,Length,Name,Format,Columns")
    out += declared(1, b"ATT", b"QccC", 17, b"TimeUS,Roll,Pitch,Yaw")
    out += declared(2, b"GPS", b"QBIHLLe", 30, b"TimeUS,Status,GMS,GWk,Lat,Lng,Alt")
    out += declared(3, b"MSG", b"QZ", 75, b"TimeUS,Message")
    for i in range(20):
        out += b"\xa3\x95\x01" + struct.pack("<QhhH", 1000 + 100_000 * i, -12, 56, 35999)
        out += b"\xa3\x95\x02" + struct.pack(
            "<QBIHiii", 1100 + 100_000 * i, 3, 252_408_000, 2312, 583_940_000, 155_740_000, 8000
        )
    return out + b"\xa3\x95\x03" + struct.pack("<Q64s", 1, HOSTILE[:64])


def trajectory(seconds: int = 20) -> bytes:
    head = "utc_ns,latitude_deg,longitude_deg,height_m,east_m,north_m,up_m,roll_deg,pitch_deg,heading_deg"
    rows = [
        f"{START_NS + k * 200_000_000},{58.394 + 1e-6 * k:.9f},15.574,80.0,0,{0.1 * k:.3f},0,1.0,-2.0,3.0"
        for k in range(5 * seconds)
    ]
    return "\n".join([head, *rows, ""]).encode()


def pos() -> bytes:
    head = "%  GPST latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio\n"
    rows = [
        f"2024/05/01 10:00:{18 + k:02d}.000 {58.394 + 1e-6 * k:.9f} 15.574 80.0 1 9 0.01 0.01 0.02 0 0 0 0.0 3.0\n"
        for k in range(20)
    ]
    return (head + "".join(rows)).encode()


def nmea() -> bytes:
    out = ""
    for k in range(20):
        out += sentence(f"GPGGA,1000{k:02d}.00,5823.640,N,01534.440,E,4,12,0.8,80.0,M,30.0,M,1.0,0001")
        out += sentence(f"GPRMC,1000{k:02d}.00,A,5823.640,N,01534.440,E,0.1,84.4,010524,,,A")
        out += sentence(f"GPGST,1000{k:02d}.00,1,0.02,0.01,10,0.02,0.02,0.03")
    return out.encode()


def sbet() -> bytes:
    record = np.zeros((400, 17))
    record[:, 0] = 295_218.0 + 0.05 * np.arange(400)
    record[:, 1], record[:, 2], record[:, 3] = np.deg2rad(58.394), np.deg2rad(15.574), 80.0
    return record.astype("<f8").tobytes()


def imu() -> bytes:
    head = "time_ns,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
    return (head + "".join(f"{START_NS + k * 10_000_000},0.01,0,0.02,0.1,0,9.8\n" for k in range(1500))).encode()


def scans_csv() -> bytes:
    rows = "".join(
        f"{START_NS + k * 100_000_000},{angle},{10 + k},80\n" for k in range(100) for angle in (-30, -15, 0, 15, 30)
    )
    return ("time_ns,angle_deg,range_m,intensity\n" + rows).encode()


def scans_npz() -> bytes:
    out = io.BytesIO()
    np.savez(
        out, time_ns=START_NS + np.arange(100) * 100_000_000, angle_deg=np.arange(-30.0, 31.0, 15.0),
        range_m=np.full((100, 5), 10.0), intensity=np.full((100, 5), 80.0),
    )  # fmt: skip
    return out.getvalue()


def npz_bomb(shape: str = "(1000000000000, 5)") -> bytes:
    """Arrays that say they are large, in a small archive."""
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    entry = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(80)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in ("time_ns", "angle_deg", "range_m", "intensity"):
            archive.writestr(f"{name}.npy", entry)
    return out.getvalue()


def control() -> bytes:
    return b"name,x,y,z,sigma,use\n" + b"".join(
        b"p%d,%d,6470000,80,0.01,control\n" % (k, 533_600 + k) for k in range(5)
    )


def cloud(suffix: str, point_format: int) -> bytes:
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.01), np.array([533_600.0, 6_470_000.0, 0.0])
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_extra_dims([laspy.ExtraBytesParams("range", np.float32, "range [m]")])
    made = laspy.LasData(header)
    made.points = laspy.ScaleAwarePointRecord.zeros(300, header=header)
    rng = np.random.default_rng(1)
    for name in "XYZ":
        made.points.array[name] = rng.integers(0, 2000, 300)
    made.points.array["gps_time"] = START_NS * 1e-9 + 18 - 315_964_800 - 1e9 + np.arange(300) * 0.05
    out = io.BytesIO()
    made.write(out, do_compress=suffix == "laz")
    return out.getvalue()


def manifest() -> bytes:
    line = {
        "file": "00001-000.mcap",
        "size": 5,
        "sha256": "ab" * 32,
        "messages": {"/x": 1},
        "boot_id": "x",
        "how": "closed",
    }
    return (json.dumps(line) + "\n").encode() * 3


OPTIONS = b"boresight: auto\nposition_sigma_m: 0.15\nknots_s: 0.5\n"
MOUNT = b"lidar:\n  position_m: [0.1, 0.0, -0.2]\n  pitch_deg: -90.0\n"


def mutated(data: bytes, dice: random.Random) -> bytes:
    """Some bytes of a file changed, left out, repeated or cut off; numbers and words in it replaced by worse ones."""
    raw = bytearray(data or b"\x00")
    for _ in range(dice.choice((1, 1, 1, 2, 4, 8))):
        _mutate(raw, dice)
        raw = raw or bytearray(b"\x00")
    return bytes(raw)


def _mutate(raw: bytearray, dice: random.Random) -> None:
    at = dice.randrange(min(len(raw), 400)) if dice.random() < 0.4 else dice.randrange(len(raw))
    kind = dice.randrange(10)
    if kind == 0:
        raw[at] = dice.randrange(256)
    elif kind == 1:
        raw[at] ^= 1 << dice.randrange(8)
    elif kind == 2:
        width = dice.choice((2, 4, 8))
        value = dice.choice(
            (0, 1, 2 ** (8 * width) - 1, 2 ** (8 * width - 1), 2 ** (8 * width - 1) - 1, dice.randrange(1 << 20))
        )
        raw[at : at + width] = (value % 2 ** (8 * width)).to_bytes(width, "little")
    elif kind == 3:
        raw[at : at + 8] = struct.pack("<d", dice.choice(WRONG_FLOATS))
    elif kind == 4:
        raw[at : at + 4] = struct.pack("<f", dice.choice((np.nan, np.inf, -np.inf, 3e38)))
    elif kind == 5:
        del raw[at : at + dice.choice((1, 2, 8, 100))]
    elif kind == 6:
        raw[at:at] = dice.choice((HOSTILE, dice.randbytes(8), b"\n", b"," * 5, raw[max(0, at - 50) : at] * 3))
    elif kind == 7 and dice.random() < 0.3:
        del raw[at:]
    elif kind == 8:
        _replace_number(raw, at, dice)
    else:
        raw[at : at + 1] = dice.choice((b"\x00", b"\xff", b"-", b"9", b"e", b";", b"\x1b"))


def _replace_number(raw: bytearray, at: int, dice: random.Random) -> None:
    """Put another number into the place of the next one in a text."""
    end = at
    while at < len(raw) and chr(raw[at]) not in "0123456789":
        at += 1
    end = at
    while end < len(raw) and chr(raw[end]) in "0123456789.-":
        end += 1
    words = (
        b"nan",
        b"inf",
        b"-inf",
        b"1e300",
        b"-1e308",
        b"9" * 30,
        b"-1",
        b"0",
        b"1e999",
        "١".encode(),
        b"0x10",
        b"1_0",
        b"",
    )
    raw[at:end] = dice.choice(words)


def write(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path
