"""Flight logs into arrays: lidar batches, position samples and MAVLink frames, with the lidar's clock carried on.

Several logs of one flight are read one after the other in the order of their times. What is read once per message is streamed;
position samples, 200 a second, are given whole.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import clock, records
from flightlog.constants import HOUR_NS, NS_PER_S, NS_PER_US
from flightlog.logfile import LogReader, Message
from flightlog.mavlink import Frame, FrameParser
from flightlog.records import LidarAccount
from flightlog.signing import is_signed
from groundproc.flight.lidar import lidar_of
from groundproc.sensors import velodyne
from groundproc.sensors.model import Lidar, Readings
from groundproc.sensors.sequence import sequenced

Progress = Callable[[int], None]

JUMP_NS: Final = NS_PER_S // 2
"""Lidar and host clock drift apart by less than this between two batches; more, and one of them was set."""


@dataclass(frozen=True, slots=True)
class LidarBatch:
    """The packets of one message: about 0.1 s, or a line of a line scanner.

    Attributes
    ----------
    log_time_ns : int
        Log time of the message [ns].
    packets : structured ndarray, shape (n,)
        Records as the lidar's model has them; may be empty: everything was masked.
    receive_time_ns : ndarray of int64, shape (n,)
        Receive times [ns of log time].
    device_time_ns : ndarray of int64, shape (n,)
        Stamps on the lidar's own clock, carried on over the hour and from log to log [ns]; the first lies within half an hour of
        its receive time.
    account : LidarAccount or None
        What became of the packets; None where the log does not say.
    jumped : bool
        Either clock was set since the batch before: times before and after do not compare.
    duplicates, moved : int
        Packets that were there twice and left out, and that stood behind later ones and were put in their place.
    """

    log_time_ns: int
    packets: npt.NDArray[np.void]
    receive_time_ns: npt.NDArray[np.int64]
    device_time_ns: npt.NDArray[np.int64]
    account: LidarAccount | None
    jumped: bool = False
    duplicates: int = 0
    moved: int = 0


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


@dataclass(slots=True)
class DeviceClock:
    """Carries the stamps of one stream of the lidar's packets on, from batch to batch.

    Attributes
    ----------
    device_ns, receive_ns : int or None
        Of the last packet, or of another stream's first where this one is to use the same hour.
    """

    device_ns: int | None = None
    receive_ns: int | None = None
    jumps: int = 0

    def extend(
        self, stamps_us: npt.NDArray[np.uint32], receive_time_ns: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.int64], bool]:
        """Lidar time [ns], shape (n,), of the next n > 0 stamps [us past the hour]; and whether a clock jumped before them."""
        if self.device_ns is None or self.receive_ns is None:
            stamp_ns = int(stamps_us[0]) * NS_PER_US
            self.receive_ns = int(receive_time_ns[0])
            self.device_ns = stamp_ns + clock.nearest_hour_ns(stamp_ns, self.receive_ns)
        host_ns = np.concatenate([np.array([self.receive_ns], np.int64), receive_time_ns])
        device_ns = clock.unwrap_top_of_hour_ns(stamps_us, host_ns, self.device_ns)
        passed_ns = np.diff(device_ns, prepend=self.device_ns) - np.diff(host_ns)
        jumped = bool((np.abs(passed_ns) > JUMP_NS).any())
        self.jumps += jumped
        self.device_ns, self.receive_ns = int(device_ns[-1]), int(receive_time_ns[-1])
        return device_ns, jumped


def in_order(readers: Sequence[LogReader]) -> list[LogReader]:
    """The logs by the time of their first message."""
    return sorted(readers, key=lambda reader: reader.start_ns)


def first_stamp(readers: Sequence[LogReader], lidar: Lidar | None = None) -> DeviceClock:
    """A clock that stands at the first lidar packet, or at the first position packet where there is none.

    Every stream of the lidar starts from it, so that all of them agree about the hour.
    """
    lidar = lidar or lidar_of(readers)
    for topic in (lidar.topic, records.POSITION.topic):
        for reader in in_order(readers):
            for message in reader.messages((topic,)):
                if topic == lidar.topic:
                    packets = lidar.unpack(message.data)
                    stamps_us, receive_ns = stamps_of(lidar, packets), lidar.receive_time_ns(packets)
                else:
                    receive_ns, position = records.decode_position(message.data)
                    stamps_us = position["stamp_us"]
                if len(stamps_us):
                    anchor = DeviceClock()
                    anchor.extend(stamps_us[:1], receive_ns[:1])
                    return anchor
    return DeviceClock()


def stamps_of(lidar: Lidar, packets: npt.NDArray[np.void]) -> npt.NDArray[np.uint32]:
    """Stamps past the hour [us], shape (n,)."""
    return np.asarray(lidar.stamp_ns(packets) % HOUR_NS // NS_PER_US, np.uint32)


def lidar_batches(
    readers: Sequence[LogReader], progress: Progress | None = None, lidar: Lidar | None = None
) -> Iterator[LidarBatch]:
    """Stream the lidar packets of one or several logs, each message with its account."""
    lidar = lidar or lidar_of(readers)
    joiner = BatchJoiner(lidar, first_stamp(readers, lidar))
    for reader in in_order(readers):
        for message in reader.messages(joiner.topics, progress):
            yield from joiner.feed(message)
        yield from joiner.finish()


class BatchJoiner:
    """Joins packets and account, two messages of one log time that may come in either order."""

    def __init__(self, lidar: Lidar, device: DeviceClock) -> None:
        self.topics = (lidar.topic, records.LIDAR_ACCOUNT.topic)
        self.device = device
        self._lidar = lidar
        self._log_time_ns = -1
        self._packets: list[npt.NDArray[np.void]] = []
        self._account: LidarAccount | None = None

    def feed(self, message: Message) -> list[LidarBatch]:
        """Take a message of `topics`; give the batch before it, when it is complete."""
        done = self.finish() if message.log_time_ns != self._log_time_ns else []
        self._log_time_ns = message.log_time_ns
        if message.topic == self._lidar.topic:
            self._packets.append(self._lidar.unpack(message.data))
        else:
            self._account = records.decode_account(message.data)
        return done

    def finish(self) -> list[LidarBatch]:
        """Give the last batch."""
        if not self._packets and self._account is None:
            return []
        if not self._packets:
            self._packets = [np.empty(0, records.SCAN_PACKET_DTYPE)]
        packets = joined(self._packets)
        account, self._packets, self._account = self._account, [], None
        if not len(packets):
            nothing = np.empty(0, np.int64)
            return [LidarBatch(self._log_time_ns, packets, nothing, nothing, account)]
        found = None
        if self._lidar.stamp_wraps:
            plain = packets.view(np.uint8).reshape(len(packets), -1)
            found = sequenced(stamps_of(self._lidar, packets), _contents(packets, plain))
            if found.duplicates or found.moved:
                packets = plain[found.kept].reshape(-1).view(packets.dtype)
        receive_ns = self._lidar.receive_time_ns(packets)
        if found is None:
            return [LidarBatch(self._log_time_ns, packets, receive_ns, self._lidar.stamp_ns(packets), account)]
        device_ns, jumped = self.device.extend(stamps_of(self._lidar, packets), receive_ns)
        mended = (found.duplicates, found.moved)
        return [LidarBatch(self._log_time_ns, packets, receive_ns, device_ns, account, jumped, *mended)]


def _contents(packets: npt.NDArray[np.void], plain: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The bytes of packets without their times of reception, shape (n, bytes)."""
    assert packets.dtype.fields is not None
    kind, start = packets.dtype.fields["data"][:2]
    return plain[:, start : start + kind.itemsize]


