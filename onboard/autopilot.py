"""MAVLink links, serial or UDP: bytes are logged as received, and parsed only to see if the autopilot is alive.

The link may come and go: it is reopened as often as needed, and the rest of the daemon does not notice.
"""

import logging
import select
import time
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import records
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import SourceError
from flightlog.mavlink import AUTOPILOT_INVALID, Frame, FrameParser, decode, field_offset
from flightlog.signing import Checker, Word, read_key, time_of
from flightlog.vehicles import Sender, Vehicles
from onboard.autopilotclock import AutopilotClock
from onboard.config import LinkConfig, StreamsConfig
from onboard.health import LOW_RATE
from onboard.lidar import Put
from onboard.sources import Chunk, Source, UdpSource, open_source
from onboard.timesync import LogTime, read_clocks
from onboard.voice import COMPONENT as COMPONENT
from onboard.voice import Voice
from onboard.worker import Worker

_log = logging.getLogger(__name__)

BATCH_NS: Final = 100 * NS_PER_MS
"""A message of the log spans about this much."""
_WAIT_S: Final = 0.1
_RETRY_S: Final = (0.5, 1.0, 2.0, 5.0)

_CHECK_NS: Final = 10 * NS_PER_S
_OUTBOX: Final = 20
"""Messages that wait to be sent; while the link is down the oldest go."""

_STREAMS: Final = (
    ("raw_sensors_hz", dialect.MAV_DATA_STREAM_RAW_SENSORS, dialect.MAVLINK_MSG_ID_RAW_IMU),
    ("extended_status_hz", dialect.MAV_DATA_STREAM_EXTENDED_STATUS, dialect.MAVLINK_MSG_ID_GPS_RAW_INT),
    ("position_hz", dialect.MAV_DATA_STREAM_POSITION, dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT),
    ("extra1_hz", dialect.MAV_DATA_STREAM_EXTRA1, dialect.MAVLINK_MSG_ID_ATTITUDE),
    ("extra2_hz", dialect.MAV_DATA_STREAM_EXTRA2, dialect.MAVLINK_MSG_ID_VFR_HUD),
    ("extra3_hz", dialect.MAV_DATA_STREAM_EXTRA3, dialect.MAVLINK_MSG_ID_SYSTEM_TIME),
)
"""Option, stream, and the message by which its rate is judged."""
_ON_PX4: Final = {dialect.MAVLINK_MSG_ID_RAW_IMU: dialect.MAVLINK_MSG_ID_HIGHRES_IMU}
"""What PX4 has in place of a message."""
_BESIDE: Final = {dialect.MAVLINK_MSG_ID_GPS_RAW_INT: (dialect.MAVLINK_MSG_ID_SYS_STATUS,)}
"""What else of a stream is asked for where each message is asked for by itself."""
_VERSION_TRIES: Final = 3
_AUTOPILOT_AT: Final = field_offset("HEARTBEAT", "autopilot")


@dataclass(slots=True)
class LinkCounts:
    """What came over a link since the start."""

    connected: bool = False
    trouble: str = ""
    """Why it is not connected."""
    opened: int = 0
    received_bytes: int = 0
    queue_dropped_bytes: int = 0
    kernel_drops: int = 0
    frames: int = 0
    bad_bytes: int = 0
    unknown_frames: int = 0
    messages: Counter[int] = field(default_factory=Counter)
    """Verified frames of the autopilot, by message id."""
    vehicles: Vehicles = field(default_factory=Vehicles)
    """Who speaks here, and which of them is the autopilot."""
    achieved_hz: dict[str, float] = field(default_factory=dict)
    """Of each message asked for, over the last seconds looked at [Hz]."""
    asked_hz: dict[str, int] = field(default_factory=dict)
    requests: int = 0
    """How many streams were asked for, or asked for again."""
    kind: int = dialect.MAV_AUTOPILOT_GENERIC
    """MAV_AUTOPILOT of the autopilot, as its heartbeat says."""
    firmware: str = ""
    """Its version, such as 4.5.7; empty: it has not said."""
    signatures: dict[str, int] = field(default_factory=dict)
    """Frames by what their signatures say, where there is a key."""

    @property
    def autopilot(self) -> tuple[int, int] | None:
        """System and component of the autopilot."""
        return self.vehicles.autopilot

    @property
    def _sender(self) -> Sender:
        return _NOBODY if self.vehicles.autopilot is None else self.vehicles.senders[self.vehicles.autopilot]

    @property
    def version(self) -> int:
        """Of MAVLink, as the autopilot speaks it."""
        return self._sender.version

    @property
    def heartbeats(self) -> int:
        """Of the autopilot."""
        return self._sender.heartbeats

    @property
    def newest_ns(self) -> int:
        """Log time of the autopilot's newest verified frame [ns]; 0 before the first."""
        return self._sender.newest_ns

    def armed(self, log_ns: int) -> bool | None:
        """Whether the aircraft is armed, as far as somebody heard lately says; None where nobody does."""
        return self.vehicles.armed(log_ns)


