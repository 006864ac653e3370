"""Tables of an autopilot's own log: each kind of message as MAVLink would have filled it."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US
from flightlog.dataflash import Dataflash
from groundproc.flight.autopilot import HALF_MS_NS, increasing
from groundproc.flight.positions.scales import EPOCH_NS, WEEK_NS, utc_from_gps_calendar

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]
Table = npt.NDArray[np.void]
ATTITUDES: Final = ("ATT", "XKF1", "NKF1", "EKF1", "AHR2")
FILTERS: Final = ("XKF1", "NKF1", "EKF1")
"""Solutions of the Kalman filters, the one of newer firmware first."""
IMUS: Final = ("IMU", "IMU2", "IMU3")
RAW_GYROS: Final = ("GYR", "GYR1")
RAW_ACCELEROMETERS: Final = ("ACC", "ACC1")
MOST_HZ: Final = 400.0
"""Faster inertial samples are averaged down to about this rate: nothing that flies moves faster, and an hour must fit in memory."""
FIX_3D: Final = 3
LEAST_ROWS: Final = 2
_ACCURACY_NS: Final = 300 * NS_PER_MS
"""GPA belongs to the GPS message this close to it."""


def converted(log: Dataflash) -> Iterator[tuple[str, str, Times, dict[str, Array]]]:
    """Name of the MAVLink table, where it comes from, boot times, columns."""
    for made in (_imu(log), _attitude(log), _positions(log), *_gps(log), _pressure(log)):
        if made is not None:
            yield made


def stamps_ns(log: Dataflash, name: str) -> Times | None:
    """Time since boot of all messages of a name [ns], shape (n,); None where they have none.

    TimeUS, or TimeMS before 2015, which in GPS was the time of the GPS week: there the time since boot is called T.
    """
    table = log.tables[name]
    names = table.dtype.names or ()
    if "TimeUS" in names:
        return np.asarray(table["TimeUS"].astype(np.int64) * NS_PER_US)
    field = "T" if name.startswith("GPS") else "TimeMS"
    if field in names:
        return np.asarray(table[field].astype(np.int64) * NS_PER_MS + HALF_MS_NS)
    return None


def _rows(
    log: Dataflash, name: str, fields: Sequence[str], instance: int | None = None
) -> tuple[Times, dict[str, Array]] | None:
    """Boot times and fields in SI units of one sensor of a kind; None where they are not in the log."""
    if not log.has(name, *fields):
        return None
    stamp_ns = stamps_ns(log, name)
    if stamp_ns is None:
        return None
    names = log.tables[name].dtype.names or ()
    number = next((label for label in ("I", "C") if label in names), None)
    mine = np.ones(len(stamp_ns), np.bool_)
    if number is not None:
        numbers = log.tables[name][number]
        mine = numbers == (numbers.min() if instance is None else instance)
    if mine.sum() < LEAST_ROWS:
        return None
    return stamp_ns[mine], {label: log.si(name, label)[mine] for label in fields}


def packed(columns: dict[str, Array]) -> Table:
    """Columns as a table, with the receive time that each table has: none."""
    count = len(next(iter(columns.values())))
    table = np.zeros(count, np.dtype([("host_ns", "<i8"), *((name, "<f8") for name in columns)]))
    for name, column in columns.items():
        table[name] = column
    return table


def _imu(log: Dataflash) -> tuple[str, str, Times, dict[str, Array]] | None:
    """The first IMU that is alive, or the raw samples where there are more of them."""
    found = next((made for name in IMUS if (made := _filtered_imu(log, name)) is not None), None)
    raw = _raw_imu(log)
    if raw is not None and (found is None or len(raw[1]) > 1.5 * len(found[1])):
        found = raw
    if found is None:
        return None
    name, stamp_ns, columns = found
    return "HIGHRES_IMU", name, *_averaged(stamp_ns, columns)


def _filtered_imu(log: Dataflash, name: str) -> tuple[str, Times, dict[str, Array]] | None:
    labels = {"xgyro": "GyrX", "ygyro": "GyrY", "zgyro": "GyrZ", "xacc": "AccX", "yacc": "AccY", "zacc": "AccZ"}
    if not log.has(name, *labels.values()):
        return None
    names = log.tables[name].dtype.names or ()
    for instance in np.unique(log.tables[name]["I"]).tolist() if "I" in names else [None]:
        made = _rows(log, name, list(labels.values()), instance)
        if made is not None and _varies(made[1]["GyrX"]):
            return name, made[0], {key: made[1][label] for key, label in labels.items()}
    return None


def _varies(values: Array) -> bool:
    """Whether a sensor is alive."""
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and bool(np.ptp(finite) > 0.0)


def _raw_imu(log: Dataflash) -> tuple[str, Times, dict[str, Array]] | None:
    """Samples of the chip itself, each with its own time; the accelerometer's at the times of the gyro's."""
    for gyro, accelerometer in zip(RAW_GYROS, RAW_ACCELEROMETERS, strict=True):
        turning = _rows(log, gyro, ["SampleUS", "GyrX", "GyrY", "GyrZ"])
        pushing = _rows(log, accelerometer, ["SampleUS", "AccX", "AccY", "AccZ"])
        if turning is None or pushing is None:
            continue
        (gyro_ns, gyro_columns), (accel_ns, accel_columns) = (_by_sample(*each) for each in (turning, pushing))
        columns = {f"{axis}gyro": gyro_columns[f"Gyr{axis.upper()}"] for axis in "xyz"}
        columns |= {f"{axis}acc": np.interp(gyro_ns, accel_ns, accel_columns[f"Acc{axis.upper()}"]) for axis in "xyz"}
        return f"{gyro}, {accelerometer}", gyro_ns, columns
    return None


def _by_sample(stamp_ns: Times, columns: dict[str, Array]) -> tuple[Times, dict[str, Array]]:
    """By the times at which samples were taken, where these are of the same clock; in order."""
    sample_ns = np.rint(columns["SampleUS"] * NS_PER_S).astype(np.int64)
    if np.median(np.abs(sample_ns - stamp_ns)) < NS_PER_S:
        stamp_ns = sample_ns
    keep = increasing(stamp_ns)
    return stamp_ns[keep], {name: column[keep] for name, column in columns.items()}


def _averaged(stamp_ns: Times, columns: dict[str, Array]) -> tuple[Times, dict[str, Array]]:
    """Means of as many samples as make `MOST_HZ` of their rate, at the mean of their times."""
    every = int(NS_PER_S / MOST_HZ / max(float(np.median(np.diff(stamp_ns))), 1.0) + 0.5) if len(stamp_ns) > 1 else 1
    if every < 2 or len(stamp_ns) < every:
        return stamp_ns, columns
    whole = len(stamp_ns) // every * every
    start = stamp_ns[:whole:every]
    middle = start + (stamp_ns[:whole].reshape(-1, every) - start[:, None]).mean(axis=1).astype(np.int64)
    return middle, {name: column[:whole].reshape(-1, every).mean(axis=1) for name, column in columns.items()}


def _attitude(log: Dataflash) -> tuple[str, str, Times, dict[str, Array]] | None:
    """The attitudes that came most often, the autopilot's own ATT among nearly equals."""
    best: tuple[str, Times, dict[str, Array]] | None = None
    for name in ATTITUDES:
        made = _rows(log, name, ["Roll", "Pitch", "Yaw"])
        if made is not None and (best is None or len(made[0]) > 1.5 * len(best[1])):
            best = name, *made
    if best is None:
        return None
    name, stamp_ns, angles = best
    return "ATTITUDE", name, stamp_ns, {"roll": angles["Roll"], "pitch": angles["Pitch"], "yaw": angles["Yaw"]}


