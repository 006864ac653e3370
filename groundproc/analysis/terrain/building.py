"""Roofs: what stands well above the ground and is a plane over some metres, cell by cell, and the outlines of it."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rasterio.features
import shapely
from numba import njit
from rasterio.transform import Affine
from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening, label, uniform_filter

from groundproc.analysis.terrain.surfaces import BLOCK, Sheet
from groundproc.raster.grid import Grid, Window

Raster = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

LEAST_HEIGHT_M: Final = 2.0
"""Eaves of a house stand higher."""
LEAST_AREA_M2: Final = 12.0
_AROUND_M: Final = 1.25
"""Half side of the square that has to be a plane."""
_ROUGH_M: Final = 0.12
"""A crown of leaves deviates from its best plane by some decimetres, tiles and noise by less than a tenth of that."""
_STEEPEST: Final = 1.8
_EDGE_CELLS: Final = 2
"""A plane cannot be told so near to the edge of a roof, where walls and what hangs over share its cells."""
_FEWEST: Final = 6
"""Cells of a plane."""
LOW_M: Final = 1.0
"""Points lower than this above the ground came by what is high, or through it."""
_BESIDE_M: Final = 10.0
"""Half side of the square in which it is looked how often the ground is met beside what is high ..."""
_THROUGH: Final = 0.5
"""... and the share of that below it which no roof lets through: its edges share their cells with the ground, and beams come in aslant."""
_THREE: Final = np.ones((3, 3), np.bool_)


def roofs(top_m: Raster, ground_m: Raster, low: Raster, cell_m: float) -> Mask:
    """Cells of buildings.

    Wires lie in one plane as well, and fill cells in which no point is left out above them. But they hide nothing of what is below, and one
    of them is no wider than two cells.

    Parameters
    ----------
    top_m : ndarray of float32, shape (rows, columns)
        Highest point of each cell; NaN without any.
    ground_m : ndarray of float32, shape (rows, columns)
    low : ndarray of float32, shape (rows, columns)
        Points of each cell lower than `LOW_M` above the ground.
    cell_m : float
    """
    high = np.isfinite(top_m) & (top_m - ground_m > LEAST_HEIGHT_M)
    half = max(round(_AROUND_M / cell_m), 1)
    rough, steep = _planes(np.where(high, top_m, np.float32(np.nan)), half, cell_m)
    plane = high & (rough < _ROUGH_M) & (steep < _STEEPEST) & ~_open(high, low, half, cell_m)
    wide = binary_opening(binary_closing(np.pad(high, 2), _THREE)[2:-2, 2:-2], _THREE)
    body = _large(binary_opening(plane, np.ones((2, 2), np.bool_)) & wide, LEAST_AREA_M2 / 2.0 / cell_m**2)
    grown = binary_closing(np.pad(body, half), _THREE, iterations=half)[half:-half, half:-half]
    grown = binary_fill_holes(grown) & (high | ~np.isfinite(top_m))
    for _ in range(_EDGE_CELLS):
        grown = _joined_edges(grown, top_m, high)
    return _large(grown, LEAST_AREA_M2 / cell_m**2)


def _open(high: Mask, low: Raster, half: int, cell_m: float) -> Mask:
    """Cells below whose high neighbours the ground is met as often as beside them."""
    points = np.where(np.isfinite(low), low, 0.0).astype(np.float64)
    below = _mean_of(points, high, 2 * half + 1)
    beside = _mean_of(points, ~high, 2 * max(round(_BESIDE_M / cell_m), half + 1) + 1)
    return np.asarray((beside > 0.0) & (below > _THROUGH * beside))


def _mean_of(values: npt.NDArray[np.float64], some: Mask, side: int) -> npt.NDArray[np.float64]:
    """Mean of some cells of the square around each; 0 without any."""
    total = uniform_filter(np.where(some, values, 0.0), side, mode="constant")
    share = uniform_filter(some.astype(np.float64), side, mode="constant")
    # sums that run along a row leave rounding where nothing is
    return np.where(share > 0.5 / side**2, total / np.maximum(share, 0.5 / side**2), 0.0)


def _joined_edges(body: Mask, top_m: Raster, high: Mask) -> Mask:
    """The body and those high cells beside it that are as high as one of it: a roof's own edge."""
    out = body.copy()
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside, height = np.roll(body, step, axis), np.roll(top_m, step, axis)
        out |= beside & high & (np.abs(height - top_m) < 0.5)
    return out


