"""One layout for the points of several clouds: LAS 1.4, point format 6 to 8, with every attribute that any of them has."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import WktCoordinateSystemVlr

from flightlog.errors import CaptureError
from groundproc.cloud.dimensions import TABLE, Dimension, in_order
from groundproc.cloud.packer import extra_bytes
from groundproc.cloud.reader import Cloud, opened

_INT32: Final = np.iinfo(np.int32)
_ANGLE_STEP_DEG: Final = 0.006


class Layout:
    """How points of some clouds are stored together.

    Extra bytes of all clouds are kept. Where one lacks them they are not known: not a number, or what stands for no data where the table
    has them, else 0. The least step and the first cloud's offsets are taken: points of that cloud, or of others whose offsets differ by
    whole steps, stay where they are; others move by half a step at most.

    Parameters
    ----------
    clouds : sequence of Cloud
        Of one CRS, the first's.
    added : iterable of str
        Attributes of the table that come with the points.

    Raises
    ------
    CaptureError
        Extra bytes of one name are of different types or steps.
    """

    def __init__(self, clouds: Sequence[Cloud], added: Iterable[str] = ()) -> None:
        self._first, self._added = clouds[0], in_order(added)
        own = {entry.name for entry in self._added}
        names, extra, self._scales, self._offsets = _found(clouds, own)
        self.form = laspy.PointFormat(8 if "nir" in names else 7 if "red" in names else 6)
        self.form.dimensions.extend(extra.values())
        for entry in self._added:
            if not entry.field:
                self.form.add_extra_dimension(extra_bytes(entry))
        self._unknown = {name: value for name in extra if (value := _unknown(name, extra[name].dtype)) is not None}
        self._known = set(self.form.dimension_names) - {entry.field or entry.name for entry in self._added} - set("XYZ")
        self._standard = any(cloud.timed and not cloud.week_time for cloud in clouds)
        self._crs = next((cloud.crs for cloud in clouds if cloud.crs is not None), None)

    def header(self) -> laspy.LasHeader:
        """A header, complete but for its totals."""
        header = laspy.LasHeader(version="1.4", point_format=self.form)
        header.scales, header.offsets = self._scales, self._offsets
        header.global_encoding.gps_time_type = (
            laspy.header.GpsTimeType.STANDARD if self._standard else laspy.header.GpsTimeType.WEEK_TIME
        )
        header.global_encoding.wkt = True
        if self._crs is not None:
            header.vlrs.append(WktCoordinateSystemVlr(self._crs.to_wkt("WKT1_GDAL")))
        return header

    def laid(
        self,
        record: Any,
        columns: Mapping[str, npt.NDArray[Any]] | None = None,
        xyz_m: npt.NDArray[np.float64] | None = None,
    ) -> Any:
        """Points of one of the clouds as they are stored together.

        Parameters
        ----------
        record : laspy.ScaleAwarePointRecord
        columns : mapping of str to ndarray, shape (n,), optional
            Values of what is added.
        xyz_m : ndarray, shape (n, 3), optional
            Other coordinates, where they were moved.

        Returns
        -------
        laspy.ScaleAwarePointRecord

        Raises
        ------
        CaptureError
            A point lies beyond what the first cloud's offsets can hold.
        """
        out = laspy.ScaleAwarePointRecord.zeros(
            len(record), point_format=self.form, scales=self._scales, offsets=self._offsets
        )
        for name in record.point_format.dimension_names:
            if name == "scan_angle_rank":
                out["scan_angle"] = angle_of_rank(record[name])
            elif name in self._known:
                if name in record.array.dtype.names and name in out.array.dtype.names:
                    out.array[name] = record.array[name]
                else:
                    out[name] = np.asarray(record[name])
        for axis, name in enumerate("XYZ"):
            place = np.asarray(record[name.lower()], np.float64) if xyz_m is None else xyz_m[:, axis]
            stored = np.rint((place - self._offsets[axis]) / self._scales[axis])
            if len(stored) and not (_INT32.min <= stored.min() and stored.max() <= _INT32.max):
                raise CaptureError(
                    f"{self._first.path}: a point lies too far from this cloud to be in one file with it"
                )
            out[name] = stored.astype(np.int32)
        for entry in self._added:
            out[entry.field or entry.name] = np.asarray((columns or {})[entry.name]).astype(entry.stored)
        for name, value in self._unknown.items():
            if name not in record.point_format.dimension_names:
                out.array[name] = value
        return out


def angle_of_rank(rank_deg: Any) -> npt.NDArray[np.int16]:
    """The field `scan_angle` of LAS 1.4, in steps of 0.006 deg, of `scan_angle_rank` of point formats 0 to 5, in whole degrees."""
    return np.rint(np.asarray(rank_deg) / _ANGLE_STEP_DEG).astype(np.int16)


def _found(
    clouds: Sequence[Cloud], own: set[str]
) -> tuple[set[str], dict[str, Any], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """What the headers say: all names, extra bytes but for `own`, least steps, offsets by which they hold all clouds."""
    names: set[str] = set()
    extra: dict[str, Any] = {}
    scales, offsets, bounds = [], [], []
    for cloud in clouds:
        with opened(cloud.path) as reader:
            header = reader.header
            names |= set(header.point_format.dimension_names)
            scales.append(header.scales)
            offsets.append(header.offsets)
            bounds += [header.mins, header.maxs]
            for each in header.point_format.extra_dimensions:
                if each.name not in own:
                    _one_meaning(extra.setdefault(each.name, each), each, cloud.path)
    least = np.min(scales, axis=0)
    return names, extra, least, _holding(np.asarray(offsets[0]), least, np.asarray(bounds))


def _holding(
    offsets: npt.NDArray[np.float64], steps: npt.NDArray[np.float64], bounds: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Offsets of the first cloud; where its coarse steps reach all places of the clouds, shape (n, 3), and the least do not, moved there.

    By whole steps, so that its points stay.
    """
    middle = (bounds.min(axis=0) + bounds.max(axis=0)) / 2.0
    short = ~(np.abs(bounds - offsets).max(axis=0) / steps <= _INT32.max) & np.isfinite(middle)
    return np.asarray(np.where(short, offsets + np.rint((middle - offsets) / steps) * steps, offsets))


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
    entry: Dimension | None = next((each for each in TABLE if each.name == name and not each.field), None)
    if entry is not None and entry.no_data is not None:
        return entry.no_data
    return float("nan") if dtype.kind == "f" else None
