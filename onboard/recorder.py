"""The flight log's writer: a bounded backlog on which no receiver waits, and segments synced to disk twice a second.

It watches the free space. Below a floor it refuses the lidar, and everything else goes on. Below a quarter of that
floor it closes the log properly and refuses everything, until there is room again.
"""

import errno
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from flightlog import records
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import LogError
from onboard import logfolder
from onboard.config import RecorderConfig
from onboard.journal import event
from onboard.logfolder import Space
from onboard.segment import Segment
from onboard.worker import Worker

_log = logging.getLogger(__name__)

_RESERVE_BYTES: Final = 4 << 20
"""Room of the backlog beyond its limit that only small messages may use, so that a stalled disk costs lidar packets first."""


_TAKE_BYTES: Final = 1 << 20
_NEARLY: Final = (7, 8)
"""A sync is nearly due when this part of the time to it has passed."""
_SLICE_NS: Final = 100 * NS_PER_MS
"""Writing goes on for at least this long between two syncs, however late the last one was."""
_PRESSING: Final = 4
"""The backlog presses when it has grown to this part of its limit."""
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_RETRY_NS: Final = 5 * NS_PER_S
"""Between two attempts to open a segment on a full disk."""
_LIDAR: Final = frozenset((records.LIDAR.topic, records.POSITION.topic))
"""What is not recorded when space is low."""


class _Item(NamedTuple):
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
        self._items: deque[_Item] = deque()
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
            self._items.append(_Item(topic, log_time_ns, data))
            self.size_bytes += len(data)
        if self.size_bytes > self._limit_bytes // _PRESSING:
            self.pressing.set()
        return True

    def get(self) -> list[_Item]:
        """Take the oldest messages, about a megabyte of them."""
        out: list[_Item] = []
        with self._lock:
            size = 0
            while self._items and size < _TAKE_BYTES:
                out.append(self._items.popleft())
                size += len(out[-1].data)
            self.size_bytes -= size
        return out


@dataclass(slots=True)
class RecorderCounts:
    """What was written."""

    segment: str = ""
    messages: int = 0
    bytes_on_disk: int = 0
    syncs: int = 0
    last_sync_ns: int = 0
    """Monotonic clock at the end of the last sync [ns]."""
    slowest_sync_ms: float = 0.0
    segments: int = 0
    """Opened since the start."""
    space: Space = Space.ROOM
    refused_for_space: int = 0
    """Messages that were not taken because space was low or out."""
    lost_on_disk: int = 0
    """Messages that were taken, and then the disk was full."""


