"""Parts of a cloud that is being written, kept as they are packed: who would read them from the file need not have them unpacked."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from groundproc.machine.scratch import Scratch

Records = npt.NDArray[np.void]
Parts = Sequence[tuple[int, int]]
"""First point and number of points of each part of a cloud, in the order of the file; no two share a point."""


class SetAside:
    """Parts of a cloud in a temporary file, which has no name and is gone when this is.

    Where the file has no room nothing is kept, and the parts are read from the cloud.

    Parameters
    ----------
    wanted : callable
        Which parts: asked once, when the first points come.
    """

    def __init__(self, wanted: Callable[[], Parts]) -> None:
        self._wanted = wanted
        self._parts: list[tuple[int, int]] | None = None
        self._seen, self._whole = 0, 0
        self._file: Scratch | None = None

    def see(self, records: Records) -> None:
        """Keep what is wanted of the next records of the cloud, shape (n,)."""
        try:
            if self._parts is None:
                self._parts = list(self._wanted())
                self._file = Scratch()
            begin, self._seen = self._seen, self._seen + len(records)
            for first, count in self._parts[self._whole :]:
                if first >= self._seen:
                    break
                assert self._file is not None
                self._file.write(records[max(first - begin, 0) : first + count - begin])
                self._whole += first + count <= self._seen
        except OSError:
            self._parts, self._whole = [], 0
            if self._file is not None:
                self._file.close()  # at once: the cloud needs the room

    def has(self, parts: Parts) -> bool:
        """Whether these are the parts that were kept, and all of them whole."""
        return bool(parts) and list(parts) == self._parts and self._whole == len(parts)

    def read(self, part: tuple[int, int], dtype: np.dtype[Any]) -> Records:
        """The records of a part that was kept, shape (n,).

        Raises
        ------
        OSError
            The file cannot be read.
        """
        assert self._parts is not None
        assert self._file is not None
        before = sum(count for _, count in itertools.takewhile(lambda each: each != part, self._parts))
        self._file.seek(before * dtype.itemsize)
        return self._file.read(part[1], dtype)
