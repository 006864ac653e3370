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
from flightlog.hdl32e import RANGE_LSB_M
from flightlog.logfile import LogReader
from groundproc.cloud.points import Points
from groundproc.cloud.writer import CloudWriter
from groundproc.files import make_folder, written_aside
from groundproc.flight import load, timebase
from groundproc.sensors import hdl32e as decode
from groundproc.sensors import identity as sensor_model
from groundproc.sensors.hdl32e import Gate, Shots

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
    make_folder(output.parent)
    with contextlib.ExitStack() as stack:
        readers = [stack.enter_context(LogReader(path)) for path in logs]
        fixes = [
            (s.device_time_ns, fix) for s in load.position_samples(readers).sentences if (fix := nmea.parse_rmc(s.text))
        ]
        tie = timebase.lidar_utc(fixes)
        about = "sensor frame, GPS time" if tie else "sensor frame, sensor time"
        origin_ns: int | None = None
        with (
            written_aside(output) as aside,
            CloudWriter(aside, COLUMNS, gps=tie is not None, about=about) as cloud,
        ):
            for batch in load.lidar_batches(readers, progress):
                if not len(batch.packets):
                    continue
                if origin_ns is None:
                    sensor_model.refuse_other_models(batch.packets["data"], str(readers[0].path))
                    origin_ns = int(batch.device_time_ns[0]) // HOUR_NS * HOUR_NS
                for packets, time_ns in decode.by_mode(batch.packets, batch.device_time_ns):
                    shots = decode.decode(packets, time_ns, gate)
                    cloud.write(points_of(shots, origin_ns if tie is None else -tie.offset_ns))
            if origin_ns is None:
                raise LogError(f"{readers[0].path}: no lidar packets in the log")
            if not cloud.points:
                raise LogError(f"{readers[0].path}: no return within the field of view and the range gate")
    return SensorCloud(cloud.points, "GPS time" if tie else "sensor time in seconds past the hour of the first packet")


def points_of(shots: Shots, origin_ns: int) -> Points:
    """Shots as points of the sensor's own frame, their times counted from an origin."""
    # the last hundredth of a turn is rounded up to a whole one, which is 0
    azimuth_cdeg = np.rint(shots.azimuth_cdeg) % 36_000
    columns = {
        "intensity": shots.intensity,
        "return_number": shots.returns & 0x0F,
        "number_of_returns": shots.returns >> 4,
        "laser": shots.laser,
        "azimuth": np.multiply(azimuth_cdeg, 0.01, dtype=np.float32),
        "range": np.multiply(shots.range_steps, RANGE_LSB_M, dtype=np.float32),
    }
    return Points(shots.time_ns - origin_ns, shots.xyz_m.astype(np.float64), columns)
