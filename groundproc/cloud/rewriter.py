"""A cloud written anew: same points, attributes, order, header and records, other coordinates, or more attributes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import laspy
import numpy as np
import numpy.typing as npt
import pyproj

from flightlog import __version__
from flightlog.errors import CaptureError
from groundproc.cloud.dimensions import Dimension, in_order
from groundproc.cloud.packer import extra_bytes
from groundproc.cloud.reader import Cloud, opened
from groundproc.cloud.storing import begun, ended, storing

Array = npt.NDArray[np.float64]

_INT32: Final = np.iinfo(np.int32)
_NOT_KEPT: Final = ("copc",)
_PROJECTION: Final = "LASF_Projection"


@dataclass(frozen=True, slots=True)
class Frame:
    """Other coordinates.

    Attributes
    ----------
    crs : pyproj.CRS or None
        None: the file states none.
    scale, offset : ndarray, shape (3,)
    """

    crs: pyproj.CRS | None
    scale: Array
    offset: Array


class Rewriter:
    """Writes one file anew, whoever made it: fields that the table of dimensions does not know are kept too.

    Use as a context manager; the caller writes aside.

    Parameters
    ----------
    cloud : Cloud
    path : Path
    compressed : bool
        LAZ; else LAS.
    added : iterable of str
        Attributes of the table that every `write` gives values of. Extra bytes of that name that the cloud had are replaced.
    frame : Frame, optional
        Other coordinates, for `write_at`; default: those of the cloud.
    system : str, optional
        At most 31 characters for the header's system identifier, where the points are no longer as they were measured; then the
        generating software is swath. Default: as the cloud has both.
    records : sequence of laspy.VLR
        More that stand in the file.

    Raises
    ------
    CaptureError
        The cloud cannot be read.
    SourceError
        The new file cannot be written.
    """

    def __init__(
        self,
        cloud: Cloud,
        path: Path,
        compressed: bool = True,
        added: Iterable[str] = (),
        frame: Frame | None = None,
        system: str | None = None,
        records: Sequence[laspy.VLR] = (),
    ) -> None:
        self.path, self.name = path, cloud.path
        self._added = in_order(added)
        with opened(cloud.path) as reader:
            old = reader.header
            self._format = _format(old.point_format, self._added)
            header = laspy.LasHeader(version=_version(old.version, self._format), point_format=self._format)
            header.scales, header.offsets = old.scales, old.offsets
            header.global_encoding, header.uuid = old.global_encoding, old.uuid
            header.file_source_id = old.file_source_id
            header.system_identifier, header.generating_software = old.system_identifier, old.generating_software
            if system is not None:
                header.system_identifier, header.generating_software = system[:31], f"swath {__version__}"[:31]
            header.creation_date = old.creation_date
            # the index of a COPC file, which LAZ would not keep true, and records that laspy writes itself
            header.vlrs.extend(v for v in old.vlrs if v.user_id not in _NOT_KEPT and not _is_extra_bytes(v))
            header.vlrs.extend(records)
            if old.version.minor >= 4:
                reader.read_evlrs()
            if frame is not None:
                header.scales, header.offsets = frame.scale, frame.offset
                header.vlrs[:] = [v for v in header.vlrs if v.user_id != _PROJECTION]
                if frame.crs is not None:
                    header.add_crs(frame.crs, keep_compatibility=False)
            self._scales, self._offsets = np.array(header.scales), np.array(header.offsets)
            self._evlrs = [v for v in (reader.evlrs or []) if v.user_id not in _NOT_KEPT]
        self._las = begun(path, header, compressed)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        ended(self._las, self.path, error is not None, self._evlrs)

    def write(
        self, record: Any, moved_m: Array | None = None, columns: Mapping[str, npt.NDArray[Any]] | None = None
    ) -> Array:
        """Append points moved by so much, shape (n, 3); gives their map coordinates as stored.

        The whole number that a coordinate is stored as changes by the whole number of steps next to the move: no move, no change.

        Parameters
        ----------
        record : laspy.ScaleAwarePointRecord
            As read; changed.
        moved_m : ndarray, shape (n, 3), optional
        columns : mapping of str to ndarray, shape (n,), optional
            Values of all attributes that were said to be added, in the unit of the table.
        """
        assert set(columns or ()) == {entry.name for entry in self._added}, columns
        if self._added:
            record = self._with_columns(record, columns or {})
        moved_m = np.zeros((len(record), 3)) if moved_m is None else moved_m
        places = np.empty((len(record), 3))
        for axis, name in enumerate("XYZ"):
            step, origin = float(record.scales[axis]), float(record.offsets[axis])
            stored = np.asarray(record[name], np.int64) + np.rint(moved_m[:, axis] / step).astype(np.int64)
            if len(stored) and not (_INT32.min <= stored.min() and stored.max() <= _INT32.max):
                raise CaptureError(f"{self.name}: a corrected point lies beyond what its scale {step:g} can hold")
            record[name] = stored.astype(np.int32)
            places[:, axis] = stored * step + origin
        with storing(self.path):
            self._las.write_points(record)
        return places

    def write_at(self, record: Any, places: Array) -> None:
        """Append points at other coordinates, shape (n, 3), of the frame that was given.

        Parameters
        ----------
        record : laspy.ScaleAwarePointRecord
            As read; changed.
        places : ndarray, shape (n, 3)

        Raises
        ------
        CaptureError
            A place lies beyond what the frame can hold.
        """
        stored = np.rint((places - self._offsets) / self._scales)
        if len(stored) and not (np.abs(stored) <= _INT32.max).all():
            raise CaptureError(
                f"{self.name}: a point has no place within what its scale can hold, expected all near each other"
            )
        for axis, name in enumerate("XYZ"):
            record[name] = stored[:, axis].astype(np.int32)
        # as the header has them: else laspy would convert the whole numbers once more
        record.scales, record.offsets = self._scales, self._offsets
        with storing(self.path):
            self._las.write_points(record)

    def _with_columns(self, record: Any, columns: Mapping[str, npt.NDArray[Any]]) -> Any:
        """The points with room for more, and that filled."""
        out = laspy.ScaleAwarePointRecord.zeros(
            len(record), point_format=self._format, scales=record.scales, offsets=record.offsets
        )
        new = {entry.name for entry in self._added if not _has_field(self._format, entry)}
        for name in record.array.dtype.names:
            if name not in new:
                out.array[name] = record.array[name]
        for entry in self._added:
            values = np.asarray(columns[entry.name])
            if entry.name not in new or entry.scale is None:
                out[entry.name if entry.name in new else entry.field] = values
                continue
            low, high = entry.steps()
            steps = np.rint(values / entry.scale)
            known = np.isfinite(steps)
            stored = np.where(known, np.clip(steps, low, high), entry.no_data or 0)
            out.array[entry.name] = stored.astype(entry.stored)
        return out


_WITH_COLOUR: Final = {0: 2, 1: 3, 4: 5, 6: 8, 7: 8, 9: 10}
"""Point formats with the same fields, and red, green and blue; those of LAS 1.4 with near infrared too, which is 0 where nobody tells."""
_WITH_NIR: Final = {6: 8, 7: 8, 9: 10}
"""With near infrared; the older ones have none, and get it as extra bytes."""


def _format(old: Any, added: Sequence[Dimension]) -> Any:
    """The point format of a cloud with more attributes: one that has their fields, where there is one, else with extra bytes."""
    fields = {entry.field for entry in added}
    number = old.id
    if "nir" in fields:
        number = _WITH_NIR.get(number, number)
    if fields & {"red", "green", "blue"}:
        number = _WITH_COLOUR.get(number, number)
    new = laspy.PointFormat(number)
    extra = [entry for entry in added if not _has_field(new, entry)]
    names = {entry.name for entry in extra}
    for each in old.extra_dimensions:
        if each.name not in names:
            new.dimensions.append(each)
    for entry in extra:
        new.add_extra_dimension(extra_bytes(entry))
    return new


def _has_field(point_format: Any, entry: Dimension) -> bool:
    """Whether an attribute is a field of a point format, and not extra bytes."""
    return bool(entry.field) and entry.field in set(point_format.standard_dimension_names)


def _version(old: Any, point_format: Any) -> Any:
    """The version of the file, or the first one that has the point format."""
    least = laspy.header.Version.from_str(laspy.point.dims.preferred_file_version_for_point_format(point_format.id))
    return old if point_format.id in laspy.point.dims.VERSION_TO_POINT_FMT.get(str(old), ()) else least


def _is_extra_bytes(record: Any) -> bool:
    return bool(record.user_id == "LASF_Spec" and record.record_id == 4) or record.user_id == "laszip encoded"
