"""Events of several recordings, each with its time, into the messages of one flight log, in the order of log time.

A slot of 0.1 s gathers what was received; when it is over each topic gives one message, whose log time is that of the last thing
in it, as the recorder aboard does it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from flightlog import hdl32e, records
from flightlog.constants import NS_PER_MS
from flightlog.records import LidarAccount
from groundproc.sensors import velodyne
from groundproc.sensors.model import Lidar

SLOT_NS: Final = 100 * NS_PER_MS
_LARGEST_SLOT: Final = 4096
"""Events; more in 0.1 s means stamps that stand still."""


class Event(NamedTuple):
    """Something received at one time."""

    time_ns: int
    topic: str
    data: bytes
    sender: bytes
    """IPv4 address, empty for what did not come over the network."""


class LogMessage(NamedTuple):
    """A message ready for LogWriter.write."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(slots=True)
class SensorCount:
    """What became of the packets of the lidar's two ports."""

    lidar: LidarAccount = field(default_factory=LidarAccount)
    position_received: int = 0
    position_rejected: int = 0


@dataclass(slots=True)
class Joiner:
    """Turns events into messages; `count` says what became of them.

    Attributes
    ----------
    lidar : Lidar
        Whose packets are kept.
    """

    lidar: Lidar
    count: SensorCount = field(default_factory=SensorCount)
    _sender: bytes = b""

    def messages(self, events: Iterable[Event]) -> Iterator[LogMessage]:
        """Messages in the order of log time; `events` must be in the order of time."""
        slot: list[Event] = []
        for event in events:
            if slot and (event.time_ns >= slot[0].time_ns + SLOT_NS or len(slot) >= _LARGEST_SLOT):
                yield from self._close(slot)
                slot = []
            slot.append(event)
        if slot:
            yield from self._close(slot)

    def _close(self, slot: list[Event]) -> list[LogMessage]:
        topics: dict[str, list[Event]] = {}
        for event in slot:
            topics.setdefault(event.topic, []).append(event)
        messages: list[LogMessage] = []
        for topic, events in topics.items():
            if topic == records.LIDAR.topic:
                messages += self._lidar(events)
            elif topic == records.POSITION.topic:
                messages += self._position(events)
            else:
                messages.append(_raw(topic, events, topic.rpartition("/")[2]))
        return sorted(messages, key=lambda message: message.log_time_ns)

    def _lidar(self, events: list[Event]) -> list[LogMessage]:
        right = [event for event in events if len(event.data) == hdl32e.DATA_BYTES]
        data = np.frombuffer(b"".join(event.data for event in right), hdl32e.DATA_DTYPE)
        valid = self.lidar.valid(data)
        if not self._sender and valid.any():
            self._sender = right[int(np.argmax(valid))].sender
        ours = np.fromiter((event.sender == self._sender for event in right), np.bool_, len(right))
        keep = valid & ours
        account = LidarAccount(
            received=len(events),
            kept=int(keep.sum()),
            rejected_length=len(events) - len(right),
            rejected_content=int((~valid).sum()),
            rejected_sender=int((valid & ~ours).sum()),
        )
        self.count.lidar = _add(self.count.lidar, account)
        log_ns = events[-1].time_ns
        messages = [LogMessage(records.LIDAR_ACCOUNT.topic, log_ns, records.encode_account(log_ns, account))]
        if keep.any():
            packets = np.zeros(account.kept, records.SCAN_PACKET_DTYPE)
            packets["data"] = data[keep]
            times_ns = np.fromiter((event.time_ns for event in right), np.int64, len(right))[keep]
            records.set_receive_time_ns(packets, times_ns)
            messages.insert(0, LogMessage(records.LIDAR.topic, log_ns, records.encode_scan(log_ns, packets)))
        return messages

    def _position(self, events: list[Event]) -> list[LogMessage]:
        right = [event for event in events if len(event.data) == hdl32e.POSITION_BYTES]
        packets = velodyne.position_packets(b"".join(event.data for event in right))
        kept = [
            event
            for event, good in zip(right, velodyne.is_position(packets), strict=True)
            if good and self._sender in (b"", event.sender)
        ]
        self.count.position_received += len(events)
        self.count.position_rejected += len(events) - len(kept)
        return [_raw(records.POSITION.topic, kept, "velodyne")] if kept else []


def _raw(topic: str, events: list[Event], frame_id: str) -> LogMessage:
    log_ns = events[-1].time_ns
    chunks = [(event.time_ns, event.data) for event in events]
    return LogMessage(topic, log_ns, records.encode_raw(log_ns, chunks, frame_id))


def _add(total: LidarAccount, account: LidarAccount) -> LidarAccount:
    return LidarAccount(
        received=total.received + account.received,
        kept=total.kept + account.kept,
        rejected_length=total.rejected_length + account.rejected_length,
        rejected_content=total.rejected_content + account.rejected_content,
        rejected_sender=total.rejected_sender + account.rejected_sender,
    )
