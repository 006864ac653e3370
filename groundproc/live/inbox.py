"""Between those who receive and the one who works: a queue of bounded size that counts what it had to drop."""

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.constants import NS_PER_S
from flightlog.hdl32e import DATA_BYTES

LARGEST_BYTES: Final = 32 << 20
"""Some 14 s of a lidar in single return mode."""
_OLDEST_NS: Final = 10 * NS_PER_S
_HEAD: Final = 8


@dataclass(frozen=True, slots=True)
class Received:
    """What came of one kind at one look.

    Attributes
    ----------
    topic : str
        Of `flightlog.records`.
    arrival_s : float
        When the last of it came to this program, monotonic clock.
    packets : ndarray of SCAN_PACKET_DTYPE
        Of the lidar topic; else empty.
    chunks : list of (int, bytes)
        Of the other topics: receive time [ns of log time] and bytes.
    """

    topic: str
    arrival_s: float
    packets: npt.NDArray[np.void] = field(default_factory=lambda: np.empty(0, records.SCAN_PACKET_DTYPE))
    chunks: list[tuple[int, bytes]] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Bytes it holds."""
        return self.packets.nbytes + sum(len(data) for _, data in self.chunks)

    @property
    def count(self) -> int:
        """Packets or chunks."""
        return len(self.packets) + len(self.chunks)


def scan_packets(chunks: list[tuple[int, bytes]]) -> npt.NDArray[np.void]:
    """Data packets of 1206 bytes with their receive times [ns of log time] as SCAN_PACKET_DTYPE."""
    out = np.zeros(len(chunks), records.SCAN_PACKET_DTYPE)
    raw = out.view(np.uint8).reshape(len(chunks), -1)
    raw[:, _HEAD : _HEAD + DATA_BYTES] = np.frombuffer(b"".join(data for _, data in chunks), np.uint8).reshape(
        len(chunks), DATA_BYTES
    )
    records.set_receive_time_ns(out, np.array([time_ns for time_ns, _ in chunks], np.int64))
    return out


class LogClock:
    """Log time: the wall clock as it was at the start, carried on by the monotonic clock."""

    def __init__(self) -> None:
        self._base_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Log time now [ns]."""
        return time.monotonic_ns() + self._base_ns

    def of_kernel_ns(self, stamp_ns: int) -> int:
        """Log time [ns] of a stamp that the kernel made a moment ago on the wall clock [ns]."""
        age_ns = min(max(time.time_ns() - stamp_ns, 0), _OLDEST_NS)
        return self.now_ns() - age_ns


class Inbox:
    """A queue for one reader.

    Parameters
    ----------
    waits : bool
        Whether those who put wait for room (a file does not run away), or the oldest is dropped (a sensor does not wait).

    Attributes
    ----------
    dropped : int
        Packets and chunks that found no room.
    ended : bool
        Nothing more will come.
    failure : BaseException or None
        What a receiver ended with.
    """

    def __init__(self, *, waits: bool = False) -> None:
        self.dropped = 0
        self.ended = False
        self.failure: BaseException | None = None
        self.waits = waits
        self._items: deque[Received] = deque()
        self._bytes = 0
        self._changed = threading.Condition()

    def put(self, item: Received) -> None:
        """Add what was received."""
        with self._changed:
            limit = LARGEST_BYTES // 32 if self.waits else LARGEST_BYTES
            while self.waits and self._bytes > limit and not self.ended:
                self._changed.wait(0.2)
            self._items.append(item)
            self._bytes += item.size
            while self._bytes > limit and not self.waits:
                oldest = self._items.popleft()
                self._bytes -= oldest.size
                self.dropped += oldest.count
            self._changed.notify_all()

    def take(self, timeout_s: float, most: int = 32) -> list[Received]:
        """What waits, at most so many pieces; after the timeout nothing."""
        with self._changed:
            if not self._items and not self.ended:
                self._changed.wait(timeout_s)
            found = [self._items.popleft() for _ in range(min(most, len(self._items)))]
            self._bytes -= sum(item.size for item in found)
            self._changed.notify_all()
            return found

    def end(self, failure: BaseException | None = None) -> None:
        """Say that nothing more will come, and why where that is wrong."""
        with self._changed:
            self.ended, self.failure = True, self.failure or failure
            self._changed.notify_all()
