"""Single trees among points: tops of the canopy, the crowns around them, stems below them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import center_of_mass, find_objects, gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.thin import VOXEL_M, thin_points
from groundproc.numerics.robust import sigma
from groundproc.numerics.voxelhash import assign
from groundproc.raster.cells import Cells
from groundproc.raster.fill import fill
from groundproc.raster.openings import dilated, eroded

Array = npt.NDArray[np.float64]

CELL_M: Final = 0.4
_SMOOTHING_M: Final = 0.35
_REACH_M: Final = (0.4, 0.06, 2.5)
"""A top is the highest within this and so much of its height, and this at most: crowns of high trees are wider."""
_CROWN: Final = 0.4
"""A crown goes down to this share of its top, in the canopy's surface."""
_STEM_HEIGHTS: Final = (0.8, 0.6)
"""Points of a stem are higher than this [m], and lower than this share of the top."""
_STEM_M: Final = 0.3
_STEM_OFF_M: Final = 1.2
"""Least distance of a stem from the middle of its crown that is believed; of wide crowns half their radius."""
_STEM_BIN_M: Final = 0.5
_STEM_BINS: Final = 4
_DEAD: Final = (0.4, 3.0)
"""Of the pulses into a dead crown more than this share go through, and so many sigmas more than through the usual one."""
_PEAK_M: Final = 0.8
_FEWEST: Final = 6
_FULL: Final = 0.5
"""A crown of which more than this has points, seen from above, is of leaves, unless it is so many times as long as wide ..."""
_LONG: Final = 3.0
_WIRE_M: Final = 4.0
"""... and one of less is a stretch of wires, if thin lines are found so far around it ..."""
_WIRES: Final = 0.7
"""... that this share of its points lies on."""
_PLANE_M: Final = 0.08
"""Points that scatter less about a plane are of no crown: of two wires side by side, or of a roof ..."""
_PLANE_POINTS: Final = 10
"""... if there are so many."""


@dataclass(frozen=True, slots=True)
class Tree:
    """A tree.

    Attributes
    ----------
    x, y, foot_m : float
        Of its stem where that is seen, else of the middle of its crown; and of the ground there.
    height_m : float
    crown_m : float
        Diameter of a circle of its crown's area.
    stem : bool
        Its stem was seen.
    through : float
        Share of pulses that went through its crown.
    points : int
        Of its crown.
    top : tuple of float
        Place of the highest point.
    """

    x: float
    y: float
    foot_m: float
    height_m: float
    crown_m: float
    stem: bool
    through: float
    points: int
    top: tuple[float, float]


def crowns(xyz_m: Array, above_m: npt.NDArray[np.float32], least_m: float) -> list[Tree]:
    """Trees of a tile.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
        All points, ground too.
    above_m : ndarray, shape (n,)
        Heights above the ground.
    least_m : float
        Height of the lowest tree.
    """
    cells = Cells(CELL_M, {"max"})
    cells.add(xyz_m, above_m)
    grid = cells.grid()
    if grid is None:
        return []
    canopy = np.maximum(fill(cells.window(grid, "max")), np.float32(0.0))
    canopy = eroded(dilated(canopy, 1), 1)
    smooth = gaussian_filter(canopy, _SMOOTHING_M / CELL_M)
    tops, ends = _tops(smooth, least_m)
    if not len(tops):
        return []
    number = _segments(smooth, tops, ends)
    row = np.floor((grid.north_m - xyz_m[:, 1]) / CELL_M).astype(np.int64).clip(0, grid.rows - 1)
    column = np.floor((xyz_m[:, 0] - grid.west_m) / CELL_M).astype(np.int64).clip(0, grid.columns - 1)
    of = number[row, column]
    order = np.argsort(of, kind="stable")
    first = np.searchsorted(of[order], np.arange(1, len(tops) + 2))
    middles = np.array(center_of_mass(canopy, number, np.arange(1, len(tops) + 1)))
    pieces: Sequence[tuple[slice, ...] | None] = find_objects(number, len(tops))
    found = []
    for each, (middle, piece) in enumerate(zip(middles, pieces, strict=True)):
        some = order[first[each] : first[each + 1]]
        if piece is None or len(some) < _FEWEST:
            continue
        place = np.array([grid.west_m + (middle[1] + 0.5) * CELL_M, grid.north_m - (middle[0] + 0.5) * CELL_M])
        area = float((number[piece] == each + 1).sum()) * CELL_M**2
        peak = np.array([grid.west_m + (tops[each, 1] + 0.5) * CELL_M, grid.north_m - (tops[each, 0] + 0.5) * CELL_M])
        tree = _tree(xyz_m[some], above_m[some], (place, peak), area)
        high = above_m[some] > 0.5 * tree.height_m
        if tree.height_m < least_m:
            continue
        if not tree.stem and _thin(xyz_m, above_m, some[high], area, least_m):
            continue
        found.append(tree)
    return found


def _thin(
    xyz_m: Array, above_m: npt.NDArray[np.float32], crown: npt.NDArray[np.int64], area: float, least_m: float
) -> bool:
    """Whether a crown, by the numbers of its points, is a stretch of one wire or of several, or flat."""
    if len(crown) < 3:
        return False
    # lines are not found among two wires that are nearer to each other than the voxels around a point reach
    if len(crown) >= _PLANE_POINTS and np.linalg.eigvalsh(np.cov(xyz_m[crown].T))[0] < _PLANE_M**2:
        return True
    wide, long = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(xyz_m[crown, :2].T)), 0.0))
    flat = np.column_stack([xyz_m[crown, :2], np.zeros(len(crown))])
    if _voxels(flat) * VOXEL_M**2 > _FULL * area and long < _LONG * wide:
        return False  # most crowns: where points lie on all of it there are no wires, and lines need not be looked for
    near = (above_m > 0.5 * least_m) & (
        np.abs(xyz_m[:, :2] - xyz_m[crown, :2].mean(axis=0)) < 2.0 * long + _WIRE_M
    ).all(axis=1)
    lines = thin_points(xyz_m[near], np.ones(int(near.sum()), np.bool_)).xyz_m
    if not len(lines):
        return False
    return bool(np.mean(cKDTree(lines).query(xyz_m[crown])[0] < VOXEL_M) > _WIRES)


