"""What is sent to an autopilot so that it speaks: heartbeats, and requests for streams that come too slowly."""

from collections import Counter
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog.constants import NS_PER_S
from flightlog.mavlink import AUTOPILOT_INVALID
from onboard.config import StreamsConfig
from onboard.health import LOW_RATE
from onboard.linkcounts import LinkCounts
from onboard.voice import Voice

_CHECK_NS: Final = 10 * NS_PER_S
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


def streams_asked(streams: StreamsConfig, kind: int) -> list[tuple[str, int, int]]:
    """Name and id of the message by which each stream asked for of a MAV_AUTOPILOT is judged, and the rate asked for [Hz]."""
    others = _ON_PX4 if kind == dialect.MAV_AUTOPILOT_PX4 else {}
    asked = [(others.get(message, message), getattr(streams, option)) for option, _, message in _STREAMS]
    return [(dialect.mavlink_map[message].msgname, message, rate) for message, rate in asked if rate]


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
