"""Slots that fill up with datagrams from poll to poll, until a message of the log is due."""

import socket
import time
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.records import SCAN_PACKET_DTYPE
from onboard.datagrams import Receiver
from onboard.timesync import KernelTime, LogTime, read_clocks

BATCH_NS: Final = 100 * NS_PER_MS
"""A message of the log spans about this much."""


class Batch:
    """Slots that fill up from poll to poll, with the receive times of what is in them."""

    def __init__(
        self,
        sock: socket.socket,
        dtype: np.dtype[np.void],
        offset: int,
        size: int,
        slots: int,
        log_time: LogTime,
        poll_s: float,
    ) -> None:
        self.slots = np.zeros(slots, dtype)
        self._time_ns = np.zeros(slots, np.int64)
        self._count = 0
        self._poll_ns = round(poll_s * NS_PER_S)
        self._drops_told = self._refused_told = 0
        self._log_time = log_time
        self._now = read_clocks()
        self._kernel_time = KernelTime(log_time, self._now)
        self.receiver = Receiver(sock, self.slots, offset, size)

    @property
    def full(self) -> bool:
        """Whether no slot is left."""
        return self._count == len(self.slots)

    def fill(self) -> int:
        """Take the waiting datagrams, as far as there are slots; gives their number."""
        first = self._count
        count = self.receiver.receive(first)
        if count:
            self._now = read_clocks()
            part = slice(first, first + count)
            self._time_ns[part] = self._kernel_time.convert(
                self.receiver.stamps_ns[part], self._now, emptied=first + count < len(self.slots)
            )
            self._count += count
        return count

    def due(self) -> bool:
        """Whether the content will reach the greatest age of a message before the next poll."""
        if not self._count:
            return False
        age_ns = self._log_time.anchor_ns + time.monotonic_ns() - int(self._time_ns[0])
        return age_ns >= BATCH_NS - self._poll_ns // 2

    def take(
        self,
    ) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.uint32]]:
        """Datagrams with receive time (in data packets also inside), their sizes, times and senders; valid until the next `fill`."""
        part = slice(0, self._count)
        self._count = 0
        packets, time_ns = self.slots[part], self._time_ns[part]
        if packets.dtype == SCAN_PACKET_DTYPE:
            records.set_receive_time_ns(packets, time_ns)
        return packets, self.receiver.sizes[part], time_ns, self.receiver.sources[part]

    def new_drops(self) -> tuple[int, int]:
        """Datagrams the kernel lost, and those its filter refused, since this was last asked."""
        lost, refused = self.receiver.drops - self._drops_told, self.receiver.refused - self._refused_told
        self._drops_told, self._refused_told = self.receiver.drops, self.receiver.refused
        return lost, refused

    def now_ns(self) -> int:
        """Log time [ns]."""
        return self._log_time.at(read_clocks())
