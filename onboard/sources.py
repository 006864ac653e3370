"""Where a MAVLink link's bytes come from: a serial device, or a UDP port."""

import os
import socket
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Final

import numpy as np
import serial

from flightlog.errors import SourceError
from onboard.config import LinkConfig
from onboard.datagrams import Receiver, open_udp
from onboard.timesync import Clocks, KernelTime, LogTime, read_clocks

_SERIAL_PAUSE_S: Final = 0.005
"""Between two reads: bounds the wake-ups, and how much later than its last byte a frame may be stamped."""
_UDP_PAUSE_S: Final = 0.02
_READ_BYTES: Final = 65536
_UDP_BUFFER_BYTES: Final = 1 << 20
_UDP_SLOTS: Final = 32
_DATAGRAM_BYTES: Final = 65536
"""The largest there is, so that none is cut."""

Chunk = tuple[int, bytes]


class Source(ABC):
    """Where a link's bytes come from and go to."""

    pause_s: float

    @abstractmethod
    def fileno(self) -> int:
        """What to wait on."""

    @abstractmethod
    def read(self) -> list[Chunk]:
        """What has arrived, with receive times [ns of log time]; OSError when the device is gone."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send if that is possible without waiting."""

    @abstractmethod
    def close(self) -> None:
        """Close the device."""


class SerialSource(Source):
    """A serial device; one chunk is what one read gave.

    Raises
    ------
    SourceError
        It is not there, or is in use.
    """

    pause_s = _SERIAL_PAUSE_S

    def __init__(self, device: str, baud: int, log_time: LogTime) -> None:
        self._log_time = log_time
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
            raise SourceError(f"serial device {device} cannot be opened: {reason}") from None
        os.set_blocking(self._port.fileno(), False)

    def fileno(self) -> int:
        """Descriptor of the device."""
        return int(self._port.fileno())

    def read(self) -> list[Chunk]:
        """One chunk, or none."""
        try:
            data = os.read(self.fileno(), _READ_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise OSError("the device was unplugged")
        return [(self._log_time.at(read_clocks()), data)]

    def write(self, data: bytes) -> None:
        """Send; what a full output buffer does not take is lost, as it would be on the air."""
        with suppress(BlockingIOError):
            os.write(self.fileno(), data)

    def close(self) -> None:
        """Close the device."""
        with suppress(OSError):
            self._port.close()


class UdpSource(Source):
    """A UDP port; one chunk is one datagram, stamped by the kernel. Answers go to the last sender.

    Raises
    ------
    SourceError
        The port is taken.
    """

    pause_s = _UDP_PAUSE_S

    def __init__(self, address: str, port: int, log_time: LogTime) -> None:
        self._socket = open_udp(address, port, _UDP_BUFFER_BYTES)
        slots = np.zeros(_UDP_SLOTS, np.dtype((np.void, _DATAGRAM_BYTES)))
        self._bytes = slots.view(np.uint8).reshape(_UDP_SLOTS, _DATAGRAM_BYTES)
        self._receiver = Receiver(self._socket, slots, 0, _DATAGRAM_BYTES)
        self._kernel_time = KernelTime(log_time, read_clocks())
        self._peer: tuple[str, int] | None = None

    @property
    def drops(self) -> int:
        """Datagrams the kernel dropped."""
        return self._receiver.drops

    def fileno(self) -> int:
        """Descriptor of the socket."""
        return self._socket.fileno()

    def read(self) -> list[Chunk]:
        """One chunk for each datagram."""
        chunks: list[Chunk] = []
        self._learn_peer()
        count = _UDP_SLOTS
        while count == _UDP_SLOTS:
            count = self._receiver.receive()
            now: Clocks = read_clocks()
            stamps_ns = self._receiver.stamps_ns[:count]
            times_ns = self._kernel_time.convert(stamps_ns, now, emptied=count < _UDP_SLOTS).tolist()
            sizes = self._receiver.sizes[:count].tolist()
            chunks += [
                (time_ns, self._bytes[i, :size].tobytes())
                for i, (time_ns, size) in enumerate(zip(times_ns, sizes, strict=True))
            ]
        return chunks

    def _learn_peer(self) -> None:
        with suppress(OSError):
            self._peer = self._socket.recvfrom(1, socket.MSG_PEEK)[1]

    def write(self, data: bytes) -> None:
        """Send to whoever was heard last."""
        if self._peer is not None:
            with suppress(OSError):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def open_source(config: LinkConfig, log_time: LogTime) -> Source:
    """Open what a link's configuration names; SourceError if that is not possible."""
    if config.serial:
        assert config.device is not None
        return SerialSource(config.device, config.baud, log_time)
    return UdpSource(*config.udp_address(), log_time)
