"""What a recording of another program holds, in the figures of a flight log, without making one of it."""

import json
import tempfile
from pathlib import Path
from typing import Any, Final

from flightlog import clock, dataflash
from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError, WrongSensorError
from flightlog.logfile import Message
from groundproc import packed, sensors
from groundproc.flight.importers import outcome
from groundproc.flight.importers.autopilotlogs import DataflashLog, open_mavlink
from groundproc.flight.importers.batching import Joiner
from groundproc.flight.importers.captures import Capture
from groundproc.flight.importers.kinds import BAG, CAPTURE, DATAFLASH, MCAP, TLOG, Kind, head_of, kind_of
from groundproc.flight.importers.ports import Ports
from groundproc.flight.importers.senders import Probed, Senders
from groundproc.flight.load import Progress
from groundproc.flight.summary.log import LogSummary
from groundproc.sensors.model import Lidar

_LINK: Final = "ins"
_MOST_DATAFLASH: Final = 128 << 20
"""Of a dataflash log that are looked at [bytes]."""


def recording_kind(path: Path) -> Kind | None:
    """The kind of a recording of another program, compressed or not; None for what is none, such as a flight log."""
    if path.is_dir():
        return (
            Kind(BAG, "a ROS 2 bag", "swath import --bag makes a log of it")
            if (path / "metadata.yaml").is_file()
            else None
        )
    kind = kind_of(head_of(path))
    with path.open("rb") as file:
        compressed = bool(packed.packing(file.read(packed.HEAD_BYTES)))
    if kind.name == MCAP and not compressed:
        return None
    return kind if kind.name in (CAPTURE, TLOG, DATAFLASH, BAG, MCAP) else None


def summarise_recording(path: Path, kind: Kind, progress: Progress | None = None) -> dict[str, Any]:
    """Read a recording and give its figures.

    Parameters
    ----------
    path : Path
    kind : Kind
        Of `recording_kind`.
    progress : callable, optional
        Called with the number of bytes of packets and frames done since the last call.

    Returns
    -------
    dict
        As `summary.log.summarise` gives it for a flight log, with `kind` (what it is and what takes it) and `notes`.

    Raises
    ------
    CaptureError
        It is not what its first bytes say, or nothing in it can be read.
    """
    head = {"file": str(path), "kind": {"name": kind.name, "what": kind.what, "remedy": kind.remedy}}
    senders = Senders()
    with tempfile.TemporaryDirectory(prefix=".swath-info-") as folder:
        if kind.name == DATAFLASH:
            return head | _dataflash(path, Path(folder))
        while (found := _read(path, kind, Path(folder), senders, progress)) is None:
            pass
    return head | found


def _read(path: Path, kind: Kind, folder: Path, senders: Senders, progress: Progress | None) -> dict[str, Any] | None:
    """Figures of a capture, a telemetry log or a bag; None where another sender than the one thought is the lidar."""
    source, probed = _opened(path, kind, folder)
    try:
        lidar = _lidar(senders, probed)
        joiner, summary = Joiner(lidar, senders.chosen), LogSummary(lidar)
        first_ns = last_ns = None
        for topic, time_ns, data in joiner.messages(source.events()):
            summary.add(Message(topic, time_ns, memoryview(data)))
            first_ns, last_ns = time_ns if first_ns is None else first_ns, time_ns
            if progress is not None:
                progress(len(data))
        try:
            if not senders.settled(joiner):
                return None
            outcome.check(joiner, [source], Ports())
            refused = []
        except (CaptureError, WrongSensorError) as error:
            refused = [f"swath import would refuse it: {error}"]
        summary.finish()
        facts, notes = source.facts(), [*source.notes(), *outcome.notes(joiner, [source], Ports()), *refused]
        session = {"sources": json.dumps([facts]), "counters": json.dumps(outcome.counters(joiner, [source]))}
    finally:
        source.close()
    return {"notes": notes, **_about(facts["bytes"], first_ns, last_ns, session), **summary.result()}


def _lidar(senders: Senders, probed: list[Probed]) -> Lidar:
    try:
        return senders.lidar(probed)
    except WrongSensorError:  # what else it holds is worth telling all the same
        return sensors.lidar(sensors.FLOWN)


def _opened(path: Path, kind: Kind, folder: Path) -> tuple[Any, list[Probed]]:
    """The recording as a source, and whether a lidar is looked for in it."""
    if kind.name == TLOG:
        return open_mavlink(path, _LINK, folder), []
    if kind.name == CAPTURE:
        capture = Capture(path, Ports(), _LINK)
        return capture, [capture]
    from groundproc.flight.importers.bag import Bag  # rosbags takes as long to load as all the rest

    bag = Bag(path, _LINK, folder)
    return bag, [bag]


def _about(size: int, first_ns: int | None, last_ns: int | None, session: dict[str, str]) -> dict[str, Any]:
    """What a flight log says of itself."""
    known = first_ns is not None and last_ns is not None
    return {
        "bytes": size,
        "format_version": None,
        "start_utc": clock.utc_text(first_ns) if first_ns is not None else None,
        "end_utc": clock.utc_text(last_ns) if last_ns is not None else None,
        "duration_s": round(((last_ns or 0) - (first_ns or 0)) / NS_PER_S, 3) if known else 0.0,
        "truncated": False,
        "damage": {"bad_chunks": 0, "lost_bytes": 0, "places": []},
        "session": session,
        "attachments": [],
    }


def _dataflash(path: Path, folder: Path) -> dict[str, Any]:
    """Messages of a dataflash log by their names."""
    log = open_mavlink(path, _LINK, folder)
    assert isinstance(log, DataflashLog)
    with log.content.open("rb") as file:
        data = file.read(_MOST_DATAFLASH)
        rest = log.content.stat().st_size - len(data)
    found = dataflash.parse(data, str(path))
    notes = [f"only its first {_MOST_DATAFLASH >> 20} MB were looked at, {rest} bytes were not"] if rest else []
    if found.bad_bytes:
        notes.append(f"{found.bad_bytes} bytes belong to no message that can be read")
    messages = {name: len(table) for name, table in sorted(found.tables.items())}
    return {
        "notes": notes,
        "bytes": path.stat().st_size,
        "dataflash": {"messages": messages, "bad_bytes": found.bad_bytes},
    }
