"""Numbers of slices, a row each, as they come: in one array, for arrays of their own take hundreds of bytes each beside the numbers."""

from collections.abc import Iterable, Iterator
from typing import Any, Final, overload

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_FIRST: Final = 64
"""Rows that there is room for at first; after that twice as many."""


class Growing:
    """Rows of so many numbers, used as a list of arrays; what is taken out is a copy.

    Parameters
    ----------
    width : int
    rows : iterable of ndarray, shape (width,), optional
        To begin with.
    """

    def __init__(self, width: int, rows: Iterable[Array] = ()) -> None:
        self._room, self._count = np.empty((_FIRST, width)), 0
        for row in rows:
            self.append(row)

    def append(self, row: Array) -> None:
        """Add a row at the end."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.empty_like(self._room)])
        self._room[self._count] = row
        self._count += 1

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, which: int) -> Array: ...
    @overload
    def __getitem__(self, which: slice) -> Array: ...
    def __getitem__(self, which: int | slice) -> Array:
        """A row, shape (width,), or some of them, shape (n, width)."""
        return np.asarray(self._room[: self._count][which].copy())

    def __setitem__(self, which: int, row: Array) -> None:
        self._room[: self._count][which] = row

    def __delitem__(self, which: slice) -> None:
        left = np.delete(self._room[: self._count], which, axis=0)
        self._count = len(left)
        self._room[: self._count] = left

    def __iter__(self) -> Iterator[Array]:
        return iter(self[:])

    def __array__(self, *_: Any, **__: Any) -> Array:
        """All rows, shape (n, width)."""
        return self[:]
