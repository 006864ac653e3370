"""Points of a LAZ file for laspy, unpacked by another process: lazrs is native code, which aborts where a file's counts and sizes lie.

That process has a limit on memory and on the processor's time. It unpacks ahead, so that reading costs no more time than in one process.
"""

import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Final

import lazrs
from laspy._pointreader import IPointReader
from laspy.errors import LaspyException

from flightlog.errors import SourceError
from groundproc.cloud import lazworker
from groundproc.cloud.lazworker import Task

_MEMORY_BYTES: Final = 512 << 20
_CHUNK_BYTES: Final = 64 << 20
"""Chunks larger than this are unpacked point by point, not side by side, which takes them whole into memory."""
_VARIABLE: Final = 0xFFFF_FFFF
"""Points of a chunk where its size is stated with each."""
_CHUNK_SIZE_AT: Final = 12
"""Where the record of the packing states the points of a chunk (LASzip VLR)."""


Parts = Sequence[tuple[int, int]]


class Backend:
    """What laspy takes for a library that unpacks.

    Parameters
    ----------
    path : Path
    most : int
        Points that are asked for at once; always so many but at the end.
    parts : sequence of (int, int), optional
        First point and number of points of each part that is read, in this order and not beyond `most`; default: all points.
    """

    def __init__(self, path: Path, most: int, parts: Parts | None = None) -> None:
        self._path, self._most, self._parts = path, most, parts

    def is_available(self) -> bool:
        """It is."""
        return True

    def create_reader(self, source: Any, header: Any, decompression_selection: Any = None) -> "Unpacker":
        """A reader of the points of a file that laspy has opened."""
        vlr = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
        return Unpacker(self._path, source, header, vlr, self._most, self._parts)


class Unpacker(IPointReader):  # type: ignore[misc]  # laspy has no types
    """Points from the other process, in the order of the file.

    Parameters
    ----------
    path : Path
    source : file object
        laspy's, which is closed with this.
    header : laspy.LasHeader
    vlr : bytes
        How the points are packed.
    most : int
        Points at once.
    parts : sequence of (int, int), optional
        As in `Backend`.
    """

    def __init__(self, path: Path, source: Any, header: Any, vlr: bytes, most: int, parts: Parts | None = None) -> None:
        self._path, self._source = path, source
        self._point_bytes = int(header.point_format.size)
        if (stated := int(lazrs.LazVlr(vlr).item_size())) != self._point_bytes:
            raise LaspyException(f"points of {stated} bytes are packed, expected {self._point_bytes} by the header")
        count = int(header.point_count)
        self._seeks = parts is not None
        self._parts = iter(((at, min(most, count - at)) for at in range(0, count, most)) if parts is None else parts)
        self._half, self._first, self._asked = 0, 0, 0
        half_bytes = min(count, most) * self._point_bytes
        self._half_bytes = half_bytes + -half_bytes % mmap.ALLOCATIONGRANULARITY
        chunk_points = int.from_bytes(vlr[_CHUNK_SIZE_AT : _CHUNK_SIZE_AT + 4], "little")
        parallel = chunk_points == _VARIABLE or chunk_points * self._point_bytes <= _CHUNK_BYTES
        shared = shared_memory(2 * self._half_bytes)
        try:
            self._memory = mmap.mmap(shared, 2 * self._half_bytes)
            limit = _MEMORY_BYTES + 2 * self._half_bytes
            offset = int(header.offset_to_point_data)
            task = Task(str(path), offset, vlr.hex(), self._point_bytes, shared, self._half_bytes, limit, parallel)
            self._child = start(task)
        finally:
            os.close(shared)

    @property
    def source(self) -> Any:
        """Laspy's file."""
        return self._source

    def read_n_points(self, n: int) -> bytearray:
        """The next n points.

        Raises
        ------
        LaspyException, SourceError
            They cannot be unpacked.
        """
        if not self._asked:
            self._ask()
        if n != self._asked:
            raise LaspyException(f"{n} points are wanted, expected {self._asked}")
        self._wait()
        begin = self._half * self._half_bytes
        self._half = 1 - self._half
        self._ask()
        return bytearray(memoryview(self._memory)[begin : begin + n * self._point_bytes])

    def seek(self, point_index: int) -> None:
        """Only to where the next part begins."""
        if not self._asked:
            self._ask()
        if point_index != self._first:
            raise LaspyException(
                f"point {point_index} is wanted, expected {self._first}: points can only be read in their order"
            )

    def close(self) -> None:
        """End the other process, whatever it does, and close the file."""
        self._child.kill()
        self._child.communicate()
        self._memory.close()
        self._source.close()

    def _ask(self) -> None:
        """Let the next points be unpacked."""
        self._first, self._asked = next(self._parts, (0, 0))
        if self._asked:
            first = f" {self._first}" if self._seeks else ""
            try:
                _pipe(self._child.stdin).write(f"{self._half} {self._asked}{first}\n")
                _pipe(self._child.stdin).flush()
            except BrokenPipeError:  # it is gone: `_wait` says why
                pass

    def _wait(self) -> None:
        """Wait until the points that were asked for are there."""
        answer = _pipe(self._child.stdout).readline()
        if answer == "ok\n":
            return
        if not answer:
            answer = ended(self._child.wait(), self._path)
        raise LaspyException(answer.strip())


def _pipe(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe


def ended(code: int, path: Path) -> str:
    """Why a process ended that unpacked points of a file, and said nothing.

    Raises
    ------
    SourceError
        That was not for the file's sake.
    """
    if -code in (signal.SIGTERM, getattr(signal, "SIGKILL", None)):
        raise SourceError(
            f"{path}: the process that unpacks its points was killed ({signal.Signals(-code).name}), by somebody or by a system that has "
            "no memory left; the file may be sound"
        )
    if code < 0 and signal.Signals(-code).name == "SIGXCPU":
        return "unpacking its points does not come to an end"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"unpacking its points failed with {name}"


def shared_memory(size: int) -> int:
    """A file descriptor of memory that processes can share."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("points")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.truncate(descriptor, size)
    return descriptor


def start(task: Task) -> "subprocess.Popen[str]":
    """Start the other process, with nothing of this one's environment but what lazrs' threads need."""
    packages = str(Path(lazrs.__file__).parents[1])
    return subprocess.Popen(
        # isolated, and without the packages' start-up files: half of the time
        [sys.executable, "-I", "-S", lazworker.__file__, packages, json.dumps(task._asdict())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        pass_fds=(task.shared,),
        env={**os.environ, "MALLOC_ARENA_MAX": "2", "RUST_BACKTRACE": "0"},
        text=True,
    )
