"""Events of several recordings, each with its time, into the messages of one flight log, in the order of log time.

A slot of 0.1 s gathers what was received; when it is over each topic gives one message, whose log time is that of the last thing
in it, as the recorder aboard does it. Packets of the lidar are put into the order in which it sent them, and each is taken once.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import hdl32e, records
from flightlog.records import LidarAccount
from groundproc.flight.importers.joining import Event, LogMessage
from groundproc.flight.importers.slots import Slot, hand_back, slots
from groundproc.sensors import velodyne
from groundproc.sensors.model import Lidar
from groundproc.sensors.sequence import sequenced

FIRST_PACKETS: Final = 64
"""Of each sender that are kept to recognise its model by."""
_MOST_SENDERS: Final = 32
_DATA: Final = slice(8, 8 + hdl32e.DATA_BYTES)
"""Bytes of SCAN_PACKET_DTYPE in which the packet is."""


@dataclass(slots=True)
class SensorCount:
    """What became of the packets of the lidar's two ports.

    Attributes
    ----------
    duplicates, reordered : int
        Packets of either port that were there twice and left out, and that came behind later ones and were put in their place.
    mavlink_duplicates : int
        Frames captured twice and left out.
    senders : Counter of bytes
        Data packets by who sent them.
    """

    lidar: LidarAccount = field(default_factory=LidarAccount)
    position_received: int = 0
    position_rejected: int = 0
    duplicates: int = 0
    reordered: int = 0
    mavlink_duplicates: int = 0
    senders: Counter[bytes] = field(default_factory=Counter)


@dataclass(slots=True)
class Joiner:
    """Turns events into messages; `count` says what became of them.

    Attributes
    ----------
    lidar : Lidar
        Whose packets are kept.
    sender : bytes
        Who sent them; empty: the first one that sends good packets.
    first_packets : dict of bytes to list of bytes
        The first data packets of each sender.
    """

    lidar: Lidar
    sender: bytes = b""
    count: SensorCount = field(default_factory=SensorCount)
    first_packets: dict[bytes, list[bytes]] = field(default_factory=dict)

    def messages(self, events: Iterable[Event]) -> Iterator[LogMessage]:
        """Messages in the order of log time; `events` must be in the order of time."""
        held = Slot()
        for slot in slots(events):
            hand_back(held, slot)
            yield from self._close(held)
            self._drop_repeated(held, slot)
            held = slot
        yield from self._close(held)

    def _close(self, slot: Slot) -> list[LogMessage]:
        messages: list[LogMessage] = []
        for topic, events in slot.topics.items():
            if not events:
                continue
            if topic == records.LIDAR.topic:
                messages += self._lidar(events, slot.log_ns[topic])
            elif topic == records.POSITION.topic:
                messages += self._position(events, slot.log_ns[topic])
            else:
                messages.append(_raw(topic, events, topic.rpartition("/")[2], slot.log_ns[topic]))
        return sorted(messages, key=lambda message: message.log_time_ns)

    def _drop_repeated(self, before: Slot, slot: Slot) -> None:
        """Leave out frames that were captured twice; what did not come over the network is as somebody recorded it."""
        for topic, events in slot.topics.items():
            if not topic.startswith(records.MAVLINK.topic):
                continue
            seen = {event.data for event in before.topics.get(topic, ()) if event.sender}
            kept = []
            for event in events:
                if event.sender and event.data in seen:
                    self.count.mavlink_duplicates += 1
                    continue
                seen.add(event.data)
                kept.append(event)
            slot.topics[topic] = kept

    def _lidar(self, events: list[Event], log_ns: int) -> list[LogMessage]:
        right = [event for event in events if len(event.data) == hdl32e.DATA_BYTES]
        data = np.frombuffer(b"".join(event.data for event in right), hdl32e.DATA_DTYPE)
        valid = self.lidar.valid(data)
        self._count_senders(right, data)
        if not self.sender and valid.any():
            self.sender = right[int(np.argmax(valid))].sender
        ours = np.fromiter((event.sender == self.sender for event in right), np.bool_, len(right))
        chosen = np.flatnonzero(valid & ours)
        # as bytes: numpy copies records field by field
        plain = data.view(np.uint8).reshape(len(data), hdl32e.DATA_BYTES)
        found = sequenced(data["stamp_us"][chosen], plain, chosen)
        kept = chosen[found.kept]
        self.count.duplicates += found.duplicates
        self.count.reordered += found.moved
        account = LidarAccount(
            received=len(events) - found.duplicates,
            kept=len(kept),
            rejected_length=len(events) - len(right),
            rejected_content=int((~valid).sum()),
            rejected_sender=int((valid & ~ours).sum()),
        )
        self.count.lidar = _add(self.count.lidar, account)
        messages = [LogMessage(records.LIDAR_ACCOUNT.topic, log_ns, records.encode_account(log_ns, account))]
        if len(kept):
            packets = np.zeros(account.kept, records.SCAN_PACKET_DTYPE)
            packets.view(np.uint8).reshape(len(kept), -1)[:, _DATA] = plain[kept]
            times_ns = np.fromiter((event.time_ns for event in right), np.int64, len(right))[kept]
            records.set_receive_time_ns(packets, times_ns)
            messages.insert(0, LogMessage(records.LIDAR.topic, log_ns, records.encode_scan(log_ns, packets)))
        return messages

    def _count_senders(self, events: list[Event], data: npt.NDArray[np.void]) -> None:
        """Rank senders by packets that begin as those of the family do, of whatever model; and keep a few of each."""
        family = data["blocks"]["flag"][:, 0] == hdl32e.BLOCK_FLAG
        senders = Counter(event.sender for event, good in zip(events, family.tolist(), strict=True) if good)
        for sender in senders:
            if sender not in self.count.senders and len(self.count.senders) >= _MOST_SENDERS:
                continue
            self.count.senders[sender] += senders[sender]
            first = self.first_packets.setdefault(sender, [])
            if len(first) < FIRST_PACKETS:
                first += [event.data for event in events if event.sender == sender][: FIRST_PACKETS - len(first)]

    def _position(self, events: list[Event], log_ns: int) -> list[LogMessage]:
        right = [event for event in events if len(event.data) == hdl32e.POSITION_BYTES]
        packets = velodyne.position_packets(b"".join(event.data for event in right))
        senders = (b"", self.sender) if self.sender else None
        ours = np.fromiter((senders is None or event.sender in senders for event in right), np.bool_, len(right))
        chosen = np.flatnonzero(velodyne.is_position(packets) & ours)
        plain = packets.view(np.uint8).reshape(len(packets), hdl32e.POSITION_BYTES)
        found = sequenced(packets["stamp_us"][chosen], plain, chosen)
        kept = [right[i] for i in chosen[found.kept]]
        self.count.duplicates += found.duplicates
        self.count.reordered += found.moved
        self.count.position_received += len(events) - found.duplicates
        self.count.position_rejected += len(events) - found.duplicates - len(kept)
        return [_raw(records.POSITION.topic, kept, "velodyne", log_ns)] if kept else []


def _raw(topic: str, events: list[Event], frame_id: str, log_ns: int) -> LogMessage:
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