def joined(parts: Sequence[npt.NDArray[np.void]]) -> npt.NDArray[np.void]:
    """Packets of one dtype in one array, shape (n,); a single part as it is."""
    if len(parts) == 1:
        return parts[0]
    # as bytes: numpy copies records field by field
    return np.concatenate([part.view(np.uint8) for part in parts]).view(parts[0].dtype)


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


def signed_links(reader: LogReader) -> list[str]:
    """Links whose frames had to be signed aboard: what is not, was not believed there, and is not here."""
    return list(filter(None, reader.metadata.get("swath.session", {}).get("signed_links", "").split(",")))


def mavlink_frames(
    readers: Sequence[LogReader],
    link: str,
    parser: FrameParser | None = None,
    progress: Progress | None = None,
) -> Iterator[Frame]:
    """Stream the MAVLink frames of one link.

    Parameters
    ----------
    readers : sequence of LogReader
    link : str
        Such as "ins" or "fc".
    parser : FrameParser, optional
        To look at its counters afterwards.
    progress : callable, optional
        Called with the number of file bytes done since the last call.
    """
    parser = FrameParser() if parser is None else parser
    for reader in in_order(readers):
        needs_key = link in signed_links(reader)
        for message in reader.messages((records.MAVLINK.topic + link,), progress):
            for time_ns, data in records.decode_raw(message.data):
                frames = parser.feed(time_ns, data)
                yield from filter(is_signed, frames) if needs_key else frames
    yield from parser.finish()
