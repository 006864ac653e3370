"""Which exposures an autopilot noted: camera messages of its link (our logs, tlog) or of its own card (dataflash), as UTC.

Sources: common.xml of MAVLink for CAMERA_FEEDBACK, CAMERA_IMAGE_CAPTURED and CAMERA_TRIGGER; ArduPilot's LogStructure.h for CAM and TRIG.
Times are the autopilot's idea of UTC: the same that a trajectory of the same log rests on. GPSTime of CAM is that of the last fix, so
that its own clock is used and tied to UTC by the fixes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import mavlink, records
from flightlog.clock import is_plausible
from flightlog.constants import NS_PER_MS, NS_PER_US
from flightlog.dataflash import Dataflash, Parser
from flightlog.errors import CaptureError
from flightlog.logfile import LogReader
from flightlog.mavlink import Frame, FrameParser
from groundproc.flight.boardlog import boot_of
from groundproc.flight.timebase import host_line

Ints = npt.NDArray[np.int64]
Table = npt.NDArray[np.void]

LOGS: Final = (".mcap", ".tlog", ".bin", ".log")
_NOTED: Final = ("CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED", "CAMERA_TRIGGER")
"""The one that says most first: the camera's own hot shoe, its word, the command to it."""
_WANTED: Final = frozenset(mavlink.message_id(name) for name in (*_NOTED, "SYSTEM_TIME"))
_ON_CARD: Final = ("CAM", "TRIG")
_CARD: Final = frozenset((*_ON_CARD, "GPS", "PARM"))
_PIECE: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Noted:
    """Exposures that were noted.

    Attributes
    ----------
    utc_ns : ndarray of int64, shape (n,)
        In order.
    camera : ndarray of int64, shape (n,)
        The autopilot's number of the camera, 0 where it counts none.
    source : str
        What noted them.
    """

    utc_ns: Ints
    camera: Ints
    source: str


def exposures_of(log: Path) -> Noted | None:
    """All exposures that a log notes; None where it notes none.

    Raises
    ------
    SwathError
        It cannot be read.
    """
    if log.suffix.lower() == ".mcap":
        frames, boards = _in_flight_log(log)
    elif log.suffix.lower() in (".bin", ".log"):
        frames, boards = [], [_card(_pieces(log))]
    else:
        frames, boards = _frames((0, piece) for piece in _pieces(log)), []
    found = [one for one in (_of_link(frames), *map(_of_card, boards)) if one is not None]
    return max(found, key=lambda one: len(one.utc_ns)) if found else None


def of_flight(logs: Sequence[Path]) -> Noted | None:
    """All exposures that the logs of one flight note, of the kind that most of them are of; None where they note none.

    Raises
    ------
    SwathError
        One cannot be read.
    """
    found = [one for one in map(exposures_of, logs) if one is not None]
    if not found:
        return None
    source = max(found, key=lambda one: len(one.utc_ns)).source
    alike = [one for one in found if one.source == source]
    return _in_order(
        np.concatenate([one.utc_ns for one in alike]), np.concatenate([one.camera for one in alike]), source
    )


def _pieces(path: Path) -> Iterator[bytes]:
    try:
        with path.open("rb") as file:
            while piece := file.read(_PIECE):
                yield piece
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None


def _in_flight_log(log: Path) -> tuple[list[Frame], list[Dataflash]]:
    """Camera messages of all links, and the cards' logs: where the stamps of one leave a gap, another file begins."""
    parsers: dict[str, FrameParser] = {}
    cards: dict[str, tuple[Parser, int]] = {}
    frames: list[Frame] = []
    boards: list[Dataflash] = []
    with LogReader(log) as reader:
        for message in reader.messages((records.MAVLINK.topic, records.DATAFLASH.topic)):
            for time_ns, part in records.decode_raw(message.data):
                if message.topic.startswith(records.MAVLINK.topic):
                    found = parsers.setdefault(message.topic, FrameParser()).feed(time_ns, part)
                    frames += [frame for frame in found if frame.message_id in _WANTED and frame.known]
                    continue
                parser, following = cards.get(message.topic, (Parser(_CARD), time_ns))
                if time_ns != following:
                    boards.append(parser.finish())
                    parser = Parser(_CARD)
                parser.feed(part)
                cards[message.topic] = parser, time_ns + 1
    return frames, boards + [parser.finish() for parser, _ in cards.values()]


