"""Where the cells of a raster lie: whole multiples of the cell size, in the CRS of the points."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

from flightlog.errors import UsageError

SMALLEST_CELL_M: Final = 1e-3
LONGEST_SIDE: Final = 1 << 19
"""Cells: 131 km of 0.25 m, farther than any flight."""
LARGEST_RASTER: Final = 1 << 34
"""Cells of one raster: some 17 thousand million are 68 GB as they are stored."""


@dataclass(frozen=True, slots=True)
class Window:
    """Some cells: from a column eastwards and a row northwards.

    Attributes
    ----------
    column, row : int
        Of the south-west cell, counted from the origin of the CRS.
    columns, rows : int
    """

    column: int
    row: int
    columns: int
    rows: int

    def grown(self, cells: int) -> "Window":
        """With a margin on all sides."""
        return Window(self.column - cells, self.row - cells, self.columns + 2 * cells, self.rows + 2 * cells)


@dataclass(frozen=True, slots=True)
class Grid(Window):
    """A window and the size of its cells.

    Attributes
    ----------
    cell_m : float
    """

    cell_m: float

    def __post_init__(self) -> None:
        if self.columns * self.rows > LARGEST_RASTER or max(self.columns, self.rows) > LONGEST_SIDE:
            raise UsageError(
                f"a raster of {self.columns} x {self.rows} cells of {self.cell_m:g} m found, expected at most {LARGEST_RASTER:,}, "
                f"and {LONGEST_SIDE:,} a side; "
                "choose larger cells, or take out the points that lie far from the others: `swath export` with --area"
            )

    @classmethod
    def of_window(cls, window: Window, cell_m: float) -> Self:
        """A window of cells of that size."""
        return cls(window.column, window.row, window.columns, window.rows, cell_m)

    @property
    def west_m(self) -> float:
        """Left edge."""
        return self.column * self.cell_m

    @property
    def north_m(self) -> float:
        """Upper edge."""
        return (self.row + self.rows) * self.cell_m

    def blocks(self, side: int) -> Iterator[Window]:
        """Windows that cover it, at most `side` cells wide and high, from north to south and west to east."""
        top = self.row + self.rows
        for down in range(0, self.rows, side):
            rows = min(side, self.rows - down)
            for right in range(0, self.columns, side):
                columns = min(side, self.columns - right)
                yield Window(self.column + right, top - down - rows, columns, rows)


def checked_cell(cell_m: float) -> float:
    """A size of cells.

    Raises
    ------
    UsageError
        It is none.
    """
    if not (math.isfinite(cell_m) and cell_m >= SMALLEST_CELL_M):
        raise UsageError(f"cell {cell_m:g} m: expected {SMALLEST_CELL_M:g} m or more, for example 0.25")
    return cell_m