def add_rates(found: dict[str, tuple[str, Times, dict[str, Array]]]) -> None:
    """Body rates at the attitudes, which ATT does not have: the gyro's, or what the attitudes themselves turn by."""
    source, stamp_ns, columns = found["ATTITUDE"]
    imu = found.get("HIGHRES_IMU")
    if imu is not None and len(imu[1]) > 0.5 * len(stamp_ns):
        rates = np.stack([np.interp(stamp_ns, imu[1], imu[2][f"{axis}gyro"]) for axis in "xyz"], axis=1)
    elif len(stamp_ns) < 3:
        rates = np.zeros((len(stamp_ns), 3))
    else:
        quat = frames.quat_from_mat(frames.mat_local_ins(columns["yaw"], columns["pitch"], columns["roll"]))
        turned = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-2]), quat[2:]))
        between = turned / ((stamp_ns[2:] - stamp_ns[:-2]) / NS_PER_S)[:, None]
        rates = frames.ins_from_frd(np.concatenate([between[:1], between, between[-1:]]))  # its own inverse
    named = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), rates.T, strict=True))
    found["ATTITUDE"] = source, stamp_ns, columns | named


def _positions(log: Dataflash) -> tuple[str, str, Times, dict[str, Array]] | None:
    """POS with the velocities of the Kalman filter, or the receiver's."""
    relative = next((label for label in ("RelHomeAlt", "RelAlt") if log.has("POS", label)), None)
    made = _rows(log, "POS", ["Lat", "Lng", "Alt", *([relative] if relative else [])])
    if made is None:
        return None
    stamp_ns, place = made
    columns = {"lat": place["Lat"] * 1e7, "lon": place["Lng"] * 1e7, "alt": place["Alt"] * 1e3}
    if relative is not None:
        columns["relative_alt"] = place[relative] * 1e3
    source, velocity = _velocity(log, stamp_ns)
    columns |= {name: velocity[:, i] * 100.0 for i, name in enumerate(("vx", "vy", "vz"))}
    known = np.hypot(place["Lat"], place["Lng"]) > 0.0
    return "GLOBAL_POSITION_INT", source, stamp_ns[known], {name: column[known] for name, column in columns.items()}