def _frames(data: Iterator[tuple[int, bytes]]) -> list[Frame]:
    parser, kept = FrameParser(), list[Frame]()
    for time_ns, part in data:
        kept += [frame for frame in parser.feed(time_ns, part) if frame.message_id in _WANTED and frame.known]
    return kept + [frame for frame in parser.finish() if frame.message_id in _WANTED and frame.known]


def _card(pieces: Iterator[bytes]) -> Dataflash:
    parser = Parser(_CARD)
    for piece in pieces:
        parser.feed(piece)
    return parser.finish()


def _of_link(frames: Sequence[Frame]) -> Noted | None:
    """Of MAVLink: stamps are UTC, or time since boot, which SYSTEM_TIME ties to it."""
    ties = mavlink.table(frames, "SYSTEM_TIME")
    unix_ns = ties["time_unix_usec"].astype(np.int64) * NS_PER_US
    good = np.array([is_plausible(int(value)) for value in unix_ns], np.bool_)
    boot_ns, unix_ns = ties["time_boot_ms"][good].astype(np.int64) * NS_PER_MS, unix_ns[good]
    for name in _NOTED:
        table = mavlink.table(frames, name)
        if not len(table):
            continue
        stamp_ns = _stamps_ns(name, table)
        since_boot = np.array([not is_plausible(int(value)) for value in stamp_ns], np.bool_)
        if since_boot.any():
            if len(boot_ns) < 2:
                continue
            # what is late only ever shows too early a time, so that the largest difference is the truest
            offset_ns = unix_ns - boot_ns
            told = boot_ns, boot_ns + 2 * int(offset_ns.max()) - offset_ns
            stamp_ns = np.where(since_boot, _tied(told, np.where(since_boot, stamp_ns, boot_ns[0])), stamp_ns)
        field = {"CAMERA_FEEDBACK": "cam_idx", "CAMERA_IMAGE_CAPTURED": "camera_id"}.get(name)
        camera = np.zeros(len(table), np.int64) if field is None else table[field].astype(np.int64)
        return _in_order(stamp_ns, camera, name)
    return None


def _stamps_ns(name: str, table: Table) -> Ints:
    if name != "CAMERA_IMAGE_CAPTURED":
        return np.asarray(table["time_usec"].astype(np.int64) * NS_PER_US)
    utc_ns, boot_ns = table["time_utc"].astype(np.int64) * NS_PER_US, table["time_boot_ms"].astype(np.int64) * NS_PER_MS
    return np.where(utc_ns > 0, utc_ns, boot_ns)


def _of_card(log: Dataflash) -> Noted | None:
    """Of a dataflash log: its own clock, tied to UTC by the fixes."""
    boot, _ = boot_of(log)
    if boot is None or boot.heard is None or len(boot.heard[0]) < 2:
        return None
    for name in _ON_CARD:
        if log.has(name, "TimeUS") and len(log.tables[name]):
            table = log.tables[name]
            names = table.dtype.names or ()
            number = next((label for label in ("I", "Instance") if label in names), None)
            camera = np.zeros(len(table), np.int64) if number is None else table[number].astype(np.int64)
            stamp_ns = _tied(boot.heard, table["TimeUS"].astype(np.int64) * NS_PER_US)
            return _in_order(stamp_ns, camera, f"{name} of the card")
    return None


def _tied(heard: tuple[Ints, Ints], stamp_ns: Ints) -> Ints:
    """UTC of stamps of a clock that was heard at some times: along the line below what was heard."""
    line = host_line(*heard)
    return np.array([line.host_ns(value) for value in stamp_ns.tolist()], np.int64)


def _in_order(utc_ns: Ints, camera: Ints, source: str) -> Noted:
    """Each exposure once: links repeat messages."""
    pairs = np.unique(np.stack([utc_ns, camera], axis=1), axis=0)
    return Noted(pairs[:, 0].copy(), pairs[:, 1].copy(), source)
