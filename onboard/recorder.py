"""The flight log's writer: from the backlog, on which no receiver waits, to segments synced to disk twice a second.

A segment that somebody deleted or moved, a folder that is gone, a disk that fails or turns read-only: the segment is given up,
and recording begins anew, in another folder if the configuration names one. Data that arrive meanwhile wait in the
backlog.

It watches the free space. Below a floor it refuses the lidar, and everything else goes on. Below a quarter of that
floor it closes the log properly and refuses everything, until there is room again.
"""

import contextlib
import errno
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flightlog import records
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import LogError
from onboard import logfolder
from onboard.backlog import Backlog, Item
from onboard.config import RecorderConfig
from onboard.journal import event
from onboard.logfolder import Space
from onboard.segment import Segment, Where
from onboard.spacewatch import SpaceWatch
from onboard.worker import Worker

_log = logging.getLogger(__name__)


_NEARLY: Final = (7, 8)
"""A sync is nearly due when this part of the time to it has passed."""
_SLICE_NS: Final = 100 * NS_PER_MS
"""Writing goes on for at least this long between two syncs, however late the last one was."""
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_RETRY_NS: Final = 5 * NS_PER_S
"""Between two attempts to open a segment on a full disk."""
_TROUBLE_NS: Final = NS_PER_S
"""Between two attempts on a disk that fails."""
_CLOSER_TICK_S: Final = 0.2
_LIDAR: Final = frozenset((records.LIDAR.topic, records.POSITION.topic))
"""What is not recorded when space is low."""


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
    directory: str = ""
    """Where the segment is."""
    trouble: str = ""
    """Why nothing is recorded, or where it is recorded instead."""
    abandoned: int = 0
    """Segments that were given up because they were deleted or moved, or the disk failed."""


