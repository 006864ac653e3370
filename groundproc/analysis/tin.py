"""A surface of few triangles that keeps within a tolerance of every cell of a raster of heights.

The outline of what is known and some corners are triangulated (Delaunay, startinpy). Then, round by round, each block of cells gives its
worst cell to the triangulation, where that is off by more than the tolerance, until none is (greedy insertion after Garland and Heckbert,
"Fast polygonal approximation of terrains and height fields", 1995, many points a round instead of one).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rasterio.features
import shapely
import startinpy

from flightlog.errors import CoverageError, UsageError
from groundproc.raster.geotiff import Raster

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MOST_CELLS: Final = 25_000_000
_FIRST_BLOCK: Final = 64
_LAST_BLOCK: Final = 4
"""Blocks of cells halve from round to round: far-off cells first, which spares near ones."""
_ROUNDS: Final = 200
_OUTLINE_CELLS: Final = 0.75
"""The outline of what is known is followed to this."""


@dataclass(frozen=True, slots=True)
class Tin:
    """Triangles.

    Attributes
    ----------
    places : ndarray, shape (n, 3)
        Easting, northing and height of the corners, in the units of the raster's CRS.
    triangles : ndarray of int64, shape (m, 3)
        Rows of `places`, counter-clockwise seen from above.
    greatest, rms : float
        How far heights of the raster are from the triangles.
    cells : int
        Cells of the raster that are known.
    """

    places: Array
    triangles: npt.NDArray[np.int64]
    greatest: float
    rms: float
    cells: int


def tin(raster: Raster, tolerance: float, progress: Callable[[float], object]) -> Tin:
    """Triangulate.

    Parameters
    ----------
    raster : Raster
    tolerance : float
        Greatest distance in height from a known cell's centre, in the unit of the heights.
    progress : callable
        Told the share of cells that are within the tolerance, round by round.

    Raises
    ------
    UsageError
        The tolerance is not positive.
    CoverageError
        Too many cells, or too few known ones.
    """
    if not (np.isfinite(tolerance) and tolerance > 0.0):
        raise UsageError(f"--tolerance {tolerance:g}: expected more than 0, for example 0.05")
    grid = raster.grid
    if grid.columns * grid.rows > MOST_CELLS:
        raise CoverageError(
            f"{raster.path}: {grid.columns} x {grid.rows} cells, expected at most {MOST_CELLS:,}; choose larger cells or a part"
        )
    heights = raster.window(grid).astype(np.float64)
    known = np.isfinite(heights)
    if known.sum() < 3 or not (known.any(axis=0).sum() > 1 and known.any(axis=1).sum() > 1):
        raise CoverageError(f"{raster.path}: {known.sum()} known cells, expected three and more that span an area")
    # small numbers, in cells: x to the east, y to the north
    middle = float(np.mean(heights[known]))
    surface = _Surface(heights - middle, known)
    surface.refine(tolerance, progress)
    corners, triangles = surface.triangles()
    off = surface.off[known]
    places = np.column_stack(
        [
            raster.west_m + (corners[:, 0] + 0.5) * grid.cell_m,
            raster.north_m - (grid.rows - corners[:, 1] - 0.5) * grid.cell_m,
            corners[:, 2] + middle,
        ]
    )
    return Tin(places, triangles, float(np.abs(off).max()), float(np.sqrt(np.mean(off**2))), int(known.sum()))


class _Surface:
    """A triangulation of some cells, and how far all are from it."""

    def __init__(self, heights: Array, known: Mask) -> None:
        self.heights, self.known = heights, known
        self.rows, self.columns = heights.shape
        down, right = np.nonzero(known)
        self.xy = np.column_stack([right, self.rows - 1 - down]).astype(np.float64)
        self.dt: Any = startinpy.DT()
        self.off = np.zeros_like(heights)
        self.used = np.zeros_like(known)
        self._insert(*_outline(known))

    def _insert(self, down: npt.NDArray[np.intp], right: npt.NDArray[np.intp]) -> None:
        fresh = ~self.used[down, right]
        down, right = down[fresh], right[fresh]
        self.used[down, right] = True
        self.dt.insert(np.column_stack([right, self.rows - 1.0 - down, self.heights[down, right]]))

    def refine(self, tolerance: float, progress: Callable[[float], object]) -> None:
        """Insert until all known cells are within the tolerance."""
        for number in range(_ROUNDS):
            self._compare()
            bad = np.abs(self.off) > tolerance
            progress(1.0 - float(bad.sum()) / len(self.xy))
            if not bad.any():
                return
            self._insert(*_worst(np.where(bad, np.abs(self.off), 0.0), max(_FIRST_BLOCK >> number, _LAST_BLOCK)))
        raise AssertionError("each round inserts cells, and there are not so many")

    def _compare(self) -> None:
        found = np.asarray(self.dt.interpolate({"method": "TIN"}, self.xy))
        # cells on the rim that the hull of the outline leaves out by rounding
        beyond = ~np.isfinite(found)
        measured = self.heights[self.known]
        off = measured - found
        off[beyond] = np.inf
        off[self.used[self.known]] = 0.0
        self.off[self.known] = off

    def triangles(self) -> tuple[Array, npt.NDArray[np.int64]]:
        """Corners (x, y, height) and the triangles that lie on known cells."""
        points = np.asarray(self.dt.points)
        faces = np.asarray(self.dt.triangles, np.int64)
        probes = points[faces, :2]
        middle = probes.mean(axis=1)
        sides = (probes + np.roll(probes, 1, axis=1)) / 2.0
        inside = self._covered(middle)
        inside &= np.stack([self._covered(sides[:, k]) for k in range(3)]).sum(axis=0) >= 2
        faces = faces[inside]
        kept, numbers = np.unique(faces, return_inverse=True)
        return points[kept], numbers.reshape(-1, 3).astype(np.int64)

    def _covered(self, xy: Array) -> Mask:
        right = np.rint(xy[:, 0]).astype(np.int64).clip(0, self.columns - 1)
        down = (self.rows - 1 - np.rint(xy[:, 1]).astype(np.int64)).clip(0, self.rows - 1)
        return np.asarray(self.known[down, right])


def _outline(known: Mask) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Cells at the corners of the simplified outlines of what is known, holes too; and the outermost cells."""
    down, right = np.nonzero(known)
    chosen = [np.array([f(line) for f in (np.argmin, np.argmax)]) for line in (down, right, down + right, down - right)]
    cells = [np.column_stack([down[some], right[some]]) for some in chosen]
    for shape, _ in rasterio.features.shapes(known.astype(np.uint8), mask=known):
        plain = shapely.geometry.shape(shape).simplify(_OUTLINE_CELLS)
        for ring in (plain.exterior, *plain.interiors):
            corners = np.asarray(ring.coords)[:-1]
            # a corner lies between cells: the nearest known one of the four stands for it
            around = (
                np.floor(corners[:, None, ::-1] - (0.5, 0.5) + np.array([[0, 0], [0, 1], [1, 0], [1, 1]])[None]) + 0.0
            )
            around = np.rint(around).astype(np.int64).clip(0, np.array(known.shape) - 1)
            there = known[around[..., 0], around[..., 1]]
            first = there.argmax(axis=1)
            cells.append(around[np.arange(len(around)), first][there.any(axis=1)])
    found = np.unique(np.concatenate(cells), axis=0)
    return found[:, 0], found[:, 1]


def _worst(off: Array, block: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """The largest value of each square block that is more than 0."""
    rows, columns = -(-off.shape[0] // block), -(-off.shape[1] // block)
    padded = np.zeros((rows * block, columns * block))
    padded[: off.shape[0], : off.shape[1]] = off
    parts = padded.reshape(rows, block, columns, block).swapaxes(1, 2).reshape(rows, columns, -1)
    which = parts.argmax(axis=2)
    i, j = np.nonzero(np.take_along_axis(parts, which[..., None], axis=2)[..., 0] > 0.0)
    inner = which[i, j]
    return i * block + inner // block, j * block + inner % block