_NOBODY: Final = Sender(0)


class Link(Worker):
    """Reads one MAVLink link into the log.

    Parameters
    ----------
    name : str
        `ins` or `fc`; its topic is /mavlink/<name>.
    config : LinkConfig
    log_time : LogTime
    put : callable
        The recorder's.
    """

    def __init__(self, name: str, config: LinkConfig, log_time: LogTime, put: Put) -> None:
        super().__init__(name)
        self.counts = LinkCounts()
        self._config, self._log_time, self._put = config, log_time, put
        self._topic = records.MAVLINK.topic + name
        self._chunks: list[Chunk] = []
        self._parser = FrameParser()
        key = None if config.signing_key is None else read_key(Path(config.signing_key))
        self._checker = None if key is None else Checker(key)
        self._voice = Voice(key)
        self._requester = Requester(config.streams, self._voice)
        self.clock = AutopilotClock(name)
        self._outbox: deque[dialect.MAVLink_message] = deque(maxlen=_OUTBOX)

    def tell(self, messages: Iterable[dialect.MAVLink_message]) -> None:
        """Send messages to the autopilot and through it to the ground, if it listens."""
        if self.listens:
            self._outbox.extend(messages)

    @property
    def listens(self) -> bool:
        """Whether this is a link to talk on, and an autopilot is heard on it."""
        return self._config.requests and self.counts.connected and self.counts.autopilot is not None

    def work(self) -> None:
        """Open, read, open again, until asked to stop."""
        tries = 0
        while not self.stopping:
            try:
                source = open_source(self._config, self._log_time)
            except SourceError as error:
                self._tell_trouble(str(error))
                self._wait(_RETRY_S[min(tries, len(_RETRY_S) - 1)])
                tries += 1
                continue
            tries = 0
            self._tell_connected()
            try:
                self._read(source)
            except OSError as error:
                self._tell_trouble(f"{self._config.device}: {error.strerror or error}")
                self._wait(_RETRY_S[0])
            finally:
                self._hand_over()
                self.counts.connected = False
                source.close()

    def _wait(self, seconds: float) -> None:
        """Wait between two attempts without looking dead."""
        for _ in range(round(seconds / _WAIT_S)):
            self.progress()
            self.pause(_WAIT_S)

    def _read(self, source: Source) -> None:
        poll = select.poll()
        poll.register(source.fileno(), select.POLLIN)
        while not self.stopping:
            if poll.poll(_WAIT_S * 1000):
                self._take(source.read())
            now_ns = self._log_time.at(read_clocks())
            if self._chunks and now_ns - self._chunks[0][0] >= BATCH_NS:
                if isinstance(source, UdpSource):
                    self.counts.kernel_drops = source.drops
                self._hand_over()
            if self._config.requests:
                self._talk(source, now_ns)
            self.progress()
            self.pause(source.pause_s)
        if poll.poll(0):  # reading nothing from a serial device looks like its end
            self._take(source.read())

    def _take(self, chunks: list[Chunk]) -> None:
        """Keep the chunks for the log, and examine the frames in them."""
        self._chunks += chunks
        for time_ns, data in chunks:
            frames = self._believed(self._parser.feed(time_ns, data))
            note_frames(self.counts, frames)
            for frame in frames:
                if frame.known and (frame.system, frame.component) == self.counts.autopilot:
                    answer = self.clock.hear(frame)
                    if answer is not None:
                        self.tell([answer])
        self.counts.bad_bytes = self._parser.bad_bytes
        self.counts.unknown_frames = self._parser.unknown

    def _believed(self, frames: list[Frame]) -> list[Frame]:
        """Those frames that nobody else can have sent; where there is no key, all."""
        if self._checker is None:
            return frames
        good = [frame for frame in frames if frame.known and self._checker.check(frame) is Word.GOOD]
        self.counts.signatures = {word.value: count for word, count in self._checker.counts.items()}
        self._voice.sign_from(self._checker.newest + 1)
        return good

    def _talk(self, source: Source, now_ns: int) -> None:
        """Send what is due."""
        if self._checker is not None:
            self._voice.sign_from(time_of(time.time_ns()))
        for data in self._requester.due(self.counts, now_ns):
            source.write(data)
        if self.counts.autopilot is None:
            return
        system, version = self.counts.autopilot[0], self.counts.version
        while self._outbox:
            source.write(self._voice.frame(self._outbox.popleft(), system, version))
        sent_ns = self._log_time.at(read_clocks())
        if (question := self.clock.question(sent_ns)) is not None:
            source.write(self._voice.frame(question, system, version))

    def _hand_over(self) -> None:
        """Give the chunks to the recorder."""
        if not self._chunks:
            return
        chunks, self._chunks = self._chunks, []
        stamp_ns = chunks[-1][0]
        size = sum(len(data) for _, data in chunks)
        self.counts.received_bytes += size
        if not self._put(self._topic, stamp_ns, records.encode_raw(stamp_ns, chunks, self.name), True):
            self.counts.queue_dropped_bytes += size

    def _tell_trouble(self, sentence: str) -> None:
        if sentence != self.counts.trouble:
            _log.warning("link %s: %s; trying again", self.name, sentence)
        self.counts.trouble = sentence

    def _tell_connected(self) -> None:
        self.counts.connected, self.counts.trouble = True, ""
        self.counts.opened += 1
        self._requester.start()
        _log.info("link %s: %s is open", self.name, self._config.device)


