"""SBET: Applanix' smoothed best estimate of trajectory, 17 doubles a record, and its accuracy file (smrmsg), 10 doubles a record.

Format: Applanix POSPac MMS user guide, "SBET" and "smrmsg". Times are seconds of the GPS week; which week, the file does not say.
Angles are radians of a forward, right, down body in a north, east, down frame that is turned by the wander angle.
"""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.clock import utc_to_gps_ns
from flightlog.errors import LogError, UsageError
from groundproc.flight.positions.ellipsoid import ecef_from_geodetic, mat_ecef_enu
from groundproc.flight.positions.scales import EPOCH_NS, WEEK_NS, first_of_each, utc_from_gps_calendar
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
_WEEK_S: Final = 604_800
_MINUTE_RAD: Final = np.pi / 180 / 60
_LARGEST: Final = {
    "time": 1e11, "latitude": np.pi / 2, "longitude": 2 * np.pi, "altitude": 1e5, "x_velocity": 1e4, "y_velocity": 1e4,
    "z_velocity": 1e4, "roll": 7.0, "pitch": 7.0, "platform_heading": 7.0, "wander_angle": 7.0,
}  # fmt: skip
"""Magnitudes that values cannot exceed; angles are written within a turn."""
_LARGEST_SIGMA: Final = 1e5
"""Metres, metres a second or minutes of arc: what is larger, or no number, is not stated."""
_MOST: Final = 0.9
"""This part of the first records must be sound for a file to be taken for an SBET."""
_LONGEST_STEP_S: Final = 60.0
_VELOCITY_MISFIT: Final = 0.1
"""Velocities may contradict the positions by this part of the speed, plus 0.1 m/s."""


def looks_like_sbet(head: bytes, size: int) -> bool:
    """Whether bytes begin as an SBET: whole records, times that rise by less than a minute, a place and an attitude that can be."""
    records = _whole(head, RECORD, size)
    if records is None:
        return False
    return _rising(records["time"]) and float(_sound(records).mean()) > _MOST


def looks_like_accuracy(head: bytes, size: int) -> bool:
    """Whether bytes begin as an accuracy file of an SBET."""
    records = _whole(head, ACCURACY_RECORD, size)
    if records is None or not _rising(records["time"]):
        return False
    with np.errstate(invalid="ignore"):
        return bool(all(((records[name] >= 0) & (records[name] < 1e5)).all() for name in _ACCURACY[1:]))


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
    records = whole[_sound(whole)]
    if not len(records):
        raise LogError(f"{path}: none of its {len(whole)} records holds a place, a velocity and an attitude")
    time_ns = _utc_ns(records["time"], path, near_utc_ns, week, utc_seconds)
    speed, sign, note = _velocity(records)
    heading = records["platform_heading"] - sign * records["wander_angle"]
    quat = frames.quat_from_mat(frames.mat_local_ins(heading, records["pitch"], records["roll"]))
    accuracy = accuracy or _beside(path)
    position, velocity, attitude = _covariances(records["time"], accuracy, path)
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


def _utc_ns(
    time_s: Array, path: Path, near_utc_ns: int | None, week: int | None, utc_seconds: bool
) -> npt.NDArray[np.int64]:
    """Unix times of seconds of the week; they run on over the week's end, or start again there."""
    if time_s.min() < 0 or time_s.max() >= 2 * _WEEK_S:
        raise LogError(
            f"{path}: times of {time_s.min():.1f} to {time_s.max():.1f} s found, expected seconds of the GPS week, 0 to {_WEEK_S}"
        )
    turned_over = np.concatenate([[0], np.cumsum(np.diff(time_s) < -_WEEK_S / 2)])
    of_week_ns = np.rint(time_s * 1e9).astype(np.int64) + turned_over * WEEK_NS
    if week is None:
        if near_utc_ns is None:
            raise UsageError(f"{path}: an SBET does not say its GPS week; give the week, or a log of the same flight")
        near_ns = utc_to_gps_ns(near_utc_ns)
        week = round((near_ns - int(of_week_ns[len(of_week_ns) // 2])) / WEEK_NS)
    calendar_ns = of_week_ns + week * WEEK_NS + EPOCH_NS
    return calendar_ns if utc_seconds else utc_from_gps_calendar(calendar_ns)


def _beside(path: Path) -> Path | None:
    """The accuracy file of the same run, where it has the usual name."""
    if not path.name.lower().startswith("sbet"):
        return None
    other = path.with_name("smrmsg" + path.name[4:])
    return other if other.is_file() else None


def _covariances(time_s: Array, accuracy: Path | None, path: Path) -> tuple[Array, Array, Array]:
    """Of position, velocity (east, north, up) and attitude (roll, pitch, heading), shape (n, 3, 3), at times (n,)."""
    if accuracy is None:
        unknown = np.full((len(time_s), 3, 3), np.nan)
        return unknown, unknown, unknown
    records = _read(accuracy, ACCURACY_RECORD, "an SBET's accuracy file (10 doubles a record)")
    if not (np.isfinite(records["time"]).all() and (np.diff(records["time"]) > 0).all()):
        raise LogError(f"{accuracy}: its times do not increase; is it an SBET's accuracy file?")
    start, end = float(records["time"][0]), float(records["time"][-1])
    if not (start - 1.0 <= time_s[0] and time_s[-1] <= end + 1.0):
        raise LogError(
            f"{accuracy}: covers {start:.1f} to {end:.1f} s of the week, but {path.name} has {time_s[0]:.1f} to {time_s[-1]:.1f}"
        )

    def at(*names: str) -> Array:
        columns = (np.where(np.abs(records[name]) <= _LARGEST_SIGMA, records[name], np.nan) for name in names)
        return np.stack([np.interp(time_s, records["time"], column) for column in columns], axis=-1)

    angle = at("roll", "pitch", "heading") * _MINUTE_RAD
    return (
        diagonal_covariance(at("east", "north", "down")),
        diagonal_covariance(at("east_velocity", "north_velocity", "down_velocity")),
        diagonal_covariance(angle),
    )


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
    latitude, longitude = np.rad2deg(records["latitude"]), np.rad2deg(records["longitude"])
    place = ecef_from_geodetic(latitude, longitude, records["altitude"])
    way = np.einsum("nji,nj->ni", mat_ecef_enu(latitude[:-1], longitude[:-1]), np.diff(place, axis=0))
    step_s = np.diff(records["time"])
    found = way / np.where(step_s > 0, step_s, np.nan)[:, None]
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    misfit = np.linalg.norm(found - mean, axis=1)
    return bool(np.nanmedian(misfit) <= 0.1 + _VELOCITY_MISFIT * np.nanmedian(np.linalg.norm(mean, axis=1)))
