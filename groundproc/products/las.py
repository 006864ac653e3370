"""Clouds as LAZ: LAS 1.4, point format 6, compressed on all cores behind the caller's back."""

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

from flightlog import __version__, clock
from flightlog.constants import NS_PER_S
from flightlog.errors import SourceError

SCALE_M: Final = 0.001
_QUEUE: Final = 3
"""Chunks that may wait for the compressor: bounded memory, and the producer never idle."""
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


def gps_time_s(utc_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Adjusted standard GPS time [s] of Unix times [ns], shape (n,)."""
    if not len(utc_ns):
        return np.empty(0)
    shift_ns = clock.utc_to_gps_ns(int(utc_ns[0])) - int(utc_ns[0]) - _ADJUSTED_S * NS_PER_S
    return np.asarray((utc_ns + shift_ns) * 1e-9)


class CloudWriter:
    """Writes one LAZ file, chunk by chunk, from a thread of its own.

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
        header = _Header(version="1.4", point_format=6)
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
        self._header = header
        self._dtype = header.point_format.dtype()
        self._chunks: queue.Queue[npt.NDArray[np.void] | None] = queue.Queue(_QUEUE)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._compress, name="laz", daemon=True)
        self._thread.start()
        self.points = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._chunks.put(None)
        self._thread.join()
        if self._error is None:
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
        if self._error is not None:
            raise self._error
        if not len(xyz_m):
            return
        points = np.zeros(len(xyz_m), self._dtype)
        offsets = self._header.offsets
        for axis, name in enumerate("XYZ"):
            points[name] = np.rint((xyz_m[:, axis] - offsets[axis]) * (1.0 / SCALE_M))
        points["gps_time"] = time_s
        points["intensity"] = intensity
        points["bit_fields"] = returns  # return number in the low half, number of returns in the high: as in LAS
        for name, values in extras.items():
            points[name] = values
        self.points += len(points)
        self._chunks.put(points)

    def _compress(self) -> None:
        while (points := self._chunks.get()) is not None:
            if self._error is not None:
                continue  # keep taking, so that the producer never waits for a dead thread
            try:
                self._las.write_points(laspy.PackedPointRecord(points, self._header.point_format))
            except BaseException as error:  # handed to the producer, whatever it is
                self._error = error


class _Header(laspy.LasHeader):  # type: ignore[misc]  # laspy has no types that mypy would see
    """A header that counts returns by bins: laspy sorts all of them, a tenth of the time of the whole pipeline."""

    mins: npt.NDArray[np.float64]
    maxs: npt.NDArray[np.float64]

    def grow(self, points: laspy.PackedPointRecord) -> None:
        """Take extent and counts of points."""
        array = points.array
        scaled = [(array[name].min(), array[name].max()) for name in "XYZ"]
        low, high = (np.array(values) * self.scales + self.offsets for values in zip(*scaled, strict=True))
        self.mins, self.maxs = np.minimum(self.mins, low), np.maximum(self.maxs, high)
        counts = np.bincount(array["bit_fields"] & 0x0F, minlength=16)[1:]
        self.number_of_points_by_return += counts.astype(self.number_of_points_by_return.dtype)
        self.point_count += len(array)


def _extra(extra: ExtraBytes) -> laspy.ExtraBytesParams:
    scales = None if extra.scale is None else np.array([extra.scale])
    offsets = None if extra.scale is None else np.array([0.0])
    return laspy.ExtraBytesParams(extra.name, np.dtype(extra.dtype), extra.about, scales=scales, offsets=offsets)
