"""trajectory.csv: the trajectory of the INS origin, for people and other programs; written and read."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.errors import LogError
from groundproc.files import written_aside
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]

COLUMNS: Final = (
    "utc_ns", "latitude_deg", "longitude_deg", "height_m", "east_m", "north_m", "up_m", "roll_deg", "pitch_deg", "heading_deg",
    "sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg",
)  # fmt: skip
_FORMATS: Final = "%.9f,%.9f,%.4f,%.4f,%.4f,%.4f,%.5f,%.5f,%.5f,%.4f,%.4f,%.4f,%.4f,%.4f,%.4f"
LONGEST_STEP_NS: Final = 1_000_000_000
"""Rows further apart than this are the two sides of a gap."""


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write every knot; utc_ns as a whole number, angles in degrees, heading clockwise from true north 0 to 360."""
    with written_aside(path) as aside, aside.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join(COLUMNS) + "\n")
        for start in range(0, len(trajectory), 20_000):
            part = slice(start, start + 20_000)
            heading, pitch, roll = frames.attitude_of(frames.mat_from_quat(trajectory.quat_local_ins_wxyz[part]))
            heading_deg = np.rad2deg(heading) % 360.0
            heading_deg[heading_deg >= 359.999995] = 0.0  # would be printed as 360
            rows = np.column_stack(
                [
                    *trajectory.frame.to_geodetic(trajectory.position_m[part]),
                    trajectory.position_m[part],
                    np.rad2deg(roll),
                    np.rad2deg(pitch),
                    heading_deg,
                    trajectory.sigma_position_m[part],
                    np.rad2deg(trajectory.sigma_attitude_rad[part]),
                ]
            )
            stamps = trajectory.time_ns[part]
            file.writelines(
                f"{stamp},{_FORMATS % tuple(row)}\n" for stamp, row in zip(stamps.tolist(), rows.tolist(), strict=True)
            )


def read_trajectory(path: Path, frame: LocalFrame | None = None) -> Trajectory:
    """Read a trajectory.csv, ours or another program's with the same column names.

    Parameters
    ----------
    path : Path
        Needed: utc_ns, latitude_deg, longitude_deg, height_m, roll_deg, pitch_deg, heading_deg; other columns are optional.
    frame : LocalFrame, optional
        Default: its origin is the first row.

    Raises
    ------
    LogError
        The file cannot be read, a column is missing, a value is no number, or the times do not increase.
    """
    try:
        names, stamps, table = _read(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    needed = [
        n
        for n in ("latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")
        if n not in names
    ]
    if needed:
        raise LogError(f"{path}: column {needed[0]} is missing; a trajectory has {', '.join(COLUMNS[:10])}")
    if len(stamps) < 2 or not (np.diff(stamps) > 0).all():
        raise LogError(f"{path}: {len(stamps)} rows, expected two or more with increasing utc_ns")
    column = {name: table[:, i] for i, name in enumerate(names)}
    place = [column[n] for n in ("latitude_deg", "longitude_deg", "height_m")]
    frame = frame or LocalFrame(*(float(values[0]) for values in place))
    position = frame.from_geodetic(*place)
    angles = (np.deg2rad(column[n]) for n in ("heading_deg", "pitch_deg", "roll_deg"))
    quat = frames.quat_from_mat(frames.mat_local_ins(*angles))
    return from_poses(
        frame, stamps, position, quat, _sigmas(column, _POSITION_SIGMAS), np.deg2rad(_sigmas(column, _ATTITUDE_SIGMAS))
    )


_POSITION_SIGMAS: Final = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_ATTITUDE_SIGMAS: Final = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg")


def from_poses(
    frame: LocalFrame,
    time_ns: npt.NDArray[np.int64],
    position_m: Array,
    quat: Array,
    sigma_position_m: Array,
    sigma_rad: Array,
) -> Trajectory:
    """A trajectory through poses, shape (n, ...), with velocities and rates from their differences; steps over 1 s are gaps."""
    step_s = np.diff(time_ns) * 1e-9
    joined = np.diff(time_ns) <= LONGEST_STEP_NS
    velocity = _at_knots(np.diff(position_m, axis=0) / step_s[:, None], step_s, joined)
    turn = frames.quat_log(frames.quat_multiply(frames.quat_inverse(quat[:-1]), quat[1:])) / step_s[:, None]
    rate = _at_knots(turn, step_s, joined)
    covered = np.append(joined, False)
    return Trajectory(frame, time_ns, position_m, velocity, quat, rate, sigma_position_m, sigma_rad, covered)


def _at_knots(slope: Array, step_s: Array, joined: npt.NDArray[np.bool_]) -> Array:
    """Slopes at knots, shape (n, 3), from those of the steps between, shape (n - 1, 3): the parabola's; one-sided at a gap."""
    weight = np.where(joined, 1.0 / step_s, 0.0)[:, None]
    total = np.zeros((len(slope) + 1, 1))
    total[:-1] += weight
    total[1:] += weight
    summed = np.zeros((len(slope) + 1, slope.shape[1]))
    summed[:-1] += weight * slope
    summed[1:] += weight * slope
    return np.asarray(summed / np.where(total > 0.0, total, 1.0))


def _sigmas(column: dict[str, Array], names: tuple[str, ...]) -> Array:
    """Columns of sigma; where a file has none they are not a number, which says that nobody stated them."""
    some = next(iter(column.values()))
    return np.stack([column.get(name, np.full(len(some), np.nan)) for name in names], axis=1)


def _read(path: Path) -> tuple[list[str], npt.NDArray[np.int64], Array]:
    """Names of the columns that mean something here, stamps, and the values, shape (n, names)."""
    with path.open(encoding="utf-8", errors="replace") as file:
        header = [name.strip() for name in file.readline().split(",")]
        if "utc_ns" not in header:
            raise LogError(f"{path}: the first line has no column utc_ns; a trajectory has {', '.join(COLUMNS[:10])}")
        names: list[str] = [name for name in COLUMNS if name in header]
        places = [header.index(name) for name in names]
        stamps, rows = [], []
        for number, line in enumerate(file, 2):
            words = line.strip().split(",")
            if words == [""]:
                continue
            row = _numbers([words[place] for place in places], names) if len(words) == len(header) else None
            if row is None:
                raise LogError(
                    f"{path}: line {number} is not {len(header)} values, utc_ns a whole number and the pose one that can be"
                )
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
        # a sigma may be missing
        if not name.startswith("sigma") and not abs(value) <= _LARGEST.get(name, 1e9):
            return None
    return stamp, values


_LARGEST: Final = {"utc_ns": 2.0**62, "latitude_deg": 90.0, "longitude_deg": 360.0}
"""Magnitudes that values of a pose cannot exceed."""
