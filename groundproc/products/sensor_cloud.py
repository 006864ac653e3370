"""A cloud in the sensor's own frame, straight from the packets."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog import nmea
from flightlog.constants import HOUR_NS
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from groundproc.cloud import las
from groundproc.files import make_folder, written_aside
from groundproc.flight import load, timebase
from groundproc.flight.lidar import lidar_of
from groundproc.sensors.shots import Gate, Shots


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
    make_folder(output.parent)
    with contextlib.ExitStack() as stack:
        readers = [stack.enter_context(LogReader(path)) for path in logs]
        fixes = [
            (s.device_time_ns, fix) for s in load.position_samples(readers).sentences if (fix := nmea.parse_rmc(s.text))
        ]
        tie = timebase.lidar_utc(fixes)
        lidar = lidar_of(readers)
        tied = tie is not None or not lidar.stamp_wraps
        about = f"{lidar.name} frame, {'GPS' if tied else 'sensor'} time"
        origin_ns: int | None = None
        offset_ns = 0
        with (
            written_aside(output) as aside,
            las.CloudWriter(aside, [las.LASER, las.AZIMUTH, las.RANGE], gps=tied, about=about) as cloud,
        ):
            for batch in load.lidar_batches(readers, progress, lidar):
                if not len(batch.packets):
                    continue
                if origin_ns is None:
                    origin_ns = 0 if tied else int(batch.device_time_ns[0]) // HOUR_NS * HOUR_NS
                    offset_ns = tie.offset_ns if tie else -origin_ns
                for shots in lidar.decode(batch.packets, batch.device_time_ns, gate):
                    _write(cloud, shots, _seconds(shots.time_ns + offset_ns, tied))
            if origin_ns is None:
                raise LogError(f"{readers[0].path}: no lidar packets in the log")
            if not cloud.points:
                raise LogError(f"{readers[0].path}: no return within the field of view and the range gate")
    return SensorCloud(cloud.points, "GPS time" if tied else "sensor time in seconds past the hour of the first packet")


def _seconds(time_ns: npt.NDArray[np.int64], tied: bool) -> npt.NDArray[np.float64]:
    """What stands in the file for times [ns]: GPS time of UTC, or seconds since the sensor's hour."""
    return las.gps_time_s(time_ns) if tied else np.asarray(time_ns * 1e-9, np.float64)


def _write(cloud: las.CloudWriter, shots: Shots, seconds: npt.NDArray[np.float64]) -> None:
    azimuth = np.rint(np.rad2deg(shots.azimuth_rad.astype(np.float64)) * 100.0).astype(np.uint16) % 36_000
    ranges = las.range_steps(shots.range_m)
    extras: dict[str, npt.NDArray[Any]] = {"laser": shots.laser, "azimuth": azimuth, "range": ranges}
    cloud.write(shots.xyz_m, seconds, shots.intensity, shots.returns, extras)
