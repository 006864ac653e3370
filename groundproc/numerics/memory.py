"""Memory of large arrays, used again: memory fresh from the system is slow.

The system clears each page of fresh memory when it is first touched. Arrays of megabytes that are made and dropped with every second of
flight lose more time to that than to decoding and placing the shots that fill them.
"""

import contextlib
import mmap
import weakref
from collections import deque
from math import prod
from typing import Any, Final

import numpy as np
import numpy.typing as npt

_SMALL: Final = 1 << 17
"""Below so many bytes numpy's own arrays are as fast."""
_LARGE_PAGE: Final = 1 << 21
"""Bytes of a large page; a block of fewer has none."""
_SPARE: Final = 4
"""Blocks of one size kept for later; the others go back to the system."""


class Pool:
    """Lends memory to arrays, and lends it again when the last array and the last view into it are gone.

    Of any thread. Blocks are of powers of two bytes; what is never touched of them takes no memory.
    """

    def __init__(self) -> None:
        self._spare: dict[int, deque[npt.NDArray[np.uint8]]] = {}

    def empty(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """As `numpy.empty`."""
        kind = np.dtype(dtype)
        count = prod(shape) if isinstance(shape, tuple) else shape
        size = count * kind.itemsize
        if size < _SMALL:
            return np.empty(shape, kind)
        block_size = 1 << (size - 1).bit_length()
        spare = self._spare.setdefault(block_size, deque(maxlen=_SPARE))
        try:
            block = spare.pop()
        except IndexError:
            block = _fresh(block_size)
        # numpy lets a view hold the array that owns the memory; here that is this array, of which the block knows when it dies
        lent = np.frombuffer(block.data, kind, count)
        weakref.finalize(lent, spare.append, block).atexit = False
        return lent.reshape(shape)


def untouched(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Zeros, of which only what is touched takes memory; it is the system's again as soon as the array is gone.

    As `numpy.zeros`, but for what the C library keeps for later: it may hand out what it has cleared, which is touched, and it may keep it.
    """
    kind = np.dtype(dtype)
    count = prod(shape) if isinstance(shape, tuple) else shape
    if count * kind.itemsize < _LARGE_PAGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.zeros(shape, kind)
    return np.frombuffer(_fresh(count * kind.itemsize).data, kind, count).reshape(shape)


def _fresh(size: int) -> npt.NDArray[np.uint8]:
    """Memory of the system, on large pages where it has some: fewer addresses to look up."""
    if size < _LARGE_PAGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.empty(size, np.uint8)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):
        memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, np.uint8)