class Recorder(Worker):
    """Writes the backlog to segments, one after the other.

    Parameters
    ----------
    config : RecorderConfig
    open_segment : callable
        Opens the next segment in a folder; LogError, with an OSError as its cause, where that is not possible.

    Raises
    ------
    LogError
        The first segment cannot be opened, for another reason than a full disk.
    """

    def __init__(self, config: RecorderConfig, open_segment: Callable[[Path], Segment]) -> None:
        super().__init__("recorder")
        self._config, self._open_segment = config, open_segment
        self._folders = [Path(config.directory), *map(Path, config.folders)]
        self._directory = self._folders[0]
        self._sync_ns = config.sync_ms * NS_PER_MS
        self._space = SpaceWatch(config)
        self._rotation_asked = threading.Event()
        self._retry_ns = 0
        self._told_drops = 0
        self._segment: Segment | None = None
        self._closer: threading.Thread | None = None
        self._taken: deque[Item] = deque()
        self._sync_soon = False
        self.backlog = Backlog(config.backlog_mb << 20)
        self.counts = RecorderCounts(last_sync_ns=time.monotonic_ns())
        self._look_at_space()
        self._open_first()

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        """Hand over one message; False, at once, if there is no room for it."""
        space = self.counts.space
        if space is Space.FULL or (space is Space.LOW and topic in _LIDAR):
            self.counts.refused_for_space += 1
            return False
        return self.backlog.put(topic, log_time_ns, data, vital)

    def handed_over(self) -> None:
        """Note that everything received so far is in the backlog: if a sync is nearly due, do it now."""
        if time.monotonic_ns() >= self.counts.last_sync_ns + self._sync_ns * _NEARLY[0] // _NEARLY[1]:
            self._sync_soon = True
            self.backlog.pressing.set()

    def rotate(self) -> None:
        """Ask for a new segment soon; no message is lost."""
        self._rotation_asked.set()

    def work(self) -> None:
        """Write and sync until asked to stop; the backlog is still written then."""
        try:
            while not self.stopping:
                self._go_round()
                self.progress()
                left_ns = self.counts.last_sync_ns + self._sync_ns - time.monotonic_ns()
                self.backlog.pressing.wait(max(0.0, left_ns / NS_PER_S))
                self.backlog.pressing.clear()
            if self._segment is None:
                self._retry_ns = 0
                self._begin_segment()
            self._until_full(lambda: self._write_until(None))
        finally:
            self._close_segment()
            with contextlib.suppress(OSError):
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
        self._look_at_names()
        self._look_at_space()
        if self.counts.space is Space.FULL:
            self._close_segment()
        elif self._segment is None:
            self._begin_segment()
        elif self._rotation_due(self._segment):
            self._rotate()

    def _write_until(self, end_ns: int | None) -> None:
        """Write the backlog, but not beyond a time of the monotonic clock [ns], even if more keeps arriving."""
        begin_ns = time.monotonic_ns()
        if self._segment is None and self._has_room and not self.stopping:
            return  # a new segment is tried soon: the backlog holds what comes until then
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

    def _rotate(self) -> None:
        """Go on in a new segment, and close the old one beside the recording.

        Closing takes four syncs or more. Waiting for them would lengthen what a power cut loses.
        """
        old, self._segment = self._segment, None
        drops, self._told_drops = self._drops() - self._told_drops, self._drops()
        self._begin_segment()
        self._closed()
        self._closer = threading.Thread(target=self._close, args=(old, drops), name="closer", daemon=True)
        self._closer.start()

    def _closed(self) -> None:
        """Wait for the segment before, if it is still being closed."""
        while self._closer is not None and self._closer.is_alive():
            self.progress()
            self._closer.join(_CLOSER_TICK_S)
        self._closer = None

    def _rotation_due(self, segment: Segment) -> bool:
        large = segment.size >= self._config.segment_mb << 20
        return large or segment.age_s >= self._config.segment_s or self._rotation_asked.is_set()

    @property
    def _has_room(self) -> bool:
        return self.counts.space is not Space.FULL

    def _open_first(self) -> None:
        """Open the first segment; a folder that cannot be used is said at once, to whoever starts the daemon."""
        if not self._has_room:
            return
        reasons = self._open_somewhere()
        if self._segment is None and self._has_room:
            raise LogError("; ".join(reasons))

    def _begin_segment(self) -> None:
        """Open the next segment, unless the disk is full; where none of the folders will do, try again soon."""
        if not self._has_room or time.monotonic_ns() < self._retry_ns:
            return
        reasons = self._open_somewhere()
        if self._segment is None and self._has_room:
            self._retry_ns = time.monotonic_ns() + _TROUBLE_NS
            self._tell_trouble("; ".join(reasons))

    def _open_somewhere(self) -> list[str]:
        """Open a segment in the first folder that takes one; what is wrong with those before."""
        self._rotation_asked.clear()
        reasons: list[str] = []
        for directory in self._folders:
            try:
                self._segment = self._open_segment(directory)
            except LogError as error:
                reasons.append(str(error))
                if len(self._folders) == 1 and _is_full(error.__cause__):
                    self._stop_for_space()
                continue
            self._directory = directory
            self._opened(reasons)
            return reasons
        return reasons

    def _opened(self, reasons: list[str]) -> None:
        """Note a segment that was just opened, and say where it is if that is not where it should be."""
        assert self._segment is not None
        logfolder.hold_reserve(self._directory)
        self.counts.segment, self.counts.directory = self._segment.path.name, str(self._directory)
        self.counts.segments += 1
        self._told_drops = self._drops()
        if reasons:
            self._tell_trouble(f"recording to {self._directory} instead: {'; '.join(reasons)}")
        elif self.counts.trouble:
            _log.warning("recording again, to %s", self._segment.path, extra=event("recording"))
            self.counts.trouble = ""

    def _look_at_names(self) -> None:
        """Give up a segment that somebody deleted or moved: nobody would look for what is written to it."""
        segment = self._segment
        where = Where.HERE if segment is None else segment.where
        if segment is None or where is Where.HERE:
            return
        if where is Where.NOWHERE:
            self._abandon(f"{segment.path} was deleted while it was being written: what was in it is lost")
            return
        with contextlib.suppress(OSError):
            segment.part()
        self._abandon(
            f"{segment.path} was moved while it was being written: it ends where it is now, and is not in the manifest"
        )

    def _tell_trouble(self, sentence: str) -> None:
        if sentence != self.counts.trouble:
            _log.critical("%s", sentence, extra=event("disk"))
        self.counts.trouble = sentence

    def _abandon(self, reason: str) -> None:
        """Give the segment up as it is; a new one is begun at once."""
        segment, self._segment = self._segment, None
        self.counts.abandoned += 1
        self._tell_trouble(reason)
        if segment is not None:
            self.counts.lost_on_disk += segment.lost
            with contextlib.suppress(OSError):
                segment.abandon()

    def _close_segment(self) -> None:
        self._closed()
        segment, self._segment = self._segment, None
        if segment is not None:
            self._close(segment, self._drops() - self._told_drops)

    def _close(self, segment: Segment, drops: int) -> None:
        """Close a segment that nothing is written to any more; the closer's work too."""
        try:
            segment.close({"refused": drops})
            _log.info("closed %s", segment.path, extra=event("closed", segment=segment.path.name))
        except OSError as error:
            reason = "on a full disk" if _is_full(error) else f"({error.strerror})"
            _log.error("%s could not be closed %s; the next start mends it", segment.path, reason)
        finally:
            self.counts.lost_on_disk += segment.lost

    def _drops(self) -> int:
        return self.backlog.refused + self.counts.refused_for_space

    # Space --------------------------------------------------------------------------------------------------------

    def _until_full(self, step: Callable[[], None]) -> None:
        """Run something that writes; a disk that is full or fails ends the segment and nothing else."""
        try:
            step()
        except OSError as error:
            if _is_full(error):
                self._stop_for_space()
                return
            path = self._directory if self._segment is None else self._segment.path
            self._abandon(f"{path}: cannot be written ({error.strerror})")
            self.counts.last_sync_ns = time.monotonic_ns()

    def _stop_for_space(self) -> None:
        """The disk is full, whatever its free space said before."""
        self.counts.space = self._space.note(Space.FULL)
        self._retry_ns = time.monotonic_ns() + _RETRY_NS
        self.counts.last_sync_ns = time.monotonic_ns()
        self._close_segment()

    def _look_at_space(self) -> None:
        if time.monotonic_ns() >= self._retry_ns:
            self.counts.space = self._space.look(self._directory)


def _is_full(error: BaseException | None) -> bool:
    """Whether the disk is full, as opposed to failed."""
    return isinstance(error, OSError) and error.errno in _FULL
