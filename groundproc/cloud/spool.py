"""Records that wait on the disk until all are known, sorted by the square of ground that they lie in."""

import tempfile
import weakref
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import zstandard
from numba import njit

from groundproc.machine.system import give_back_disk
from groundproc.numerics.voxelhash import sorted_by

Records = npt.NDArray[np.void]
Place = tuple[int, int]

_WAITING_BYTES: Final = 48 << 20
"""In memory before it is written: many squares are written at once, so each gets pieces that are worth compressing."""
_SMALL: Final = 1 << 12
"""Records of one square that are written before the others have to be."""


class Spool:
    """A temporary file of records by square.

    Parameters
    ----------
    dtype : numpy.dtype
        Of the records.
    folder : Path
        For the file; it has no name, and is gone when this is.
    """

    def __init__(self, dtype: np.dtype[Any], folder: Path) -> None:
        self._dtype = dtype
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (open as long as this lives)
        weakref.finalize(self, self._file.close)
        self._pack = zstandard.ZstdCompressor(level=1)
        self._unpack = zstandard.ZstdDecompressor()
        self._waiting: dict[Place, list[Records]] = {}
        self._bytes = 0
        self._pieces: dict[Place, array[int]] = {}
        self.counts: dict[Place, int] = {}
        """Records of each square."""

    def add(self, place: Place, records: Records) -> None:
        """Take records of a square; the array is kept, and may not be changed."""
        if len(records):
            self._waiting.setdefault(place, []).append(records)
            self.counts[place] = self.counts.get(place, 0) + len(records)
            self._bytes += records.nbytes
            if self._bytes > _WAITING_BYTES:
                self._write()

    def add_sorted(self, records: Records, number: npt.NDArray[np.int32], places: list[Place]) -> None:
        """Take records of many squares: number of the square of each, shape (n,), and the squares."""
        order, first = sorted_by(number, len(places))
        records = records.take(order)  # rows by number copy field by field, a sixth of its speed
        for each, place in enumerate(places):
            self.add(place, records[first[each] : first[each + 1]])

    def take(self, place: Place) -> Records:
        """All records of a square, in the order in which they came; they are here no longer."""
        out, done = np.empty(self.counts.get(place, 0), self._dtype), 0
        for piece in self.pieces(place):
            _bytes_of(out)[done : done + len(piece)] = _bytes_of(piece)
            done += len(piece)
        return out

    def look(self, place: Place) -> Iterator[Records]:
        """All records of a square, piece by piece, in the order in which they came; they stay, and are not to be changed."""
        for begin, size in _pairs(self._pieces.get(place)):
            yield self._read(begin, size)
        yield from self._waiting.get(place, ())

    def pieces(self, place: Place) -> Iterator[Records]:
        """The same; they are here no longer."""
        for begin, size in _pairs(self._pieces.pop(place, None)):
            yield self._read(begin, size)
            give_back_disk(self._file.fileno(), begin, size)
        waiting = self._waiting.pop(place, [])
        self._bytes -= sum(each.nbytes for each in waiting)
        self.counts.pop(place, None)
        yield from waiting

    def _read(self, begin: int, size: int) -> Records:
        """A piece from the disk."""
        self._file.seek(begin)
        ranks = np.frombuffer(self._unpack.decompress(self._file.read(size)), np.uint8)
        ranks = ranks.reshape(self._dtype.itemsize, -1)
        records = np.empty(ranks.shape[1], self._dtype)
        _by_record(ranks, _bytes_of(records))
        return records

    def _write(self) -> None:
        """Write what waits; squares with few records wait on, unless that is all there is."""
        self._file.seek(0, 2)
        at = self._file.tell()
        many = {place for place, parts in self._waiting.items() if sum(map(len, parts)) >= _SMALL}
        for place in many or list(self._waiting):
            parts = self._waiting.pop(place)
            # bytes of the same rank together are compressed best
            ranks, done = np.empty((self._dtype.itemsize, sum(map(len, parts))), np.uint8), 0
            for records in parts:
                _by_rank(_bytes_of(records), ranks[:, done : done + len(records)])
                done += len(records)
            self._bytes -= ranks.nbytes
            packed = self._pack.compress(ranks.data)
            self._file.write(packed)
            self._pieces.setdefault(place, array("q")).extend((at, len(packed)))
            at += len(packed)
        if many and self._bytes > _WAITING_BYTES // 2:  # very many squares with few records each
            self._write()
        # what waits on is a part of arrays with many squares' records, which it would keep in memory
        self._waiting = {place: [_copied(parts)] for place, parts in self._waiting.items()}


def joined(parts: list[Records]) -> Records:
    """Records one after the other."""
    return parts[0] if len(parts) == 1 else _copied(parts)


def _pairs(numbers: "array[int] | None") -> Iterator[tuple[int, int]]:
    """Where the pieces of a square begin, and their sizes [bytes]."""
    numbers = numbers or array("q")
    return zip(numbers[::2], numbers[1::2], strict=True)


def _copied(parts: list[Records]) -> Records:
    """Records one after the other in memory of their own, copied as bytes: numpy copies structures field by field."""
    whole = f"V{parts[0].dtype.itemsize}"
    return np.concatenate([each.view(whole) for each in parts]).view(parts[0].dtype)


def _bytes_of(records: Records) -> npt.NDArray[np.uint8]:
    """The same memory as bytes, shape (n, bytes of a record)."""
    return records.view(np.uint8).reshape(len(records), records.dtype.itemsize)


@njit(cache=True, nogil=True)
def _by_rank(rows: Any, out: Any) -> None:
    """Bytes of the same rank together, (n, m) to (m, n), in blocks that stay in the nearest cache."""
    for start in range(0, len(rows), 256):
        stop = min(start + 256, len(rows))
        for rank in range(len(out)):
            for row in range(start, stop):
                out[rank, row] = rows[row, rank]


@njit(cache=True, nogil=True)
def _by_record(ranks: Any, out: Any) -> None:
    """Bytes of the same record together again, (m, n) to (n, m)."""
    for start in range(0, len(out), 256):
        stop = min(start + 256, len(out))
        for rank in range(len(ranks)):
            for row in range(start, stop):
                out[row, rank] = ranks[rank, row]
