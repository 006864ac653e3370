"""Scans for a lidar odometry: revolutions from behind to behind, with the time of each point, not yet deskewed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flightlog.logfile import LogReader
from groundproc.accuracy.cloud import GATE
from groundproc.flight import load
from groundproc.sensors import hdl32e as decode

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Scan:
    """The returns of one revolution.

    Attributes
    ----------
    points_m : ndarray, shape (n, 3)
        In the sensor frame at each point's own time.
    time_ns : ndarray of int64, shape (n,)
        Lidar time; grows.
    """

    points_m: Array
    time_ns: Times

    @property
    def end_ns(self) -> int:
        """Time of the last point: that of the scan's pose."""
        return int(self.time_ns[-1])


def scans(readers: Sequence[LogReader]) -> Iterator[Scan]:
    """The whole revolutions of a log, cut behind the aircraft, where the field of view leaves the airframe out."""
    waiting: list[npt.NDArray[np.void]] = []
    times: list[Times] = []
    first = True
    for batch in load.lidar_batches(readers):
        past = (batch.packets["data"]["blocks"]["azimuth"][:, 0].astype(np.int64) + 18_000) % 36_000
        cuts = np.flatnonzero(np.diff(past) < -18_000) + 1
        if waiting and len(past) and past[0] < _last(waiting) - 18_000:
            cuts = np.concatenate([[0], cuts])
        start = 0
        for cut in [*cuts.tolist(), None]:
            waiting.append(batch.packets[start:cut])
            times.append(batch.device_time_ns[start:cut])
            if cut is None:
                break
            scan = _scan(waiting, times)
            if scan is not None and not first:  # the first is a part of a revolution
                yield scan
            waiting, times, start, first = [], [], cut, False
        if not len(waiting[-1]):
            waiting.pop()
            times.pop()


def _last(parts: Sequence[npt.NDArray[np.void]]) -> int:
    """Azimuth of the last packet [0.01 deg], counted from behind."""
    return (int(parts[-1]["data"]["blocks"]["azimuth"][-1, 0]) + 18_000) % 36_000


def _scan(parts: Sequence[npt.NDArray[np.void]], times: Sequence[Times]) -> Scan | None:
    shots = decode.decode(load.joined(parts), np.concatenate(times), GATE)
    return Scan(shots.xyz_m.astype(np.float64), shots.time_ns) if len(shots) else None
