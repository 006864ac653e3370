"""Which of several senders on a network, or topics of a bag, is the lidar of the flight: the one that sent most packets."""

import ipaddress
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from flightlog import hdl32e, records
from flightlog.errors import CaptureError, UsageError, WrongSensorError
from flightlog.words import clean
from groundproc import sensors
from groundproc.flight.importers.batching import Joiner
from groundproc.flight.importers.topics import TOPIC, topic_sender
from groundproc.flight.lidar import recognised
from groundproc.sensors.model import Lidar


class Probed(Protocol):
    """A source whose first packets have been looked at."""

    path: Path
    first_packets: dict[bytes, list[bytes]]


def address_of(text: str) -> bytes:
    """The sender of an address or a topic as the user writes it.

    Raises
    ------
    UsageError
        It is neither.
    """
    if text.startswith("/"):
        return topic_sender(text)
    try:
        return ipaddress.ip_address(text).packed
    except ValueError:
        raise UsageError(
            f"--sender {text!r}: is no address such as 192.168.1.201, and no topic such as /points"
        ) from None


def name_of(sender: bytes) -> str:
    """An address or a topic as people read it."""
    if sender.startswith(TOPIC):
        return clean(sender.removeprefix(TOPIC).decode(errors="replace"))
    return str(ipaddress.ip_address(sender)) if len(sender) in (4, 16) else "unknown"


def listed(packets: Mapping[bytes, int]) -> str:
    """Senders with their packets, the largest first."""
    ranked = sorted(packets.items(), key=lambda item: -item[1])
    return ", ".join(f"{name_of(sender)} with {count}" for sender, count in ranked)


@dataclass(slots=True)
class Senders:
    """The choice of the lidar: a guess by the first packets, that the whole of the recordings confirms or mends.

    Attributes
    ----------
    given : bytes
        What the user asked for; empty where the packets decide.
    chosen : bytes
        Whose packets are taken.
    """

    given: bytes = b""
    chosen: bytes = b""
    _packets: dict[bytes, list[bytes]] = field(default_factory=dict)
    """The first packets of each sender, once all have been read."""
    _wrong: WrongSensorError | None = None
    """Why the first packets are of no lidar that is known."""

    def lidar(self, sources: Sequence[Probed]) -> Lidar:
        """Choose a sender, and recognise its model; the flown model where nothing tells.

        Raises
        ------
        WrongSensorError
            Sources are of different models, or the packets that decide are of none that is known.
        """
        if self._packets:
            places = ", ".join(str(source.path) for source in sources)
            return _model(self._packets[self.chosen], places)
        first: Counter[bytes] = Counter()
        for source in sources:
            first.update({sender: len(packets) for sender, packets in source.first_packets.items()})
        self.chosen = self.given or max(first, key=lambda sender: first[sender], default=b"")
        told: dict[str, Path] = {}
        for source in sources:
            mine = source.first_packets
            sender = self.given if self.given in mine else max(mine, key=lambda each: len(mine[each]), default=b"")
            if sender and (not self.given or sender == self.given):
                try:
                    told.setdefault(_model(mine[sender], str(source.path)).name, source.path)
                except WrongSensorError as error:
                    self._wrong = error
        if len(told) > 1:
            raise WrongSensorError(
                "; ".join(f"{path}: is of a {name}" for name, path in told.items())
                + "; one flight has one lidar: give the captures of one, or its address with --sender"
            )
        return sensors.lidar(next(iter(told), sensors.FLOWN))

    def settled(self, joiner: Joiner) -> bool:
        """Whether the lidar was the right one; if not, read again with the one that is `chosen` now.

        Raises
        ------
        CaptureError
            The sender that the user gave sent nothing.
        WrongSensorError
            The lidar is of a model that is not known.
        """
        counted = joiner.count.senders
        if self._packets or not counted:
            return True
        if self.given and self.given not in counted:
            raise CaptureError(f"no packet came from {name_of(self.given)}; senders of packets are {listed(counted)}")
        best = self.given or max(counted, key=lambda sender: counted[sender])
        if counted[best] > counted[joiner.sender] or (self.given and not joiner.count.lidar.kept):
            self.chosen, self._packets, self._wrong = best, joiner.first_packets, None
            return False
        if self._wrong is not None:
            raise self._wrong
        return True


def _model(packets: Sequence[bytes], place: str) -> Lidar:
    data = np.frombuffer(b"".join(packets), hdl32e.DATA_DTYPE)
    return recognised(sensors.of_topic(records.LIDAR.topic), data, place)