def _voxels(xyz_m: Array) -> int:
    """How many places `thin_points` looks at among some."""
    return assign(xyz_m - np.floor(xyz_m.min(axis=0)), VOXEL_M)[1] if len(xyz_m) else 0


def _tops(smooth: npt.NDArray[np.float32], least_m: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Rows and columns of tops, shape (n, 2), and the number of the top that each cell climbs to, from 1; 0: none.

    A top is the highest within a distance that grows with its height; lower ones within it are branches of its crown.
    """
    local = np.argwhere((smooth == maximum_filter(smooth, 3)) & (smooth >= 0.8 * least_m))
    heights = smooth[local[:, 0], local[:, 1]]
    order = np.argsort(-heights, kind="stable")
    local, heights = local[order], heights[order]
    owner = np.full(len(local), -1, np.int64)
    kept = 0
    tree = cKDTree(local * CELL_M) if len(local) else None
    for n in range(len(local)):
        if owner[n] < 0 and tree is not None:
            reach = min(_REACH_M[0] + _REACH_M[1] * heights[n], _REACH_M[2])
            near = np.array(tree.query_ball_point(local[n] * CELL_M, reach))
            kept += 1
            owner[near[(near >= n) & (owner[near] < 0)]] = kept
    ends = np.zeros(smooth.shape, np.int32)
    ends[local[:, 0], local[:, 1]] = owner
    first = np.unique(owner, return_index=True)[1]
    return local[first], ends


def _segments(
    smooth: npt.NDArray[np.float32], tops: npt.NDArray[np.int64], ends: npt.NDArray[np.int32]
) -> npt.NDArray[np.int32]:
    """Number of the crown of each cell, from 1; 0: none. Each cell is of the crown whose top the steepest way up leads to."""
    rows, columns = smooth.shape
    padded = np.pad(smooth, 1, constant_values=-np.inf)
    best, step = smooth.copy(), np.zeros(smooth.shape, np.int64)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            other = padded[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
            higher = other > best
            best[higher], step[higher] = other[higher], down * columns + right
    to = (np.arange(rows * columns) + step.ravel()).astype(np.int64)
    while True:  # each round doubles the way
        further = to[to]
        if np.array_equal(further, to):
            break
        to = further
    number = ends.ravel()[to].reshape(rows, columns)
    top_m = np.concatenate([[np.inf], smooth[tops[:, 0], tops[:, 1]]])
    return np.asarray(np.where(smooth > _CROWN * top_m[number], number, 0), np.int32)


def _tree(xyz_m: Array, above_m: npt.NDArray[np.float32], places_m: tuple[Array, Array], area_m2: float) -> Tree:
    """The tree of the points of one crown and below it, with the middle of the crown and its top as the canopy has them."""
    middle_m, peak_m = places_m
    # beside its top the crown of a higher neighbour may reach into its area
    beside = np.hypot(*(xyz_m[:, :2] - peak_m).T) > _PEAK_M
    highest = int(np.argmax(np.where(beside & ~beside.all(), -np.inf, above_m)))
    height = float(above_m[highest])
    diameter = 2.0 * float(np.sqrt(area_m2 / np.pi))
    stem = _stem(xyz_m, above_m, middle_m, height, max(_STEM_OFF_M, 0.25 * diameter))
    x, y = middle_m if stem is None else stem
    crown = above_m > 0.5 * height
    ground = above_m < 0.5
    through = float(ground.sum() / max(int((ground | crown).sum()), 1))
    away = np.hypot(xyz_m[:, 0] - x, xyz_m[:, 1] - y)
    nearest = np.argsort(away)[:20]
    foot = float(np.median(xyz_m[nearest, 2] - above_m[nearest]))
    top = (float(xyz_m[highest, 0]), float(xyz_m[highest, 1]))
    return Tree(float(x), float(y), foot, height, diameter, stem is not None, through, int(crown.sum()), top)


def _stem(
    xyz_m: Array, above_m: npt.NDArray[np.float32], middle_m: Array, height: float, reach_m: float
) -> Array | None:
    """Place of the stem: where points at the most heights lie one above the other, near the middle of the crown."""
    low = (above_m > _STEM_HEIGHTS[0]) & (above_m < _STEM_HEIGHTS[1] * height)
    low &= np.hypot(*(xyz_m[:, :2] - middle_m).T) < reach_m + _STEM_M
    if low.sum() < _STEM_BINS:
        return None
    xy, level = xyz_m[low, :2], np.floor(above_m[low] / _STEM_BIN_M).astype(np.int64)
    best, place = 0, None
    for near in cKDTree(xy).query_ball_point(xy[:: max(len(xy) // 60, 1)], _STEM_M):
        bins = len(np.unique(level[near]))
        if bins > best:
            best, place = bins, np.median(xy[near], axis=0)
    if place is None or best < _STEM_BINS or np.hypot(*(place - middle_m)) > reach_m:
        return None
    return np.asarray(place)


def dead(trees: list[Tree]) -> list[bool]:
    """Which trees let much more light through than the others do."""
    if not trees:
        return []
    through = np.array([each.through for each in trees])
    usual = float(np.median(through))
    limit = max(_DEAD[0], usual + _DEAD[1] * sigma(through))
    return [bool(each > limit) for each in through]
