"""Files of a line scanner's kit: lines of ranges (CSV or NPZ), and samples of an IMU (CSV)."""

from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import LogError
from flightlog.records import line_dtype
from groundproc.arrays import read_arrays
from groundproc.flight.sound import FORCE_M_S2, RATE_RAD_S
from groundproc.text import decimal_comma, open_text, table_of

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

SCAN_COLUMNS: Final = ("time_ns", "angle_deg", "range_m", "intensity")
IMU_COLUMNS: Final = (
    "time_ns", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s", "accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2",
)  # fmt: skip
_LARGEST: Final = np.repeat([RATE_RAD_S, FORCE_M_S2], 3)
_LARGEST_VALUE: Final = 1e9
"""Of a range [m] or an intensity; what is larger no scanner states."""
_UNEVEN_RAD: Final = np.deg2rad(0.02)
"""Angles of a line may be off an even spacing by this: they are stated to 0.01 deg."""
_DEFAULT_LINE_S: Final = 1.0 / 18.0


def read_lines(path: Path) -> npt.NDArray[np.void]:
    """Lines of a scanner, of `records.line_dtype`, shape (n,), in order of time.

    A CSV has a head and a row a shot: time_ns of the line (UTC of its first shot), angle_deg (clockwise from forward, seen from above),
    range_m, intensity. An NPZ has arrays time_ns (n,), angle_deg (m,), range_m and intensity (n, m), and may have shot_step_s, the time
    from shot to shot. All lines have the same angles, evenly spaced; range 0 or not a number is no return.

    Raises
    ------
    LogError
        The file is not that.
    """
    try:
        tables = _npz(path) if path.suffix.lower() == ".npz" else _csv(path)
    except (OSError, ValueError, KeyError, OverflowError) as error:
        raise LogError(
            f"{path}: cannot be read as lines of a scanner ({error}); expected {', '.join(SCAN_COLUMNS)}"
        ) from None
    time_ns, angle_deg, range_m, intensity, shot_step_s = tables
    angle = np.deg2rad(angle_deg.astype(np.float64))
    many = len(time_ns)
    if many < 2 or range_m.shape != (many, len(angle)) or intensity.shape != range_m.shape or len(angle) < 2:
        raise LogError(
            f"{path}: {many} times, {len(angle)} angles, ranges {range_m.shape}, intensities {intensity.shape}; "
            "expected n, m, (n, m) and (n, m)"
        )
    if (np.diff(time_ns) <= 0).any():
        raise LogError(f"{path}: times of the lines do not grow")
    for name, values in (("range", range_m), ("intensity", intensity)):
        finite = values[np.isfinite(values)]
        if len(finite) and float(np.abs(finite).max()) > _LARGEST_VALUE:
            raise LogError(f"{path}: a {name} of {np.abs(finite).max():g}, expected at most {_LARGEST_VALUE:g}")
    step = (angle[-1] - angle[0]) / (len(angle) - 1)
    uneven = float(np.abs(angle - (angle[0] + step * np.arange(len(angle)))).max())
    if uneven > _UNEVEN_RAD:
        raise LogError(f"{path}: angles are off an even spacing by {np.rad2deg(uneven):.3f} deg, expected at most 0.02")
    lines = np.zeros(many, line_dtype(len(angle)))
    lines["time_ns"], lines["ranges"], lines["intensities"] = time_ns, range_m, intensity
    # as LaserScan has it: from x towards y
    lines["angle_min"], lines["angle_increment"] = np.pi / 2.0 - angle[0], -step
    lines["time_increment"] = shot_step_s
    lines["scan_time"] = np.median(np.diff(time_ns)) * 1e-9 if many > 2 else _DEFAULT_LINE_S
    return lines


def _npz(path: Path) -> tuple[Times, Array, Array, Array, float]:
    found = read_arrays(path)
    step = float(found["shot_step_s"]) if "shot_step_s" in found else 0.0
    time_ns, angle, ranges, intensity = (found[name] for name in SCAN_COLUMNS)
    if (time_ns.ndim, angle.ndim) != (1, 1) or any(
        array.dtype.kind not in "iuf" for array in (time_ns, angle, ranges, intensity)
    ):
        raise ValueError("arrays of other shapes or kinds")
    return time_ns.astype(np.int64), angle, ranges, intensity, step


def _csv(path: Path) -> tuple[Times, Array, Array, Array, float]:
    columns = _columns(path, SCAN_COLUMNS, "lines of a scanner have")
    time_ns = columns[0].astype(np.int64)
    begins = np.flatnonzero(np.diff(time_ns, prepend=time_ns[0] - 1))
    lengths = np.diff(np.append(begins, len(time_ns)))
    if len(set(lengths.tolist())) != 1:
        raise ValueError(f"lines of {lengths.min()} to {lengths.max()} shots, expected one length")
    angle, ranges, intensity = (column.astype(np.float64).reshape(len(begins), -1) for column in columns[1:])
    if (angle != angle[0]).any():
        raise ValueError("lines of different angles")
    return time_ns[begins], angle[0], ranges, intensity, 0.0


def read_imu(path: Path) -> tuple[Times, Array, Array]:
    """Samples of an IMU: UTC [ns], shape (n,), rates [rad/s] and specific force [m/s^2], shape (n, 3), right, forward, up.

    Raises
    ------
    LogError
        The file is not that: a CSV with a head of `IMU_COLUMNS`.
    """
    try:
        columns = _columns(path, IMU_COLUMNS, "an IMU's samples have")
        values = np.stack([column.astype(np.float64) for column in columns[1:]], axis=1)
        time_ns = columns[0].astype(np.int64)
    except (OSError, ValueError, KeyError, OverflowError) as error:
        raise LogError(
            f"{path}: cannot be read as an IMU's samples ({error}); expected {', '.join(IMU_COLUMNS)}"
        ) from None
    if len(time_ns) < 2 or (np.diff(time_ns) <= 0).any():
        raise LogError(f"{path}: {len(time_ns)} samples, expected at least 2, of growing times")
    if not (np.abs(values) <= _LARGEST).all():
        raise LogError(f"{path}: a sample is no number, or above {RATE_RAD_S:g} rad/s or {FORCE_M_S2:g} m/s^2")
    return time_ns, values[:, :3], values[:, 3:]


def _columns(path: Path, names: tuple[str, ...], what: str) -> list[npt.NDArray[np.str_]]:
    """Columns of a CSV by the names in its head, as text: a time in ns has more digits than a float."""
    with open_text(path) as file:
        found = table_of(file, str(path), names[0], LogError, f"{what} {', '.join(names)}")
        missing = [name for name in names if name not in found.names]
        if missing:
            raise KeyError(f"no column {missing[0]}")
        places = [found.names.index(name) for name in names]
        first = file.readline()
        for _, words in found.of([first]):  # of the first row only: there may be millions
            if comma := decimal_comma(words):
                raise ValueError(comma)
        rows = (line for line in chain([first], file) if line.strip())
        head = next(rows, None)
        if head is None:
            raise ValueError("no rows")
        values = np.loadtxt(
            chain([head], rows),
            delimiter=found.separator,
            dtype=np.str_,
            ndmin=2,
            usecols=places,
            quotechar='"',
            comments=None,
        )
    return list(values.T)
