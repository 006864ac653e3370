"""SBET: Applanix' smoothed best estimate of trajectory, 17 doubles a record, and its accuracy file (smrmsg), 10 doubles a record.

Format: Applanix POSPac MMS user guide, "SBET" and "smrmsg". Times are seconds of the GPS week; which week, the file does not say.
Angles are radians of a forward, right, down body in a north, east, down frame that is turned by the wander angle.
"""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError, UsageError
from groundproc.flight.positions.ellipsoid import ecef_from_geodetic, mat_ecef_enu
from groundproc.flight.positions.scales import (
    EPOCH_NS,
    WEEK_NS,
    WEEK_S,
    calendar_of_week,
    first_of_each,
    gps_calendar_from_utc,
    stray,
    utc_from_gps_calendar,
)
from groundproc.flight.positions.solution import ELLIPSOID, INS, Quality, Solution, diagonal_covariance, tidied

Array = npt.NDArray[np.float64]

_NAMES: Final = (
    "time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity", "roll", "pitch", "platform_heading",
    "wander_angle", "x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate",
)  # fmt: skip
_ACCURACY: Final = (
    "time", "north", "east", "down", "north_velocity", "east_velocity", "down_velocity", "roll", "pitch", "heading",
)  # fmt: skip
RECORD: Final = np.dtype([(name, "<f8") for name in _NAMES])
ACCURACY_RECORD: Final = np.dtype([(name, "<f8") for name in _ACCURACY])
MINUTE_RAD: Final = np.pi / 180 / 60
_LARGEST: Final = {
    "time": 1e11, "latitude": np.pi / 2, "longitude": 2 * np.pi, "altitude": 1e5, "x_velocity": 1e4, "y_velocity": 1e4,
    "z_velocity": 1e4, "roll": 7.0, "pitch": 7.0, "platform_heading": 7.0, "wander_angle": 7.0,
}  # fmt: skip
"""Magnitudes that values cannot exceed; angles are written within a turn."""
_DEGREES: Final = {"latitude": 90.0, "roll": 180.0, "pitch": 90.0}
_SPEEDS: Final = ("altitude", "x_velocity", "y_velocity", "z_velocity")
_LARGEST_SIGMA: Final = 1e5
"""Metres, metres a second or minutes of arc: what is larger, or no number, is not stated."""
_MOST: Final = 0.9
"""This part of the first records must be sound for a file to be taken for an SBET."""
_LONGEST_STEP_S: Final = 60.0
_PROBED: Final = 400
DEGREES_SENTENCE: Final = "is in degrees, expected radians, as every SBET has them; export it in radians"
_VELOCITY_MISFIT: Final = 0.1
"""Velocities may contradict the positions by this part of the speed, plus 0.1 m/s."""


def looks_like_sbet(head: bytes, size: int) -> bool:
    """Whether bytes begin as an SBET: whole records, times that rise by less than a minute, a place and an attitude that can be."""
    records = _whole(head, RECORD, size)
    if records is None:
        return False
    return _rising(records["time"]) and float(_sound(records).mean()) > _MOST


def in_degrees(head: bytes, size: int) -> str:
    """What of an SBET that begins so is in degrees, in words; empty where nothing is, or where it is none.

    Latitudes beyond a quarter of a turn and headings beyond a whole one are no radians. Near the equator and Greenwich degrees may pass for
    radians, but the way between places is then 57 times what the velocities say.
    """
    records = _whole(head, RECORD, size)
    if records is None or not _rising(records["time"]):
        return ""
    angles = {name: np.abs(records[name]) for name in ("latitude", "longitude", "roll", "pitch", "platform_heading")}
    with np.errstate(invalid="ignore"):
        possible = np.all([angle <= _DEGREES.get(name, 360.0) for name, angle in angles.items()], axis=0)
        possible &= np.all([np.abs(records[name]) <= _LARGEST[name] for name in _SPEEDS], axis=0)
        if float(possible.mean()) <= _MOST:
            return ""
        found = []
        if float(np.median(angles["latitude"])) > np.pi / 2 or _too_fast(records[possible]):
            found.append("latitude and longitude")
        if float(np.quantile(angles["platform_heading"], 0.9)) > _LARGEST["platform_heading"]:
            found.append("attitude")
    return " and ".join(found)


