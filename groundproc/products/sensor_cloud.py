"""A cloud in the sensor's own frame, straight from the packets."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from flightlog import nmea
from flightlog.constants import HOUR_NS
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.files import written_aside
from groundproc.flight import load, timebase
from groundproc.flight.belonging import in_order_of_one_flight
from groundproc.flight.lidar import lidar_of
from groundproc.flight.positionpackets import position_samples
from groundproc.sensors.shots import Gate, Shots

COLUMNS: Final = ("intensity", "return_number", "number_of_returns", "laser", "azimuth", "range")


@dataclass(frozen=True, slots=True)
class SensorCloud:
    """What was written."""

    points: int
    time_scale: str


def write_sensor_cloud(logs: Sequence[Path], output: Path, gate: Gate, progress: Callable[[int], None]) -> SensorCloud:
    """Decode logs of one flight to a LAZ file: x right, y forward, z up.

    Times are GPS time where the lidar's clock is tied to it, else seconds of the sensor's clock past the hour of the first packet.

    Raises
    ------
    LogError
        No lidar packets, or none that gives a point.
    """
    with contextlib.ExitStack() as stack:
        readers = in_order_of_one_flight([stack.enter_context(LogReader(path)) for path in logs])
        fixes = [
            (s.device_time_ns, fix) for s in position_samples(readers).sentences if (fix := nmea.parse_rmc(s.text))
        ]
        tie = timebase.lidar_utc(fixes)
        lidar = lidar_of(readers)
        tied = tie is not None or not lidar.stamp_wraps
        about = f"{lidar.name} frame, {'GPS' if tied else 'sensor'} time"
        origin_ns: int | None = None
        offset_ns = 0
        with (
            written_aside(output) as aside,
            CloudWriter(aside, COLUMNS, gps=tied, about=about) as cloud,
        ):
            for batch in load.lidar_batches(readers, progress, lidar):
                if not len(batch.packets):
                    continue
                if origin_ns is None:
                    origin_ns = 0 if tied else int(batch.device_time_ns[0]) // HOUR_NS * HOUR_NS
                    offset_ns = tie.offset_ns if tie else -origin_ns
                for shots in lidar.decode(batch.packets, batch.device_time_ns, gate):
                    cloud.write(points_of(shots, offset_ns))
            if origin_ns is None:
                raise LogError(f"{readers[0].path}: no lidar packets in the log")
            if not cloud.points:
                raise LogError(f"{readers[0].path}: no return within the field of view and the range gate")
    return SensorCloud(cloud.points, "GPS time" if tied else "sensor time in seconds past the hour of the first packet")


def points_of(shots: Shots, offset_ns: int) -> Points:
    """Shots as points of the sensor's own frame, an offset added to their times."""
    azimuth_cdeg = np.rint(np.rad2deg(shots.azimuth_rad.astype(np.float64)) * 100.0)
    columns = {
        "intensity": shots.intensity,
        "return_number": shots.returns & 0x0F,
        "number_of_returns": shots.returns >> 4,
        "laser": shots.laser,
        # the last hundredth of a turn is rounded up to a whole one, which is 0
        "azimuth": (azimuth_cdeg % 36_000 * 0.01).astype(np.float32),
        "range": shots.range_m,
    }
    return Points(shots.time_ns + offset_ns, shots.xyz_m.astype(np.float64), columns)
