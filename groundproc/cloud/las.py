"""Clouds as LAZ: LAS 1.4, point format 6, compressed on all cores."""

import queue
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import laspy
import numpy as np
import numpy.typing as npt
import pyproj
from laspy.vlrs.known import WktCoordinateSystemVlr
from numba import njit

from flightlog import __version__, clock
from flightlog.constants import NS_PER_S
from flightlog.errors import SourceError

SCALE_M: Final = 0.001
_BUFFERS: Final = 3
"""One is filled while another is compressed and the third waits: bounded memory, and neither side idle for long."""
_BUFFER_POINTS: Final = 20 * 50_000
"""lazrs compresses 50,000 points at a time on each core: a call of many such leaves no core idle at its end."""
_INT32: Final = np.iinfo(np.int32)
_ADJUSTED_S: Final = 1_000_000_000
"""Adjusted standard GPS time is GPS time less this (LAS 1.4 R15, global encoding bit 0)."""


@dataclass(frozen=True, slots=True)
class ExtraBytes:
    """An attribute beyond the point format; the stored number times `scale` is the value in `unit`."""

    name: str
    dtype: str
    about: str
    scale: float | None = None


LASER: Final = ExtraBytes("laser", "u1", "laser in firing order")
RANGE: Final = ExtraBytes("range", "u2", "range [m]", 0.002)
AZIMUTH: Final = ExtraBytes("azimuth", "u2", "azimuth [deg]", 0.01)


