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
from groundproc.flight.timebase import UtcTie
from groundproc.sensors import hdl32e as decode
from groundproc.sensors import identity as sensor_model
from groundproc.sensors.hdl32e import Gate, Shots


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
            las.CloudWriter(aside, [las.LASER, las.AZIMUTH, las.RANGE], gps=tie is not None, about=about) as cloud,
        ):
            for batch in load.lidar_batches(readers, progress):
                if not len(batch.packets):
                    continue
                if origin_ns is None:
                    sensor_model.refuse_other_models(batch.packets["data"], str(readers[0].path))
                    origin_ns = int(batch.device_time_ns[0]) // HOUR_NS * HOUR_NS
                for packets, time_ns in decode.by_mode(batch.packets, batch.device_time_ns):
                    shots = decode.decode(packets, time_ns, gate)
                    _write(cloud, shots, _seconds(shots.time_ns, origin_ns, tie))
            if origin_ns is None:
                raise LogError(f"{readers[0].path}: no lidar packets in the log")
            if not cloud.points:
                raise LogError(f"{readers[0].path}: no return within the field of view and the range gate")
    return SensorCloud(cloud.points, "GPS time" if tie else "sensor time in seconds past the hour of the first packet")


def _seconds(time_ns: npt.NDArray[np.int64], origin_ns: int, tie: UtcTie | None) -> npt.NDArray[np.float64]:
    """What stands in the file for lidar times [ns]: GPS time, or seconds since an origin."""
    if tie is None:
        return np.asarray((time_ns - origin_ns) * 1e-9, np.float64)
    return las.gps_time_s(time_ns + tie.offset_ns)


def _write(cloud: las.CloudWriter, shots: Shots, seconds: npt.NDArray[np.float64]) -> None:
    azimuth = np.rint(shots.azimuth_cdeg).astype(np.uint16) % 36_000
    extras: dict[str, npt.NDArray[Any]] = {"laser": shots.laser, "azimuth": azimuth, "range": shots.range_steps}
    cloud.write(shots.xyz_m, seconds, shots.intensity, shots.returns, extras)
