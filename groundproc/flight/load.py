"""Flight logs into arrays: lidar batches and MAVLink frames, streamed, with the lidar's clock carried on.

Several logs of one flight are read one after the other in the order of their times.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import clock, records
from flightlog.constants import HOUR_NS, NS_PER_S, NS_PER_US
from flightlog.logfile import LogReader, Message
from flightlog.mavlink import Frame, FrameParser
from flightlog.records import LidarAccount
from flightlog.signing import is_signed
from groundproc.flight.lidar import lidar_of
from groundproc.sensors.model import Lidar
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
