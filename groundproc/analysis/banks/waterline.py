"""Lines of waters in one epoch of a place: level first, then where the land meets it, station by station."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from contourpy import contour_generator
from scipy import ndimage

from groundproc.analysis.banks import water
from groundproc.analysis.banks.axes import Axis, axes
from groundproc.analysis.banks.edges import scatter
from groundproc.analysis.banks.ground import Ground
from groundproc.analysis.banks.stations import around
from groundproc.analysis.banks.water import Level
from groundproc.analysis.terrain.surfaces import blocks
from groundproc.numerics.robust import MAD_TO_SIGMA
from groundproc.raster.grid import Window

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_HALO_M: Final = 60.0
_REACH_M: Final = 5.0
_HIGHEST_M: Final = 0.6
"""Of the land above the water whose slope counts."""
_LEAST_HIGH_M: Final = 0.05
"""Lower points may be of the water itself."""
_NEAR_M: Final = 0.3
"""Of a level that is given: where nothing answers, and the rim lies so near to it, is water."""
_SHORTEST_M: Final = 5.0
_GAP: Final = 3
_UNSURE_M: Final = 1.0
_LAG: Final = 2
"""Stations between places that tell what the line scatters by."""


@dataclass(frozen=True, slots=True)
class WaterLine:
    """A line of water.

    Attributes
    ----------
    epoch : int
        1 or 2.
    line_m : ndarray, shape (n, 3)
    sigma_m : ndarray, shape (n,)
        Across.
    level : Level
    """

    epoch: int
    line_m: Array
    sigma_m: Array
    level: Level

    @property
    def length_m(self) -> float:
        """In plan."""
        return float(np.hypot(*np.diff(self.line_m[:, :2], axis=0).T).sum())

    @property
    def level_m(self) -> float:
        """In the middle of the line."""
        return float(np.median(self.line_m[:, 2]))

    def figures(self) -> dict[str, Any]:
        """For features."""
        return {
            "kind": "water", "epoch": self.epoch, "sigma_m": float(np.sqrt(np.mean(self.sigma_m**2))),
            "sigma_most_m": float(self.sigma_m.max()), "height_sigma_m": self.level.sigma_m, "level_m": self.level_m,
            "told_by": self.level.told_by,
        }  # fmt: skip


def find(ground: Ground, epoch: int, level_m: float | None, step_m: float, folder: Path) -> list[WaterLine]:
    """Lines of waters.

    Parameters
    ----------
    ground : Ground
    epoch : int
        0 or 1.
    level_m : float or None
        Of all waters, where the user states it.
    step_m : float
        Between vertices.
    folder : Path
        For a temporary file.
    """
    shores, levels = _shores(ground, epoch, level_m, step_m)
    reach = [_REACH_M] * len(shores)
    found: list[dict[int, tuple[float, float]]] = [{} for _ in shores]
    for number, station, s, z in around(shores, reach, ground.pieces(epoch), folder, step_m):
        level, axis = levels[number], shores[number]
        height = float(level.at(axis.places_m[station][None])[0])
        between = max(_LEAST_HIGH_M, 3.0 * level.sigma_m), _HIGHEST_M
        met = water.crossing(-s, z, height, level.sigma_m, between)
        if met is not None and met[1] < _UNSURE_M and abs(met[0]) < _REACH_M:
            found[number][station] = met
    out = []
    for axis, level, places in zip(shores, levels, found, strict=True):
        out += _lines(epoch + 1, axis, level, places)
    return out


def _lines(epoch: int, axis: Axis, level: Level, met: dict[int, tuple[float, float]]) -> list[WaterLine]:
    at = np.array(sorted(met), np.int64)
    if len(at) < 2:
        return []
    s, sigma = np.array([met[n] for n in at]).T
    usual = ndimage.median_filter(s, 5, mode="nearest")
    keep = np.abs(s - usual) <= np.maximum(6.0 * np.hypot(sigma, MAD_TO_SIGMA * np.median(np.abs(s - usual))), 0.5)
    at, s, sigma = at[keep], s[keep], sigma[keep]
    sigma = np.hypot(sigma, scatter(at, s, _LAG))
    xy = axis.places_m[at] - s[:, None] * axis.downhill[at]
    out = []
    for rows in np.split(np.arange(len(at)), np.flatnonzero(np.diff(at) > _GAP) + 1):
        line = WaterLine(epoch, np.column_stack([xy[rows], level.at(xy[rows])]), sigma[rows], level)
        if len(rows) > 1 and line.length_m >= _SHORTEST_M:
            out.append(line)
    return out


def _shores(ground: Ground, epoch: int, level_m: float | None, step_m: float) -> tuple[list[Axis], list[Level]]:
    """Lines about where the land ends, with the level of each."""
    cells, wet = ground.cells[epoch], ground.water[epoch]
    grid = cells.grid()
    shores: list[Axis] = []
    levels: list[Level] = []
    if grid is None:
        return shores, levels
    known_level = (
        water.given(level_m) if level_m is not None else water.level_of(wet, "class 9") if len(wet) > 100 else None
    )
    for block, wide, _ in blocks(grid, int(np.ceil(_HALO_M / grid.cell_m))):
        lowest = cells.window(wide, "min")
        bodies = (
            [(known_level, _below(lowest, wide, grid.cell_m, known_level))]
            if known_level is not None
            else water.find(lowest, wide, grid.cell_m)
        )
        for level, mask in bodies:
            lines = [
                (line, 2.0 * grid.cell_m) for line in _outline(mask, np.isfinite(lowest), wide, grid.cell_m, block)
            ]
            found = axes(lines, grid.cell_m, step_m, _SHORTEST_M)
            shores += found
            levels += [level] * len(found)
    return shores, levels


def _below(lowest_m: npt.NDArray[np.float32], window: Window, cell_m: float, level: Level) -> Mask:
    """Cells that lie under a level, and what has no echoes beside land that is near to it."""
    x = (window.column + np.arange(window.columns) + 0.5) * cell_m
    y = (window.row + window.rows - np.arange(window.rows) - 0.5) * cell_m
    height = level.at(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(lowest_m.shape)
    known = np.isfinite(lowest_m)
    under = known & (lowest_m < height + _LEAST_HIGH_M)
    near = ndimage.binary_dilation(known & (lowest_m < height + _NEAR_M), iterations=max(round(1.0 / cell_m), 1))
    body, _ = ndimage.label(water.void(known, cell_m))
    beside = np.unique(body[near & (body > 0)])
    return np.asarray(ndimage.binary_closing(under | np.isin(body, beside[beside > 0]), np.ones((3, 3), np.bool_)))


def _outline(mask: Mask, known: Mask, window: Window, cell_m: float, block: Window) -> list[Array]:
    """Edge of water within a block, what lies on the right of it going along; none where the window ends, or nothing is known beyond."""
    x = (window.column + np.arange(window.columns) + 0.5) * cell_m
    y = (window.row + window.rows - np.arange(window.rows) - 0.5) * cell_m
    if min(mask.shape) < 2:
        return []
    land = ndimage.gaussian_filter((~mask).astype(np.float32), max(0.5 / cell_m, 0.7))
    near = ndimage.binary_dilation(known & ~mask, iterations=max(round(1.5 / cell_m), 1))
    generator = contour_generator(x, y[::-1], np.ma.masked_where(~near, land)[::-1], name="serial")
    out = []
    for line in generator.lines(0.5):
        column, row = np.floor(np.asarray(line) / cell_m).astype(np.int64).T
        own = (column >= block.column) & (column < block.column + block.columns)
        own &= (row >= block.row) & (row < block.row + block.rows)
        cuts = np.flatnonzero(np.diff(own.astype(np.int8))) + 1
        out += [
            np.asarray(line)[rows] for rows in np.split(np.arange(len(line)), cuts) if own[rows[0]] and len(rows) > 1
        ]
    return out
