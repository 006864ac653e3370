"""What an import takes of an autopilot: telemetry logs of a ground station, and the log on its own board."""

import mmap
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from flightlog import records
from flightlog.errors import CaptureError
from groundproc import packed
from groundproc.flight.importers import tlog
from groundproc.flight.importers.inputs import hash_of
from groundproc.flight.importers.joining import Event, LogMessage
from groundproc.flight.importers.kinds import DATAFLASH, HEAD_BYTES, TLOG, Kind, kind_of
from groundproc.flight.importers.mended import mended
from groundproc.flight.importers.sources import facts_of
from groundproc.flight.importers.starting import Start, start_of
from groundproc.flight.importers.steady import Steady

_DATAFLASH_CHUNK: Final = 1 << 16


class Tlog:
    """A telemetry log of Mission Planner or MAVProxy; `content` is the file, or what was in it where it is compressed."""

    kind = "tlog"

    def __init__(self, path: Path, link: str, content: Path) -> None:
        self.path = path
        self.count = tlog.TlogCount()
        self.steady = Steady()
        self._topic = records.MAVLINK.topic + link
        with content.open("rb") as file:
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

    @property
    def mavlink_frames(self) -> int:
        """See Source."""
        return self.count.frames

    def facts(self) -> dict[str, Any]:
        """See Source."""
        return facts_of(self, self.path.stat().st_size, hash_of(self.path), asdict(self.count) | asdict(self.steady))

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
    """An autopilot's own log, kept byte for byte; `content` is the file, or what was in it where it is compressed."""

    path: Path
    link: str
    content: Path
    kind: str = field(default="dataflash", init=False)

    @property
    def written_ns(self) -> int:
        """When the file was written [ns]."""
        return self.path.stat().st_mtime_ns

    @property
    def mavlink_frames(self) -> int:
        """See Source."""
        return 0

    def events(self) -> Iterator[Event]:
        """None: the stamps in it are not of the time of reception."""
        return iter(())

    @property
    def pieces(self) -> int:
        """Messages that it makes."""
        return -(-self.content.stat().st_size // _DATAFLASH_CHUNK)

    def messages(self, start_ns: int) -> Iterator[LogMessage]:
        """The file in pieces, ahead of everything else in the log, which starts at `start_ns` [ns].

        The stamps say nothing but the order: one nanosecond from piece to piece.
        """
        topic = records.DATAFLASH.topic + self.link
        time_ns = start_ns - self.pieces
        with self.content.open("rb") as file:
            while piece := file.read(_DATAFLASH_CHUNK):
                yield LogMessage(topic, time_ns, records.encode_raw(time_ns, [(time_ns, piece)], self.link))
                time_ns += 1

    def facts(self) -> dict[str, Any]:
        """See Source."""
        return facts_of(self, self.path.stat().st_size, hash_of(self.path), {})

    def notes(self) -> list[str]:
        """See Source."""
        return []

    def close(self) -> None:
        """See Source."""


def open_mavlink(path: Path, link: str, folder: Path) -> Tlog | DataflashLog:
    """Open a recording of the autopilot, told by its content, not by its name; a compressed one is unpacked into `folder`.

    Raises
    ------
    CaptureError
        No such file, or neither a telemetry log nor a dataflash log.
    """
    content, damage = packed.unpacked(path, folder)
    with content.open("rb") as file:
        head = file.read(HEAD_BYTES)
    kind = kind_of(head)
    if kind.name == DATAFLASH:
        return DataflashLog(path, link, content)
    if kind.name == TLOG:
        return Tlog(path, link, content)
    raise CaptureError(f"{path}: {damage or _no_autopilot(head, kind)}")


def _no_autopilot(head: bytes, kind: Kind) -> str:
    """What a file is that is no recording of an autopilot."""
    if not head:
        return "is empty, expected a .tlog or a dataflash .bin"
    if kind.remedy:
        return f"is {kind.what}, expected a .tlog or a dataflash .bin; {kind.remedy}"
    if tlog.is_plain_mavlink(head):
        return "is a plain MAVLink byte stream without times; a .tlog or a dataflash .bin is needed"
    return "is neither a telemetry log (.tlog: times and MAVLink frames) nor a dataflash log (.bin)"
