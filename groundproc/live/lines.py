"""Streams of bytes that may break and come back: a serial device, a TCP server."""

import errno
import os
import socket
import sys
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Final

from flightlog.errors import SourceError, UsageError
from groundproc.live.inbox import LogClock

with suppress(ImportError):  # not on every system: there it listens to recordings only
    import termios
    import tty

LISTENS: Final = sys.platform == "linux" and "termios" in globals()
"""Whether this system tells when a datagram came, and has serial devices as files."""
READ_BYTES: Final = 65536
_BAUDS: Final = (
    {int(name[1:]): getattr(termios, name) for name in dir(termios) if name.startswith("B") and name[1:].isdecimal()}
    if LISTENS
    else {}
)
Chunk = tuple[int, bytes]


class Line(ABC):
    """A stream of bytes that may break and come back."""

    def __init__(self, clock: LogClock) -> None:
        self._clock = clock
        self.descriptor = self._open()

    @abstractmethod
    def _open(self) -> int:
        """A descriptor that does not block; SourceError where there is none."""

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self.descriptor

    def read(self) -> list[Chunk]:
        """One chunk, or none; OSError when the other side is gone."""
        try:
            data = os.read(self.descriptor, READ_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise OSError(errno.EPIPE, "it was closed by the other side")
        return [(self._clock.now_ns(), data)]

    def again(self) -> None:
        """Open it once more."""
        self.close()
        self.descriptor = self._open()

    def close(self) -> None:
        """Close it."""
        if self.descriptor >= 0:
            with suppress(OSError):
                os.close(self.descriptor)
        self.descriptor = -1


class Serial(Line):
    """A serial device or a pseudo terminal, raw, 8N1."""

    def __init__(self, device: str, baud: int, clock: LogClock) -> None:
        if baud not in _BAUDS:
            raise UsageError(f"--baud {baud}: expected one of {', '.join(map(str, sorted(_BAUDS)))}")
        self._device, self._baud = device, baud
        super().__init__(clock)

    def _open(self) -> int:
        try:
            descriptor = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise SourceError(f"{self._device}: cannot be opened ({error.strerror})") from None
        try:
            tty.setraw(descriptor)
            settings = termios.tcgetattr(descriptor)
            settings[2] |= termios.CLOCAL | termios.CREAD
            settings[4] = settings[5] = _BAUDS[self._baud]
            termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        except termios.error:
            os.close(descriptor)
            raise SourceError(f"{self._device}: is no serial device") from None
        return descriptor


class Tcp(Line):
    """A TCP server that sends MAVLink, such as a simulator's or a router's."""

    def __init__(self, host: str, port: int, clock: LogClock) -> None:
        self._address = (host, port)
        super().__init__(clock)

    def _open(self) -> int:
        try:
            sock = socket.create_connection(self._address, 3.0)
        except OSError as error:
            place = f"{self._address[0]}:{self._address[1]}"
            raise SourceError(f"TCP {place}: cannot be reached ({error.strerror or error})") from None
        sock.setblocking(False)
        return sock.detach()
