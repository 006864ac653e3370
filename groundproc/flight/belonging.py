"""Whether several logs are parts of one flight: of one vehicle with one sensor in one mount, at one place on one day.

A flight of several batteries is one flight here: the copter lands, gets another battery, and goes on. What makes two flights is what no
swap of batteries does: half a day between them, another site, another vehicle, lidar or mount. A lidar's packets carry no serial number, so
that two sensors of one model cannot be told apart.
"""

import itertools
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyproj

from flightlog import mavlink, records
from flightlog.clock import utc_text
from flightlog.constants import NS_PER_S, NS_PER_US
from flightlog.errors import ConfigError, SwathError, UsageError
from flightlog.logfile import LogReader
from flightlog.mavlink import Frame, FrameParser
from flightlog.mount import Mount
from groundproc.flight.lidar import lidar_of
from groundproc.flight.mounting import find_mount

LONGEST_PAUSE_S: Final = 12 * 3600.0
"""Between two parts of a flight: those of one day are nearer, those of two days farther apart."""
SITE_M: Final = 10_000.0
"""Take-off places of one site lie within: twice what a pilot sees of a multirotor, with a walk between."""
OVERLAP_NS: Final = NS_PER_S
"""Batches of one log may reach so far into the next."""
_LINK: Final = f"{records.MAVLINK.topic}ins"
_GEODESIC: Final = pyproj.Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class Part:
    """What tells whether a log belongs to others.

    Attributes
    ----------
    path : Path
    start_ns, end_ns : int
        Log time.
    utc_ns : int or None
        To be added to log time for UTC by GNSS; None where the log does not tell.
    place_deg : tuple of float or None
        Latitude and longitude of the first fix.
    system : int or None
        MAVLink id of the vehicle.
    lidar : str
        Model.
    """

    path: Path
    start_ns: int
    end_ns: int
    utc_ns: int | None = None
    place_deg: tuple[float, float] | None = None
    system: int | None = None
    lidar: str = ""


def in_order_of_one_flight(readers: Sequence[LogReader], mount: Mount | str | None = None) -> list[LogReader]:
    """The logs in order of time.

    Parameters
    ----------
    readers : sequence of LogReader
    mount : Mount or str, optional
        What the user says of it: then those of the logs may differ.

    Raises
    ------
    UsageError
        They overlap, or are not of one flight; with the command for several.
    """
    ordered = sorted(readers, key=lambda reader: reader.start_ns)
    if len(ordered) < 2:
        return ordered
    paths = [reader.path for reader in ordered]
    for before, after in itertools.pairwise(ordered):
        if after.start_ns < before.end_ns - OVERLAP_NS:
            raise UsageError(
                f"{before.path} and {after.path}: overlap in time, but the parts of one flight follow each other; {one_by_one(paths)}"
            )
    parts = [part_of(reader) for reader in ordered]
    for one, other in itertools.pairwise(parts):
        why = next(differences(one, other), None)
        if why is not None:
            raise UsageError(f"{one.path} and {other.path}: are not of one flight: {why}; {one_by_one(paths)}")
    try:
        find_mount(mount, ordered)
    except ConfigError as error:
        raise UsageError(f"{error}; {one_by_one(paths)}") from None
    return ordered


def differences(one: Part, other: Part) -> Iterator[str]:
    """Why two logs that follow each other are not of one flight; nothing where nothing speaks against it."""
    pause_s = pause_between_s(one, other)
    if pause_s > LONGEST_PAUSE_S:
        yield f"{_duration(pause_s)} lie between them ({utc_text(one.end_ns)} and {utc_text(other.start_ns)})"
    if one.place_deg is not None and other.place_deg is not None:
        away_m = distance_m(one.place_deg, other.place_deg)
        if away_m > SITE_M:
            yield f"they began {away_m / 1000.0:,.0f} km apart"
    if one.system is not None and other.system is not None and one.system != other.system:
        yield f"they are of vehicles {one.system} and {other.system}"
    if one.lidar != other.lidar:
        yield f"they are of different lidars, {one.lidar} and {other.lidar}"


def pause_between_s(one: Part, other: Part) -> float:
    """From the end of one log to the beginning of the next [s]: by GNSS too where both know it, for computers without a clock."""
    pause_ns = other.start_ns - one.end_ns
    if one.utc_ns is not None and other.utc_ns is not None:
        by_gnss_ns = pause_ns + other.utc_ns - one.utc_ns
        pause_ns = min(abs(pause_ns), abs(by_gnss_ns))
    return pause_ns / NS_PER_S


def distance_m(one_deg: tuple[float, float], other_deg: tuple[float, float]) -> float:
    """Along the ellipsoid [m]."""
    *_, away_m = _GEODESIC.inv(one_deg[1], one_deg[0], other_deg[1], other_deg[0])
    return float(away_m)


def one_by_one(paths: Sequence[Path]) -> str:
    """The command that processes several flights."""
    names = " ".join(shlex.quote(str(path)) for path in paths)
    return f'several flights are processed one by one: for log in {names}; do swath process "$log" -o "${{log%.mcap}}"; done'


def part_of(reader: LogReader) -> Part:
    """Read a log until it has told what is asked of it."""
    found: dict[str, int | tuple[float, float]] = {}
    for frame in _frames(reader):
        _hear(frame, found)
        if len(found) == 3:
            break
    place, utc, system = found.get("place"), found.get("utc"), found.get("system")
    try:
        lidar = lidar_of([reader]).name
    except SwathError:  # said by whoever reads the packets
        lidar = ""
    return Part(
        reader.path,
        reader.start_ns,
        reader.end_ns,
        utc if isinstance(utc, int) else None,
        place if isinstance(place, tuple) else None,
        system if isinstance(system, int) else None,
        lidar,
    )


def _frames(reader: LogReader) -> Iterator[Frame]:
    parser = FrameParser()
    for message in reader.messages((_LINK,)):
        for time_ns, data in records.decode_raw(message.data):
            yield from parser.feed(time_ns, data)
    yield from parser.finish()


def _hear(frame: Frame, found: dict[str, int | tuple[float, float]]) -> None:
    """Take from a frame what is still missing."""
    if not frame.known or frame.name not in ("GLOBAL_POSITION_INT", "SYSTEM_TIME", "ATTITUDE"):
        return
    row = mavlink.table([frame], frame.name)
    if frame.name == "GLOBAL_POSITION_INT":
        place = float(row["lat"][0]) * 1e-7, float(row["lon"][0]) * 1e-7
        if np.any(place):
            found.setdefault("place", place)
    elif frame.name == "SYSTEM_TIME":
        if row["time_unix_usec"][0]:
            found.setdefault("utc", int(row["time_unix_usec"][0]) * NS_PER_US - frame.time_ns)
    else:
        found.setdefault("system", frame.system)


def _duration(seconds: float) -> str:
    """In the unit that suits it."""
    for unit, size in (("years", 365.25 * 86400.0), ("days", 86400.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:,.1f} {unit}"
    return f"{seconds / 3600.0:.1f} hours"
