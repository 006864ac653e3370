"""Nodes of a COPC file (copc.io, version 1.0), one by one and in any order: what is shown is read, and no more.

The hierarchy is held against the file before anything is read by it, and points are unpacked by another process (`laz`).
"""

import contextlib
import mmap
import os
import struct
import subprocess
import threading
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

import laspy
import lazrs
import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.cloud import laz, reader
from groundproc.cloud.lazworker import Task
from groundproc.cloud.points import Points
from groundproc.cloud.reader import Cloud
from groundproc.machine import system

Key = tuple[int, int, int, int]
"""Level, and x, y, z of a node."""

_VLR_AT: Final = 375
_INFO: Final = struct.Struct("<5d2Q2d")
_ENTRY: Final = struct.Struct("<4iQ2i")
_MOST_NODES: Final = 2_000_000
_MOST_LEVELS: Final = 31
_MOST_POINTS: Final = 4_000_000
"""Of a node: writers make them of some ten thousand."""
_MEMORY_BYTES: Final = 512 << 20


@dataclass(frozen=True, slots=True)
class Node:
    """Where the points of a node lie.

    Attributes
    ----------
    key : tuple of int
    place, size : int
        Of its chunk in the file [bytes].
    points : int
    """

    key: Key
    place: int
    size: int
    points: int


@dataclass(frozen=True, slots=True)
class Octree:
    """What a COPC file says of its nodes.

    Attributes
    ----------
    corner_m : tuple of float
        Least x, y, z of the root.
    side_m : float
        Of the root.
    spacing_m : float
        Between points of the root.
    nodes : dict
        Those with points, by key.
    """

    corner_m: tuple[float, float, float]
    side_m: float
    spacing_m: float
    nodes: dict[Key, Node]


def is_copc(path: Path) -> bool:
    """Whether a file says that it is one: the first record of its head is the info."""
    try:
        with path.open("rb") as file:
            file.seek(_VLR_AT + 2)
            return file.read(4) == b"copc"
    except OSError:
        return False


