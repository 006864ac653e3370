"""Logs that a power cut or a crash left open: mended slowly while recording goes on, so that it is not disturbed."""

import fcntl
import logging
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flightlog.errors import LogError, SwathError
from flightlog.logfile import LogReader
from flightlog.salvage import Salvage, examine, salvage
from onboard import logfolder
from onboard.journal import event
from onboard.logfolder import READ_ONLY, Entry, sync_directory

_log = logging.getLogger(__name__)

_BYTES_PER_S: Final = 20e6
"""A card manages a multiple of what the recording needs, but not of both."""
_SYNC_BYTES: Final = 8 << 20
"""A sync of the recording waits for what others have written and not synced."""
_TEMPORARY: Final = ".salvage"


class _StoppedError(Exception):
    """The daemon ends; the next start goes on."""


@dataclass(slots=True)
class SalvageCounts:
    """What became of the leftovers."""

    found: int = 0
    mended: int = 0
    lossy: int = 0
    """Of those mended: more than a torn end was lost."""
    left: int = 0
    """Not mended: there is no space, or they are no logs."""


class Salvager(threading.Thread):
    """Mends the leftovers of a folder and enters them into its manifest.

    A torn end, as every power cut leaves it, is replaced by a summary. Where more is damaged, the original stays beside the
    mended log, as NAME.damaged, until it too is acknowledged.

    Parameters
    ----------
    directory : Path
    paths : list of Path
        Found before the first new segment was opened.
    keep_free_bytes : int
        Space that stays free for the recording.
    compression : str
        Of the mended logs.
    """

    def __init__(self, directory: Path, paths: list[Path], keep_free_bytes: int, compression: str) -> None:
        super().__init__(name="salvage", daemon=True)
        self._directory, self._paths = directory, paths
        self._keep_free_bytes, self._compression = keep_free_bytes, compression
        self._stop_asked = threading.Event()
        self._unsynced = 0
        self._temporary: Path | None = None
        self.counts = SalvageCounts(found=len(paths))

    def stop(self) -> None:
        """Ask it to end, and wait."""
        self._stop_asked.set()
        if self.ident is not None:
            self.join(10)

    def run(self) -> None:
        """Mend one after the other; no failure here ends the recording."""
        for path in self._paths:
            try:
                self._mend(path)
            except _StoppedError:
                return
            except (OSError, SwathError) as error:
                self.counts.left += 1
                _log.error("leftover %s cannot be mended: %s", path.name, error)
            except Exception:  # the top of a thread: one damaged log may not keep the others from being mended
                self.counts.left += 1
                _log.exception("leftover %s cannot be mended", path.name)

    def _mend(self, path: Path) -> None:
        with path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:  # somebody writes it
                return
            if not self._is_log(path):
                return
            with LogReader(path) as log:
                cut_off = log.damage.truncated
            if not cut_off and (found := examine(path, self._pace)).whole:
                self._enter(path, found, "whole", path)
                self.counts.mended += 1
                return
            self._rewrite(path)

    def _is_log(self, path: Path) -> bool:
        """Set aside a file that is no log: the power failed before the first sync."""
        try:
            LogReader(path).close()
        except LogError as error:
            aside = path.with_name(f"{path.name}.unreadable")
            path.rename(aside)
            sync_directory(self._directory)
            line = {"file": path.name, "size": aside.stat().st_size, "how": "unreadable", "kept_as": aside.name}
            logfolder.append_to_manifest(self._directory, line)
            self.counts.left += 1
            _log.error("leftover %s is no log and kept as %s (%s)", path.name, aside.name, error)
            return False
        return True

    def _rewrite(self, path: Path) -> None:
        if logfolder.free_bytes(self._directory) < path.stat().st_size + self._keep_free_bytes:
            self.counts.left += 1
            _log.error(
                "leftover %s stays as it is: no space to mend it; `swath recover` does it on the ground", path.name
            )
            return
        new = path.with_name(path.name + _TEMPORARY)
        self._temporary = new
        found = salvage(path, new, compression=self._compression, progress=self._pace)
        if found.torn_tail_only:
            self._enter(new, found, "salvaged", path)
        else:
            aside = path.with_name(f"{path.name}.damaged")
            aside.unlink(missing_ok=True)  # the same file, of a salvage that was interrupted
            os.link(path, aside)
            self._enter(aside, found, "damaged", aside)
            self._enter(new, found, "salvaged", path)
            self.counts.lossy += 1
        self.counts.mended += 1
        lost = "; ".join(found.sentences())
        _log.warning("leftover %s mended: %s", path.name, lost, extra=event("mended", segment=path.name))

    def _enter(self, file: Path, found: Salvage, how: str, name: Path) -> None:
        """Make a finished file read-only, give it its name, and enter it into the manifest."""
        with LogReader(file) as log:
            boot_id = log.metadata.get("swath.session", {}).get("boot_id", "")
        checksum = logfolder.sha256(file, self._pace)
        entry = Entry(
            name.name, file.stat().st_size, checksum, found.messages, found.start_ns, found.end_ns, boot_id, how,
            lost=found.to_mapping(),
        )  # fmt: skip
        file.chmod(READ_ONLY)
        file.replace(name)
        sync_directory(self._directory)
        logfolder.enter(self._directory, entry)

    def _pace(self, done_bytes: int) -> None:
        """Called with the bytes read since: wait to keep the pace, and sync what was written."""
        if self._stop_asked.wait(done_bytes / _BYTES_PER_S):
            raise _StoppedError
        self._unsynced += done_bytes
        if self._unsynced >= _SYNC_BYTES:
            self._unsynced = 0
            self._sync_temporary()

    def _sync_temporary(self) -> None:
        if self._temporary is None or not self._temporary.exists():
            return
        descriptor = os.open(self._temporary, os.O_WRONLY)
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)


def begin(directory: Path, keep_free_bytes: int, compression: str) -> Salvager:
    """Look for leftovers, and delete the remains of an interrupted salvage; the thread is not started yet."""
    for path in directory.glob(f"*{_TEMPORARY}"):
        path.unlink(missing_ok=True)
    return Salvager(directory, logfolder.leftovers(directory), keep_free_bytes, compression)
