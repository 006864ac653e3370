"""Files as an import reads them: hashed on the way, and unpacked where they are compressed."""

import hashlib
import io
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from flightlog.errors import CaptureError
from groundproc import packed

_BUFFER_BYTES: Final = 1 << 18
"""Of each file: hundreds may be open at a time."""


class Hashed(io.RawIOBase):
    """A file that hashes what is read from it.

    Attributes
    ----------
    size : int
        Bytes read so far.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise CaptureError(f"{path}: cannot be opened ({error.strerror})") from None
        self._hash = hashlib.sha256()
        self.size = 0

    def readable(self) -> bool:
        """It can be read."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read, hash and count."""
        count = self._file.readinto(buffer) or 0
        self._hash.update(memoryview(buffer)[:count])
        self.size += count
        return count

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    def sha256(self) -> str:
        """Hash of what was read, in hexadecimal."""
        return self._hash.hexdigest()


class Input:
    """A file, read once from begin to end.

    Attributes
    ----------
    stream : BinaryIO
        What is in it.

    Raises
    ------
    CaptureError
        It cannot be opened or read.
    """

    stream: BinaryIO

    def __init__(self, path: Path) -> None:
        self._hashed = Hashed(path)
        self._raw = io.BufferedReader(self._hashed, _BUFFER_BYTES)
        try:
            plain, self._unpacking = packed.opened(cast(io.BufferedReader, self._raw), str(path))
        except OSError as error:
            raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
        self.stream = cast(BinaryIO, plain)

    @property
    def size(self) -> int:
        """Bytes of the file, as read so far."""
        return self._hashed.size

    @property
    def damage(self) -> str:
        """What is wrong with its compression, empty where nothing is."""
        return "" if self._unpacking is None else self._unpacking.damage

    def sha256(self) -> str:
        """Hash of the file, in hexadecimal; reads what has not been read of it."""
        while self._raw.read(1 << 20):
            pass
        return self._hashed.sha256()

    def close(self) -> None:
        """Close the file."""
        self._hashed.close()


def hash_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