def streams_asked(streams: StreamsConfig, kind: int) -> list[tuple[str, int, int]]:
    """Name and id of the message by which each stream asked for of a MAV_AUTOPILOT is judged, and the rate asked for [Hz]."""
    others = _ON_PX4 if kind == dialect.MAV_AUTOPILOT_PX4 else {}
    asked = [(others.get(message, message), getattr(streams, option)) for option, _, message in _STREAMS]
    return [(dialect.mavlink_map[message].msgname, message, rate) for message, rate in asked if rate]


def note_frames(counts: LinkCounts, frames: list[Frame]) -> None:
    """Count frames; those of an id that cannot be verified are no sign of life."""
    for frame in frames:
        if not frame.known:
            continue
        counts.frames += 1
        if counts.vehicles.hear(frame):
            _tell_autopilot(counts)
        if (frame.system, frame.component) == counts.autopilot:
            counts.messages[frame.message_id] += 1
            _note_kind(counts, frame)


def _note_kind(counts: LinkCounts, frame: Frame) -> None:
    """What the autopilot says of itself."""
    if frame.message_id == dialect.MAVLINK_MSG_ID_HEARTBEAT and _AUTOPILOT_AT is not None:
        counts.kind = frame.payload.ljust(9, b"\x00")[_AUTOPILOT_AT]
    elif frame.message_id == dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION and (said := decode(frame)) is not None:
        major, minor, patch, _ = int(said.flight_sw_version).to_bytes(4, "big")
        counts.firmware = f"{major}.{minor}.{patch}"


def _tell_autopilot(counts: LinkCounts) -> None:
    """Say who the autopilot is, and who else might be."""
    first, *others = (f"{system}/{component}" for system, component in counts.vehicles.vehicles())
    if counts.autopilot is None:
        _log.warning("nobody on the link is an autopilot any more")
    elif others:
        _log.warning("autopilot %s heard, MAVLink %d; other vehicles: %s", first, counts.version, ", ".join(others))
    else:
        _log.info("autopilot %s heard, MAVLink %d", first, counts.version)