def _too_fast(records: npt.NDArray[np.void]) -> bool:
    """Whether places, taken as radians, lie as much too far apart as degrees would."""
    if len(records) < 2 or float(np.abs(records["latitude"]).max()) > np.pi / 2:
        return False
    found, mean = _speeds(records, np.stack([records[name] for name in _SPEEDS[1:]], axis=-1))
    ratio = float(
        np.nanmedian(np.linalg.norm(found, axis=1)) / max(float(np.nanmedian(np.linalg.norm(mean, axis=1))), 0.5)
    )
    return bool(np.rad2deg(1.0) / 1.5 < ratio < np.rad2deg(1.0) * 1.5)


def looks_like_accuracy(head: bytes, size: int) -> bool:
    """Whether bytes begin as an accuracy file of an SBET."""
    records = _whole(head, ACCURACY_RECORD, size)
    if records is None or not _rising(records["time"]):
        return False
    with np.errstate(invalid="ignore"):
        possible = ((records[name] >= 0) & (records[name] < 1e5) | np.isnan(records[name]) for name in _ACCURACY[1:])
        return bool(all(good.all() for good in possible)) and bool(np.isfinite(records["north"]).any())


def _whole(head: bytes, record: np.dtype[np.void], size: int) -> npt.NDArray[np.void] | None:
    count = len(head) // record.itemsize
    if size == 0 or size % record.itemsize or count == 0:
        return None
    return np.frombuffer(head, record, count)


def _rising(time_s: Array) -> bool:
    """Whether most steps are forward and short: a week's end or a damaged record is no reason to doubt."""
    with np.errstate(invalid="ignore", over="ignore"):
        step = np.diff(time_s)
        return len(step) == 0 or float(np.mean((step > 0) & (step < _LONGEST_STEP_S))) > _MOST


def read_sbet(
    path: Path,
    *,
    near_utc_ns: int | None = None,
    week: int | None = None,
    accuracy: Path | None = None,
    utc_seconds: bool = False,
    interval_s: float = 0.0,
) -> Solution:
    """Read an SBET.

    Velocities are taken with the wander angle undone, the one way round or the other, or as north and east, whichever fits the
    positions; where none does they are left out. Accelerations and rates are not read.

    Parameters
    ----------
    path : Path
    near_utc_ns : int, optional
        A time of the flight [ns], such as a log's; the week is the one that brings the file nearest to it.
    week : int, optional
        GPS week of the first record, without rollover. One of the two is needed.
    accuracy : Path, optional
        Its accuracy file. Default: smrmsg_NAME beside sbet_NAME, if it is there; without it no sigma is stated.
    utc_seconds : bool
        The seconds are of the UTC week, not of the GPS week.
    interval_s : float
        Take one record of each such interval [s]: an hour at 200 Hz needs 1 GB of memory whole, 0.1 GB at 10 Hz.

    Raises
    ------
    LogError
        It cannot be read or is none, or the accuracy file is of another time.
    UsageError
        Neither `week` nor `near_utc_ns` is given.
    """
    whole = _read(path, RECORD, "an SBET (17 doubles a record)")
    if interval_s > 0:
        whole = whole[first_of_each(whole["time"], interval_s)]
    if degrees := in_degrees(whole[:_PROBED].tobytes(), len(whole[:_PROBED]) * RECORD.itemsize):
        raise LogError(f"{path}: its {degrees} {DEGREES_SENTENCE}")
    records = whole[_sound(whole)]
    if not len(records):
        raise LogError(f"{path}: none of its {len(whole)} records holds a place, a velocity and an attitude")
    records, calendar_ns = _of_weeks(records, path, near_utc_ns, week)
    time_ns = calendar_ns if utc_seconds else utc_from_gps_calendar(calendar_ns)
    speed, sign, note = _velocity(records)
    heading = records["platform_heading"] - sign * records["wander_angle"]
    quat = frames.quat_from_mat(frames.mat_local_ins(heading, records["pitch"], records["roll"]))
    accuracy = accuracy or _there(accuracy_beside(path))
    position, velocity, attitude = _covariances(calendar_ns, accuracy, path)
    return tidied(
        Solution(
            source=path.name,
            format="SBET",
            point=INS,
            height_reference=ELLIPSOID,
            sigma_source=f"accuracy file {accuracy.name}" if accuracy else "nobody",
            time_ns=time_ns,
            latitude_deg=np.rad2deg(records["latitude"]),
            longitude_deg=np.rad2deg(records["longitude"]),
            height_m=records["altitude"].astype(np.float64),
            covariance_m2=position,
            quality=np.full(len(records), Quality.INERTIAL, np.uint8),
            velocity_m_s=speed,
            velocity_covariance_m2_s2=None if speed is None else velocity,
            quat_place_ins_wxyz=quat,
            attitude_covariance_rad2=attitude,
            left_out={"damaged": len(whole) - len(records)} if len(records) < len(whole) else {},
            notes=(note,) if note else (),
        ),
        str(path),
    )


