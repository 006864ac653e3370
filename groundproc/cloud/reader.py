"""Clouds from LAS and LAZ files of any version and point format, ours and other programs': `Points` in chunks, in the order of the file."""

import contextlib
import logging
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
from laspy.header import GpsTimeType
from pyproj.exceptions import CRSError

from flightlog.errors import CaptureError
from flightlog.words import clean
from groundproc.cloud import lashead, laz
from groundproc.cloud.dimensions import TABLE, Dimension, in_order
from groundproc.cloud.gpstime import Clock, is_week_time
from groundproc.cloud.points import Points
from groundproc.cloud.selection import Choice, Selection
from groundproc.cloud.setaside import SetAside
from groundproc.machine import system

CHUNK: Final = 1_000_000
"""Points that are in memory at once, unless they are very large."""
_CHUNK_BYTES: Final = 64 << 20
_FARTHEST_M: Final = 1e8
"""Coordinates on a map are below this, false eastings with the number of a zone included."""
_LONGEST_CRS: Final = 1 << 16
_LONGEST_REASON: Final = 200
DAMAGE: Final = (
    laspy.errors.LaspyException, ValueError, RuntimeError, EOFError, ArithmeticError, LookupError, TypeError, AttributeError,
    AssertionError, struct.error,
)  # fmt: skip
"""What laspy raises for damaged files: errors of its own, and whatever its code runs into."""
# what it has to say becomes errors here; it would write to the terminal, in the words of the file
logging.getLogger("laspy").setLevel(logging.CRITICAL + 1)
_LEGACY: Final = {"scan_angle": ("scan_angle_rank", 1.0)}
"""Fields of point formats 0 to 5 that have another name, and a step in the unit of the table."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """A file and what its header says.

    Attributes
    ----------
    path : Path
    points : int
    columns : tuple of str
        Names of the table's attributes that its points have.
    timed : bool
        Points have times.
    week_time : bool
        Times are seconds of the GPS week; else adjusted standard GPS time. As the header says, unless the times cannot be that.
    crs : pyproj.CRS or None
        As the file states it.
    choices : tuple of Choice
        Which of its points `chunks` gives; all where there are none.
    """

    path: Path
    points: int
    columns: tuple[str, ...]
    timed: bool
    week_time: bool
    crs: pyproj.CRS | None
    choices: tuple[Choice, ...] = ()

    @property
    def horizontal(self) -> pyproj.CRS | None:
        """Horizontal part of the CRS."""
        return self.crs.sub_crs_list[0] if self.crs is not None and self.crs.is_compound else self.crs


@dataclass(frozen=True, slots=True)
class Chunk:
    """Points of a file.

    Attributes
    ----------
    points : Points
        What the table knows of them.
    record : laspy.ScaleAwarePointRecord
        All that the file holds of them, as stored: what `Rewriter` writes anew.
    """

    points: Points
    record: Any


Picked = Callable[[int, int], npt.NDArray[np.bool_]]


def look(path: Path, *choices: Choice) -> Cloud:
    """Read a header.

    Parameters
    ----------
    path : Path
    choices : Choice
        Which points of it are wanted, such as `selection.SURFACES`; default: all.

    Raises
    ------
    CaptureError
        It is no LAS file, holds no point, or its CRS is nonsense.
    """
    with opened(path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise CaptureError(f"{path}: holds no points")
        crs = _crs(path, header)
        columns = tuple(entry.name for entry in TABLE if _step(entry, header.point_format) is not None)
        timed = "gps_time" in header.point_format.dimension_names
        weekly = timed and header.global_encoding.gps_time_type != GpsTimeType.STANDARD
        if weekly:
            # many programs leave the bit unset with times that no week has
            time = np.asarray(next(_records(path, reader)).gps_time, np.float64)
            weekly = is_week_time(time)
        return Cloud(path, header.point_count, columns, timed, weekly, crs, choices)


def chunks(
    cloud: Cloud, clock: Clock | None = None, columns: Collection[str] | None = None, selection: Selection | None = None,
    picked: Picked | None = None, parts: laz.Parts | None = None, aside: SetAside | None = None,
) -> Iterator[Chunk]:  # fmt: skip
    """All points of a file that are wanted; no piece is empty where some are not.

    Parameters
    ----------
    cloud : Cloud
    clock : Clock, optional
        How its times become UTC. None: times are not asked for, and `time_ns` is 0.
    columns : collection of str, optional
        Those wanted, of `cloud.columns`; default: all.
    selection : Selection, optional
        Counts what is left out; default: one of the cloud's own choices, whose counts nobody sees.
    picked : callable, optional
        Given the number of a piece's first point and how many it has: a mask of those that are wanted at all. Only they are unfolded.
    parts : sequence of (int, int), optional
        First point and number of points, at most `CHUNK`, of each part of the file that is read at all, in this order.
    aside : SetAside, optional
        What was kept as the file was written: parts that it has are taken from there.

    Raises
    ------
    CaptureError
        The file is damaged, or has no times though a clock is given.
    """
    if clock is not None and not cloud.timed:
        raise CaptureError(f"{cloud.path}: its points have no gps_time, expected the time of each point")
    selection = Selection(cloud.choices) if selection is None else selection
    asked = cloud.columns if columns is None else columns
    needed = {*asked, *(name for each in selection.choices for name in each.columns)}
    with opened(cloud.path, parts) as reader:
        seen = 0
        for record in _records(cloud.path, reader, parts, aside):
            begin, seen = seen, seen + len(record)
            if picked is not None:
                record = _of(record, picked(begin, len(record)))
            time_ns = np.zeros(len(record), np.int64)
            if clock is not None:
                time_s = np.asarray(record.gps_time, np.float64)
                clock = clock.begun(time_s) if cloud.week_time else clock
                time_ns = clock.utc_ns(cloud.path, cloud.week_time, time_s)
            points = points_of(cloud, record, time_ns, needed)
            wanted = selection.mask(points)
            if wanted is not None:
                points, record = points.masked(wanted), record[wanted]
            if len(points) or not selection.choices:
                yield Chunk(_only(points, asked), record)
        expected = cloud.points if parts is None else sum(count for _, count in parts)
        if seen != expected:
            raise CaptureError(f"{cloud.path}: ends after {seen} points, expected {expected} by its header")


def _of(record: Any, wanted: npt.NDArray[np.bool_]) -> Any:
    """Some of some records, copied as bytes: numpy copies structures field by field."""
    array = record.array
    some = array.view(f"V{array.dtype.itemsize}").take(np.flatnonzero(wanted)).view(array.dtype)
    return laspy.ScaleAwarePointRecord(some, record.point_format, record.scales, record.offsets)


def _only(points: Points, names: Collection[str]) -> Points:
    """The points with some of their columns."""
    if set(points.columns) <= set(names):
        return points
    return replace(points, columns={name: values for name, values in points.columns.items() if name in names})


def points_of(
    cloud: Cloud, record: Any, time_ns: npt.NDArray[np.int64], columns: Collection[str] | None = None
) -> Points:
    """Records of a file, shape (n,), as points in the units of the table; `columns` as for `chunks`.

    Raises
    ------
    CaptureError
        A place is beyond any map.
    """
    wanted = in_order(cloud.columns if columns is None else set(columns) & set(cloud.columns))
    values = {entry.name: _column(entry, record) for entry in wanted}
    return Points(time_ns, _places(cloud.path, record), values)


def _crs(path: Path, header: Any) -> pyproj.CRS | None:
    """The CRS that a file states, if any."""
    records = [*header.vlrs, *(header.evlrs or ())]
    size = sum(len(record.record_data_bytes()) for record in records if record.user_id == "LASF_Projection")
    if size > _LONGEST_CRS:
        raise CaptureError(f"{path}: states its CRS in {size} bytes, expected {_LONGEST_CRS} at most")
    try:
        found: pyproj.CRS | None = header.parse_crs()
    except CRSError as error:
        raise CaptureError(f"{path}: its CRS cannot be understood ({sentence(error)})") from None
    except DAMAGE as error:
        raise CaptureError(f"{path}: its CRS is damaged ({sentence(error)})") from None
    return found


def _places(path: Path, record: Any) -> npt.NDArray[np.float64]:
    """Coordinates, shape (n, 3); those of a file whose offsets or scales are damaged are beyond any map."""
    xyz = np.stack([record.x, record.y, record.z], axis=1).astype(np.float64)
    farthest = float(np.abs(xyz).max(initial=0.0))
    if not farthest <= _FARTHEST_M:
        raise CaptureError(f"{path}: a point has the coordinate {farthest:g}, expected {_FARTHEST_M:g} at most")
    return xyz


def _step(entry: Dimension, point_format: Any) -> tuple[str, float | None] | None:
    """How a point format calls an attribute of the table, and its step there (None: stored as it is); None: it has none.

    Extra bytes are the table's attribute if they have its name, state its unit and fit into its column.
    """
    name, step = entry.field or entry.name, entry.scale
    if entry.field and name not in point_format.dimension_names:
        name, step = _LEGACY.get(name, (name, step))
    if name not in point_format.dimension_names:
        return None
    if entry.field:
        return name, step
    found = point_format.dimension_by_name(name)
    if found.num_elements != 1 or (entry.unit and f"[{entry.unit}]" not in found.description):
        return None
    own = None if found.scales is None else float(found.scales[0])
    if not np.isfinite([own or 0.0, 0.0 if found.offsets is None else float(found.offsets[0])]).all():
        return None
    if entry.scale is None and (own is not None or not np.can_cast(found.dtype, entry.stored, "safe")):
        return None
    return name, own


def _column(entry: Dimension, record: Any) -> npt.NDArray[Any]:
    """One attribute of a piece of a file, in the unit of the table."""
    found = _step(entry, record.point_format)
    assert found is not None
    name, step = found
    if entry.scale is None:
        return np.asarray(record[name]).astype(entry.column)
    if entry.field:
        return (np.asarray(record[name]) * (step or 1.0)).astype(entry.column)
    stored = record.array[name]
    offsets = record.point_format.dimension_by_name(name).offsets
    values = stored * (1.0 if step is None else step) + (0.0 if offsets is None else float(offsets[0]))
    if entry.no_data is not None:
        values = np.where(stored == entry.no_data, np.nan, values)
    return np.asarray(values, entry.column)


def _records(path: Path, reader: Any, parts: laz.Parts | None = None, aside: SetAside | None = None) -> Iterator[Any]:
    points = reader.chunk_iterator(_at_once(reader.header)) if parts is None else _of_parts(reader, parts, aside)
    while True:
        try:
            record = next(points)
        except StopIteration:
            return
        except DAMAGE as error:
            raise CaptureError(f"{path}: is damaged ({sentence(error)})") from None
        yield record


def _of_parts(reader: Any, parts: laz.Parts, aside: SetAside | None) -> Iterator[Any]:
    if aside is not None and aside.has(parts):
        header = reader.header
        for part in parts:
            records = aside.read(part, header.point_format.dtype())
            yield laspy.ScaleAwarePointRecord(records, header.point_format, header.scales, header.offsets)
        return
    for first, count in parts:
        reader.seek(first)
        yield reader.read_points(count)


def _at_once(header: Any) -> int:
    """Points that are read at once."""
    return min(CHUNK, max(1, _CHUNK_BYTES // int(header.point_format.size)))


@contextlib.contextmanager
def opened(path: Path, parts: laz.Parts | None = None) -> Iterator[Any]:
    """A file, read by laspy; `parts` of it as in `chunks`.

    Raises
    ------
    CaptureError
        It cannot be read, or is no LAS file.
    """
    try:
        lashead.check(path)
        reader = laspy.open(path)
        if system.LIMITED:  # else in this process: what aborts takes all of it
            reader.laz_backend = laz.Backend(path, _at_once(reader.header), parts)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from None
    except DAMAGE as error:
        raise CaptureError(f"{path}: is no LAS or LAZ file ({sentence(error)})") from None
    with reader:
        yield reader


def sentence(error: BaseException) -> str:
    """What an error of laspy says, on one line."""
    return clean(" ".join(str(error).split()), _LONGEST_REASON) or type(error).__name__