def range_steps(range_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """Ranges as the extra bytes hold them, in whole steps of their scale; beyond what 16 bits hold, the largest."""
    assert RANGE.scale is not None
    return np.asarray(np.minimum(np.rint(range_m / np.float32(RANGE.scale)), 65535.0), np.uint16)


def gps_time_s(utc_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Adjusted standard GPS time [s] of Unix times [ns], shape (n,)."""
    if not len(utc_ns):
        return np.empty(0)
    shift_ns = clock.utc_to_gps_ns(int(utc_ns[0])) - int(utc_ns[0]) - _ADJUSTED_S * NS_PER_S
    return np.asarray((utc_ns + shift_ns) * 1e-9)


class CloudWriter:
    """Writes one LAZ file, compressed by a thread of its own.

    Use as a context manager: the file is complete when it is left, and an error inside leaves none behind (the caller writes aside).

    Parameters
    ----------
    path : Path
    extras : sequence of ExtraBytes
    crs : pyproj.CRS, optional
        Written as WKT 1, as LAS 1.4 asks.
    offset_m : sequence of 3 floats
        Added to the stored whole millimetres.
    gps : bool
        Times are adjusted standard GPS time; False: seconds of the sensor's own clock.
    about : str
        At most 31 characters for the header's system identifier.
    """

    def __init__(
        self,
        path: Path,
        extras: Sequence[ExtraBytes],
        *,
        crs: pyproj.CRS | None = None,
        offset_m: Sequence[float] = (0.0, 0.0, 0.0),
        gps: bool = True,
        about: str = "Velodyne HDL-32E",
    ) -> None:
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.add_extra_dims([_extra(extra) for extra in extras])
        header.scales, header.offsets = np.full(3, SCALE_M), np.asarray(offset_m, np.float64)
        header.generating_software, header.system_identifier = f"swath {__version__}"[:31], about[:31]
        header.creation_date = datetime.now(UTC).date()
        header.global_encoding.gps_time_type = (
            laspy.header.GpsTimeType.STANDARD if gps else laspy.header.GpsTimeType.WEEK_TIME
        )
        header.global_encoding.wkt = True
        if crs is not None:
            header.vlrs.append(WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")))
        try:
            self._las = laspy.open(
                path, mode="w", header=header, laz_backend=laspy.LazBackend.LazrsParallel, do_compress=True
            )
        except OSError as error:
            raise SourceError(f"{path}: cannot be written ({error.strerror})") from None
        self._offset_m = np.asarray(offset_m, np.float64)
        self._limits = np.array([[_INT32.max] * 3, [_INT32.min] * 3], np.int64)
        self._by_return = np.zeros(16, np.int64)
        dtype = header.point_format.dtype()
        self._filling, self._used = np.zeros(_BUFFER_POINTS, dtype), 0
        self._full: queue.SimpleQueue[npt.NDArray[np.void] | None] = queue.SimpleQueue()
        self._free: queue.SimpleQueue[npt.NDArray[np.void]] = queue.SimpleQueue()
        for _ in range(_BUFFERS - 1):
            self._free.put(np.zeros(_BUFFER_POINTS, dtype))
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._compress, name="laz", daemon=True)
        self._thread.start()
        self.points = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._full.put(self._filling[: self._used])
        self._full.put(None)
        self._thread.join()
        if self._error is None:
            self._state_totals(self._las.header)
            self._las.close()
        else:
            self._las.dest.close()
        if self._error is not None and error is None:
            raise self._error

    def write(
        self,
        xyz_m: npt.NDArray[np.floating[Any]],
        time_s: npt.NDArray[np.float64],
        intensity: npt.NDArray[np.uint8],
        returns: npt.NDArray[np.uint8],
        extras: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        """Append points, shape (n, 3) and (n,); extras are the stored numbers, by name."""
        start = 0
        while start < len(xyz_m):
            if self._error is not None:
                raise self._error
            count = min(len(xyz_m) - start, _BUFFER_POINTS - self._used)
            part, place = slice(start, start + count), slice(self._used, self._used + count)
            out = self._filling[place]
            # return number in the low half, number of returns in the high: bit_fields as they are in LAS
            columns = tuple(out[name] for name in ("X", "Y", "Z", "gps_time", "intensity", "bit_fields"))
            values = (xyz_m[part], time_s[part], intensity[part], returns[part])
            _pack(*values, self._offset_m, columns, self._limits, self._by_return)
            for name, stored in extras.items():
                out[name] = stored[part]
            start, self._used, self.points = start + count, self._used + count, self.points + count
            if self._used == _BUFFER_POINTS:
                self._full.put(self._filling)
                self._filling, self._used = self._free.get(), 0

    def _compress(self) -> None:
        """Compress what is full, in order; the thread's work."""
        while (points := self._full.get()) is not None:
            try:
                # not its write_points(): that sorts all return numbers for the header, a tenth of the time of the whole pipeline
                if self._error is None and len(points):
                    self._las.point_writer.write_points(laspy.PackedPointRecord(points, self._las.header.point_format))
            except BaseException as error:  # handed to the producer, whatever it is
                self._error = error
            self._free.put(points)  # also after an error, so that the producer never waits for a dead thread

    def _state_totals(self, header: laspy.LasHeader) -> None:
        """Write extent and counts of all points into the header."""
        header.point_count = self.points
        header.number_of_points_by_return[:] = self._by_return[1:]
        header.mins, header.maxs = self._limits * SCALE_M + self._offset_m


@njit(cache=True, nogil=True)
def _pack(
    xyz_m: Any, time_s: Any, intensity: Any, returns: Any, offset_m: Any, columns: Any, limits: Any, by_return: Any
) -> None:
    """Fill columns of points; widen the limits of the stored coordinates, shape (2, 3), and count the returns, shape (16,)."""
    out_x, out_y, out_z, out_time, out_intensity, out_returns = columns
    for i in range(len(returns)):
        for axis, out in ((0, out_x), (1, out_y), (2, out_z)):
            value = np.int64(np.rint((xyz_m[i, axis] - offset_m[axis]) * (1.0 / SCALE_M)))
            out[i] = value
            limits[0, axis] = min(limits[0, axis], value)
            limits[1, axis] = max(limits[1, axis], value)
        out_time[i], out_intensity[i], out_returns[i] = time_s[i], intensity[i], returns[i]
        by_return[returns[i] & 0x0F] += 1


def _extra(extra: ExtraBytes) -> laspy.ExtraBytesParams:
    scales = None if extra.scale is None else np.array([extra.scale])
    offsets = None if extra.scale is None else np.array([0.0])
    return laspy.ExtraBytesParams(extra.name, np.dtype(extra.dtype), extra.about, scales=scales, offsets=offsets)