def _sound(records: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Which records hold values that can be, shape (n,)."""
    with np.errstate(invalid="ignore"):
        found = np.ones(len(records), bool)
        for name, limit in _LARGEST.items():
            found &= np.abs(records[name]) <= limit
    return found


def _read(path: Path, record: np.dtype[np.void], what: str) -> npt.NDArray[np.void]:
    try:
        size = path.stat().st_size
        if size == 0 or size % record.itemsize:
            raise LogError(f"{path}: {size} bytes found, expected {what}, a multiple of {record.itemsize}")
        records = np.memmap(path, record, mode="r")
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    return records


def _of_weeks(
    records: npt.NDArray[np.void], path: Path, near_utc_ns: int | None, week: int | None
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]:
    """Records whose times are seconds of the week, and those times written as a calendar [ns], shape (n,)."""
    time_s = records["time"]
    can_be = (time_s >= 0) & (time_s < 2 * WEEK_S)
    if can_be.mean() <= _MOST:
        raise LogError(
            f"{path}: times of {time_s.min():.1f} to {time_s.max():.1f} s found, expected seconds of the GPS week, 0 to {WEEK_S}"
        )
    if week is None and near_utc_ns is None:
        raise UsageError(f"{path}: an SBET does not say its GPS week; give the week, or a log of the same flight")
    records = records[can_be]
    if week is not None:  # it goes first: it is that of the file, and a log may be of another flight
        return records, calendar_of_week(records["time"], week=week)
    assert near_utc_ns is not None
    calendar_ns = calendar_of_week(records["time"], week=0)
    near_ns = int(gps_calendar_from_utc(np.array([near_utc_ns]))[0])
    return records, calendar_ns + round((near_ns - int(np.median(calendar_ns))) / WEEK_NS) * WEEK_NS


def accuracy_beside(path: Path) -> Path | None:
    """The usual name of the accuracy file of an SBET; None where that does not have the usual name itself."""
    return path.with_name("smrmsg" + path.name[4:]) if path.name.lower().startswith("sbet") else None


def _there(path: Path | None) -> Path | None:
    return path if path is not None and path.is_file() else None


def _covariances(calendar_ns: npt.NDArray[np.int64], accuracy: Path | None, path: Path) -> tuple[Array, Array, Array]:
    """Of position, velocity (east, north, up) and attitude (roll, pitch, heading), shape (n, 3, 3), at times (n,)."""
    if accuracy is None:
        unknown = np.full((len(calendar_ns), 3, 3), np.nan)
        return unknown, unknown, unknown
    records = _read(accuracy, ACCURACY_RECORD, "an SBET's accuracy file (10 doubles a record)")
    kept, middle_ns = ~stray(calendar_ns), int(np.median(calendar_ns))
    records, stated_ns = _rising_records(records, accuracy, middle_ns)
    start, end = int(stated_ns[0]), int(stated_ns[-1])
    first, last = int(calendar_ns[kept].min()), int(calendar_ns[kept].max())
    if not (start - NS_PER_S <= first and last <= end + NS_PER_S):
        raise LogError(
            f"{accuracy}: covers {_of_week(start)} to {_of_week(end)} s of the week, but {path.name} has {_of_week(first)} to "
            f"{_of_week(last)}"
        )
    time_s, stated_s = (calendar_ns - start) * 1e-9, (stated_ns - start) * 1e-9

    def at(*names: str) -> Array:
        columns = (np.where(np.abs(records[name]) <= _LARGEST_SIGMA, records[name], np.nan) for name in names)
        return np.stack([np.interp(time_s, stated_s, column) for column in columns], axis=-1)

    angle = at("roll", "pitch", "heading") * MINUTE_RAD
    return (
        diagonal_covariance(at("east", "north", "down")),
        diagonal_covariance(at("east_velocity", "north_velocity", "down_velocity")),
        diagonal_covariance(angle),
    )


def _rising_records(
    records: npt.NDArray[np.void], place: Path, near_ns: int
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]:
    """Records of an accuracy file whose times increase over the week's end, and those times; single wild ones are passed over."""
    time_s = records["time"]
    with np.errstate(invalid="ignore"):
        records = records[(time_s >= 0) & (time_s < 2 * WEEK_S)]
    stated_ns = calendar_of_week(records["time"], near_ns=near_ns)
    near = ~stray(stated_ns)
    rises = near.copy()
    rises[1:] &= stated_ns[1:] > np.maximum.accumulate(np.where(near, stated_ns, 0))[:-1]
    if rises.sum() <= _MOST * len(time_s):
        raise LogError(f"{place}: its times do not increase; is it an SBET's accuracy file?")
    return records[rises], stated_ns[rises]


def _of_week(calendar_ns: int) -> str:
    return f"{(calendar_ns - EPOCH_NS) % WEEK_NS * 1e-9:.1f}"


def _velocity(records: npt.NDArray[np.void]) -> tuple[Array | None, float, str]:
    """Velocities east, north, up, shape (n, 3), that agree with the positions; the sign of the wander angle; what was decided, in words.

    True heading is platform heading less the wander angle. Whether a file counts the angle the other way round, its velocities tell.
    """
    x, y, up = records["x_velocity"], records["y_velocity"], -records["z_velocity"]
    for sign, note in ((1.0, ""), (-1.0, "its wander angle counts the other way round"), (0.0, "")):
        angle = sign * records["wander_angle"]
        velocity = np.stack([y * np.cos(angle) - x * np.sin(angle), x * np.cos(angle) + y * np.sin(angle), up], axis=-1)
        if not _agrees(records, velocity):
            continue
        if sign == 0.0:  # the velocities say nothing of the heading
            return velocity, 1.0, "velocities are north and east already; the wander angle was not applied to them"
        return velocity, sign, note
    return None, 1.0, "velocities contradict the positions and were left out"


def _agrees(records: npt.NDArray[np.void], velocity: Array) -> bool:
    """Whether velocities, integrated, give the way between positions."""
    if len(records) < 2:
        return True
    found, mean = _speeds(records, velocity)
    misfit = np.linalg.norm(found - mean, axis=1)
    return bool(np.nanmedian(misfit) <= 0.1 + _VELOCITY_MISFIT * np.nanmedian(np.linalg.norm(mean, axis=1)))


def _speeds(records: npt.NDArray[np.void], velocity: Array) -> tuple[Array, Array]:
    """Velocities east, north, up by the way from record to record, and means of those stated, shape (n - 1, 3)."""
    latitude, longitude = np.rad2deg(records["latitude"]), np.rad2deg(records["longitude"])
    place = ecef_from_geodetic(latitude, longitude, records["altitude"])
    way = np.einsum("nji,nj->ni", mat_ecef_enu(latitude[:-1], longitude[:-1]), np.diff(place, axis=0))
    step_s = np.diff(records["time"])
    found = way / np.where(step_s > 0, step_s, np.nan)[:, None]
    return found, 0.5 * (velocity[1:] + velocity[:-1])
