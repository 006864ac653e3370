"""A whole log in figures: one pass over its messages, one accumulator for each kind of record."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog import clock, records
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError, SwathError, WrongSensorError
from flightlog.logfile import LogReader, Message
from flightlog.mavlink import FrameParser
from groundproc import sensors
from groundproc.flight import claims
from groundproc.flight.flight import read_flight
from groundproc.flight.lidar import lidar_of
from groundproc.flight.load import BatchJoiner, DeviceClock, Progress
from groundproc.flight.positionpackets import PositionBatch
from groundproc.flight.summary.lidar import LidarSummary
from groundproc.flight.summary.position import PositionSummary
from groundproc.flight.summary.rates import rate_hz, rounded
from groundproc.flight.summary.telemetry import TelemetrySummary
from groundproc.sensors import velodyne
from groundproc.sensors.model import Lidar

GAP_NS: Final = NS_PER_S
"""A silence longer than this is told."""
_MOST_GAPS: Final = 50


@dataclass(slots=True)
class _Topic:
    messages: int = 0
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0
    received_ns: int | None = None
    """Receive time of the last packet or chunk."""


@dataclass(slots=True)
class LogSummary:
    """Accumulates a log message by message.

    Attributes
    ----------
    model : Lidar
        Of its lidar.
    """

    model: Lidar
    topics: dict[str, _Topic] = field(default_factory=dict)
    lidar: LidarSummary = field(init=False)
    position: PositionSummary = field(default_factory=PositionSummary)
    links: dict[str, tuple[FrameParser, TelemetrySummary]] = field(default_factory=dict)
    gaps: list[dict[str, Any]] = field(default_factory=list)
    gap_count: int = 0
    backwards: int = 0
    """Messages whose log time lies before that of the message ahead of them in the same topic."""
    damaged: int = 0
    """Messages that are not what their topic says."""
    clock_steps: int = 0
    _batches: BatchJoiner = field(init=False)
    _position_clock: DeviceClock = field(default_factory=DeviceClock)

    def __post_init__(self) -> None:
        self.lidar = LidarSummary(self.model)
        self._batches = BatchJoiner(self.model, DeviceClock())

    def add(self, message: Message) -> None:
        """Take the next message."""
        topic = self.topics.get(message.topic)
        if topic is None:
            topic = self.topics[message.topic] = _Topic(first_ns=message.log_time_ns)
        self.backwards += topic.messages > 0 and message.log_time_ns < topic.last_ns
        topic.messages += 1
        topic.size += len(message.data)
        topic.last_ns = max(topic.last_ns, message.log_time_ns)
        try:
            self._records(message, topic)
        except LogError:
            self.damaged += 1

    def _records(self, message: Message, topic: _Topic) -> None:
        if message.topic in self._batches.topics:
            for batch in self._batches.feed(message):
                self.lidar.add(batch)
            if message.topic == self.model.topic:
                self._gap(message.topic, topic, self.model.receive_time_ns(self.model.unpack(message.data)))
        elif message.topic == records.POSITION.topic:
            self._position(message, topic)
        elif message.topic.startswith(records.MAVLINK.topic):
            chunks = records.decode_raw(message.data)
            self._gap(message.topic, topic, np.array([time_ns for time_ns, _ in chunks], np.int64))
            link = message.topic.removeprefix(records.MAVLINK.topic)
            parser, telemetry = self.links.setdefault(link, (FrameParser(), TelemetrySummary()))
            for time_ns, data in chunks:
                for frame in parser.feed(time_ns, data):
                    telemetry.add(frame)
        elif message.topic == records.HOST_CLOCK.topic:
            self.clock_steps += abs(records.decode_host_clock(message.data).step_ns) > NS_PER_S // 20

    def _position(self, message: Message, topic: _Topic) -> None:
        receive_ns, packets = records.decode_position(message.data)
        good = velodyne.is_position(packets)
        receive_ns, packets = receive_ns[good], packets[good]
        self._gap(message.topic, topic, receive_ns)
        if len(packets):
            device_ns, _ = self._position_clock.extend(packets["stamp_us"], receive_ns)
            self.position.add(PositionBatch(velodyne.readings(packets), receive_ns, device_ns))

    def _gap(self, name: str, topic: _Topic, received_ns: npt.NDArray[np.int64]) -> None:
        """Note the silences ahead of and between packets."""
        if not len(received_ns):
            return
        times_ns = received_ns if topic.received_ns is None else np.append(topic.received_ns, received_ns)
        topic.received_ns = int(received_ns[-1])
        passed_ns = np.diff(times_ns)
        for i in np.flatnonzero(passed_ns > GAP_NS):
            self.gap_count += 1
            if len(self.gaps) < _MOST_GAPS:
                from_utc, seconds = clock.utc_text(int(times_ns[i])), round(int(passed_ns[i]) / NS_PER_S, 3)
                self.gaps.append({"topic": name, "from_utc": from_utc, "duration_s": seconds})

    def finish(self) -> None:
        """Take what is still held back; no more messages will come."""
        for batch in self._batches.finish():
            self.lidar.add(batch)
        for parser, telemetry in self.links.values():
            for frame in parser.finish():
                telemetry.add(frame)

    def result(self) -> dict[str, Any]:
        """The figures of the messages; see `swath info --json`."""
        return {
            "topics": {name: _topic(name, topic) for name, topic in sorted(self.topics.items())},
            "lidar": self.lidar.result() if self._seen(*self._batches.topics) else None,
            "position": self.position.result() if self._seen(records.POSITION.topic) else None,
            "mavlink": {
                link: telemetry.result(parser.bad_bytes, parser.unknown)
                for link, (parser, telemetry) in sorted(self.links.items())
            },
            "utc": self._utc(),
            "lidar_with_autopilot_s": self._together_s(),
            "gaps": self.gaps,
            "gap_count": self.gap_count,
            "messages_backwards": self.backwards,
            "messages_damaged": self.damaged,
            "host_clock_steps": self.clock_steps,
        }

    def _claims(self) -> tuple[dict[str, int], bool]:
        """What each source says that UTC was at the first SYSTEM_TIME, else at the lidar's first fix; and whether the lidar's is exact."""
        pilot = next((each for _, each in self.links.values() if each.first_utc_ns is not None), None)
        fix = self.position.first_utc_ns()
        host_ns = pilot.first_utc_received_ns if pilot is not None else self.position.first_fix_received_ns
        found = {claims.HOST: host_ns} if host_ns else {}
        if pilot is not None and pilot.first_utc_ns is not None:
            found[claims.SYSTEM_TIME] = pilot.first_utc_ns
        if fix is not None:
            found[claims.GPRMC] = fix[0] + host_ns - self.position.first_fix_received_ns
        return found, fix is not None and fix[1]

    def _utc(self) -> dict[str, Any]:
        """Absolute times held against each other; those mended."""
        claimed, exact = self._claims()
        held = claims.settled(claimed, exact=exact)
        return {
            "claims": {name: clock.utc_text(utc_ns) for name, utc_ns in claimed.items()},
            "right": {name: clock.utc_text(claimed[name] + add_ns) for name, add_ns in held.add_ns.items()},
            "mended": list(held.mended),
            "doubts": list(held.doubts),
        }

    def _together_s(self) -> float | None:
        """Seconds in which both lidar and autopilot were recorded; None where one of them was not at all."""
        lidar, link = self.topics.get(self.model.topic), self.topics.get(f"{records.MAVLINK.topic}ins")
        if lidar is None or link is None:
            return None
        both_ns = min(lidar.last_ns, link.last_ns) - max(lidar.first_ns, link.first_ns)
        return round(max(both_ns, 0) / NS_PER_S, 3)

    def _seen(self, *topics: str) -> bool:
        return any(topic in self.topics for topic in topics)


def _topic(name: str, topic: _Topic) -> dict[str, Any]:
    span_ns = topic.last_ns - topic.first_ns
    # the stamps of a dataflash log's pieces say nothing but their order
    rate = None if name.startswith(records.DATAFLASH.topic) else rate_hz(topic.messages, span_ns)
    return {
        "messages": topic.messages,
        "bytes": topic.size,
        "rate_hz": rounded(rate, 3),
        "duration_s": round(span_ns / NS_PER_S, 3),
    }


def summarise(reader: LogReader, progress: Progress | None = None) -> dict[str, Any]:
    """Read a log once, in bounded memory, and give its figures.

    Parameters
    ----------
    reader : LogReader
    progress : callable, optional
        Called with the number of file bytes done since the last call.

    Returns
    -------
    dict
        JSON-ready; keys are stable.
    """
    try:
        model = lidar_of([reader])
    except WrongSensorError:  # what else the log holds is worth telling all the same
        model = sensors.lidar(sensors.FLOWN)
    summary = LogSummary(model)
    for message in reader.messages(progress=progress):
        summary.add(message)
    summary.finish()
    damage = reader.damage
    found = summary.result()
    for link, mavlink in found["mavlink"].items():
        # numbers that jump all the time are of several senders with one id
        if len(mavlink["autopilots"]) > 1 or mavlink["lost_frames"] > mavlink["frames"]:
            _tell_vehicles(reader, link, mavlink)
    return {
        "file": str(reader.path),
        "bytes": reader.size,
        "format_version": reader.metadata.get("swath.log", {}).get("format_version"),
        "start_utc": clock.utc_text(reader.start_ns) if reader.start_ns else None,
        "end_utc": clock.utc_text(reader.end_ns) if reader.end_ns else None,
        "duration_s": round((reader.end_ns - reader.start_ns) / NS_PER_S, 3),
        "truncated": damage.truncated,
        "damage": {"bad_chunks": damage.bad_chunks, "lost_bytes": damage.lost_bytes, "places": damage.places},
        "session": reader.metadata.get("swath.session", {}),
        "attachments": sorted(reader.attachments),
        **found,
    }


def _tell_vehicles(reader: LogReader, link: str, mavlink: dict[str, Any]) -> None:
    """Which of several vehicles on a link is taken, by another reading of the log: gyros do not fit in bounded memory."""
    try:
        choice = read_flight([reader], link).choice
    except SwathError as error:
        if len(mavlink["autopilots"]) > 1:
            mavlink["notes"] = [f"several vehicles on the link, and no telling which carries the lidar: {error}"]
        return
    mavlink["notes"], mavlink["shared_ids"] = list(choice.notes), list(choice.shared)
