"""Points as records of LAS 1.4, point format 6 to 8, made from the table of dimensions: header, fields, totals."""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
from laspy.vlrs.known import WktCoordinateSystemVlr
from numba import njit

from flightlog import __version__
from flightlog.errors import SourceError
from groundproc.cloud.dimensions import BIT_FIELDS, Dimension, in_order
from groundproc.cloud.gpstime import gps_shift_ns
from groundproc.cloud.points import Points

SCALE_M: Final = 0.001
_INT32: Final = np.iinfo(np.int32)


class Packer:
    """Makes records of points, and keeps count for the header.

    Parameters
    ----------
    path : Path
        Named in errors.
    columns : iterable of str
        What all points have, by names of `dimensions.TABLE`.
    crs : pyproj.CRS, optional
        Written as WKT 1, as LAS 1.4 asks.
    offset_m : sequence of 3 floats
        Added to the stored whole millimetres.
    gps : bool
        Times are UTC, and are written as adjusted standard GPS time; False: they are the sensor's own, written as seconds.
    about : str
        At most 31 characters for the header's system identifier.

    Attributes
    ----------
    header : laspy.LasHeader
        Complete but for its totals.
    dtype : numpy.dtype
        Of a record.
    """

    def __init__(
        self,
        path: Path,
        columns: Iterable[str],
        *,
        crs: pyproj.CRS | None = None,
        offset_m: Sequence[float] = (0.0, 0.0, 0.0),
        gps: bool = True,
        about: str = "Velodyne HDL-32E",
    ) -> None:
        self._path, self._gps = path, gps
        self._dimensions = in_order(columns)
        self.header = _header(self._dimensions, crs, offset_m, gps, about)
        self.dtype = self.header.point_format.dtype()
        self._offset_m = np.asarray(offset_m, np.float64)
        self._limits = np.array([[_INT32.max] * 3, [_INT32.min] * 3], np.int64)
        self._by_return = np.zeros(16, np.int64)
        self.points = 0

    def pack(self, points: Points, out: npt.NDArray[np.void]) -> None:
        """Fill records, shape (n,).

        Raises
        ------
        SourceError
            A coordinate or an attribute lies beyond what its stored number can hold.
        """
        assert points.columns.keys() == {entry.name for entry in self._dimensions}, list(points.columns)
        shift_ns = gps_shift_ns(points.time_ns) if self._gps else 0
        number, returns = (points.columns.get(name) for name in BIT_FIELDS)
        one = np.ones(1, np.uint8)  # LAS counts from 1: an echo of which nothing is known is the only one
        place = tuple(out[name] for name in ("X", "Y", "Z", "gps_time", "bit_fields"))
        _pack_place(
            points.xyz_m, (points.time_ns, shift_ns), one if number is None else number, one if returns is None else returns,
            self._offset_m, place, self._limits, self._by_return,
        )  # fmt: skip
        if self._limits[0].min() < _INT32.min or self._limits[1].max() > _INT32.max:
            raise SourceError(
                f"{self._path}: a point lies more than {_INT32.max * SCALE_M / 1e3:.0f} km from the origin of the file"
            )
        for entry in self._dimensions:
            if entry.field not in BIT_FIELDS:
                self._pack_column(entry, points.columns[entry.name], out[entry.field or entry.name])
        self.points += len(points)

    def _pack_column(self, entry: Dimension, values: npt.NDArray[Any], out: npt.NDArray[Any]) -> None:
        """Fill one attribute of a piece of a buffer."""
        if entry.scale is None:
            out[:] = values
            return
        low, high = entry.steps()
        if _pack_scaled(values, 1.0 / entry.scale, low, high, entry.no_data or 0, entry.no_data is not None, out):
            raise SourceError(
                f"{self._path}: {entry.name} of {np.nanmin(values):g} to {np.nanmax(values):g} {entry.unit} found, expected "
                f"{low * entry.scale:g} to {high * entry.scale:g}, which is what its {entry.stored.itemsize} bytes can hold"
                + ("" if entry.no_data is not None else ", and no value that is not a number")
            )

    def state_totals(self, header: laspy.LasHeader) -> None:
        """Write extent and counts of all points into the header."""
        header.point_count = self.points
        header.number_of_points_by_return[:] = self._by_return[1:]
        header.mins, header.maxs = self._limits * SCALE_M + self._offset_m
        for records in header.vlrs.get("ExtraBytesVlr"):
            for each in records.extra_bytes_structs:
                # laspy counts the extent of extra bytes in the write_points() passed by above: better none than a wrong one
                each.options &= ~(each.MIN_BIT_MASK | each.MAX_BIT_MASK)


