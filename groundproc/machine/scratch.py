"""Arrays written one after the other to a temporary file, and read again into arrays."""

import tempfile
import weakref
from typing import Any

import numpy as np
import numpy.typing as npt


class Scratch:
    """A file for arrays that has no name and is gone when this is.

    Raises
    ------
    OSError
        By each of its methods, and where the file cannot be made: no room, or bytes that are missing.
    """

    def __init__(self) -> None:
        self._file: Any = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 (open as long as this lives)
        weakref.finalize(self, self._file.close)

    def write(self, array: npt.NDArray[Any]) -> None:
        """Write all of an array, in one piece in memory, where the last ended."""
        left = memoryview(array.view(np.uint8).data)
        while len(left):
            left = left[self._file.write(left) :]

    def seek(self, place: int) -> None:
        """Read on from a byte."""
        self._file.seek(place)

    def read(self, count: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """The next so many values, shape (count,)."""
        out: npt.NDArray[Any] = np.empty(count, dtype)
        left = memoryview(out.view(np.uint8).data)
        while len(left):
            done = self._file.readinto(left)
            if not done:
                raise OSError(f"{len(left)} bytes are missing of what was set aside")
            left = left[done:]
        return out

    def close(self) -> None:
        """Give its room back at once."""
        self._file.close()
