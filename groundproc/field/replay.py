"""Plays a flight log to UDP: the packets as they were recorded, at their times, for viewers, drivers and `swathd` itself."""

import heapq
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from flightlog import records
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError, SourceError, UsageError
from flightlog.hdl32e import DATA_PORT, POSITION_PORT
from flightlog.logfile import LogReader, Message

_HORIZON_NS: Final = NS_PER_S
"""Messages of different topics stand in a log out of order by less than this; a message spans about 0.1 s."""
_LONGEST_PAUSE_NS: Final = 10 * NS_PER_S
_SLICE_S: Final = 0.002
"""A timer is not finer than this on a busy machine; what is due within it is sent together."""
_LATE_S: Final = 0.05
_DATAGRAM_BYTES: Final = 65507
"""The largest that UDP over IPv4 carries."""


class Destination(NamedTuple):
    """Where to send to."""

    host: str = "127.0.0.1"
    lidar_port: int = DATA_PORT
    position_port: int = POSITION_PORT
    mavlink: tuple[str, int] | None = None
    """None: the autopilot's bytes are not sent."""
    link: str = "ins"
    """Which MAVLink link of the log."""


@dataclass(slots=True)
class Replayed:
    """What was sent."""

    data_packets: int = 0
    position_packets: int = 0
    mavlink_chunks: int = 0
    unheard: int = 0
    """Datagrams that the receiving machine refused: no program has the port."""
    pauses_cut: int = 0
    """Silences of more than 10 s, played as none."""
    late: int = 0
    """Datagrams sent more than 50 ms after their time."""
    worst_late_s: float = 0.0


class Event(NamedTuple):
    """One datagram."""

    time_ns: int
    """Receive time when it was recorded [ns of log time]."""
    topic: str
    payload: bytes


def datagrams(messages: Iterable[Message]) -> Iterator[Event]:
    """The datagrams of a log's messages in the order of their receive times, in bounded memory.

    Parameters
    ----------
    messages : iterable of Message
        Of lidar, position and MAVLink topics, as a LogReader gives them.
    """
    waiting: list[tuple[int, int, Event]] = []
    count = 0
    for message in messages:
        for event in _events(message):
            heapq.heappush(waiting, (event.time_ns, count, event))
            count += 1
        while waiting and waiting[0][0] < message.log_time_ns - _HORIZON_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


def _events(message: Message) -> Iterator[Event]:
    if message.topic == records.LIDAR.topic:
        packets = records.decode_scan(message.data)
        for time_ns, packet in zip(records.receive_time_ns(packets).tolist(), packets["data"], strict=True):
            yield Event(time_ns, message.topic, np.asarray(packet).tobytes())
    else:
        for time_ns, chunk in records.decode_raw(message.data):
            for start in range(0, len(chunk), _DATAGRAM_BYTES):
                yield Event(time_ns, message.topic, chunk[start : start + _DATAGRAM_BYTES])


def replay(
    paths: Sequence[Path],
    to: Destination,
    speed: float | None = 1.0,
    progress: Callable[[float], object] | None = None,
) -> Replayed:
    """Send what logs hold.

    Parameters
    ----------
    paths : sequence of Path
        Flight logs; several are played in the order of their beginnings.
    to : Destination
    speed : float or None
        Recorded seconds per second; None: as fast as the socket takes it.
    progress : callable, optional
        Called with the recorded seconds played since the last call.

    Raises
    ------
    LogError
        A log cannot be read, or none has anything to play.
    SourceError
        The address is none, or cannot be reached.
    """
    replayed = Replayed()
    with ExitStack() as stack:
        readers = [stack.enter_context(LogReader(path)) for path in paths]
        sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        addresses = _addresses(to)
        readers.sort(key=lambda reader: reader.start_ns)
        messages = (message for reader in readers for message in reader.messages(tuple(addresses)))
        for event in _paced(datagrams(messages), speed, replayed, progress):
            _send(sock, event, addresses[event.topic], replayed)
    if not (replayed.data_packets or replayed.position_packets or replayed.mavlink_chunks):
        raise LogError(f"{', '.join(map(str, paths))}: nothing in there to play")
    return replayed


def _addresses(to: Destination) -> dict[str, tuple[str, int]]:
    """Where each topic goes."""
    host = _resolve(to.host)
    addresses = {records.LIDAR.topic: (host, to.lidar_port), records.POSITION.topic: (host, to.position_port)}
    if to.mavlink is not None:
        addresses[records.MAVLINK.topic + to.link] = (_resolve(to.mavlink[0]), to.mavlink[1])
    return addresses


def _resolve(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise SourceError(f"{host}: no such address ({getattr(error, 'strerror', None) or error})") from None


def _paced(
    events: Iterator[Event], speed: float | None, replayed: Replayed, progress: Callable[[float], object] | None
) -> Iterator[Event]:
    """Yield each event when it is due."""
    start_s, first_ns, before_ns, shown_ns = time.monotonic(), None, 0, 0
    for event in events:
        if first_ns is None:
            first_ns = shown_ns = before_ns = event.time_ns
        pause_ns = event.time_ns - before_ns
        if abs(pause_ns) > _LONGEST_PAUSE_NS:  # another flight, or one without anybody there
            first_ns += pause_ns
            shown_ns += pause_ns
            replayed.pauses_cut += 1
        before_ns = event.time_ns
        if speed is not None:
            late_s = _wait(start_s + (event.time_ns - first_ns) / NS_PER_S / speed)
            replayed.worst_late_s = max(replayed.worst_late_s, late_s)
            replayed.late += late_s > _LATE_S
        if progress is not None and event.time_ns - shown_ns > NS_PER_S // 5:
            progress((event.time_ns - shown_ns) / NS_PER_S)
            shown_ns = event.time_ns
        yield event


def _wait(due_s: float) -> float:
    """Wait until it is due; gives by how much it is late [s]."""
    now_s = time.monotonic()
    if due_s - now_s > _SLICE_S:
        time.sleep(due_s - now_s)
        now_s = time.monotonic()
    return max(now_s - due_s, 0.0)


def _send(sock: socket.socket, event: Event, address: tuple[str, int], replayed: Replayed) -> None:
    try:
        sock.sendto(event.payload, address)
    except ConnectionRefusedError:
        replayed.unheard += 1
        return
    except OSError as error:
        raise SourceError(f"{address[0]}:{address[1]} cannot be sent to ({error.strerror})") from None
    if event.topic == records.LIDAR.topic:
        replayed.data_packets += 1
    elif event.topic == records.POSITION.topic:
        replayed.position_packets += 1
    else:
        replayed.mavlink_chunks += 1


def parse_speed(text: str) -> float | None:
    """`max`, or how many recorded seconds go into one; UsageError for anything else."""
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.01 <= speed <= 1000.0:
        raise UsageError(f"--speed {text!r}: expected max, or a number of 0.01 to 1000")
    return speed


def parse_mavlink(text: str) -> tuple[str, int]:
    """`udp:ADDRESS:PORT`; UsageError for anything else."""
    host, _, port = text.removeprefix("udp:").rpartition(":")
    if not text.startswith("udp:") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"--mavlink {text!r}: expected udp:ADDRESS:PORT")
    return host, int(port)
