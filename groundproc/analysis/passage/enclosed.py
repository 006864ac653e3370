"""Cells without a value amid those with one: of rasters whose blocks are not all there."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groundproc.analysis.terrain.surfaces import BLOCK, Sheet

_OUTSIDE: Final = 0


def enclosed(sheet: Sheet) -> int:
    """How many cells of 0 lie amid others, from which no way over cells of 0, side by side, leads out of the raster.

    Pieces of each block are numbered, and joined over the edges of blocks; a block that is not there is outside.

    Parameters
    ----------
    sheet : Sheet of uint8
    """
    sizes: list[npt.NDArray[np.int64]] = [np.zeros(1, np.int64)]
    joined: list[npt.NDArray[np.int64]] = [np.empty((0, 2), np.int64)]
    last = 0
    before: npt.NDArray[np.int64] = np.zeros(0, np.int64)
    number: npt.NDArray[np.int64]
    above = np.zeros(sheet.grid.columns, np.int64)
    below = np.zeros(sheet.grid.columns, np.int64)
    for block in sheet.grid.blocks(BLOCK):
        left = block.column - sheet.grid.column
        if left == 0:  # a new row of blocks
            above, below, before = below, np.zeros(sheet.grid.columns, np.int64), np.zeros(block.rows, np.int64)
        span = slice(left, left + block.columns)
        if sheet.holds(block):
            pieces, count = label(sheet.window(block) == 0)
            number = np.where(pieces > 0, pieces.astype(np.int64) + last, -1)
            sizes.append(np.bincount(pieces.ravel(), minlength=count + 1)[1:])
            last += count
        else:
            number = np.zeros((block.rows, block.columns), np.int64)
        joined += [_both(above[span], number[0]), _both(before, number[:, 0])]
        if left + block.columns == sheet.grid.columns:
            joined.append(_both(np.zeros(block.rows, np.int64), number[:, -1]))
        below[span], before = number[-1], number[:, -1]
    joined.append(_both(np.zeros(len(below), np.int64), below))
    pairs, size = np.concatenate(joined), np.concatenate(sizes)
    graph: Any = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(size), len(size)))
    part = connected_components(graph, directed=False)[1]
    return int(size[part != part[_OUTSIDE]].sum())


def _both(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Pairs of pieces that lie side by side, shape (n, 2); -1 is a cell with a value."""
    some = (first >= 0) & (second >= 0) & (first != second)
    return np.unique(np.column_stack([first[some], second[some]]), axis=0)