def round_origin_m(place_m: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    """Origin for the stored whole numbers of a cloud around a place, shape (3,): whole hundreds of metres, and height 0."""
    return float(np.floor(place_m[0] / 100) * 100), float(np.floor(place_m[1] / 100) * 100), 0.0


def _header(
    dimensions: Sequence[Dimension], crs: pyproj.CRS | None, offset_m: Sequence[float], gps: bool, about: str
) -> laspy.LasHeader:
    """The header of a file with some attributes; totals come at its end."""
    fields = {entry.field for entry in dimensions}
    header = laspy.LasHeader(version="1.4", point_format=8 if "nir" in fields else 7 if "red" in fields else 6)
    header.add_extra_dims([extra_bytes(entry) for entry in dimensions if not entry.field])
    header.scales, header.offsets = np.full(3, SCALE_M), np.asarray(offset_m, np.float64)
    header.generating_software, header.system_identifier = f"swath {__version__}"[:31], about[:31]
    header.creation_date = datetime.now(UTC).date()
    header.global_encoding.gps_time_type = (
        laspy.header.GpsTimeType.STANDARD if gps else laspy.header.GpsTimeType.WEEK_TIME
    )
    header.global_encoding.wkt = True
    if crs is not None:
        header.vlrs.append(WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
    return header


def extra_bytes(entry: Dimension) -> laspy.ExtraBytesParams:
    """What laspy wants to know of an attribute that no field of LAS holds."""
    scaled = entry.scale is not None
    return laspy.ExtraBytesParams(
        entry.name,
        entry.stored,
        entry.description,
        offsets=np.array([0.0]) if scaled else None,
        scales=np.array([entry.scale]) if scaled else None,
        no_data=None if entry.no_data is None else np.array([entry.no_data]),
    )


@njit(cache=True, nogil=True)
def _pack_place(
    xyz_m: Any, times: Any, number: Any, returns: Any, offset_m: Any, out: Any, limits: Any, by_return: Any
) -> None:
    """Fill place, time and returns; widen the limits of the stored coordinates, shape (2, 3), and count the returns, shape (16,).

    Times are in nanoseconds, with what is added to all of them. Return numbers of shape (1,) hold for all points.
    """
    time_ns, shift_ns = times
    out_x, out_y, out_z, out_time, out_returns = out
    each_number, each_count = int(len(number) > 1), int(len(returns) > 1)
    for i in range(len(time_ns)):
        for axis, stored in ((0, out_x), (1, out_y), (2, out_z)):
            value = np.int64(np.rint((xyz_m[i, axis] - offset_m[axis]) * (1.0 / SCALE_M)))
            stored[i] = value
            limits[0, axis] = min(limits[0, axis], value)
            limits[1, axis] = max(limits[1, axis], value)
        out_time[i] = (time_ns[i] + shift_ns) * 1e-9
        rank, count = min(number[i * each_number], 15), min(returns[i * each_count], 15)
        out_returns[i] = rank | count << 4
        by_return[rank] += 1


@njit(cache=True, nogil=True)
def _pack_scaled(values: Any, per_unit: float, low: int, high: int, no_data: int, has_no_data: bool, out: Any) -> int:
    """Fill one attribute with whole steps; gives how many lie beyond what it can hold."""
    beyond = 0
    for i in range(len(values)):
        steps = np.rint(values[i] * per_unit)
        if low <= steps <= high:
            out[i] = np.int64(steps)
        elif has_no_data and np.isnan(steps):
            out[i] = no_data
        else:
            beyond += 1
    return beyond
