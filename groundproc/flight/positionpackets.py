"""Position packets of a flight as arrays: the gyros, accelerometers and GPS sentences of the lidar itself, 200 times a second."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.logfile import LogReader, Message
from groundproc.flight.load import DeviceClock, Progress, first_stamp, in_order
from groundproc.sensors import velodyne
from groundproc.sensors.model import Readings


@dataclass(frozen=True, slots=True)
class Sentence:
    """A GPS sentence when it first appeared in a position packet."""

    device_time_ns: int
    receive_time_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class PositionSamples:
    """The position packets of a flight, in order.

    Attributes
    ----------
    device_time_ns : ndarray of int64, shape (n,)
        Stamps on the lidar's own clock, on the scale of LidarBatch.device_time_ns [ns].
    receive_time_ns : ndarray of int64, shape (n,)
        Receive times [ns of log time].
    gyro_rad_s : ndarray of float64, shape (n, 3)
        Angular rate in the sensor frame; zero offsets of tens of deg/s are normal.
    accel_m_s2 : ndarray of float64, shape (n, 3)
        Specific force in the sensor frame.
    temperature_c : ndarray of float64, shape (n, 3)
    has_imu : ndarray of bool, shape (n,)
        Whether the packet carries readings of the gyros at all.
    pps : ndarray of uint8, shape (n,)
        flightlog.hdl32e.PpsState.
    sentences : list of Sentence
        Each when it first appeared.
    clock_jumps : int
        How often the lidar's or the host's clock was set while they were recorded.
    """

    device_time_ns: npt.NDArray[np.int64]
    receive_time_ns: npt.NDArray[np.int64]
    gyro_rad_s: npt.NDArray[np.float64]
    accel_m_s2: npt.NDArray[np.float64]
    temperature_c: npt.NDArray[np.float64]
    has_imu: npt.NDArray[np.bool_]
    pps: npt.NDArray[np.uint8]
    sentences: list[Sentence]
    clock_jumps: int


def position_samples(readers: Sequence[LogReader], progress: Progress | None = None) -> PositionSamples:
    """Read all position packets of one or several logs."""
    collector = PositionCollector(first_stamp(readers))
    for reader in in_order(readers):
        for message in reader.messages((records.POSITION.topic,), progress):
            collector.feed(message)
    return collector.samples()


class PositionCollector:
    """Gathers the position packets of a flight, message by message: their columns, not the packets, 512 bytes for the 37 that count.

    Parameters
    ----------
    device : DeviceClock
        Of `first_stamp`.
    """

    def __init__(self, device: DeviceClock) -> None:
        self._device = device
        self._parts = [_NO_SAMPLES]
        self._sentences: list[Sentence] = []

    def feed(self, message: Message) -> None:
        """Take the next message of the position topic."""
        receive_ns, packets = records.decode_position(message.data)
        good = velodyne.is_position(packets)
        receive_ns, packets = receive_ns[good], packets[good]
        if not len(packets):
            return
        device_ns, _ = self._device.extend(packets["stamp_us"], receive_ns)
        batch = PositionBatch(velodyne.readings(packets), receive_ns, device_ns)
        self._parts.append(_samples(batch))
        self._sentences += new_sentences(batch, self._sentences[-1].text if self._sentences else "")

    def samples(self) -> PositionSamples:
        """All that was fed."""
        device_ns, receive_ns, gyro, accel, temperature, has_imu, pps = (
            np.concatenate(column) for column in zip(*self._parts, strict=True)
        )
        return PositionSamples(
            device_ns, receive_ns, gyro, accel, temperature, has_imu, pps, self._sentences, self._device.jumps
        )


@dataclass(frozen=True, slots=True)
class PositionBatch:
    """The position packets of one message, read; times as in LidarBatch."""

    readings: Readings
    receive_time_ns: npt.NDArray[np.int64]
    device_time_ns: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.device_time_ns)


def _samples(batch: PositionBatch) -> tuple[npt.NDArray[Any], ...]:
    """The columns of PositionSamples, in its order."""
    read = batch.readings
    return (
        batch.device_time_ns,
        batch.receive_time_ns,
        read.gyro_rad_s,
        read.accel_m_s2,
        read.temperature_c,
        read.has_imu,
        read.pps,
    )


_NO_SAMPLES: Final = _samples(
    PositionBatch(velodyne.readings(velodyne.position_packets(b"")), np.empty(0, np.int64), np.empty(0, np.int64))
)


def new_sentences(batch: PositionBatch, last: str) -> list[Sentence]:
    """The sentences of a batch that differ from the one before, the first from `last`."""
    texts = batch.readings.sentences
    changed = np.ones(len(texts), np.bool_)
    changed[1:] = texts[1:] != texts[:-1]
    found: list[Sentence] = []
    for i in np.flatnonzero(changed):
        text = bytes(texts[i]).split(b"\x00")[0].decode("ascii", errors="replace").strip()
        if text and text != last:
            found.append(Sentence(int(batch.device_time_ns[i]), int(batch.receive_time_ns[i]), text))
            last = text
    return found
