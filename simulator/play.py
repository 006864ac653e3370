"""Plays a rendered flight in real time: the lidar's packets by UDP, the MAVLink bytes through a pseudo terminal.

To whoever records, it is the sensor's network and the autopilot's serial port.
"""

import heapq
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from flightlog.constants import NS_PER_S
from flightlog.errors import CaptureError, SourceError
from flightlog.hdl32e import DATA_PORT

with suppress(ImportError):  # not on every system
    import fcntl
    import pty
    import termios
    import tty

TERMINALS: Final = "pty" in globals()
_PCAP_HEAD: Final = 24
_FRAME_HEAD: Final = 42
_SLICE_S: Final = 0.002
"""Events due within this time are sent together; a timer is not finer than this on a busy machine."""
_PATIENCE_S: Final = 5.0
"""For a reader of the terminal that takes nothing: a busy machine may not let it run for a second or two."""
_ABSENT_S: Final = 0.5
"""For one that let the terminal fill up before."""
_LOOKS: Final = 10
"""So many times in turn the terminal has to be empty: what was written reaches it a moment later."""


class Target(NamedTuple):
    """Where to play to."""

    host: str = "127.0.0.1"
    lidar_port: int = 2368
    position_port: int = 8308
    pty_link: Path | None = None
    wait_s: float = 0.0


@dataclass(slots=True)
class Played:
    """What was sent."""

    packets: int = 0
    frames: int = 0
    unread_bytes: int = 0
    """Bytes that the terminal did not take because nobody reads it."""
    refused_packets: int = 0
    worst_late_s: float = 0.0


class _Event(NamedTuple):
    time_ns: int
    port: int
    payload: bytes


def _packets(path: Path) -> Iterator[_Event]:
    """Packets of a capture that the simulator wrote."""
    with path.open("rb") as stream:
        head = stream.read(_PCAP_HEAD)
        unit_ns = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}.get(struct.unpack_from("<I", head)[0] if len(head) >= 4 else 0)
        if unit_ns is None:
            raise CaptureError(f"{path}: is no pcap file of the simulator")
        while len(record := stream.read(16)) == 16:
            seconds, fraction, size, _ = struct.unpack("<4I", record)
            frame = stream.read(size)
            (port,) = struct.unpack_from(">H", frame, 36)
            yield _Event(seconds * NS_PER_S + fraction * unit_ns, port, frame[_FRAME_HEAD:])


def _frames(path: Path) -> Iterator[_Event]:
    """Stretches of a tlog's bytes between stamps; line noise goes along with the frame before it."""
    data = path.read_bytes()
    at = _next_frame(data, 0)
    while at < len(data):
        (time_us,) = struct.unpack_from(">Q", data, at)
        end = at + 8 + _frame_bytes(data, at + 8)
        following = _next_frame(data, end)
        yield _Event(time_us * 1000, 0, data[at + 8 : following])
        at = following


def _frame_bytes(data: bytes, at: int) -> int:
    """Size of the MAVLink frame that starts here: 8 bytes around the payload in version 1, 12 in version 2."""
    return data[at + 1] + (8 if data[at] == 0xFE else 12)


def _next_frame(data: bytes, at: int) -> int:
    """Where the next record starts: two bytes of a plausible stamp (1970 + 2^48 us and more) and a frame's start."""
    while at + 10 < len(data):
        if data[at] == 0 and data[at + 1] in (5, 6, 7) and data[at + 8] in (0xFE, 0xFD):
            return at
        at += 1
    return len(data)


def play(
    capture: Path,
    tlog: Path,
    target: Target,
    announce: Callable[[str], object],
    progress: Callable[[float], object] | None = None,
) -> Played:
    """Send everything at its time.

    Parameters
    ----------
    capture, tlog : Path
        Written by `render`.
    target : Target
    announce : callable
        Called with the path of the pseudo terminal once it is open; the playing starts `target.wait_s` later.
    progress : callable, optional
        Called with the seconds played since the last call.

    Raises
    ------
    SourceError
        The link to the terminal or the address is not possible.
    """
    if not TERMINALS:
        raise SourceError("this system has no pseudo terminals: `swath replay` sends what was simulated to UDP instead")
    with ExitStack() as stack:
        master, slave = pty.openpty()
        stack.callback(os.close, master)
        stack.callback(os.close, slave)
        tty.setraw(slave)
        os.set_blocking(master, False)
        path = os.ttyname(slave)
        if target.pty_link is not None:
            _link(target.pty_link, path)
            stack.callback(target.pty_link.unlink, missing_ok=True)
        sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            address = socket.gethostbyname(target.host)
        except OSError as error:
            raise SourceError(f"{target.host}: no such address ({error.strerror})") from None
        announce(path if target.pty_link is None else str(target.pty_link))
        time.sleep(target.wait_s)
        ports = {DATA_PORT: target.lidar_port}
        played = Played()
        events = heapq.merge(_packets(capture), _frames(tlog), key=lambda event: event.time_ns)
        for event in _paced(events, played, progress):
            if event.port:
                _send(sock, event.payload, (address, ports.get(event.port, target.position_port)), played)
            else:
                _write(master, event.payload, played)
        _drain(slave, _ABSENT_S if played.unread_bytes else _PATIENCE_S)
        return played


def _drain(slave: int, patience_s: float) -> None:
    """Wait for the reader: what is unread when the terminal closes is lost. Not for one who has stopped reading."""
    left, waited_s, empty = _unread(slave), 0.0, 0
    while empty < _LOOKS and waited_s < patience_s:
        time.sleep(_SLICE_S)
        now = _unread(slave)
        empty = 0 if now else empty + 1
        waited_s = 0.0 if now < left else waited_s + _SLICE_S
        left = now


def _unread(slave: int) -> int:
    """Bytes that wait in the terminal."""
    (count,) = struct.unpack("i", fcntl.ioctl(slave, termios.FIONREAD, bytes(4)))
    return int(count)


def _link(link: Path, path: str) -> None:
    try:
        if link.is_symlink():
            link.unlink()
        link.symlink_to(path)
    except OSError as error:
        raise SourceError(f"{link}: no link to {path} can be made there ({error.strerror})") from None


def _paced(events: Iterator[_Event], played: Played, progress: Callable[[float], object] | None) -> Iterator[_Event]:
    """Yield each event when it is due."""
    start_s = first_ns = None
    shown_s = now_s = 0.0
    for event in events:
        if start_s is None or first_ns is None:
            start_s, first_ns = time.monotonic(), event.time_ns
        due_s = (event.time_ns - first_ns) / NS_PER_S
        if due_s > now_s:
            now_s = time.monotonic() - start_s
            if due_s > now_s:
                time.sleep(max(due_s - now_s, _SLICE_S))
                now_s = time.monotonic() - start_s
        played.worst_late_s = max(played.worst_late_s, now_s - due_s)
        if progress is not None and due_s - shown_s > 0.2:
            progress(due_s - shown_s)
            shown_s = due_s
        yield event


def _send(sock: socket.socket, payload: bytes, address: tuple[str, int], played: Played) -> None:
    try:
        sock.sendto(payload, address)
        played.packets += 1
    except ConnectionRefusedError:  # nobody listens: that is what UDP says on loopback
        played.refused_packets += 1


def _write(master: int, payload: bytes, played: Played) -> None:
    written = 0
    with suppress(BlockingIOError):
        written = os.write(master, payload)
    played.unread_bytes += len(payload) - written
    played.frames += 1
