"""The head of a LAS or LAZ file held against the size of the file, before anybody asks for memory or counts by it.

Format: ASPRS LAS 1.4 R15, tables 3, 6 and 7.
"""

import os
import struct
from pathlib import Path
from typing import BinaryIO, Final

from flightlog.errors import CaptureError

_SIGNATURE: Final = b"LASF"
_LEAST_BYTES: Final = 227
_VLR: Final = struct.Struct("<H16sHH32s")
_EVLR: Final = struct.Struct("<H16sHQ32s")
_POINTS_PER_BYTE: Final = 8
"""Of a LAZ file. Clouds that were measured take two bytes a point or more; packing can say one point a million times in few bytes."""
_SOME_POINTS: Final = 100_000
_LARGEST_M: Final = 1e9
"""Coordinates on a map are far below."""
_COARSEST_M: Final = 1e3


def check(path: Path) -> None:
    """Hold what the head says of sizes, counts and scales against the file.

    Raises
    ------
    CaptureError
        It cannot be so.
    OSError
        It cannot be read.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(375).ljust(375, b"\x00")
        if head[:4] != _SIGNATURE or size < _LEAST_BYTES:
            raise CaptureError(f"{path}: is no LAS or LAZ file: {size} bytes that begin with {head[:4]!r}")
        reason = _sizes(head, size) or _scales(head) or _records(file, head, size)
    if reason:
        raise CaptureError(f"{path}: is damaged ({reason})")


def _sizes(head: bytes, size: int) -> str:
    """What is wrong with the sizes of the head and the number of points, or nothing."""
    head_bytes, offset = struct.unpack_from("<HI", head, 94)
    if not _LEAST_BYTES <= head_bytes <= offset <= size:
        return f"a head of {head_bytes} bytes and points from byte {offset} on, in a file of {size} bytes"
    points, point_bytes, packed = _points(head)
    if packed:
        most = _SOME_POINTS + _POINTS_PER_BYTE * size
        return f"{points} points in a file of {size} bytes, expected {most} at most" if points > most else ""
    held = (size - offset) // point_bytes if point_bytes else 0
    return f"ends after {held} points, expected {points} by its header" if points > held else ""


def _points(head: bytes) -> tuple[int, int, bool]:
    """Number of points, bytes of each, and whether they are packed."""
    kind, point_bytes, points = struct.unpack_from("<BHI", head, 104)
    if head[25] >= 4:
        (points,) = struct.unpack_from("<Q", head, 247)
    return points, point_bytes, bool(kind & 0xC0)


def _scales(head: bytes) -> str:
    """What is wrong with scales and offsets, or nothing."""
    values = struct.unpack_from("<6d", head, 131)
    for scale, offset in zip(values[:3], values[3:], strict=True):
        if not (0.0 < scale <= _COARSEST_M and abs(offset) <= _LARGEST_M):
            most = f"a scale above 0 to {_COARSEST_M:g} and an offset of {_LARGEST_M:g} at most"
            return f"scale {scale:g} and offset {offset:g}, expected {most}"
    return ""


def _records(file: BinaryIO, head: bytes, size: int) -> str:
    """What is wrong with the variable length records, or nothing."""
    head_bytes, offset, count = struct.unpack_from("<HII", head, 94)
    if not _fits(file, _VLR, head_bytes, offset, count):
        return f"{count} variable length records do not fit between bytes {head_bytes} and {offset}"
    if head[25] >= 4:
        start, count = struct.unpack_from("<QI", head, 235)
        if count and not _fits(file, _EVLR, start, size, count):
            return f"{count} extended variable length records do not fit between bytes {start} and {size}"
    return ""


def _fits(file: BinaryIO, record: struct.Struct, start: int, end: int, count: int) -> bool:
    """Whether so many records, each with its data, are between two places of a file."""
    if count * record.size > end - start:
        return False
    place = start
    for _ in range(count):
        file.seek(place)
        head = file.read(record.size)
        if len(head) < record.size:
            return False
        place += record.size + record.unpack(head)[3]
        if place > end:
            return False
    return True