class Recorder(Worker):
    """Writes the backlog to segments, one after the other.

    Parameters
    ----------
    config : RecorderConfig
    open_segment : callable
        Opens the next segment; LogError, with an OSError as its cause, where that is not possible.

    Raises
    ------
    LogError
        The first segment cannot be opened, for another reason than a full disk.
    """

    def __init__(self, config: RecorderConfig, open_segment: Callable[[], Segment]) -> None:
        super().__init__("recorder")
        self._config, self._open_segment = config, open_segment
        self._directory = Path(config.directory)
        self._sync_ns = config.sync_ms * NS_PER_MS
        self._floor_bytes = config.min_free_mb << 20
        self._rotation_asked = threading.Event()
        self._retry_ns = 0
        self._told_drops = 0
        self._segment: Segment | None = None
        self._taken: deque[_Item] = deque()
        self._sync_soon = False
        self.backlog = Backlog(config.backlog_mb << 20)
        self.counts = RecorderCounts(last_sync_ns=time.monotonic_ns())
        self._look_at_space()
        self._begin_segment()

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        """Hand over one message; False, at once, if there is no room for it."""
        space = self.counts.space
        if space is Space.FULL or (space is Space.LOW and topic in _LIDAR):
            self.counts.refused_for_space += 1
            return False
        return self.backlog.put(topic, log_time_ns, data, vital)

    def handed_over(self) -> None:
        """Hear that all there is for now is in the backlog: where a sync is nearly due, it is best done now."""
        if time.monotonic_ns() >= self.counts.last_sync_ns + self._sync_ns * _NEARLY[0] // _NEARLY[1]:
            self._sync_soon = True
            self.backlog.pressing.set()

    def rotate(self) -> None:
        """Ask for a new segment; soon, and not a message is lost for it."""
        self._rotation_asked.set()

    def work(self) -> None:
        """Write and sync until asked to stop; what is in the backlog then is still written."""
        try:
            while not self.stopping:
                self._go_round()
                self.progress()
                left_ns = self.counts.last_sync_ns + self._sync_ns - time.monotonic_ns()
                self.backlog.pressing.wait(max(0.0, left_ns / NS_PER_S))
                self.backlog.pressing.clear()
            self._until_full(lambda: self._write_until(None))
        finally:
            self._close_segment()
            logfolder.release_reserve(self._directory)

    def stop(self, timeout_s: float = 10.0) -> None:
        """Ask it to end and wait for that."""
        self._stop_asked.set()
        self.backlog.pressing.set()
        super().stop(timeout_s)

    def _go_round(self) -> None:
        due_ns = self.counts.last_sync_ns + self._sync_ns
        self._until_full(lambda: self._write_until(due_ns))
        if time.monotonic_ns() < due_ns and not self._sync_soon:
            return
        self._sync_soon = False
        self._until_full(self._sync)
        self._look_at_space()
        if self.counts.space is Space.FULL:
            self._close_segment()
        elif self._segment is None or self._rotation_due(self._segment):
            self._close_segment()
            self._begin_segment()

    def _write_until(self, end_ns: int | None) -> None:
        """Write the backlog; not beyond a time of the monotonic clock [ns] even if more and more comes."""
        begin_ns = time.monotonic_ns()
        while self._taken or self._take():
            item = self._taken.popleft()
            if self._segment is None:
                self.counts.lost_on_disk += 1
                continue
            self._segment.write(item.topic, item.log_time_ns, item.data)
            self.counts.messages += 1
            if end_ns is not None and time.monotonic_ns() >= max(end_ns, begin_ns + _SLICE_NS):
                break

    def _take(self) -> bool:
        """Take the next messages from the backlog; whether there were any."""
        self._taken.extend(self.backlog.get())
        return bool(self._taken)

    def _sync(self) -> None:
        begin_ns = time.monotonic_ns()
        if self._segment is not None:
            self.counts.bytes_on_disk = self._segment.sync()
            self.counts.syncs += 1
        self.counts.last_sync_ns = time.monotonic_ns()
        took_ms = (self.counts.last_sync_ns - begin_ns) / NS_PER_MS
        self.counts.slowest_sync_ms = max(self.counts.slowest_sync_ms, took_ms)

    # Segments -----------------------------------------------------------------------------------------------------

    def _rotation_due(self, segment: Segment) -> bool:
        large = segment.size >= self._config.segment_mb << 20
        return large or segment.age_s >= self._config.segment_s or self._rotation_asked.is_set()

    def _begin_segment(self) -> None:
        """Open the next segment, unless the disk is full."""
        if self.counts.space is Space.FULL or time.monotonic_ns() < self._retry_ns:
            return
        self._rotation_asked.clear()
        try:
            self._segment = self._open_segment()
        except LogError as error:
            if not isinstance(error.__cause__, OSError) or error.__cause__.errno not in _FULL:
                raise
            self._stop_for_space()
            return
        logfolder.hold_reserve(self._directory)
        self.counts.segment = self._segment.path.name
        self.counts.segments += 1
        self._told_drops = self._drops()

    def _close_segment(self) -> None:
        segment, self._segment = self._segment, None
        if segment is None:
            return
        try:
            segment.close({"refused": self._drops() - self._told_drops})
            _log.info("closed %s", segment.path, extra=event("closed", segment=segment.path.name))
        except OSError as error:
            if error.errno not in _FULL:
                raise
            _log.error("%s could not be closed on a full disk; the next start mends it", segment.path)
        finally:
            self.counts.lost_on_disk += segment.lost

    def _drops(self) -> int:
        return self.backlog.refused + self.counts.refused_for_space

    # Space --------------------------------------------------------------------------------------------------------

    def _until_full(self, step: Callable[[], None]) -> None:
        """Do something that writes; a full disk closes the segment and ends nothing else."""
        try:
            step()
        except OSError as error:
            if error.errno not in _FULL:
                raise
            self._stop_for_space()

    def _stop_for_space(self) -> None:
        """The disk is full, whatever it said before."""
        self._set_space(Space.FULL)
        self._retry_ns = time.monotonic_ns() + _RETRY_NS
        self.counts.last_sync_ns = time.monotonic_ns()
        self._close_segment()

    def _look_at_space(self) -> None:
        if time.monotonic_ns() < self._retry_ns:
            return
        if self._judge() is not Space.ROOM and self._config.prune_acknowledged:
            logfolder.prune(self._directory, lambda: self._judge() is Space.ROOM)
        self._set_space(self._judge())

    def _judge(self) -> Space:
        try:
            free_bytes = logfolder.free_bytes(self._directory)
        except (FileNotFoundError, NotADirectoryError):  # it is made with the first segment
            return Space.ROOM
        return logfolder.space(free_bytes, self._floor_bytes, self.counts.space)

    def _set_space(self, space: Space) -> None:
        if space is not self.counts.space:
            _log.log(*_SPACE_NEWS[space], extra=event("space", space=space.value))
        self.counts.space = space


_SPACE_NEWS: Final = {
    Space.ROOM: (logging.WARNING, "there is room on the disk again: everything is recorded"),
    Space.LOW: (logging.ERROR, "space on the disk is low: the lidar is not recorded any more"),
    Space.FULL: (logging.CRITICAL, "the disk is full: the log is closed, nothing is recorded any more"),
}