def _large(mask: Mask, cells: float) -> Mask:
    """Pieces of so many cells at least."""
    number, _ = label(mask)
    size = np.bincount(number.ravel())
    size[0] = 0
    return np.asarray((size >= cells)[number])


def outlines(mask: Mask, grid: Grid) -> list[Any]:
    """Outlines of pieces, as polygons whose edges do not follow the steps of the cells."""
    return _simple(_pieces(mask, grid, grid.cell_m), grid.cell_m)


def roof_outlines(roof: Sheet) -> list[Any]:
    """The same of a raster on the disk, block by block; a house that lies in several is one.

    Parameters
    ----------
    roof : Sheet of uint8
        1 where there is one.
    """
    found: list[Any] = []
    cut: list[Any] = []
    cell_m = roof.grid.cell_m
    for block in roof.grid.blocks(BLOCK):
        mask = roof.window(block) > 0 if roof.holds(block) else np.zeros((0, 0), np.bool_)
        if mask.any():
            west, south = block.column * cell_m, block.row * cell_m
            rim = shapely.box(west, south, west + block.columns * cell_m, south + block.rows * cell_m).exterior
            for polygon in _pieces(mask, block, cell_m):
                (cut if polygon.intersects(rim) else found).append(polygon)
    if cut:
        found += shapely.get_parts(shapely.union_all(cut)).tolist()
    return _simple(found, cell_m)


def _pieces(mask: Mask, window: Window, cell_m: float) -> list[Any]:
    """Polygons along the cells of pieces."""
    transform = Affine(cell_m, 0.0, window.column * cell_m, 0.0, -cell_m, (window.row + window.rows) * cell_m)
    shapes = rasterio.features.shapes(mask.astype(np.uint8), mask, connectivity=4, transform=transform)
    return [shapely.geometry.shape(shape) for shape, _ in shapes]


def _simple(polygons: list[Any], cell_m: float) -> list[Any]:
    simple = [each.simplify(0.75 * cell_m) for each in polygons]
    return [each for each in simple if not each.is_empty and each.geom_type == "Polygon"]


@njit(cache=True, nogil=True)
def _planes(top: Any, half: int, cell_m: float) -> Any:
    """Deviation of the highest points around each cell from their best plane [m], and its slope; infinite with too few."""
    rows, columns = top.shape
    rough, steep = np.full((rows, columns), np.inf, np.float32), np.full((rows, columns), np.inf, np.float32)
    for i in range(rows):
        for j in range(columns):
            if not np.isfinite(top[i, j]):
                continue
            n, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for a in range(max(i - half, 0), min(i + half + 1, rows)):
                for b in range(max(j - half, 0), min(j + half + 1, columns)):
                    z = top[a, b] - top[i, j]
                    # what stands a storey higher or lower is another roof, or the street
                    if np.isfinite(z) and abs(z) < 2.5:
                        x, y = (b - j) * cell_m, (a - i) * cell_m
                        n, sx, sy, sz = n + 1.0, sx + x, sy + y, sz + z
                        sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                        sxz, syz, szz = sxz + x * z, syz + y * z, szz + z * z
            if n < _FEWEST:
                continue
            cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
            cxz, cyz, czz = sxz - sx * sz / n, syz - sy * sz / n, szz - sz * sz / n
            det = cxx * cyy - cxy * cxy
            if det < 1e-6 * (cxx + cyy) ** 2:
                continue
            p, q = (cxz * cyy - cyz * cxy) / det, (cyz * cxx - cxz * cxy) / det
            rough[i, j] = np.sqrt(max(czz - p * cxz - q * cyz, 0.0) / max(n - 3.0, 1.0))
            steep[i, j] = np.sqrt(p * p + q * q)
    return rough, steep