def _velocity(log: Dataflash, time_ns: Times) -> tuple[str, Array]:
    """North, east, down at some times [m/s], shape (n, 3), and where from; zeros where nothing tells."""
    for name in FILTERS:
        made = _rows(log, name, ["VN", "VE", "VD"])
        if made is not None:
            stamp_ns, values = made
            keep = increasing(stamp_ns) & np.isfinite(values["VN"] + values["VE"] + values["VD"])
            if keep.sum() >= LEAST_ROWS:
                ned = [np.interp(time_ns, stamp_ns[keep], values[label][keep]) for label in ("VN", "VE", "VD")]
                return f"POS, {name}", np.stack(ned, axis=1)
    return "POS", np.zeros((len(time_ns), 3))


def _gps(log: Dataflash) -> Iterator[tuple[str, str, Times, dict[str, Array]]]:
    """The receiver's fixes, and what they say of UTC."""
    instance = _used_receiver(log)
    week, milliseconds = ("GWk", "GMS") if log.has("GPS", "GWk") else ("Week", "TimeMS")
    fields = ["Status", "Lat", "Lng", "Alt", "Spd", "GCrs", "NSats", "HDop", week, milliseconds]
    made = _rows(log, "GPS", fields, instance)
    if made is None:
        return
    stamp_ns, of = made
    columns = {
        "fix_type": of["Status"], "lat": of["Lat"] * 1e7, "lon": of["Lng"] * 1e7, "alt": of["Alt"] * 1e3,
        "eph": of["HDop"] * 100.0, "vel": of["Spd"] * 100.0, "cog": np.rad2deg(of["GCrs"]) % 360.0 * 100.0,
        "satellites_visible": of["NSats"],
    }  # fmt: skip
    yield "GPS_RAW_INT", "GPS", stamp_ns, columns | _accuracy(log, stamp_ns, of["Alt"], instance)
    told = (of["Status"] >= FIX_3D) & (of[week] > 0)
    if told.any():
        calendar_ns = EPOCH_NS + of[week][told].astype(np.int64) * WEEK_NS
        calendar_ns += np.rint(of[milliseconds][told] * NS_PER_S).astype(np.int64)
        unix_us = utc_from_gps_calendar(calendar_ns) / NS_PER_US
        yield "SYSTEM_TIME", "GPS", stamp_ns[told], {"time_unix_usec": unix_us}


def _used_receiver(log: Dataflash) -> int | None:
    """The receiver that the autopilot used for most of the time."""
    if not log.has("GPS", "I"):
        return None
    table = log.tables["GPS"]
    used = table["I"][table["U"] == 1] if "U" in (table.dtype.names or ()) else table["I"]
    numbers, counts = np.unique(used if len(used) else table["I"], return_counts=True)
    return int(numbers[np.argmax(counts)])


def _accuracy(log: Dataflash, time_ns: Times, alt_m: Array, instance: int | None) -> dict[str, Array]:
    """What the receiver states of its own error, from GPA: 0 where it does not, as in MAVLink; 65535 for the vertical dilution."""
    unknown = np.zeros(len(time_ns))
    columns = {"epv": unknown + 65535.0, "h_acc": unknown, "v_acc": unknown, "alt_ellipsoid": unknown}
    made = _rows(log, "GPA", ["VDop", "HAcc", "VAcc"], instance)
    if made is None:
        return columns
    stamp_ns, of = made
    row = np.clip(np.searchsorted(stamp_ns, time_ns), 0, len(stamp_ns) - 1)
    before = np.maximum(row - 1, 0)
    row = np.where(np.abs(stamp_ns[before] - time_ns) < np.abs(stamp_ns[row] - time_ns), before, row)
    near = np.abs(stamp_ns[row] - time_ns) <= _ACCURACY_NS
    columns["epv"] = np.where(near & (of["VDop"][row] > 0), of["VDop"][row] * 100.0, 65535.0)
    columns["h_acc"] = np.where(near, of["HAcc"][row] * 1e3, 0.0)
    columns["v_acc"] = np.where(near, of["VAcc"][row] * 1e3, 0.0)
    geoid = _rows(log, "GPA", ["Und"], instance)
    if geoid is not None and np.any(geoid[1]["Und"]):
        columns["alt_ellipsoid"] = np.where(near, (alt_m + geoid[1]["Und"][row]) * 1e3, 0.0)
    # what is no number is not known; the fix itself may be good
    return {name: np.nan_to_num(column, nan=65535.0 if name == "epv" else 0.0) for name, column in columns.items()}


def _pressure(log: Dataflash) -> tuple[str, str, Times, dict[str, Array]] | None:
    made = _rows(log, "BARO", ["Press"])
    return None if made is None else ("SCALED_PRESSURE", "BARO", made[0], {"press_abs": made[1]["Press"] * 0.01})
