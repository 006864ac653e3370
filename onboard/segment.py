"""One file of the flight log, from its first synced byte to its line in the manifest."""

import contextlib
import enum
import fcntl
import hashlib
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from flightlog import __version__
from flightlog.constants import NS_PER_S
from flightlog.errors import LogError
from flightlog.logwriter import LogWriter
from onboard import logfolder
from onboard.logfolder import READ_ONLY, Entry, sync_directory

_CHUNK_BYTES: Final = 3 << 19
"""A little more than arrives between two syncs, so that each sync closes one chunk, and little is lost with one."""


_IOV_MAX: Final = 1024
"""The kernel takes no more pieces in one call."""


class Where(enum.Enum):
    """Where a file is that is being written."""

    HERE = enum.auto()
    ELSEWHERE = enum.auto()
    """Moved or renamed: its name leads to nothing, or to another file."""
    NOWHERE = enum.auto()
    """Deleted: nobody can reach it by a name any more."""


class _HashedFile:
    """An unbuffered file with the checksum of what was written to it: a write that the disk refuses fails at once, to the byte."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._raw = path.open("xb", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX)  # it is being written: no leftover
        self._digest: Any = hashlib.sha256()
        self.size = 0

    def write(self, data: bytes) -> int:
        """Write all of it, or raise OSError."""
        self.write_pieces([data])
        return len(data)

    def write_pieces(self, pieces: Sequence[bytes]) -> None:
        """Write all of them in one call, or raise OSError."""
        for begin in range(0, len(pieces), _IOV_MAX):
            some = pieces[begin : begin + _IOV_MAX]
            size = sum(map(len, some))
            done = os.writev(self._raw.fileno(), some)
            if done < size:  # seldom: a disk that is nearly full
                rest = memoryview(b"".join(some))
                while done < size:
                    done += self._raw.write(rest[done:])
            self.size += size
            if self._digest is not None:
                for piece in some:
                    self._digest.update(piece)

    def seek(self, offset: int) -> None:
        """Go back to where a record began that did not fit."""
        self._raw.seek(offset)

    def truncate(self, size: int) -> None:
        """Take back what is behind; the checksum is then made of the file itself."""
        self._raw.truncate(size)
        self.size = size
        self._digest = None

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        """Force it on to the disk."""
        os.fdatasync(self._raw.fileno())

    @property
    def where(self) -> Where:
        """Whether its name still leads to it."""
        own = os.fstat(self._raw.fileno())
        if own.st_nlink == 0:
            return Where.NOWHERE
        try:
            named = self._path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return Where.ELSEWHERE
        except OSError:  # a disk that fails is told by the writing
            return Where.HERE
        return Where.HERE if os.path.samestat(own, named) else Where.ELSEWHERE

    def finish(self) -> str:
        """Sync, make read-only, close; gives the SHA-256."""
        with self._raw:
            os.fchmod(self._raw.fileno(), READ_ONLY)
            os.fsync(self._raw.fileno())
        return logfolder.sha256(self._path) if self._digest is None else str(self._digest.hexdigest())

    def close(self) -> None:
        """Close it as it is."""
        self._raw.close()


class Segment:
    """A segment that is being written.

    Parameters
    ----------
    path : Path
        Must not exist.
    metadata, attachments
        See LogWriter.
    topics : iterable of str
        Announced at the head of the file: without them nothing that follows could be read.
    first : tuple of topic, log time, bytes
        A message to begin with, so that the file has a chunk with the topics from the start.
    compression : str
        See LogWriter.

    Raises
    ------
    LogError
        The file cannot be made; its cause is the OSError.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, bytes],
        topics: Iterable[str],
        first: tuple[str, int, bytes],
        compression: str = "none",
    ) -> None:
        self.path = path
        self.opened_ns = time.monotonic_ns()
        self._boot_id = metadata.get("swath.session", {}).get("boot_id", "")
        try:
            self._file = _HashedFile(path)
        except OSError as error:
            raise LogError(f"{path}: cannot be written ({error.strerror})") from error
        try:
            self._writer = LogWriter(
                cast(BinaryIO, self._file), metadata=metadata, attachments=attachments, library=f"swathd {__version__}",
                compression=compression, chunk_bytes=_CHUNK_BYTES,
            )  # fmt: skip
            for topic in topics:
                self._writer.add_topic(topic)
            self.write(*first)
            self.sync()
            sync_directory(path.parent)
        except OSError as error:
            self._file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise LogError(f"{path}: cannot be written ({error.strerror})") from error

    @property
    def size(self) -> int:
        """Of the file so far [bytes]."""
        return self._file.size

    @property
    def where(self) -> Where:
        """Whether somebody deleted or moved the file."""
        return self._file.where

    def abandon(self) -> None:
        """Let go of a file that cannot be closed well; the next start mends it, if it is still there."""
        self._file.close()

    def part(self) -> None:
        """Make whole what was moved elsewhere, and let go of it: it is in no folder of ours any more."""
        try:
            self._writer.finish()
        finally:
            self._file.close()

    @property
    def age_s(self) -> float:
        """Since it was opened [s]."""
        return (time.monotonic_ns() - self.opened_ns) / NS_PER_S

    @property
    def lost(self) -> int:
        """Messages that the disk did not take."""
        return self._writer.lost

    def write(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Append one message."""
        self._writer.write(topic, log_time_ns, data)

    def sync(self) -> int:
        """Force everything on to the disk; gives the file's size [bytes]."""
        self._writer.flush()
        self._file.sync()
        return self._file.size

    def close(self, drops: Mapping[str, int] | None = None) -> Entry:
        """Write the footer, sync, make read-only, enter into the manifest.

        Where the disk is full the reserve is given up for it. If even that does not help, the OSError says so, and what is in the
        file is found and mended at the next start.
        """
        try:
            self._finish()
            checksum = self._file.finish()
        except BaseException:
            self._file.close()
            raise
        first_ns, last_ns = self._writer.span_ns
        entry = Entry(
            self.path.name, self.size, checksum, self._writer.counts, first_ns, last_ns, self._boot_id, "closed",
            drops={**(drops or {}), "disk": self.lost},
        )  # fmt: skip
        sync_directory(self.path.parent)
        logfolder.enter(self.path.parent, entry)
        return entry

    def _finish(self) -> None:
        try:
            self._writer.finish()
        except OSError:
            logfolder.release_reserve(self.path.parent)
            self._writer.finish()
