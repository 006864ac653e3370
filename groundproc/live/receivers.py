"""From the network and from a serial line into the inbox: the lidar's two UDP ports and the autopilot's bytes, in one thread."""

import errno
import selectors
import socket
import struct
import threading
import time
from contextlib import suppress
from typing import Final

from flightlog import records
from flightlog.errors import SourceError, UsageError
from flightlog.hdl32e import DATA_BYTES, POSITION_BYTES
from groundproc.live.inbox import Inbox, LogClock, Received, scan_packets
from groundproc.live.lines import LISTENS, READ_BYTES, Chunk, Line, Serial, Tcp

_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40
_BUFFER_BYTES: Final = 8 << 20
_MOST: Final = 512
"""Datagrams taken at one look."""
_PAUSE_S: Final = 0.004
"""Between two looks: a wake-up for each of 1,808 packets a second would cost more than all else here."""
_RETRY_S: Final = 1.0
_OTHER_S: Final = 10.0
"""After so long a silence another sender is taken for the lidar."""


class Counts:
    """What did not become data."""

    def __init__(self) -> None:
        self.kernel_drops = 0
        """Datagrams that the kernel had no room for."""
        self.rejected = 0
        """Datagrams of another length, or from others than the lidar."""
        self.trouble = ""
        """Why the autopilot's line is down."""


class Port:
    """A UDP port whose datagrams carry the kernel's receive time.

    Raises
    ------
    SourceError
        The port is taken, or the address is not ours.
    """

    def __init__(self, topic: str, address: str, port: int, clock: LogClock, size: int | None = None) -> None:
        self.topic, self.drops, self._clock, self._size = topic, 0, clock, size
        self.rejected = 0
        self.sender: str | None = None
        self._heard_s = -_OTHER_S
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            sock.bind((address, port))
        except (OSError, OverflowError) as error:
            sock.close()
            taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            what = "another program has it" if taken else getattr(error, "strerror", None) or str(error)
            raise SourceError(f"UDP port {port} at {address} cannot be opened: {what}") from None
        self._socket = sock

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._socket.fileno()

    def read(self) -> list[Chunk]:
        """What has arrived, with receive times [ns of log time]."""
        found: list[Chunk] = []
        for _ in range(_MOST):
            try:
                data, notes, _, peer = self._socket.recvmsg(READ_BYTES, 128)
            except BlockingIOError:
                break
            except ConnectionError:
                continue
            stamp_ns = self._stamp_ns(notes)
            if self._is_wanted(data, peer[0]):
                found.append((stamp_ns, data))
        return found

    def _is_wanted(self, data: bytes, sender: str) -> bool:
        if self._size is None:
            return True
        if len(data) != self._size:
            self.rejected += 1
            return False
        now_s = time.monotonic()
        if sender != self.sender and now_s - self._heard_s > _OTHER_S:
            self.sender = sender
        if sender != self.sender:
            self.rejected += 1
            return False
        self._heard_s = now_s
        return True

    def _stamp_ns(self, notes: list[tuple[int, int, bytes]]) -> int:
        stamp_ns = time.time_ns()
        for _, kind, value in notes:
            if kind == _SO_TIMESTAMPNS:
                seconds, rest_ns = struct.unpack_from("=qq", value)
                stamp_ns = seconds * 1_000_000_000 + rest_ns
            elif kind == _SO_RXQ_OVFL:
                self.drops = int(struct.unpack_from("=I", value)[0])
        return self._clock.of_kernel_ns(stamp_ns)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def open_mavlink(text: str, baud: int, clock: LogClock) -> Port | Line:
    """`udp:ADDRESS:PORT` to listen on, `tcp:HOST:PORT` to connect to, or a serial device.

    Raises
    ------
    UsageError, SourceError
        No such form; or it cannot be opened.
    """
    kind, _, rest = text.partition(":")
    if kind not in ("udp", "tcp"):
        return Serial(text, baud, clock)
    host, _, port = rest.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"--mavlink {text!r}: expected udp:ADDRESS:PORT, tcp:HOST:PORT or a serial device")
    if kind == "udp":
        return Port(records.MAVLINK.topic, host, int(port), clock)
    return Tcp(host, int(port), clock)


class Receivers:
    """One thread that empties all of them.

    Parameters
    ----------
    inbox : Inbox
    address : str
        To listen on for the lidar.
    lidar_port, position_port : int
    mavlink : str
        As in `open_mavlink`.
    baud : int
    """

    def __init__(
        self, inbox: Inbox, address: str, lidar_port: int, position_port: int, mavlink: str, baud: int
    ) -> None:
        if not LISTENS:
            raise SourceError(
                "this system does not say when a datagram came, as Linux does: `swath live --follow LOG` shows a log that grows"
            )
        self._inbox, self._stop, self._counts = inbox, threading.Event(), Counts()
        clock = LogClock()
        self._ports: list[Port] = []
        self._line: Line | None = None
        self._retry_s = 0.0
        self._selector = selectors.DefaultSelector()
        try:
            self._ports.append(Port(records.LIDAR.topic, address, lidar_port, clock, DATA_BYTES))
            self._ports.append(Port(records.POSITION.topic, address, position_port, clock, POSITION_BYTES))
            source = open_mavlink(mavlink, baud, clock)
        except BaseException:
            self._close()
            raise
        if isinstance(source, Port):
            self._ports.append(source)
        else:
            self._line = source
            self._selector.register(source, selectors.EVENT_READ, source)
        for port in self._ports:
            self._selector.register(port, selectors.EVENT_READ, port)
        self._thread = threading.Thread(target=self._work, name="receive", daemon=True)

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and close everything."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._close()

    def counts(self) -> Counts:
        """What was lost or refused so far."""
        self._counts.kernel_drops = sum(port.drops for port in self._ports)
        self._counts.rejected = sum(port.rejected for port in self._ports)
        return self._counts

    def _close(self) -> None:
        for port in self._ports:
            port.close()
        if self._line is not None:
            self._line.close()
        self._selector.close()

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                ready = self._selector.select(0.2)
                for key, _ in ready:
                    self._take(key.data)
                if self._line is not None and self._line.descriptor < 0:
                    self._reopen(self._line)
                self._stop.wait(_PAUSE_S)
        except BaseException as error:
            self._inbox.end(error)

    def _take(self, source: Port | Line) -> None:
        try:
            chunks = source.read()
        except OSError as error:
            if not isinstance(source, Line):
                raise
            self._selector.unregister(source)
            source.close()
            self._counts.trouble = f"the autopilot's line is down ({error.strerror or error})"
            return
        if not chunks:
            return
        now_s = time.monotonic()
        if isinstance(source, Port) and source.topic == records.LIDAR.topic:
            self._inbox.put(Received(source.topic, now_s, packets=scan_packets(chunks)))
        else:
            topic = source.topic if isinstance(source, Port) else records.MAVLINK.topic
            self._inbox.put(Received(topic, now_s, chunks=chunks))

    def _reopen(self, line: Line) -> None:
        if time.monotonic() < self._retry_s:
            return
        self._retry_s = time.monotonic() + _RETRY_S
        with suppress(SourceError):
            line.again()
            self._selector.register(line, selectors.EVENT_READ, line)
            self._counts.trouble = ""
