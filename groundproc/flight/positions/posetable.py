"""The columns of trajectory.csv, ours or another program's with the same names."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import LogError
from groundproc.text import open_text, table_of

Array = npt.NDArray[np.float64]

COLUMNS: Final = (
    "utc_ns", "latitude_deg", "longitude_deg", "height_m", "east_m", "north_m", "up_m", "roll_deg", "pitch_deg", "heading_deg",
    "sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PoseTable:
    """Poses of the INS origin, in time order.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        UTC, strictly increasing; two rows or more.
    latitude_deg, longitude_deg, height_m : ndarray, shape (n,)
    quat_local_ins_wxyz : ndarray, shape (n, 4)
    sigma_position_m : ndarray, shape (n, 3)
        East, north, up; not a number where the file does not state it.
    sigma_attitude_rad : ndarray, shape (n, 3)
        Roll, pitch, heading; likewise.
    """

    time_ns: npt.NDArray[np.int64]
    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    quat_local_ins_wxyz: Array
    sigma_position_m: Array
    sigma_attitude_rad: Array


_NEEDED: Final = ("latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")
_POSITION_SIGMAS: Final = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_ATTITUDE_SIGMAS: Final = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg")


def read_pose_table(path: Path) -> PoseTable:
    """Read poses.

    Parameters
    ----------
    path : Path
        Needed: utc_ns, latitude_deg, longitude_deg, height_m, roll_deg, pitch_deg, heading_deg; other columns are optional.

    Raises
    ------
    LogError
        The file cannot be read, a column is missing, a value is no number, or the times do not increase.
    """
    try:
        names, stamps, table = _read(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise LogError(f"{path}: column {missing[0]} is missing; a trajectory has {', '.join(COLUMNS[:10])}")
    if len(stamps) < 2 or not (np.diff(stamps) > 0).all():
        raise LogError(f"{path}: {len(stamps)} rows, expected two or more with increasing utc_ns")
    column = {name: table[:, i] for i, name in enumerate(names)}
    latitude, longitude, height = (column[name] for name in _NEEDED[:3])
    angles = (np.deg2rad(column[name]) for name in ("heading_deg", "pitch_deg", "roll_deg"))
    return PoseTable(
        stamps,
        latitude,
        longitude,
        height,
        frames.quat_from_mat(frames.mat_local_ins(*angles)),
        _sigmas(column, _POSITION_SIGMAS),
        np.deg2rad(_sigmas(column, _ATTITUDE_SIGMAS)),
    )


def _sigmas(column: dict[str, Array], names: tuple[str, ...]) -> Array:
    """Columns of sigma; where a file has none they are not a number, which says that nobody stated them."""
    some = next(iter(column.values()))
    return np.stack([column.get(name, np.full(len(some), np.nan)) for name in names], axis=1)


def _read(path: Path) -> tuple[list[str], npt.NDArray[np.int64], Array]:
    """Names of the columns that mean something here, stamps, and the values, shape (n, names)."""
    with open_text(path) as file:
        rows_of = table_of(file, str(path), "utc_ns", LogError, f"a trajectory has {', '.join(COLUMNS[:10])}")
        header = rows_of.names
        names: list[str] = [name for name in COLUMNS if name in header]
        places = [header.index(name) for name in names]
        stamps, rows = [], []
        for number, words in rows_of.rows():
            row = _numbers([words[place] for place in places], names)
            if row is None:
                expected = (
                    f"{len(header)} values, utc_ns a whole number, the pose one that can be, and no sigma below 0"
                )
                raise LogError(f"{path}: line {number}: {rows_of.blame(words, expected)}")
            stamps.append(row[0])
            rows.append(row[1])
    return names, np.array(stamps, np.int64), np.array(rows, np.float64).reshape(len(rows), len(names))


def _numbers(words: list[str], names: list[str]) -> tuple[int, list[float]] | None:
    """The stamp, exactly, and all values of a row, the stamp first; None where one is no number or no pose."""
    try:
        stamp, values = int(words[0]), [float(word) for word in words]
    except ValueError:
        return None
    for name, value in zip(names, values, strict=True):
        # a sigma may be missing, and is never below 0
        is_sigma = name.startswith("sigma")
        stated = not (is_sigma and math.isnan(value))
        if stated and not (abs(value) <= _LARGEST.get(name, 1e9) and (value >= 0.0 or not is_sigma)):
            return None
    return stamp, values


_LARGEST: Final = {"utc_ns": 2.0**62, "latitude_deg": 90.0, "longitude_deg": 360.0}
"""Magnitudes that values of a pose cannot exceed."""
