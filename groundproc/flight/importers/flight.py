"""Recordings of one flight into one flight log: merged by time, written aside, and put in place when it is whole."""

import heapq
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar, cast

from flightlog import __version__
from flightlog.errors import LogError, UsageError
from flightlog.logwriter import LogWriter
from groundproc.files import made_folder
from groundproc.flight.importers import outcome
from groundproc.flight.importers.autopilotlogs import DataflashLog, Tlog, open_mavlink
from groundproc.flight.importers.batching import Joiner
from groundproc.flight.importers.captures import Capture
from groundproc.flight.importers.joining import Event, LogMessage
from groundproc.flight.importers.ports import Ports
from groundproc.flight.importers.senders import Probed, Senders, address_of
from groundproc.flight.importers.sources import Source, Timed
from groundproc.flight.importers.starting import moves
from groundproc.flight.lidar import STATED

if TYPE_CHECKING:
    from groundproc.flight.importers.bag import Bag

S = TypeVar("S", bound=Source)

LINK = "ins"
"""The autopilot that measures: what these recordings are of."""


@dataclass(frozen=True, slots=True)
class Recordings:
    """What is imported.

    Attributes
    ----------
    captures : sequence of Path
        pcap or pcapng files, in any order.
    mavlink : sequence of Path
        Telemetry logs and dataflash logs.
    bags : sequence of Path
        ROS 1 bags, ROS 2 bags (folder, db3, MCAP).
    """

    captures: Sequence[Path] = ()
    mavlink: Sequence[Path] = ()
    bags: Sequence[Path] = ()

    @property
    def paths(self) -> list[Path]:
        """All of them."""
        return [*self.captures, *self.mavlink, *self.bags]


@dataclass(slots=True)
class Imported:
    """What an import did."""

    lidar_packets: int = 0
    position_packets: int = 0
    mavlink_frames: int = 0
    dataflash_bytes: int = 0
    messages: int = 0
    notes: list[str] = field(default_factory=list)
    sources: list[dict[str, Any]] = field(default_factory=list)


