"""Scans for a lidar odometry: revolutions from behind to behind, with the time of each point, not yet deskewed."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flightlog.logfile import LogReader
from groundproc.accuracy.cloud import GATE
from groundproc.flight import load
from groundproc.flight.lidar import lidar_of
from groundproc.sensors.shots import Shots, turns

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
    waiting: list[Shots] = []
    first, azimuth_rad = True, None
    lidar = lidar_of(readers)
    for batch in load.lidar_batches(readers, None, lidar):
        for shots in lidar.decode(batch.packets, batch.device_time_ns, GATE):
            if not len(shots):
                continue
            azimuth = shots.azimuth_rad
            cuts = turns(azimuth, azimuth_rad).tolist()
            azimuth_rad = float(azimuth[-1])
            for start, cut in itertools.pairwise([0, *cuts, None]):
                waiting.append(shots[start:cut])
                if cut is None:
                    break
                scan = _scan(waiting)
                if scan is not None and not first:  # the first is a part of a revolution
                    yield scan
                waiting, first = [], False


def _scan(parts: Sequence[Shots]) -> Scan | None:
    xyz = np.concatenate([part.xyz_m for part in parts]).astype(np.float64)
    return Scan(xyz, np.concatenate([part.time_ns for part in parts])) if len(xyz) else None
