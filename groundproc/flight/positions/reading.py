"""Solutions of any of the known formats, told by their content."""

from pathlib import Path
from typing import Final

from flightlog.errors import LogError
from groundproc.flight.positions import localposes
from groundproc.flight.positions.nmea import looks_like_nmea, read_nmea
from groundproc.flight.positions.poses import looks_like_poses, read_poses
from groundproc.flight.positions.rinex import is_raw_observations
from groundproc.flight.positions.rtklib import looks_like_pos, read_pos
from groundproc.flight.positions.sbet import (
    DEGREES_SENTENCE,
    in_degrees,
    looks_like_accuracy,
    looks_like_sbet,
    read_sbet,
)
from groundproc.flight.positions.solution import ELLIPSOID, Solution, dated
from groundproc.text import head_of

_HEAD: Final = 1 << 16


def read_solution(
    path: Path,
    *,
    near_utc_ns: int | None = None,
    week: int | None = None,
    accuracy: Path | None = None,
    utc_seconds: bool = False,
    poses_height: str = ELLIPSOID,
) -> Solution:
    """Read a solution, whatever its format: RTKLIB .pos, SBET, NMEA, or poses (trajectory.csv, TUM, KITTI).

    Parameters
    ----------
    path : Path
    near_utc_ns : int, optional
        A time of the flight [ns], such as the start of its log: it gives an SBET its week, NMEA without date its day, and dates
        that are whole eras of 1024 weeks off theirs.
    week, accuracy, utc_seconds
        Of an SBET; see `read_sbet`.
    poses_height : str
        Height reference of poses; see `read_poses`.

    Raises
    ------
    LogError
        It cannot be read, or is none of these.
    """
    try:
        head = head_of(path, _HEAD)
        size = path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from None
    text = head.decode("utf-8", errors="replace") if b"\x00" not in head else ""
    if looks_like_pos(text):
        return dated(read_pos(path), near_utc_ns)
    if looks_like_poses(text):
        return dated(read_poses(path, height_reference=poses_height), near_utc_ns)
    if kind := localposes.looks_like(text):
        read = localposes.read_tum if kind == localposes.TUM else localposes.read_kitti
        return dated(read(path), near_utc_ns)
    if looks_like_nmea(head):
        return dated(read_nmea(path, near_utc_ns=near_utc_ns), near_utc_ns)
    if degrees := in_degrees(head, size):
        raise LogError(f"{path}: looks like an SBET, but its {degrees} {DEGREES_SENTENCE}")
    if looks_like_sbet(head, size):
        return read_sbet(path, near_utc_ns=near_utc_ns, week=week, accuracy=accuracy, utc_seconds=utc_seconds)
    raise LogError(
        f"{path}: {_what_else(head, size)}, expected an RTKLIB .pos, an SBET, NMEA, TUM, KITTI, or a table with utc_ns"
    )


def _what_else(head: bytes, size: int) -> str:
    """What a file that is no solution is."""
    if not head:
        return "is empty"
    if is_raw_observations(head):
        return "holds raw observations, of which `swath ppk` makes positions"
    if looks_like_accuracy(head, size):
        return "is the accuracy file of an SBET, which is read together with it"
    return "is no solution that is known"
