"""Shots of a log that were aimed at some places, whether an echo came back or not."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import LogError, WrongSensorError
from flightlog.logfile import LogReader
from groundproc.flight.belonging import in_order_of_one_flight
from groundproc.flight.lidar import lidar_of
from groundproc.flight.load import lidar_batches
from groundproc.sensors.shots import Gate, LaserTable, Shots
from groundproc.sensors.velodyne import Velodyne
from groundproc.verification.panels import Panel

Array = npt.NDArray[np.float64]

MOST: Final = 400_000
"""Shots kept of a panel: more do not tell more."""
_AROUND_M: Final = 0.6
"""Beyond a panel's edge: the rim, and what its place may be off by."""


@dataclass(frozen=True, slots=True)
class Aimed:
    """Shots towards one panel, in the sensor's frame.

    Attributes
    ----------
    direction : ndarray, shape (n, 3)
    range_m : ndarray, shape (n,)
        NaN where no echo came back.
    intensity : ndarray, shape (n,)
    laser : ndarray of uint8, shape (n,)
    second : ndarray of bool, shape (n,)
        The further of two echoes of a shot, which is no shot of its own.
    """

    direction: Array
    range_m: Array
    intensity: Array
    laser: npt.NDArray[np.uint8]
    second: npt.NDArray[np.bool_]

    def __getitem__(self, some: npt.NDArray[np.bool_]) -> "Aimed":
        return Aimed(
            self.direction[some], self.range_m[some], self.intensity[some], self.laser[some], self.second[some]
        )


@dataclass(frozen=True, slots=True)
class Recording:
    """What a log holds of the panels.

    Attributes
    ----------
    lidar : Velodyne
    aimed : list of Aimed
        For each panel.
    shots : int
        All that were fired in the field of view.
    """

    lidar: Velodyne
    aimed: list[Aimed]
    shots: int


def read_aimed(logs: Sequence[Path], panels: Sequence[Panel], progress: Callable[[int], None]) -> Recording:
    """Read logs of one recording on a tripod.

    Raises
    ------
    LogError, WrongSensorError
        No lidar packets in them, or not those of a sensor whose shots without an echo are known.
    """
    kept: list[list[Aimed]] = [[] for _ in panels]
    total = 0
    with contextlib.ExitStack() as stack:
        readers = in_order_of_one_flight([stack.enter_context(LogReader(path)) for path in logs])
        lidar = lidar_of(readers)
        if not isinstance(lidar, Velodyne):
            raise WrongSensorError(f"{readers[0].path}: is of a {lidar.name}, expected a Velodyne")
        # beams of all lasers go through one point here: their parallax of centimetres would turn a shot without an echo away
        lasers = LaserTable.of_elevations(np.rad2deg(lidar.lasers.elevation_rad))
        for batch in lidar_batches(readers, progress, lidar):
            if not len(batch.packets):
                continue
            for shots in lidar.decode(lidar.with_all_shots(batch.packets), batch.device_time_ns, Gate(), lasers):
                total += len(shots)
                for panel, found in zip(panels, kept, strict=True):
                    if sum(len(each.laser) for each in found) < MOST:
                        found.append(_towards(shots, panel, lidar.nothing_m))
        if not total:
            raise LogError(f"{readers[0].path}: no lidar packets in the log")
    return Recording(lidar, [_joined(found) for found in kept], total)


def _towards(shots: Shots, panel: Panel, nothing_m: float) -> Aimed:
    """Those whose beam passes the panel or its surroundings."""
    middle = panel.middle_m
    reach = np.hypot(*panel.size_m) / 2.0 + _AROUND_M
    xyz = shots.xyz_m.astype(np.float64)
    direction = xyz / np.linalg.norm(xyz, axis=1)[:, None]
    along = direction @ middle
    off = np.linalg.norm(np.cross(direction, middle), axis=1)
    near = (along > 0.0) & (off < reach)
    range_m = np.where(shots.range_m[near] > 1.5 * nothing_m, np.linalg.norm(xyz[near], axis=1), np.nan)
    returns = shots.returns[near]
    second = ((returns & 0x0F) > 1) & ((returns >> 4) > 1)
    return Aimed(direction[near], range_m, shots.intensity[near].astype(np.float64), shots.laser[near], second)


def _joined(parts: Sequence[Aimed]) -> Aimed:
    if not parts:
        return Aimed(np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, np.uint8), np.empty(0, np.bool_))
    return Aimed(*(np.concatenate([getattr(each, name) for each in parts]) for name in Aimed.__slots__))
