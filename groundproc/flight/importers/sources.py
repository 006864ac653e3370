"""The files that an import takes: each opened, recognised by its content, and read once as a stream of events."""

import hashlib
import io
import mmap
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol, cast

import numpy as np

from flightlog import dataflash, hdl32e, records
from flightlog.errors import CaptureError
from groundproc import sensors
from groundproc.flight.importers import pcap, tlog, udp
from groundproc.flight.importers.joining import Event, LogMessage
from groundproc.flight.importers.mended import mended
from groundproc.flight.importers.starting import Start, start_of
from groundproc.flight.importers.steady import Steady
from groundproc.flight.lidar import recognised
from groundproc.sensors.model import Lidar

_PROBE_PACKETS: Final = 64
_PROBE_DATAGRAMS: Final = 2000
_DATAFLASH_CHUNK: Final = 1 << 16


class Hashed(io.RawIOBase):
    """A file that hashes what is read from it.

    Attributes
    ----------
    size : int
        Bytes read so far.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise CaptureError(f"{path}: cannot be opened ({error.strerror})") from None
        self._hash = hashlib.sha256()
        self.size = 0

    def readable(self) -> bool:
        """It can be read."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read, hash and count."""
        count = self._file.readinto(buffer) or 0
        self._hash.update(memoryview(buffer)[:count])
        self.size += count
        return count

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    def sha256(self) -> str:
        """Hash of what was read, in hexadecimal."""
        return self._hash.hexdigest()


class Source(Protocol):
    """One recording."""

    path: Path
    kind: str

    def facts(self) -> dict[str, Any]:
        """What it was and what was found in it, for the log's metadata; complete once it has been read."""

    def notes(self) -> list[str]:
        """Sentences on what was not as it should be."""

    def close(self) -> None:
        """Close the file."""


@dataclass(frozen=True, slots=True)
class Ports:
    """UDP destination ports of the lidar."""

    lidar: int = hdl32e.DATA_PORT
    position: int = hdl32e.POSITION_PORT


class Capture:
    """A pcap or pcapng file.

    Raises
    ------
    CaptureError
        No such file, or no capture.
    WrongSensorError
        The capture of another lidar.
    """

    kind = "capture"
    lidar: Lidar | None
    """The model of its packets; None where it holds no data packet, or none that tells."""

    def __init__(self, path: Path, ports: Ports) -> None:
        self.path = path
        self.found = pcap.CaptureCount()
        self.datagrams = udp.DatagramCount()
        self.steady = Steady()
        self._ports = ports
        self.other_ports: dict[int, int] = {}
        self._hashed = Hashed(path)
        stream = cast(BinaryIO, io.BufferedReader(self._hashed, 1 << 20))
        try:
            packets = pcap.packets(stream, self.found, str(path))
            self._stream = udp.datagrams(packets, self.datagrams)
            self._head = self._probe()
        except OSError as error:
            raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None

    def _probe(self) -> list[udp.Datagram]:
        """Take the first datagrams, and recognise the sensor by them."""
        head: list[udp.Datagram] = []
        lidar: list[bytes] = []
        for datagram in self._stream:
            head.append(datagram)
            if datagram.port == self._ports.lidar and len(datagram.payload) == hdl32e.DATA_BYTES:
                lidar.append(datagram.payload)
            if len(lidar) >= _PROBE_PACKETS or len(head) >= _PROBE_DATAGRAMS:
                break
        packets = np.frombuffer(b"".join(lidar), hdl32e.DATA_DTYPE)
        self.lidar = recognised(sensors.of_topic(records.LIDAR.topic), packets, str(self.path)) if lidar else None
        return head

    def events(self) -> Iterator[Event]:
        """The packets of the lidar in the order in which they were sent, with times that never step back."""
        return self.steady(self._as_stamped(chain(self._head, self._stream)))

    def start(self) -> Start | None:
        """What the first stamps say; the file is opened once more for it."""
        return start_of(self._again)

    def _again(self) -> Iterator[Event]:
        with self.path.open("rb", buffering=1 << 20) as file:
            packets = pcap.packets(file, pcap.CaptureCount(), str(self.path))
            yield from self._as_stamped(udp.datagrams(packets, udp.DatagramCount()))

    def _as_stamped(self, datagrams: Iterable[udp.Datagram]) -> Iterator[Event]:
        topics = {self._ports.lidar: records.LIDAR.topic, self._ports.position: records.POSITION.topic}
        for datagram in datagrams:
            topic = topics.get(datagram.port)
            if topic is not None:
                yield Event(datagram.time_ns, topic, datagram.payload, datagram.sender)
            elif len(datagram.payload) in (hdl32e.DATA_BYTES, hdl32e.POSITION_BYTES):
                self.other_ports[datagram.port] = len(datagram.payload)

    def facts(self) -> dict[str, Any]:
        """See Source."""
        counters = asdict(self.found) | asdict(self.datagrams) | asdict(self.steady)
        return _facts(self, self._hashed.size, self._hashed.sha256(), counters)

    def notes(self) -> list[str]:
        """See Source."""
        notes = []
        if self.found.damage:
            notes.append(f"{self.path}: {self.found.damage}, {self.found.lost_bytes} bytes left out")
        if self.datagrams.cut:
            notes.append(f"{self.path}: {self.datagrams.cut} packets were captured only in part and left out")
        if self.datagrams.fragments:
            notes.append(f"{self.path}: {self.datagrams.fragments} IP fragments left out")
        if self.found.untimed or self.found.borrowed_times:
            count = self.found.untimed + self.found.borrowed_times
            notes.append(f"{self.path}: {count} packets carry no time of their own")
        return notes + [f"{self.path}: {said}" for said in mended(self.steady)]

    def close(self) -> None:
        """See Source."""
        self._hashed.close()


