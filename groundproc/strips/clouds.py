"""LAS and LAZ files of other programs: read in chunks, and written with nothing but their coordinates changed."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
from laspy.header import GpsTimeType
from pyproj.exceptions import CRSError

from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError, SourceError
from groundproc.files import written_aside
from groundproc.flight.positions.scales import EPOCH_NS, WEEK_NS, utc_from_gps_calendar

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

CHUNK: Final = 1_000_000
"""Points that are in memory at once."""
_ADJUSTED_S: Final = 1_000_000_000
"""Adjusted standard GPS time is GPS time less this (LAS 1.4 R15, global encoding bit 0)."""
_INT32: Final = np.iinfo(np.int32)
_DAMAGE: Final = (laspy.errors.LaspyException, ValueError, RuntimeError, EOFError, OverflowError)
"""What laspy and lazrs raise for damaged files; lazrs' own error is a RuntimeError."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """A file and what its header says.

    Attributes
    ----------
    path : Path
    points : int
    week_time : bool
        Times are seconds of the GPS week; else adjusted standard GPS time. As the header says, unless the times cannot be that.
    crs : pyproj.CRS or None
        Horizontal part of the file's CRS.
    """

    path: Path
    points: int
    week_time: bool
    crs: pyproj.CRS | None


@dataclass(slots=True)
class Chunk:
    """Points of a file, in its order.

    Attributes
    ----------
    file : int
    record : laspy.ScaleAwarePointRecord
    xyz_m : ndarray, shape (n, 3)
        Map coordinates.
    time_ns : ndarray of int64, shape (n,)
        UTC.
    source : ndarray of int64, shape (n,)
        Point source id.
    """

    file: int
    record: Any
    xyz_m: Array
    time_ns: Ints
    source: Ints


def look(path: Path) -> Cloud:
    """Read a header.

    Raises
    ------
    CaptureError
        It is no LAS file, holds no point, or its points have no times.
    """
    with _opened(path) as reader:
        header = reader.header
        if "gps_time" not in header.point_format.dimension_names:
            raise CaptureError(
                f"{path}: its points have no gps_time (point format {header.point_format.id}), expected format 1, 3 to 10: the "
                "trajectory is tied to points by time"
            )
        if header.point_count == 0:
            raise CaptureError(f"{path}: holds no points")
        try:
            crs = header.parse_crs()
        except CRSError as error:
            raise CaptureError(f"{path}: its CRS cannot be understood ({error})") from None
        weekly = header.global_encoding.gps_time_type != GpsTimeType.STANDARD
        if weekly:
            # many programs leave the bit unset with times that no week has
            some = next(_records(path, reader))
            time = np.asarray(some.gps_time, np.float64)
            weekly = bool(((time >= 0.0) & (time < 2.0 * WEEK_NS / NS_PER_S)).all())
        return Cloud(path, header.point_count, weekly, _horizontal(crs))


def _horizontal(crs: pyproj.CRS | None) -> pyproj.CRS | None:
    if crs is None:
        return None
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    return crs


def agreed_crs(clouds: Sequence[Cloud], given: pyproj.CRS | None) -> pyproj.CRS:
    """The projected CRS of all files.

    Raises
    ------
    CaptureError
        A file states none and none is given, they differ, or it is not projected in metres.
    """
    crs = given
    for cloud in clouds:
        if given is not None:
            break
        if cloud.crs is None:
            raise CaptureError(f"{cloud.path}: states no CRS; give it with --crs")
        if crs is not None and not crs.equals(cloud.crs, ignore_axis_order=True):
            raise CaptureError(f"{cloud.path}: is in {cloud.crs.name}, expected {crs.name} as {clouds[0].path.name}")
        crs = cloud.crs if crs is None else crs
    assert crs is not None
    if not crs.is_projected or {axis.unit_name for axis in crs.axis_info} != {"metre"}:
        raise CaptureError(f"{clouds[0].path}: is in {crs.name}, expected a projected CRS in metres")
    return crs


@dataclass(frozen=True, slots=True)
class Clock:
    """How the stamps of a file become UTC.

    Attributes
    ----------
    week : int or None
        GPS week of files that count seconds of the week.
    near_utc_ns : int or None
        A time of the flight, where the trajectory knows it: gives files with seconds of the week theirs.
    """

    week: int | None = None
    near_utc_ns: int | None = None

    def utc_ns(self, cloud: Cloud, time_s: Array) -> Ints:
        """Unix times of stamps, shape (n,)."""
        if not np.isfinite(time_s).all() or not (time_s != 0.0).any():
            raise CaptureError(f"{cloud.path}: gps_time is {_example(time_s)}, expected the time of each point")
        whole = np.floor(time_s)
        nano = whole.astype(np.int64) * NS_PER_S + np.rint((time_s - whole) * 1e9).astype(np.int64)
        if not cloud.week_time:
            return utc_from_gps_calendar(nano + _ADJUSTED_S * NS_PER_S + EPOCH_NS)
        if self.week is not None:
            week = self.week
        elif self.near_utc_ns is not None:
            # the leap seconds, 18 of 604800, do not matter here
            week = round((self.near_utc_ns - EPOCH_NS - int(nano[len(nano) // 2])) / WEEK_NS)
        else:
            raise CaptureError(f"{cloud.path}: its times are seconds of the GPS week; give the week with --week")
        return utc_from_gps_calendar(nano + week * WEEK_NS + EPOCH_NS)


def _example(time_s: Array) -> str:
    return "0 for all points" if not time_s.any() else "no number for some points"


def chunks(clouds: Sequence[Cloud], clock: Clock) -> Iterator[Chunk]:
    """All points of all files, in their order.

    Raises
    ------
    CaptureError
        A file is damaged, or has no times.
    """
    for number, cloud in enumerate(clouds):
        with _opened(cloud.path) as reader:
            seen = 0
            for record in _records(cloud.path, reader):
                seen += len(record)
                xyz = np.stack([record.x, record.y, record.z], axis=1).astype(np.float64)
                time = np.asarray(record.gps_time, np.float64)
                yield Chunk(
                    number, record, xyz, clock.utc_ns(cloud, time), np.asarray(record.point_source_id).astype(np.int64)
                )
            if seen != cloud.points:
                raise CaptureError(f"{cloud.path}: ends after {seen} points, expected {cloud.points} by its header")


def _records(path: Path, reader: Any) -> Iterator[Any]:
    points = reader.chunk_iterator(CHUNK)
    while True:
        try:
            record = next(points)
        except StopIteration:
            return
        except _DAMAGE as error:
            raise CaptureError(f"{path}: is damaged ({_sentence(error)})") from None
        yield record


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        reader = laspy.open(path)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from None
    except _DAMAGE as error:
        raise CaptureError(f"{path}: is no LAS or LAZ file ({_sentence(error)})") from None
    with reader:
        yield reader


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


class Rewriter:
    """Writes one file anew: same points, attributes, order, header and records, other coordinates.

    Use as a context manager; the caller writes aside.

    Parameters
    ----------
    cloud : Cloud
    path : Path
    """

    def __init__(self, cloud: Cloud, path: Path) -> None:
        self.path, self.name = path, cloud.path
        with _opened(cloud.path) as reader:
            header = laspy.LasHeader(version=reader.header.version, point_format=reader.header.point_format)
            old = reader.header
            header.scales, header.offsets = old.scales, old.offsets
            header.global_encoding, header.uuid = old.global_encoding, old.uuid
            header.file_source_id = old.file_source_id
            header.system_identifier, header.generating_software = old.system_identifier, old.generating_software
            header.creation_date = old.creation_date
            # the index of a COPC file, which LAZ would not keep true, and records that laspy writes itself
            header.vlrs.extend(v for v in old.vlrs if v.user_id not in _NOT_KEPT and not _is_extra_bytes(v))
            if old.version.minor >= 4:
                reader.read_evlrs()
            self._evlrs = [v for v in (reader.evlrs or []) if v.user_id not in _NOT_KEPT]
        try:
            self._las = laspy.open(
                path, mode="w", header=header, laz_backend=laspy.LazBackend.LazrsParallel, do_compress=True
            )
        except OSError as error:
            raise SourceError(f"{path}: cannot be written ({error.strerror})") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None and self._evlrs:
            self._las.write_evlrs(laspy.vlrs.vlrlist.VLRList(self._evlrs))
        self._las.close()

    def write(self, record: Any, moved_m: Array) -> Array:
        """Append points moved by so much, shape (n, 3); gives their map coordinates as stored.

        The whole number that a coordinate is stored as changes by the whole number of steps next to the move: no move, no change.
        """
        places = np.empty((len(record), 3))
        for axis, name in enumerate("XYZ"):
            step, origin = float(record.scales[axis]), float(record.offsets[axis])
            stored = np.asarray(record[name], np.int64) + np.rint(moved_m[:, axis] / step).astype(np.int64)
            if len(stored) and not (_INT32.min <= stored.min() and stored.max() <= _INT32.max):
                raise CaptureError(f"{self.name}: a corrected point lies beyond what its scale {step:g} can hold")
            record[name] = stored.astype(np.int32)
            places[:, axis] = stored * step + origin
        self._las.write_points(record)
        return places


_NOT_KEPT: Final = ("copc",)


def _is_extra_bytes(record: Any) -> bool:
    return bool(record.user_id == "LASF_Spec" and record.record_id == 4) or record.user_id == "laszip encoded"


@contextlib.contextmanager
def rewriters(clouds: Sequence[Cloud], folder: Path) -> Iterator[list[Rewriter]]:
    """Writers of all files, aside; they get their names, those of the inputs with .laz, when all went well."""
    with contextlib.ExitStack() as stack:
        asides = [stack.enter_context(written_aside(folder / cloud.path.with_suffix(".laz").name)) for cloud in clouds]
        with contextlib.ExitStack() as inner:
            yield [inner.enter_context(Rewriter(cloud, aside)) for cloud, aside in zip(clouds, asides, strict=True)]
