"""Recordings of one flight into one flight log: merged by time, written aside, and put in place when it is whole."""

import heapq
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

from flightlog import __version__
from flightlog.clock import utc_text
from flightlog.errors import CaptureError, LogError, UsageError, WrongSensorError
from flightlog.logfile import LogWriter
from groundproc import sensors
from groundproc.flight.importers.joining import Event, Joiner
from groundproc.flight.importers.sources import Capture, DataflashLog, Ports, Source, Tlog, open_mavlink
from groundproc.flight.lidar import STATED
from groundproc.sensors.model import Lidar

LINK = "ins"
"""The autopilot that measures: what these recordings are of."""


@dataclass(slots=True)
class Imported:
    """What an import did."""

    lidar_packets: int = 0
    position_packets: int = 0
    mavlink_frames: int = 0
    messages: int = 0
    notes: list[str] = field(default_factory=list)
    sources: list[dict[str, Any]] = field(default_factory=list)


def import_flight(
    captures: Sequence[Path],
    mavlink: Sequence[Path],
    output: Path,
    *,
    ports: Ports,
    attachments: dict[str, bytes],
    force: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Imported:
    """Make a flight log of captures and recordings of the autopilot.

    Parameters
    ----------
    captures, mavlink : sequence of Path
        pcap or pcapng files, in any order; telemetry logs and dataflash logs.
    output : Path
        The log to write; it appears when it is whole.
    ports : Ports
        Where the lidar sent to.
    attachments : dict of name to bytes
        What makes the log stand alone, such as the mount.
    force : bool
        Replace an existing output.
    progress : callable, optional
        Called with the number of bytes of captured data since the last call.

    Raises
    ------
    CaptureError
        An input that is not what it should be, or no packet of the lidar in any of them.
    UsageError
        The output exists, or an input is given twice.
    LogError
        The output cannot be written.
    """
    _refuse_repetition([*captures, *mavlink], output)
    if output.exists() and not force:
        raise UsageError(f"{output}: exists already; give another name, or --force to replace it")
    sources: list[Source] = []
    try:
        for path in captures:
            sources.append(Capture(path, ports))
        for path in mavlink:
            sources.append(open_mavlink(path, LINK))
        partial = output.with_name(f".{output.name}.partial")
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as stream:
                result = _write(stream, sources, attachments, progress)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(output)
        except OSError as error:
            raise LogError(f"{output}: cannot be written ({error.strerror})") from None
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
    finally:
        for source in sources:
            source.close()
    return result


def _refuse_repetition(paths: list[Path], output: Path) -> None:
    seen = set()
    for path in paths:
        if path.resolve() in seen:
            raise UsageError(f"{path}: is given twice")
        seen.add(path.resolve())
    if output.resolve() in seen:
        raise UsageError(f"{output}: is an input and cannot be the output too")


def _write(
    stream: BinaryIO,
    sources: Sequence[Source],
    attachments: dict[str, bytes],
    progress: Callable[[int], object] | None,
) -> Imported:
    streams = [source.events() for source in sources if isinstance(source, (Capture, Tlog))]
    events = heapq.merge(*streams, key=attrgetter("time_ns"))
    first = next(events, None)
    lidar_model = _lidar(sources)
    joiner = Joiner(lidar_model)
    session = {"origin": "import", "version": __version__, STATED[1]: lidar_model.name}
    writer = LogWriter(
        stream, metadata={"swath.session": session}, attachments=attachments, library=f"swath {__version__}"
    )
    result = Imported()
    if first is not None:
        flashes = [s.messages(first.time_ns) for s in sources if isinstance(s, DataflashLog)]
        following = joiner.messages(_counted(chain([first], events), progress))
        for message in chain(heapq.merge(*flashes, key=attrgetter("log_time_ns")), following):
            writer.write(*message)
            result.messages += 1
    _check(joiner, sources)
    lidar = joiner.count.lidar
    result.sources = [source.facts() for source in sources]
    result.notes = [note for source in sources for note in source.notes()]
    result.notes += _packet_notes(joiner) + _overlap_notes(sources)
    result.lidar_packets = lidar.kept
    result.position_packets = joiner.count.position_received - joiner.count.position_rejected
    result.mavlink_frames = sum(s.count.frames for s in sources if isinstance(s, Tlog))
    counters = {
        "lidar": {name: value for name, value in asdict(lidar).items() if not name.startswith("fov")},
        "position_received": joiner.count.position_received,
        "position_rejected": joiner.count.position_rejected,
    }
    session |= {"sources": json.dumps(result.sources), "counters": json.dumps(counters)}
    writer.add_metadata("swath.session", session)
    writer.finish()
    return result


def _lidar(sources: Sequence[Source]) -> Lidar:
    """The lidar of all captures; the flown model where none of them tells.

    Raises
    ------
    WrongSensorError
        They are of different ones.
    """
    told = {s.lidar.name: s for s in sources if isinstance(s, Capture) and s.lidar is not None}
    if len(told) > 1:
        raise WrongSensorError(
            "; ".join(f"{source.path}: is of a {name}" for name, source in told.items()) + "; one flight has one lidar"
        )
    return sensors.lidar(next(iter(told), sensors.FLOWN))


def _counted(events: Iterator[Event], progress: Callable[[int], object] | None) -> Iterator[Event]:
    if progress is None:
        yield from events
        return
    for event in events:
        progress(len(event.data))
        yield event


def _check(joiner: Joiner, sources: Sequence[Source]) -> None:
    """Refuse an import that found no packet of the lidar, with the likeliest reason."""
    lidar = joiner.count.lidar
    if lidar.kept or joiner.count.position_received > joiner.count.position_rejected:
        return
    captures = [source for source in sources if isinstance(source, Capture)]
    names = ", ".join(str(capture.path) for capture in captures)
    damage = "; ".join(f"it {capture.found.damage}" for capture in captures if capture.found.damage)
    ports = {port for capture in captures for port, size in capture.other_ports.items() if size > 1000}
    if lidar.received:
        reason = f"{lidar.received} packets came to its port, none of them a {joiner.lidar.name}'s"
    elif ports:
        reason = f"packets of the right size went to UDP port {min(ports)}: try --lidar-port {min(ports)}"
    else:
        reason = damage or f"{sum(c.found.packets for c in captures)} packets seen, none to the lidar's UDP port"
    raise CaptureError(f"{names}: holds no packet of a lidar ({reason})")


def _overlap_notes(sources: Sequence[Source]) -> list[str]:
    """Say which telemetry was not recorded while the lidar was: two flights, or two computers' clocks."""
    captures = [s.steady for s in sources if isinstance(s, Capture) and s.steady.first_ns is not None]
    start_ns = min((steady.first_ns or 0 for steady in captures), default=0)
    end_ns = max((steady.last_ns for steady in captures), default=0)
    return [
        f"{s.path}: lies wholly before or after the lidar packets ({utc_text(s.steady.first_ns)} to "
        f"{utc_text(s.steady.last_ns)}; these {utc_text(start_ns)} to {utc_text(end_ns)})"
        for s in sources
        if isinstance(s, Tlog) and s.steady.first_ns is not None
        if s.steady.last_ns < start_ns or s.steady.first_ns > end_ns
    ]


def _packet_notes(joiner: Joiner) -> list[str]:
    lidar, notes = joiner.count.lidar, []
    if not lidar.kept:
        notes.append("no lidar data packet was found, position packets only")
    for name in ("rejected_length", "rejected_content", "rejected_sender"):
        if count := getattr(lidar, name):
            what = {"rejected_length": "of a wrong length", "rejected_content": f"that are no {joiner.lidar.name}'s"}
            notes.append(f"{count} packets {what.get(name, 'of a second sender')} on the lidar's port left out")
    if joiner.count.position_rejected:
        notes.append(f"{joiner.count.position_rejected} packets on the position port left out")
    return notes