def import_flight(
    recordings: Recordings,
    output: Path,
    *,
    ports: Ports,
    attachments: dict[str, bytes],
    sender: str = "",
    force: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Imported:
    """Make a flight log of recordings of other programs.

    Parameters
    ----------
    recordings : Recordings
    output : Path
        The log to write; it appears when it is whole.
    ports : Ports
        Where the lidar sent to.
    attachments : dict of name to bytes
        What makes the log stand alone, such as the mount.
    sender : str
        Address of the lidar, or its topic in a bag; empty: the one that sent most packets.
    force : bool
        Replace an existing output.
    progress : callable, optional
        Called with the number of bytes of captured data since the last call.

    Raises
    ------
    CaptureError
        An input that is not what it should be, or nothing of a lidar or an autopilot in any of them.
    WrongSensorError
        The lidar is of a model that is not known, or captures are of different ones.
    UsageError
        The output exists, or an input is given twice.
    LogError
        The output cannot be written.
    """
    _refuse_repetition(recordings.paths, output)
    if output.exists() and not force:
        raise UsageError(f"{output}: exists already; give another name, or --force to replace it")
    senders = Senders(address_of(sender) if sender else b"")
    partial = output.with_name(f".{output.name}.partial")
    try:
        with (
            made_folder(output.parent),
            tempfile.TemporaryDirectory(prefix=".swath-import-", dir=output.parent) as unpacked,
        ):
            try:
                while True:
                    result = _attempt(recordings, partial, Path(unpacked), ports, attachments, senders, progress)
                    if result is not None:
                        break
                partial.replace(output)
            finally:
                with suppress(OSError):
                    partial.unlink(missing_ok=True)
    except OSError as error:
        raise LogError(f"{output}: cannot be written ({error.strerror})") from None
    return result


def _refuse_repetition(paths: list[Path], output: Path) -> None:
    seen = set()
    for path in paths:
        if path.resolve() in seen:
            raise UsageError(f"{path}: is given twice")
        seen.add(path.resolve())
    if output.resolve() in seen:
        raise UsageError(f"{output}: is an input and cannot be the output too")


def _attempt(
    recordings: Recordings,
    partial: Path,
    unpacked: Path,
    ports: Ports,
    attachments: dict[str, bytes],
    senders: Senders,
    progress: Callable[[int], object] | None,
) -> Imported | None:
    """Read and write all of it; None where another sender than the one thought turns out to be the lidar."""
    with ExitStack() as opened:

        def taken(source: S) -> S:
            opened.callback(source.close)
            return source

        logs = [taken(open_mavlink(path, LINK, unpacked)) for path in recordings.mavlink]
        takes_mavlink = "mavlink" in ports.given or not any(isinstance(log, Tlog) for log in logs)
        captures = [taken(Capture(path, ports, LINK, takes_mavlink=takes_mavlink)) for path in recordings.captures]
        bags = [taken(_bag(path, unpacked)) for path in recordings.bags]
        probed: list[Probed] = [*captures, *bags]
        with partial.open("wb") as stream:
            result = _write(stream, probed, [*captures, *logs, *bags], ports, attachments, senders, progress)
            stream.flush()
            os.fsync(stream.fileno())
    return result


def _bag(path: Path, folder: Path) -> "Bag":
    from groundproc.flight.importers.bag import Bag  # rosbags takes as long to load as all the rest

    return Bag(path, LINK, folder)


def _write(
    stream: BinaryIO,
    probed: Sequence[Probed],
    sources: Sequence[Source],
    ports: Ports,
    attachments: dict[str, bytes],
    senders: Senders,
    progress: Callable[[int], object] | None,
) -> Imported | None:
    lidar = senders.lidar(probed)
    timed = [cast(Timed, source) for source in sources if not isinstance(source, DataflashLog)]
    for source, moved_ns in zip(timed, moves([source.start() for source in timed]), strict=True):
        source.steady.begin(moved_ns)
    events = heapq.merge(*(source.events() for source in sources), key=attrgetter("time_ns"))
    first = next(events, None)
    joiner = Joiner(lidar, senders.chosen)
    session = {"origin": "import", "version": __version__}
    if senders.chosen:
        session[STATED[1]] = lidar.name
    writer = LogWriter(
        stream, metadata={"swath.session": session}, attachments=attachments, library=f"swath {__version__}"
    )
    result = Imported()
    flashes = [source for source in sources if isinstance(source, DataflashLog)]
    for message in _messages(flashes, joiner, first, events, progress):
        writer.write(*message)
        result.messages += 1
    if not senders.settled(joiner):
        return None
    outcome.check(joiner, sources, ports)
    result.sources = [source.facts() for source in sources]
    result.notes = [note for source in sources for note in source.notes()]
    result.notes += outcome.notes(joiner, sources, ports)
    result.lidar_packets = joiner.count.lidar.kept
    result.position_packets = joiner.count.position_received - joiner.count.position_rejected
    result.mavlink_frames = sum(source.mavlink_frames for source in sources)
    result.dataflash_bytes = sum(flash.content.stat().st_size for flash in flashes)
    if result.lidar_packets:
        session[STATED[1]] = lidar.name
    session |= {"sources": json.dumps(result.sources), "counters": json.dumps(outcome.counters(joiner, sources))}
    writer.add_metadata("swath.session", session)
    writer.finish()
    return result


def board_logs(logs: Sequence[DataflashLog], start_ns: int) -> Iterator[LogMessage]:
    """Dataflash logs one after the other, ahead of what starts at a time [ns]; a gap of a nanosecond more tells one from the next."""
    start_ns -= sum(log.pieces + 1 for log in logs)
    for log in logs:
        start_ns += log.pieces + 1
        yield from log.messages(start_ns)


def _messages(
    flashes: Sequence[DataflashLog],
    joiner: Joiner,
    first: Event | None,
    events: Iterator[Event],
    progress: Callable[[int], object] | None,
) -> Iterator[LogMessage]:
    """All messages of the log, dataflash logs ahead; alone they begin at the time of their file, for want of a better one."""
    start_ns = first.time_ns if first is not None else min((flash.written_ns for flash in flashes), default=0)
    yield from board_logs(flashes, start_ns)
    if first is not None:
        yield from joiner.messages(_counted(chain([first], events), progress))


def _counted(events: Iterator[Event], progress: Callable[[int], object] | None) -> Iterator[Event]:
    if progress is None:
        yield from events
        return
    for event in events:
        progress(len(event.data))
        yield event
