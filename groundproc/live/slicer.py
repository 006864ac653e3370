"""Packets as they come into slices of a tenth of a second."""

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc import sensors
from groundproc.estimation.odometry.grid import SLICE_NS
from groundproc.sensors import shots as seen
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import Gate

_MOST_AHEAD: Final = 40
"""Slices that may wait for the motion; what comes farther ahead is dropped."""


@dataclass(frozen=True, slots=True)
class Shots:
    """Returns of one slice.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        Lidar time.
    xyz_m : ndarray of float32, shape (n, 3)
        In the sensor frame.
    intensity : ndarray of uint8, shape (n,)
    """

    time_ns: npt.NDArray[np.int64]
    xyz_m: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint8]

    def thinned(self, step: int) -> "Shots":
        """One return in `step`."""
        if step <= 1:
            return self
        # whole copies: the kernels are compiled for these, and would be compiled anew for views
        return Shots(self.time_ns[::step].copy(), self.xyz_m[::step].copy(), self.intensity[::step].copy())


class Slicer:
    """Sorts returns by the slice that they fall in: number k is from k SLICE_NS of lidar time to the next.

    Parameters
    ----------
    gate : Gate
    lidar : Lidar, optional
        Default: the model that is flown.

    Attributes
    ----------
    last_ns : int or None
        Lidar time of the newest packet.
    late : int
        Returns whose slice had gone.
    """

    def __init__(self, gate: Gate, lidar: Lidar | None = None) -> None:
        self._lidar, self._gate = lidar or sensors.lidar(sensors.FLOWN), gate
        self._parts: dict[int, list[Shots]] = {}
        self._next: int | None = None
        self.last_ns: int | None = None
        self.late = 0

    def feed(self, packets: npt.NDArray[np.void], device_ns: npt.NDArray[np.int64]) -> None:
        """Take packets with their lidar times [ns], shape (n,)."""
        for shots in self._lidar.decode(packets, device_ns, self._gate):
            self._sort(shots)
        self.last_ns = max(int(device_ns.max()), self.last_ns or 0)

    def _sort(self, shots: seen.Shots) -> None:
        slot = shots.time_ns // SLICE_NS
        edges = [0, *(np.flatnonzero(np.diff(slot)) + 1).tolist(), len(slot)]
        for first, last in itertools.pairwise(edges):
            if first == last:
                continue
            number = int(slot[first])
            if self._next is not None and number < self._next:
                self.late += last - first
                continue
            self._parts.setdefault(number, []).append(
                Shots(shots.time_ns[first:last], shots.xyz_m[first:last], shots.intensity[first:last])
            )
        while len(self._parts) > _MOST_AHEAD:
            gone = self._parts.pop(min(self._parts))
            if self._next is not None:
                self.late += sum(len(part.time_ns) for part in gone)

    def take(self, number: int) -> Shots:
        """The returns of a slice, which may be none; later ones for it come too late."""
        self._next = number + 1
        for gone in [n for n in self._parts if n < number]:
            del self._parts[gone]
        parts = self._parts.pop(number, [])
        if not parts:
            return Shots(np.empty(0, np.int64), np.empty((0, 3), np.float32), np.empty(0, np.uint8))
        return Shots(
            np.concatenate([p.time_ns for p in parts]),
            np.concatenate([p.xyz_m for p in parts]),
            np.concatenate([p.intensity for p in parts]),
        )
