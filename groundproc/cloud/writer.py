"""Clouds as LAZ, compressed on all cores."""

import queue
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import laspy
import numpy as np
import numpy.typing as npt
import pyproj

from groundproc.cloud.packer import Packer
from groundproc.cloud.points import Points
from groundproc.cloud.setaside import SetAside
from groundproc.cloud.storing import begun, ended, storing
from groundproc.machine.system import cores

BUFFER_POINTS: Final = min(max(5 * cores(), 5), 20) * 50_000
"""lazrs compresses 50,000 points at a time on each core: a call of several such for each leaves none idle for long at its end."""
_BUFFERS: Final = 3
"""One is filled while another is compressed and the third waits: bounded memory, and neither side idle for long."""


class CloudWriter:
    """Writes one LAZ file, compressed by a thread of its own.

    Use as a context manager: the file is complete when it is left, and an error inside leaves none behind (the caller writes aside).

    Parameters
    ----------
    path : Path
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
    aside : SetAside, optional
        Keeps what it wants of the records.

    Raises
    ------
    SourceError
        The file cannot be written.
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
        aside: SetAside | None = None,
    ) -> None:
        self._path, self._aside = path, aside
        self._packer = Packer(path, columns, crs=crs, offset_m=offset_m, gps=gps, about=about)
        self._las = begun(path, self._packer.header)
        self._filling, self._used = np.zeros(BUFFER_POINTS, self._packer.dtype), 0
        self._full: queue.SimpleQueue[npt.NDArray[np.void] | None] = queue.SimpleQueue()
        self._free: queue.SimpleQueue[npt.NDArray[np.void]] = queue.SimpleQueue()
        for _ in range(_BUFFERS - 1):
            self._free.put(np.zeros(BUFFER_POINTS, self._packer.dtype))
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._compress, name="laz", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._full.put(self._filling[: self._used])
        self._full.put(None)
        self._thread.join()
        if self._error is None:
            self._packer.state_totals(self._las.header)
        ended(self._las, self._path, self._error is not None)
        if self._error is not None and error is None:
            raise self._error

    @property
    def points(self) -> int:
        """How many were written."""
        return self._packer.points

    def write(self, points: Points) -> None:
        """Append points.

        Raises
        ------
        SourceError
            A coordinate or an attribute lies beyond what its stored number can hold.
        """
        start = 0
        while start < len(points):
            if self._error is not None:
                raise self._error
            count = min(len(points) - start, BUFFER_POINTS - self._used)
            self._packer.pack(
                points.masked(slice(start, start + count)), self._filling[self._used : self._used + count]
            )
            start, self._used = start + count, self._used + count
            if self._used == BUFFER_POINTS:
                self._full.put(self._filling)
                self._filling, self._used = self._free.get(), 0

    def _compress(self) -> None:
        """Compress what is full, in order; the thread's work."""
        while (points := self._full.get()) is not None:
            try:
                # not its write_points(): that sorts all return numbers for the header, a tenth of the time of the whole pipeline
                if self._error is None and len(points):
                    with storing(self._path):
                        record = laspy.PackedPointRecord(points, self._las.header.point_format)
                        self._las.point_writer.write_points(record)
                    if self._aside is not None:
                        self._aside.see(points)
            except BaseException as error:  # handed to the producer, whatever it is
                self._error = error
            self._free.put(points)  # also after an error, so that the producer never waits for a dead thread
