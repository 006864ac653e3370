"""The flight log's writer: a bounded backlog that never makes a receiver wait, and segments synced to the disk twice a second."""

import contextlib
import json
import logging
import os
import re
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from flightlog import __version__
from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.errors import LogError
from flightlog.logfile import LogWriter
from onboard.config import RecorderConfig
from onboard.worker import Worker

_log = logging.getLogger(__name__)

_RESERVE_BYTES: Final = 4 << 20
"""Room of the backlog beyond its limit that only small messages may use, so that a stalled disk costs lidar packets first."""


_SLICE_NS: Final = 100 * NS_PER_MS
"""Writing goes on for at least this long between two syncs, however late the last one was."""
_PRESSING: Final = 4
"""The backlog presses when it has grown to this part of its limit."""


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

    def get(self) -> _Item | None:
        """Take the oldest message, None if there is none."""
        with self._lock:
            if not self._items:
                return None
            item = self._items.popleft()
            self.size_bytes -= len(item.data)
            return item


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


class Segment:
    """One file of the flight log, from its first synced byte to its footer.

    Parameters
    ----------
    path : Path
        Must not exist.
    metadata, attachments
        See LogWriter.
    topics : iterable of str
        Announced at the head of the file: without them nothing that follows could be read.
    first : tuple of topic, log time, bytes
        A message to begin with, because a chunk without one is not written.

    Raises
    ------
    LogError
        The file cannot be made.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, bytes],
        topics: Iterable[str],
        first: tuple[str, int, bytes],
    ) -> None:
        self.path = path
        try:
            self._file = path.open("xb")
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror})") from None
        self._writer = LogWriter(
            self._file, metadata=metadata, attachments=attachments, library=f"swathd {__version__}"
        )
        for topic in topics:
            self._writer.add_topic(topic)
        self.write(*first)
        self.sync()
        sync_directory(path.parent)

    def write(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Append one message."""
        self._writer.write(topic, log_time_ns, data)

    def sync(self) -> int:
        """Force everything on to the disk; gives the file's size [bytes]."""
        self._writer.flush()
        os.fdatasync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        """Write the footer, sync, close."""
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()
        sync_directory(self.path.parent)


class Recorder(Worker):
    """Writes the backlog to the segment.

    Parameters
    ----------
    config : RecorderConfig
    segment : Segment
        Open; closed when the recorder stops.
    """

    def __init__(self, config: RecorderConfig, segment: Segment) -> None:
        super().__init__("recorder")
        self._segment = segment
        self._sync_ns = config.sync_ms * NS_PER_MS
        self.backlog = Backlog(config.backlog_mb << 20)
        self.counts = RecorderCounts(segment=segment.path.name, last_sync_ns=time.monotonic_ns())

    def put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        """Hand over one message; False, at once, if there is no room for it."""
        return self.backlog.put(topic, log_time_ns, data, vital)

    def work(self) -> None:
        """Write and sync until asked to stop; what is in the backlog then is still written."""
        try:
            while not self.stopping:
                self._write_until(self.counts.last_sync_ns + self._sync_ns)
                if time.monotonic_ns() >= self.counts.last_sync_ns + self._sync_ns:
                    self._sync()
                self.progress()
                left_ns = self.counts.last_sync_ns + self._sync_ns - time.monotonic_ns()
                self.backlog.pressing.wait(max(0.0, left_ns / NS_PER_S))
                self.backlog.pressing.clear()
            self._write_until(None)
        finally:
            self._segment.close()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Ask it to end and wait for that."""
        self._stop_asked.set()
        self.backlog.pressing.set()
        super().stop(timeout_s)

    def _write_until(self, end_ns: int | None) -> None:
        """Write the backlog; not beyond a time of the monotonic clock [ns] even if more and more comes."""
        begin_ns = time.monotonic_ns()
        while (item := self.backlog.get()) is not None:
            self._segment.write(item.topic, item.log_time_ns, item.data)
            self.counts.messages += 1
            if end_ns is not None and time.monotonic_ns() >= max(end_ns, begin_ns + _SLICE_NS):
                break

    def _sync(self) -> None:
        begin_ns = time.monotonic_ns()
        self.counts.bytes_on_disk = self._segment.sync()
        self.counts.last_sync_ns = time.monotonic_ns()
        self.counts.syncs += 1
        took_ms = (self.counts.last_sync_ns - begin_ns) / NS_PER_MS
        self.counts.slowest_sync_ms = max(self.counts.slowest_sync_ms, took_ms)


# Names ----------------------------------------------------------------------------------------------------------------

_NAME: Final = re.compile(r"(\d{5})-(\d{3})\.mcap")


def next_segment_path(directory: Path, boot_id: str) -> Path:
    """Path of the next segment: boot counter and a number within the boot, because dates cannot be trusted aboard.

    The counter outlives the logs in `boot.json` of the folder.

    Raises
    ------
    LogError
        The folder cannot be made or written to.
    """
    state = directory / "boot.json"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        taken = [(int(match[1]), int(match[2])) for p in directory.iterdir() if (match := _NAME.fullmatch(p.name))]
        last_id, last = _last_boot(state)
        newest = max([last, *(boot for boot, _ in taken)])
        boot = last if boot_id == last_id and last == newest else newest + 1
        write_atomically(state, json.dumps({"boot_id": boot_id, "number": boot}))
    except OSError as error:
        raise LogError(f"{directory}: logs cannot be written there ({error.strerror})") from None
    segment = 1 + max((number for of_boot, number in taken if of_boot == boot), default=-1)
    return directory / f"{boot:05d}-{segment:03d}.mcap"


def _last_boot(state: Path) -> tuple[str, int]:
    with contextlib.suppress(FileNotFoundError, ValueError, KeyError, TypeError):
        tree = json.loads(state.read_text(encoding="utf-8"))
        return str(tree["boot_id"]), int(tree["number"])
    return "", 0


def write_atomically(path: Path, text: str, *, sync: bool = True) -> None:
    """Replace a file so that a reader, or a power cut, finds the old text or the new one."""
    temporary = path.with_name(f".{path.name}.new")
    with temporary.open("w", encoding="utf-8") as file:
        os.fchmod(file.fileno(), 0o644)  # whoever may enter the folder may read it, whatever the umask
        file.write(text)
        if sync:
            file.flush()
            os.fsync(file.fileno())
    temporary.replace(path)
    if sync:
        sync_directory(path.parent)


def sync_directory(directory: Path) -> None:
    """Force the names in a folder on to the disk."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
