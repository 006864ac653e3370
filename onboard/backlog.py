"""What the disk has not taken yet: messages in memory, bounded, on which no receiver waits."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

_RESERVE_BYTES: Final = 4 << 20
"""Room of the backlog beyond its limit that only small messages may use, so that a stalled disk costs lidar packets first."""
_TAKE_BYTES: Final = 1 << 20
_PRESSING: Final = 4
"""The backlog presses when it has grown to this part of its limit."""
Put = Callable[[str, int, bytes, bool], bool]
"""Hands a message to the recorder: topic, log time, bytes, whether it is small and must not be lost; False if it was refused."""


class Item(NamedTuple):
    """A message that waits."""

    topic: str
    log_time_ns: int
    data: bytes


class Backlog:
    """What the disk has not taken yet, bounded by its size in memory.

    Parameters
    ----------
    limit_bytes : int
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._items: deque[Item] = deque()
        self._lock = threading.Lock()
        self.size_bytes = 0
        self.refused = 0
        self.pressing = threading.Event()
        """Set when the writer should not wait any longer."""

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        """Append a message; False if there is no room. A vital one may use the reserve."""
        with self._lock:
            if self.size_bytes + len(data) > self._limit_bytes + (_RESERVE_BYTES if vital else 0):
                self.refused += 1
                return False
            self._items.append(Item(topic, log_time_ns, data))
            self.size_bytes += len(data)
        if self.size_bytes > self._limit_bytes // _PRESSING:
            self.pressing.set()
        return True

    def get(self) -> list[Item]:
        """Take the oldest messages, about a megabyte of them."""
        out: list[Item] = []
        with self._lock:
            size = 0
            while self._items and size < _TAKE_BYTES:
                out.append(self._items.popleft())
                size += len(out[-1].data)
            self.size_bytes -= size
        return out