class Requester:
    """What to send to the autopilot, and when: our heartbeat each second, and requests for streams that come too slowly.

    ArduCopter 3.1.3 knows only REQUEST_DATA_STREAM, and only as MAVLink 1: we answer in the version that the autopilot speaks.
    """

    def __init__(self, streams: StreamsConfig, voice: Voice | None = None) -> None:
        self._streams = [
            (stream, rate, message) for option, stream, message in _STREAMS if (rate := getattr(streams, option))
        ]
        self._voice = voice or Voice()
        self.start()

    def start(self) -> None:
        """Begin anew, on a link that was just opened."""
        self._heartbeat_ns = 0
        self._checked_ns: int | None = None
        self._before: Counter[int] = Counter()
        self._tries: Counter[int] = Counter()
        self._version_tries = 0

    def due(self, counts: LinkCounts, now_ns: int) -> list[bytes]:
        """Frames to send now; `now_ns` is log time."""
        if counts.autopilot is None or now_ns - self._heartbeat_ns < NS_PER_S:
            return []
        self._heartbeat_ns = now_ns
        heartbeat = dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_ONBOARD_CONTROLLER, AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
        )
        messages = [heartbeat, *self._version_request(counts, counts.autopilot)]
        messages += self._requests(counts, counts.autopilot, now_ns)
        return [self._voice.frame(message, counts.autopilot[0], counts.version) for message in messages]

    def _version_request(self, counts: LinkCounts, autopilot: tuple[int, int]) -> list[dialect.MAVLink_message]:
        """Ask for the firmware's version, a few times; those that speak version 1 have none to tell."""
        if counts.version != 2 or counts.firmware or self._version_tries >= _VERSION_TRIES:
            return []
        self._version_tries += 1
        return [_command(autopilot, dialect.MAV_CMD_REQUEST_MESSAGE, float(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION))]

    def _asking(
        self, counts: LinkCounts, autopilot: tuple[int, int], wanted: tuple[int, int, int]
    ) -> list[dialect.MAVLink_message]:
        """What asks for a stream: message by message, and if that brings nothing as the old firmwares want it, in turn."""
        stream, rate, message = wanted
        self._tries[message] += 1
        if counts.version != 2 or self._tries[message] % 2 == 0:
            return [dialect.MAVLink_request_data_stream_message(*autopilot, stream, rate, 1)]
        return [
            _command(autopilot, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e6 / rate)
            for number in (message, *_BESIDE.get(message, ()))
        ]

    def _requests(self, counts: LinkCounts, autopilot: tuple[int, int], now_ns: int) -> list[dialect.MAVLink_message]:
        streams = self._streams
        if counts.kind == dialect.MAV_AUTOPILOT_PX4:
            streams = [(stream, rate, _ON_PX4.get(message, message)) for stream, rate, message in streams]
        if self._checked_ns is None:
            low = streams
        elif now_ns - self._checked_ns < _CHECK_NS:
            return []
        else:
            seconds = (now_ns - self._checked_ns) / NS_PER_S
            hz = {message: (counts.messages[message] - self._before[message]) / seconds for *_, message in streams}
            counts.achieved_hz = {dialect.mavlink_map[message].msgname: round(rate, 1) for message, rate in hz.items()}
            counts.asked_hz = {dialect.mavlink_map[message].msgname: rate for _, rate, message in streams}
            low = [(stream, rate, message) for stream, rate, message in streams if hz[message] < LOW_RATE * rate]
        self._checked_ns, self._before = now_ns, Counter(counts.messages)
        counts.requests += len(low)
        return [message for wanted in low for message in self._asking(counts, autopilot, wanted)]


def _command(autopilot: tuple[int, int], command: int, *parameters: float) -> dialect.MAVLink_message:
    """A COMMAND_LONG."""
    values = (*parameters, *(0.0,) * (7 - len(parameters)))
    return dialect.MAVLink_command_long_message(*autopilot, command, 0, *values)