class Tlog:
    """A telemetry log of Mission Planner or MAVProxy."""

    kind = "tlog"

    def __init__(self, path: Path, link: str) -> None:
        self.path = path
        self.count = tlog.TlogCount()
        self.steady = Steady()
        self._topic = records.MAVLINK.topic + link
        with path.open("rb") as file:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def events(self) -> Iterator[Event]:
        """The records in the order in which they were received, with times that never step back."""
        return self.steady(self._as_stamped(self.count))

    def start(self) -> Start | None:
        """What the first stamps say."""
        return start_of(lambda: self._as_stamped(tlog.TlogCount()))

    def _as_stamped(self, count: tlog.TlogCount) -> Iterator[Event]:
        for record in tlog.records(self._data, count):
            yield Event(record.time_ns, self._topic, record.data, b"")

    def facts(self) -> dict[str, Any]:
        """See Source."""
        sha256 = hashlib.sha256(self._data).hexdigest()
        return _facts(self, len(self._data), sha256, asdict(self.count) | asdict(self.steady))

    def notes(self) -> list[str]:
        """See Source."""
        notes = []
        if self.count.bad_bytes:
            notes.append(f"{self.path}: {self.count.bad_bytes} bytes belong to no good MAVLink frame")
        if self.count.cut:
            notes.append(f"{self.path}: ends within a record")
        return notes + [f"{self.path}: {said}" for said in mended(self.steady)]

    def close(self) -> None:
        """See Source."""
        self._data.close()


@dataclass(slots=True)
class DataflashLog:
    """An autopilot's own log, kept byte for byte."""

    path: Path
    link: str
    kind: str = field(default="dataflash", init=False)
    _hash: Any = field(default_factory=hashlib.sha256, init=False)

    @property
    def pieces(self) -> int:
        """Messages that it makes."""
        return -(-self.path.stat().st_size // _DATAFLASH_CHUNK)

    def messages(self, start_ns: int) -> Iterator[LogMessage]:
        """The file in pieces, ahead of everything else in the log, which starts at `start_ns` [ns].

        The stamps say nothing but the order: one nanosecond from piece to piece.
        """
        topic = records.DATAFLASH.topic + self.link
        time_ns = start_ns - self.pieces
        with self.path.open("rb") as file:
            while piece := file.read(_DATAFLASH_CHUNK):
                self._hash.update(piece)
                yield LogMessage(topic, time_ns, records.encode_raw(time_ns, [(time_ns, piece)], self.link))
                time_ns += 1

    def facts(self) -> dict[str, Any]:
        """See Source."""
        return _facts(self, self.path.stat().st_size, self._hash.hexdigest(), {})

    def notes(self) -> list[str]:
        """See Source."""
        return []

    def close(self) -> None:
        """See Source."""


def open_mavlink(path: Path, link: str) -> Tlog | DataflashLog:
    """Open a recording of the autopilot, told by its content, not by its name.

    Raises
    ------
    CaptureError
        No such file, or neither a telemetry log nor a dataflash log.
    """
    try:
        with path.open("rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be opened ({error.strerror})") from None
    if dataflash.is_dataflash(head):
        return DataflashLog(path, link)
    if tlog.is_tlog(head):
        return Tlog(path, link)
    if not head:
        raise CaptureError(f"{path}: is empty, expected a .tlog or a dataflash .bin")
    if tlog.is_plain_mavlink(head):
        raise CaptureError(
            f"{path}: is a plain MAVLink byte stream without times; a .tlog or a dataflash .bin is needed"
        )
    raise CaptureError(
        f"{path}: is neither a telemetry log (.tlog: times and MAVLink frames) nor a dataflash log (.bin)"
    )


def _facts(source: Source, size: int, sha256: str, counters: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": source.path.name,
        "kind": source.kind,
        "bytes": size,
        "sha256": sha256,
        "counters": {name: value for name, value in counters.items() if not name.startswith("_")},
    }
