"""Several clouds in one file: every point as it was, with attributes more, in the order of the clouds."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import laspy
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import WktCoordinateSystemVlr

from flightlog.errors import CaptureError, SourceError
from groundproc.cloud.dimensions import TABLE, in_order
from groundproc.cloud.packer import extra_bytes
from groundproc.cloud.reader import Cloud, opened
from groundproc.cloud.storing import storing

_INT32: Final = np.iinfo(np.int32)


class Merger:
    """Writes one LAZ file, LAS 1.4, point format 6 to 8.

    Extra bytes of all clouds are kept. Where one lacks them they are not known: not a number, or what stands for no data where the table
    has them, else 0.

    Use as a context manager; the caller writes aside.

    Parameters
    ----------
    clouds : sequence of Cloud
        Of one CRS, the first's.
    path : Path
    added : iterable of str
        Attributes of the table that every `write` gives.

    Raises
    ------
    CaptureError
        Extra bytes of one name are of different types or steps.
    SourceError
        The file cannot be written.
    """

    def __init__(self, clouds: Sequence[Cloud], path: Path, added: Iterable[str]) -> None:
        self._path, self._added = path, in_order(added)
        names: set[str] = set()
        scales, offsets, standard = [], [], False
        extra: dict[str, Any] = {}
        own = {entry.name for entry in self._added}
        for cloud in clouds:
            with opened(cloud.path) as reader:
                header = reader.header
                names |= set(header.point_format.dimension_names)
                scales.append(header.scales)
                offsets.append(header.offsets)
                standard |= cloud.timed and not cloud.week_time
                for each in header.point_format.extra_dimensions:
                    if each.name not in own:
                        _one_meaning(extra.setdefault(each.name, each), each, cloud.path)
        wanted = 8 if "nir" in names else 7 if "red" in names else 6
        self._format = laspy.PointFormat(wanted)
        self._format.dimensions.extend(extra.values())
        for entry in self._added:
            if not entry.field:
                self._format.add_extra_dimension(extra_bytes(entry))
        self._unknown = {name: value for name in extra if (value := _unknown(name, extra[name].dtype)) is not None}
        self._records: Sequence[laspy.VLR] = ()
        header = laspy.LasHeader(version="1.4", point_format=self._format)
        header.scales, header.offsets = np.min(scales, axis=0), np.asarray(offsets[0])
        header.global_encoding.gps_time_type = (
            laspy.header.GpsTimeType.STANDARD if standard else laspy.header.GpsTimeType.WEEK_TIME
        )
        header.global_encoding.wkt = True
        crs = next((cloud.crs for cloud in clouds if cloud.crs is not None), None)
        if crs is not None:
            header.vlrs.append(WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
        self._scales, self._offsets = header.scales, header.offsets
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
        if error is not None:
            with contextlib.suppress(OSError):
                self._las.dest.close()
            return
        with storing(self._path):
            if self._records:
                self._las.write_evlrs(laspy.vlrs.vlrlist.VLRList(self._records))
            self._las.close()

    def close_with(self, records: Sequence[laspy.VLR]) -> None:
        """What is to stand behind the points when all is written."""
        self._records = records

    def write(
        self, record: Any, columns: Mapping[str, npt.NDArray[Any]], xyz_m: npt.NDArray[np.float64] | None = None
    ) -> None:
        """Append points of one of the clouds, with what is added; and other coordinates, shape (n, 3), where they were moved.

        Raises
        ------
        CaptureError
            A point lies beyond what the first cloud's offsets can hold.
        """
        out = laspy.ScaleAwarePointRecord.zeros(
            len(record), point_format=self._format, scales=self._scales, offsets=self._offsets
        )
        own = {entry.field or entry.name for entry in self._added}
        known = set(self._format.dimension_names)
        for name in record.point_format.dimension_names:
            if name == "scan_angle_rank":
                out["scan_angle"] = np.rint(np.asarray(record[name]) / 0.006).astype(np.int16)
            elif name in known and name not in own and name not in "XYZ":
                raw = name in record.array.dtype.names and name in out.array.dtype.names
                if raw:
                    out.array[name] = record.array[name]
                else:
                    out[name] = np.asarray(record[name])
        for axis, name in enumerate("XYZ"):
            place = np.asarray(record[name.lower()], np.float64) if xyz_m is None else xyz_m[:, axis]
            stored = np.rint((place - self._offsets[axis]) / self._scales[axis])
            if len(stored) and not (_INT32.min <= stored.min() and stored.max() <= _INT32.max):
                raise CaptureError(f"{self._path}: a point lies too far from the first cloud to be in one file with it")
            out[name] = stored.astype(np.int32)
        for entry in self._added:
            out[entry.field or entry.name] = np.asarray(columns[entry.name]).astype(entry.stored)
        for name, value in self._unknown.items():
            if name not in record.point_format.dimension_names:
                out.array[name] = value
        with storing(self._path):
            self._las.write_points(out)


def _one_meaning(one: Any, other: Any, path: Path) -> None:
    """Refuse extra bytes of one name that are not stored alike."""
    told = [
        (each.dtype, *(None if v is None else tuple(np.atleast_1d(v)) for v in (each.scales, each.offsets)))
        for each in (one, other)
    ]
    if told[0] != told[1]:
        raise CaptureError(
            f"{path}: its attribute {other.name} is stored as {told[1][0]} with step {told[1][1]}, in a cloud before as {told[0][0]} with "
            f"step {told[0][1]}; expected one meaning of one name"
        )


def _unknown(name: str, dtype: np.dtype[Any]) -> float | int | None:
    """What is stored where a cloud does not have an attribute; None: 0, as there is nothing that says so."""
    entry = next((each for each in TABLE if each.name == name and not each.field), None)
    if entry is not None and entry.no_data is not None:
        return entry.no_data
    return float("nan") if dtype.kind == "f" else None
