"""The MCAP file: all topics of a flight in the order of their time, in bounded memory."""

import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from flightlog import __version__
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from flightlog.logwriter import QOS
from flightlog.mcapwriter import McapWriter
from flightlog.mount import Mount
from groundproc.estimation import ins, ownsolution
from groundproc.files import written_aside
from groundproc.flight import flight as flights
from groundproc.flight.shots import Tally, shots
from groundproc.geodesy import LocalFrame
from groundproc.ros import messages, streams
from groundproc.ros.scale import UTC, Scale, scale_of
from groundproc.ros.streams import KINDS, ODOMETRY_KIND, PATH_KIND, Record
from groundproc.sensors.shots import Gate
from groundproc.trajectory.estimate import Estimate
from groundproc.trajectory.trajectory import Trajectory

_CHUNK_BYTES: Final = 4 << 20
_LATCHED: Final = QOS.replace("history: 1", "history: 3").replace("durability: 2", "durability: 1")
"""For what is said once and must be heard by whoever comes later."""
OWN: Final = "/autopilot"
"""Topics of the autopilot's own trajectory."""


@dataclass(frozen=True, slots=True)
class Written:
    """What a bag holds.

    Attributes
    ----------
    scale : str
        "UTC" or "log time".
    messages : dict of str to int
        By topic.
    notes : tuple of str
        What could not be written, and why.
    """

    scale: str
    messages: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Way:
    """A trajectory and the names of its topics."""

    trajectory: Trajectory
    prefix: str


def write_bag(
    readers: Sequence[LogReader],
    output: Path,
    mount: Mount,
    gate: Gate,
    estimate: Estimate | None,
    progress: Callable[[str, int], None],
) -> Written:
    """Write a flight as decoded topics.

    Parameters
    ----------
    readers : sequence of LogReader
        In order of time.
    output : Path
        It appears when it is whole.
    mount : Mount
        Of the log; that of the estimate goes before it.
    gate : Gate
        Which shots are written.
    estimate : Estimate, optional
        Its trajectory is the way of the body, its mount and lasers place the points; without it the autopilot's own way is taken.
    progress : callable
        Told ("read" or "write", bytes of the logs done).

    Raises
    ------
    LogError
        No lidar packets.
    ClockError
        The estimate's clocks do not fit the log.
    """
    runs, boots, lidar = flights.read_clocks(readers, "ins", lambda done: progress("read", done))
    mount = estimate.mount if estimate is not None else mount
    scale = scale_of(runs, boots, mount, estimate.ties if estimate is not None else ())
    ways, notes = _ways(scale, mount, estimate)
    lasers = None if estimate is None else estimate.corrections.table(lidar.lasers)
    tally = Tally()
    pieces = shots(readers, scale.lidar, gate, lasers, tally, lambda done: progress("write", done))
    sources: list[Iterator[Record]] = [streams.points(pieces)]
    sources += [streams.lidar_imu(run, tie) for run, tie in zip(runs, scale.lidar, strict=False)]
    for pilot in scale.pilots:
        sources += [streams.imu(pilot), streams.attitude(pilot), streams.fixes(pilot)]
    sources += [streams.poses(way.trajectory, f"{way.prefix}/odometry") for way in ways]
    kinds = KINDS | dict.fromkeys((f"{way.prefix}/odometry" for way in ways), ODOMETRY_KIND)
    kinds |= dict.fromkeys((f"{way.prefix}/path" for way in ways), PATH_KIND)
    merged = heapq.merge(*sources, key=lambda record: record.time_ns)
    first = next(merged, None)
    if first is None:
        raise LogError(f"{readers[0].path}: holds nothing to write")
    latched = [streams.mounted(first.time_ns, mount)]
    latched += [streams.path(way.trajectory, f"{way.prefix}/path") for way in ways]
    with written_aside(output) as aside, aside.open("wb") as stream:
        writer = McapWriter(stream, "ros2", f"swath {__version__}", _CHUNK_BYTES, "zstd")
        writer.add_metadata("swath.bag", _facts(readers, scale, ways))
        counts = _write(writer, itertools.chain(latched, [first], merged), kinds)
        writer.finish()
    return Written(scale.name, counts, (*notes, *_losses(scale, tally)))


def _write(writer: McapWriter, records: Iterator[Record], kinds: dict[str, str]) -> dict[str, int]:
    """Write messages; a path has the time of the message behind it, so that the file's times never go back."""
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    counts: Counter[str] = Counter()
    for time_ns, topic, data in records:
        if topic not in channels:
            kind = kinds[topic]
            if kind not in schemas:
                schemas[kind] = writer.add_schema(kind, "ros2msg", messages.definition(kind).encode())
            latched = kind == PATH_KIND or topic == streams.TF_STATIC
            qos = _LATCHED if latched else QOS
            channels[topic] = writer.add_channel(topic, "cdr", schemas[kind], {"offered_qos_profiles": qos})
        writer.add_message(channels[topic], time_ns, data)
        counts[topic] += 1
    return dict(sorted(counts.items()))


def _ways(scale: Scale, mount: Mount, estimate: Estimate | None) -> tuple[list[_Way], list[str]]:
    """The trajectories that are written, and why there is none."""
    if estimate is not None:
        return [_Way(estimate.trajectory, "")], []
    if scale.name != UTC:
        return [], [f"times are log time, and there is no /tf of the map: {scale.note}"]
    found: list[_Way] = []
    reasons: list[str] = []
    frame: LocalFrame | None = None
    for pilot in scale.pilots:
        try:
            fixes = ownsolution.position_fixes(pilot.boot, "msl")
            origin = float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]), float(fixes.height_m[0])
            frame = frame or LocalFrame(*origin)
            trajectory = ins.ins_trajectory(pilot.boot, fixes, frame, pilot.to_scale, mount)
        except LogError as error:
            reasons.append(f"no /tf of the map: {error}")
            continue
        found.append(_Way(trajectory, OWN))
    return found[:1], reasons + ([f"{len(found) - 1} later boots of the autopilot have no /tf"] if found[1:] else [])


def _facts(readers: Sequence[LogReader], scale: Scale, ways: Sequence[_Way]) -> dict[str, str]:
    """What the bag says of itself."""
    facts = {
        "version": __version__,
        "logs": ", ".join(reader.path.name for reader in readers),
        "time": scale.name,
        "note": scale.note,
    }
    for way in ways:
        frame = way.trajectory.frame
        facts["map_origin"] = f"{frame.latitude_deg!r} {frame.longitude_deg!r} {frame.height_m!r}"
    return facts


def _losses(scale: Scale, tally: Tally) -> list[str]:
    """What is in the log and not in the bag, in sentences."""
    found = []
    if tally.packets_without_leg:
        found.append(f"{tally.packets_without_leg:,} lidar packets go with no autopilot and were left out")
    if scale.boots_without:
        found.append(f"{scale.boots_without} boots of the autopilot go with no lidar and were left out")
    return found
