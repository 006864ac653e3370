"""Poses in a local frame as other programs exchange them: TUM and KITTI, with the frame's origin in a line of comment.

Both formats hold poses of a body whose x points forward, y to the left and z up (REP 103 of ROS) in the axes east, north, up of a plane
that touches the ellipsoid at an origin. Neither says where that is; we write a line `# origin LATITUDE LONGITUDE HEIGHT REFERENCE`
(degrees, metres; REFERENCE is ellipsoid, msl or relative), which other readers pass over, and need it to read a file back.

TUM: `time x y z qx qy qz qw` a line, time in Unix seconds (UTC).
KITTI: the upper three rows of a homogeneous matrix a line, 12 numbers; the times are in NAME_times.txt beside NAME.kitti, a line for each.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import frames
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from groundproc.flight.positions.ellipsoid import mat_ecef_enu
from groundproc.flight.positions.solution import ELLIPSOID, INS, MSL, Quality, Solution, tidied
from groundproc.geodesy import LocalFrame
from groundproc.text import open_text

Array = npt.NDArray[np.float64]

TUM: Final = "TUM"
KITTI: Final = "KITTI"
RELATIVE: Final = "relative"
REFERENCES: Final = (ELLIPSOID, MSL, RELATIVE)
QUAT_INS_BODY: Final = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
"""Ins frame (right, forward, up) from the body's (forward, left, up)."""
_WIDTH: Final = {TUM: 8, KITTI: 12}
_TIME: Final = re.compile(r"(\d{1,10})(?:\.(\d*))?")
_PROBED: Final = 20
_UNIT: Final = 1e-3
"""What the length of a quaternion, or the rows of a rotation, may be off by."""
_FARTHEST_M: Final = 1e5
"""From the origin of a local frame."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a local frame lies.

    Attributes
    ----------
    latitude_deg, longitude_deg, height_m : float
        WGS 84; the height above `reference`.
    reference : str
        One of `REFERENCES`, or "unknown".
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    reference: str

    def line(self) -> str:
        """As a comment of a file, every digit of it."""
        return f"# origin {self.latitude_deg!r} {self.longitude_deg!r} {self.height_m!r} {self.reference}\n"


def times_beside(path: Path) -> Path:
    """The file of times that belongs to poses of KITTI."""
    return path.with_name(f"{path.stem}_times.txt")


def looks_like(text: str) -> str:
    """What the beginning of a text is, `TUM` or `KITTI`; empty where it is neither."""
    rows = [line.split() for line in text.splitlines()[:-1] if line.strip() and not line.startswith("#")][:_PROBED]
    for kind, width in _WIDTH.items():
        if rows and all(len(row) == width and _numbers(row) is not None for row in rows):
            timed = kind == KITTI or all(_TIME.fullmatch(row[0]) for row in rows)
            return kind if timed else ""
    return ""


def read_tum(path: Path) -> Solution:
    """Read poses in TUM's format, with their origin.

    Raises
    ------
    LogError
        It cannot be read, has no line of origin, or a line that is no pose.
    """
    origin, lines = _lines(path)
    times, rows = [], []
    for number, line in lines:
        words = line.split()
        time_ns = _time_ns(words[0]) if len(words) == _WIDTH[TUM] else None
        values = _numbers(words[1:])
        if time_ns is None or values is None:
            raise _damaged(path, number, line, "time x y z qx qy qz qw")
        times.append(time_ns)
        rows.append(values)
    table = np.array(rows).reshape(len(rows), 7)
    length = np.linalg.norm(table[:, 3:], axis=1)
    if len(bad := np.flatnonzero(np.abs(length - 1.0) > _UNIT)):
        raise LogError(f"{path}: pose {bad[0] + 1}: a quaternion of length {length[bad[0]]:.4g} found, expected 1")
    quat = table[:, [6, 3, 4, 5]] / length[:, None]
    return _solution(path, TUM, _placed(origin, path), np.array(times, np.int64), table[:, :3], quat)


def read_kitti(path: Path) -> Solution:
    """Read poses in KITTI's format, with the times and the origin of the file of times beside.

    Raises
    ------
    LogError
        One of the two cannot be read, they do not belong together, or a line is no pose.
    """
    beside = times_beside(path)
    if not beside.is_file():
        raise LogError(f"{path}: KITTI's poses have no times, expected them in {beside.name} beside it")
    _, lines = _lines(path)
    rows = []
    for number, line in lines:
        words = line.split()
        values = _numbers(words) if len(words) == _WIDTH[KITTI] else None
        if values is None:
            raise _damaged(path, number, line, "the 12 numbers of a pose")
        rows.append(values)
    matrix = np.array(rows).reshape(len(rows), 3, 4)
    rotation = matrix[:, :, :3]
    off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    if len(bad := np.flatnonzero((off > _UNIT) | (np.linalg.det(rotation) < 0.0))):
        raise LogError(f"{path}: pose {bad[0] + 1}: its first three columns are no rotation")
    origin, times = _times(beside)
    if len(times) != len(rows):
        raise LogError(f"{beside}: {len(times)} times found, expected {len(rows)} as in {path.name}")
    return _solution(path, KITTI, _placed(origin, beside), times, matrix[:, :, 3], frames.quat_from_mat(rotation))


def _times(path: Path) -> tuple[Origin | None, npt.NDArray[np.int64]]:
    origin, lines = _lines(path)
    times = []
    for number, line in lines:
        time_ns = _time_ns(line.strip())
        if time_ns is None:
            raise _damaged(path, number, line, "a time in Unix seconds")
        times.append(time_ns)
    return origin, np.array(times, np.int64)


def _lines(path: Path) -> tuple[Origin | None, list[tuple[int, str]]]:
    """The origin that a file names, and its lines with their numbers, without comments."""
    origin, lines = None, []
    try:
        with open_text(path) as file:
            for number, line in enumerate(file, 1):
                if line.startswith("#"):
                    origin = _origin(line, path) or origin
                elif line.strip():
                    lines.append((number, line))
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    return origin, lines


def _origin(line: str, path: Path) -> Origin | None:
    words = line[1:].split()
    if words[:1] != ["origin"]:
        return None
    place = _numbers(words[1:4]) if len(words) == 5 else None
    if place is None or abs(place[0]) > 90.0 or abs(place[1]) > 360.0 or words[4] not in (*REFERENCES, "unknown"):
        raise LogError(
            f"{path}: {line.strip()!r} found, expected # origin LATITUDE LONGITUDE HEIGHT and one of {', '.join(REFERENCES)}"
        )
    return Origin(place[0], place[1], place[2], words[4])


def _placed(origin: Origin | None, path: Path) -> Origin:
    if origin is None:
        raise LogError(
            f"{path}: does not say where on the Earth its poses are; add a line # origin LATITUDE LONGITUDE HEIGHT ellipsoid (or msl)"
        )
    return origin


_LATEST_S: Final = 9_000_000_000
"""In 2255; beyond 2262 nanoseconds do not go into 64 bits."""


def _time_ns(text: str) -> int | None:
    """Nanoseconds of decimal seconds, exactly; None where it is no time."""
    found = _TIME.fullmatch(text)
    if found is None or int(found[1]) >= _LATEST_S:
        return None
    return int(found[1]) * NS_PER_S + int((found[2] or "")[:9].ljust(9, "0"))


def _numbers(words: Sequence[str]) -> list[float] | None:
    try:
        values = [float(word) for word in words]
    except ValueError:
        return None
    return values if all(math.isfinite(value) for value in values) else None


def _damaged(path: Path, number: int, line: str, expected: str) -> LogError:
    return LogError(f"{path}: line {number}: {line.strip()[:80]!r} found, expected {expected}")


def _solution(
    path: Path, kind: str, origin: Origin, time_ns: npt.NDArray[np.int64], position_m: Array, quat_local_body: Array
) -> Solution:
    if len(position_m) and not float(np.abs(position_m).max()) <= _FARTHEST_M:
        raise LogError(
            f"{path}: a position {np.abs(position_m).max():.4g} m from the origin found, expected {_FARTHEST_M:.0f} m at most"
        )
    frame = LocalFrame(origin.latitude_deg, origin.longitude_deg, origin.height_m)
    latitude, longitude, height = frame.to_geodetic(position_m)
    quat_local_ins = frames.quat_multiply(quat_local_body, frames.quat_inverse(QUAT_INS_BODY))
    mat_ecef_frame = mat_ecef_enu(np.array(origin.latitude_deg), np.array(origin.longitude_deg))
    quat_place_frame = frames.quat_from_mat(np.swapaxes(mat_ecef_enu(latitude, longitude), -1, -2) @ mat_ecef_frame)
    return tidied(
        Solution(
            source=path.name,
            format=kind,
            point=INS,
            height_reference=origin.reference,
            sigma_source="nobody",
            time_ns=time_ns,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            covariance_m2=np.full((len(time_ns), 3, 3), np.nan),
            quality=np.full(len(time_ns), Quality.INERTIAL, np.uint8),
            quat_place_ins_wxyz=frames.quat_multiply(quat_place_frame, quat_local_ins),
        ),
        str(path),
    )