def octree_of(path: Path) -> Octree:
    """Read the hierarchy of a COPC file.

    Raises
    ------
    CaptureError
        It is none, or is damaged.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(_VLR_AT + 54)
            x, y, z, half_m, spacing_m, root, root_bytes, *_ = _INFO.unpack(file.read(_INFO.size))
            if not (np.isfinite([x, y, z, spacing_m]).all() and 0.0 < half_m < 1e9):
                raise CaptureError(
                    f"{path}: is damaged (its octree lies at {x:g}, {y:g}, {z:g} and is {half_m:g} m wide)"
                )
            nodes = dict(_nodes(path, file, size, (root, root_bytes)))
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from None
    except struct.error:
        raise CaptureError(f"{path}: ends within its head") from None
    if not nodes:
        raise CaptureError(f"{path}: is damaged (its hierarchy names no points)")
    return Octree((x - half_m, y - half_m, z - half_m), 2.0 * half_m, abs(spacing_m), nodes)


def _nodes(path: Path, file: BinaryIO, size: int, root: tuple[int, int]) -> Iterator[tuple[Key, Node]]:
    """Nodes with points, page by page."""
    waiting, met, seen = [root], set[int](), 0
    while waiting:
        place, length = waiting.pop()
        if place in met or length % _ENTRY.size or not 0 < length <= size - place:
            raise CaptureError(f"{path}: is damaged (a page of its hierarchy has {length} bytes from {place} on)")
        met.add(place)
        file.seek(place)
        for level, nx, ny, nz, at, packed, count in _ENTRY.iter_unpack(file.read(length)):
            seen += 1
            side = 1 << level if 0 <= level <= _MOST_LEVELS else 0
            if seen > _MOST_NODES or not all(0 <= number < side for number in (nx, ny, nz)):
                raise CaptureError(f"{path}: is damaged (node {level}-{nx}-{ny}-{nz} in its hierarchy)")
            if count == -1:
                waiting.append((at, packed))
            elif count:
                if not (0 < count <= _MOST_POINTS and 0 < packed <= size - at):
                    raise CaptureError(
                        f"{path}: is damaged (node {level}-{nx}-{ny}-{nz} of {count} points, {packed} bytes)"
                    )
                yield (level, nx, ny, nz), Node((level, nx, ny, nz), at, packed, count)


class NodeReader:
    """Reads nodes; may be asked by several threads, and answers one after the other.

    Use as a context manager.

    Parameters
    ----------
    cloud : Cloud
        Of a COPC file.
    octree : Octree

    Raises
    ------
    CaptureError
        The file cannot be read.
    """

    def __init__(self, cloud: Cloud, octree: Octree) -> None:
        self._cloud, self._lock = cloud, threading.Lock()
        with reader.opened(cloud.path) as file:
            header = file.header
            self._form, self._scales, self._offsets = header.point_format, header.scales, header.offsets
            self._weekly = cloud.week_time
            try:
                vlr = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
            except (ValueError, IndexError):
                raise CaptureError(f"{cloud.path}: is damaged (a COPC file whose points are not packed)") from None
        point_bytes = int(self._form.size)
        most = max(node.points for node in octree.nodes.values()) * point_bytes
        self._bytes = most + -most % mmap.ALLOCATIONGRANULARITY
        self._vlr = vlr
        self._child: subprocess.Popen[str] | None = None
        if not system.LIMITED:
            return
        shared = laz.shared_memory(self._bytes * 2)
        self._task = Task(
            str(cloud.path), 0, vlr.hex(), point_bytes, shared, self._bytes, _MEMORY_BYTES + 2 * self._bytes, False
        )
        self._memory = mmap.mmap(shared, 2 * self._bytes)
        self._child = laz.start(self._task)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process that unpacks."""
        if self._child is None:
            return
        self._child.kill()
        self._child.communicate()
        self._memory.close()
        os.close(self._task.shared)

    def read(self, node: Node, columns: Collection[str] | None = None) -> tuple[Points, npt.NDArray[np.float64]]:
        """Points of a node, with the columns that are wanted, and their times as stored [s], shape (n,).

        Raises
        ------
        CaptureError
            It is damaged; others can still be read.
        """
        with self._lock:
            raw = self._unpacked(node)
        record = laspy.ScaleAwarePointRecord(
            np.frombuffer(raw, self._form.dtype()), self._form, self._scales, self._offsets
        )
        time_s = np.asarray(record.gps_time, np.float64)
        return reader.points_of(self._cloud, record, np.zeros(len(record), np.int64), columns), time_s

    def _unpacked(self, node: Node) -> bytes:
        child = self._child
        if child is None:
            return self._unpacked_here(node)
        assert child.stdin is not None
        assert child.stdout is not None
        answer = ""
        with contextlib.suppress(BrokenPipeError):
            child.stdin.write(f"0 {node.points} {node.place} {node.size}\n")
            child.stdin.flush()
            answer = child.stdout.readline()
        if answer != "ok\n":
            child.kill()
            child.communicate()
            self._child = laz.start(self._task)
            key = "-".join(map(str, node.key))
            reason = answer.strip() or laz.ended(child.returncode, self._cloud.path)
            raise CaptureError(f"{self._cloud.path}: node {key} is damaged ({reason})")
        return bytes(memoryview(self._memory)[: node.points * self._task.point_bytes])

    def _unpacked_here(self, node: Node) -> bytes:
        """The same in this process, on a system where no other can be given limits."""
        points = bytearray(node.points * int(self._form.size))
        try:
            with self._cloud.path.open("rb") as file:
                file.seek(node.place)
                packed = file.read(node.size)
            lazrs.decompress_points_with_chunk_table(packed, self._vlr, points, [(node.points, len(packed))])
        except (OSError, lazrs.LazrsError) as error:
            key = "-".join(map(str, node.key))
            raise CaptureError(f"{self._cloud.path}: node {key} is damaged ({error})") from None
        return bytes(points)
