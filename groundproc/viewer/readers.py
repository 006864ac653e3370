"""Readers of the nodes of many files: each holds a process, so few are open at a time."""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from typing import Final

from groundproc.cloud.nodes import NodeReader, Octree
from groundproc.cloud.reader import Cloud

_AT_ONCE: Final = 2
"""Nodes that are unpacked at the same time."""
_OPEN: Final = 8
"""Readers that wait for the next node of their file."""


class Readers:
    """Lends a reader of a file to one thread at a time.

    Parameters
    ----------
    files : sequence of (Cloud, Octree)
    """

    def __init__(self, files: Sequence[tuple[Cloud, Octree]]) -> None:
        self._files = files
        self._turns = threading.BoundedSemaphore(_AT_ONCE)
        self._lock = threading.Lock()
        self._idle: list[tuple[int, NodeReader]] = []
        self._closed = False

    @contextlib.contextmanager
    def of(self, number: int) -> Iterator[NodeReader]:
        """A reader of a file, by its number among them.

        Raises
        ------
        CaptureError
            The file cannot be read.
        """
        with self._turns:
            reader = self._waiting(number) or NodeReader(*self._files[number])
            try:
                yield reader
            finally:
                self._wait(number, reader)

    def close(self) -> None:
        """End them all; those that are lent end when they come back."""
        with self._lock:
            self._closed, over = True, self._idle
            self._idle = []
        for _, reader in over:
            reader.close()

    def _waiting(self, number: int) -> NodeReader | None:
        with self._lock:
            for at, (other, reader) in enumerate(self._idle):
                if other == number:
                    del self._idle[at]
                    return reader
        return None

    def _wait(self, number: int, reader: NodeReader) -> None:
        with self._lock:
            self._idle.append((number, reader))
            over = self._idle.pop(0)[1] if self._closed or len(self._idle) > _OPEN else None
        if over is not None:
            over.close()
