"""Squares of an octree that hold very many points, in as many parts as it takes: counted by cell, then parted where that is too much."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.spool import Place

Counts = npt.NDArray[np.int64]

_HALVINGS: Final = 5
"""A square is counted in cells of a 32nd of its side; a part that is still too large is counted and parted again."""


@dataclass(frozen=True, slots=True)
class Square:
    """A square of the octree: its place among those of 2^bits units."""

    place: Place
    bits: int


def cells_of(square: Square, smallest: int) -> tuple[Counts, Square]:
    """Counts by cell, shape (rows, columns), all 0; and the first cell, none smaller than 2^smallest units."""
    halvings = min(_HALVINGS, square.bits - smallest)
    first = Square((square.place[0] << halvings, square.place[1] << halvings), square.bits - halvings)
    return np.zeros((1 << halvings, 1 << halvings), np.int64), first


def count_cells(within: Counts, first: Square, counts: Counts) -> None:
    """Count points, given in units from the corner of the root, shape (n, 3)."""
    _count(within, first.bits, first.place[0], first.place[1], counts)


def parts_of(square: Square, counts: Counts, most: int) -> tuple[list[Square], npt.NDArray[np.int32]]:
    """The square's parts that have points, each quartered while it has more than `most` and more than one cell.

    Gives the parts, one quarter after the other, and the number of the part of each cell, shape of the counts.
    """
    parts: list[Square] = []
    number = np.zeros(counts.shape, np.int32)

    def quarter(each: Square, row: int, column: int, side: int) -> None:
        inside = slice(row, row + side), slice(column, column + side)
        total = int(counts[inside].sum())
        if not total:
            return
        if total <= most or side == 1:
            number[inside] = len(parts)
            parts.append(each)
            return
        half, (x, y) = side // 2, each.place
        for south in (0, 1):
            for east in (0, 1):
                smaller = Square((2 * x + east, 2 * y + south), each.bits - 1)
                quarter(smaller, row + south * half, column + east * half, half)

    quarter(square, 0, 0, len(counts))
    return parts, number


@njit(cache=True, nogil=True)
def _count(within: Any, bits: int, first_x: int, first_y: int, counts: Any) -> None:
    for n in range(len(within)):
        counts[(within[n, 1] >> bits) - first_y, (within[n, 0] >> bits) - first_x] += 1
