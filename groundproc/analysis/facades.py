"""Walls of houses, and which beams went through them: upright planes with their wall cells, whose gaps are openings."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_closing, binary_dilation, label

from groundproc.numerics.normals import normals

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

CELL_M: Final = 0.25
_THIN_M: Final = 0.1
_UPRIGHT: Final = 0.2
"""Largest share of the vertical in the normal of a wall."""
_ROUGHEST_M: Final = 0.08
_ON_M: Final = 0.12
"""Points so near to its plane are of the wall."""
_LEAST_CELLS: Final = 48
"""3 m2 of wall."""
_LEAST_SIDE_M: Final = 1.5
_GAP_M: Final = 3.0
"""Widest opening: wall on both sides and above and below within that."""
_ALIKE: Final = float(np.cos(np.deg2rad(8.0)))
_MOST_FAILS: Final = 12
_BINS: Final = 180


@dataclass(frozen=True, slots=True)
class Facade:
    """A wall in a plane n . (x, y) = d.

    Attributes
    ----------
    normal : ndarray, shape (2,)
        Unit vector in plan, of either sign.
    offset_m : float
    start_m, low_m : float
        Corner of `wall` along the plane and in height.
    wall : ndarray of bool, shape (rows, columns)
        Cells that points lie in, the lowest row first.
    within : ndarray of bool, shape (rows, columns)
        Those and the openings in it.
    """

    normal: Array
    offset_m: float
    start_m: float
    low_m: float
    wall: Flags
    within: Flags

    @property
    def along(self) -> Array:
        """Unit vector along it in plan."""
        return np.array([-self.normal[1], self.normal[0]])

    @property
    def area_m2(self) -> float:
        """With its openings."""
        return float(self.within.sum()) * CELL_M**2

    @property
    def height_m(self) -> float:
        """From its lowest cell to its highest."""
        return float(self.wall.shape[0] * CELL_M)

    @property
    def ends(self) -> Array:
        """Both ends in plan, shape (2, 2)."""
        reach = self.start_m + np.array([0.0, self.wall.shape[1] * CELL_M])
        return self.normal * self.offset_m + reach[:, None] * self.along

    def off(self, xyz_m: Array) -> Array:
        """Signed distance from the plane, shape (n,)."""
        return np.asarray(xyz_m[:, :2] @ self.normal - self.offset_m)

    def holds(self, xyz_m: Array) -> Flags:
        """Whether places lie within the wall or its openings, as seen along the normal, shape (n,)."""
        return self._in(self.within, xyz_m)

    def near(self, xyz_m: Array) -> Flags:
        """The same, and up to two cells beside it."""
        return self._in(np.asarray(binary_dilation(np.pad(self.within, 2), np.ones((3, 3), np.bool_), 2)), xyz_m, 2)

    def _in(self, cells: Flags, xyz_m: Array, margin: int = 0) -> Flags:
        column = np.floor((xyz_m[:, :2] @ self.along - self.start_m) / CELL_M).astype(np.int64)
        row = np.floor((xyz_m[:, 2] - self.low_m) / CELL_M).astype(np.int64)
        row, column = row + margin, column + margin
        rows, columns = cells.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.asarray(inside & cells[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)])

    def through(self, origin_m: Array, xyz_m: Array) -> Array:
        """How far behind the wall points lie whose beams went through it [m], shape (n,); NaN for others."""
        before, behind = self.off(origin_m), self.off(xyz_m)
        crosses = before * behind < 0.0
        share = before / np.where(crosses, before - behind, 1.0)
        crosses &= self.holds(origin_m + share[:, None] * (xyz_m - origin_m))
        return np.where(crosses, np.abs(behind), np.nan)


def facades(xyz_m: Array) -> list[Facade]:
    """Walls among the points of a piece of a cloud, the largest first found.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
        Without the ground.
    """
    thin = _thinned(xyz_m)
    if len(thin) < _LEAST_CELLS:
        return []
    lies = normals(thin)
    upright = np.isfinite(lies.sigma_rad) & (np.abs(lies.normal[:, 2]) < _UPRIGHT) & (lies.roughness_m < _ROUGHEST_M)
    places = thin[upright]
    if len(places) < _LEAST_CELLS:
        return []
    across = lies.normal[upright, :2]
    across /= np.linalg.norm(across, axis=1)[:, None]
    left, found, fails = np.ones(len(places), np.bool_), [], 0
    while left.sum() >= _LEAST_CELLS and fails < _MOST_FAILS:
        normal, offset_m, near = _plane(places, across, left)
        parts = _parts(normal, offset_m, places[near]) if near.sum() >= _LEAST_CELLS else []
        fails = 0 if parts else fails + 1
        found += parts
        left &= ~near
        if not near.any():
            break
    return found


def _thinned(xyz_m: Array) -> Array:
    """One point of each small voxel."""
    if not len(xyz_m):
        return xyz_m
    cell = np.floor((xyz_m - xyz_m.min(axis=0)) / _THIN_M).astype(np.int64)
    key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
    return np.ascontiguousarray(xyz_m[np.unique(key, return_index=True)[1]])


def _plane(places: Array, across: Array, left: Flags) -> tuple[Array, float, Flags]:
    """The plane that most of what is left lies on, and what that is."""
    some = np.flatnonzero(left)
    angle = np.arctan2(across[some, 1], across[some, 0]) % np.pi
    count, edges = np.histogram(angle, _BINS, (0.0, np.pi))
    wide = count + np.roll(count, 1) + np.roll(count, -1)
    direction = edges[int(np.argmax(wide))] + 0.5 * np.pi / _BINS
    normal = np.array([np.cos(direction), np.sin(direction)])
    alike = some[np.abs(across[some] @ normal) > _ALIKE]
    offset = places[alike, :2] @ normal
    bins = np.arange(offset.min() - 0.1, offset.max() + 0.3, 0.2)
    counts = np.histogram(offset, bins)[0]
    peak = bins[int(np.argmax(counts))] + 0.1
    near = alike[np.abs(offset - peak) < 0.3]
    offset_m = float(peak)
    for within in (0.3, 0.2, _ON_M):
        if len(near) < 3:
            break
        middle = places[near, :2].mean(axis=0)
        vectors = np.linalg.eigh(np.cov((places[near, :2] - middle).T))[1]
        normal, offset_m = vectors[:, 0], float(middle @ vectors[:, 0])
        near = some[(np.abs(places[some, :2] @ normal - offset_m) < within) & (np.abs(across[some] @ normal) > _ALIKE)]
    flags = np.zeros(len(places), np.bool_)
    flags[near] = True
    flags[alike[np.abs(offset - peak) < 0.1]] = True  # what was tried is not tried again
    return normal, offset_m, flags


def _parts(normal: Array, offset_m: float, places: Array) -> list[Facade]:
    """The walls in one plane, apart where it has gaps wider than an opening."""
    t, z = places[:, :2] @ np.array([-normal[1], normal[0]]), places[:, 2]
    start_m, low_m = float(t.min()), float(z.min())
    cell = np.floor(np.stack([z - low_m, t - start_m], axis=1) / CELL_M).astype(np.int64)
    wall = np.zeros(cell.max(axis=0) + 1, np.bool_)
    wall[cell[:, 0], cell[:, 1]] = True
    reach = int(_GAP_M / CELL_M / 2)
    padded = np.pad(wall, reach)
    joined = np.asarray(binary_closing(padded, np.ones((3, 2 * reach + 1), np.bool_)))[reach:-reach, reach:-reach]
    numbers, count = label(joined, np.ones((3, 3)))
    found = []
    for number in range(1, count + 1):
        own = wall & (numbers == number)
        rows, columns = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
        if own.sum() < _LEAST_CELLS or min(np.ptp(rows), np.ptp(columns)) * CELL_M < _LEAST_SIDE_M:
            continue
        cut = own[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        corner = start_m + columns[0] * CELL_M, low_m + rows[0] * CELL_M
        found.append(Facade(normal, offset_m, corner[0], corner[1], cut, _with_openings(cut)))
    return found


def _with_openings(wall: Flags) -> Flags:
    """Wall cells, and those that have wall on both sides, above, and below or nothing but the ground there."""
    reach = int(_GAP_M / CELL_M)

    def beside(axis: int, sign: int) -> Flags:
        out = np.zeros_like(wall)
        for step in range(1, reach + 1):
            shifted = np.roll(wall, sign * step, axis)
            edge = [slice(None), slice(None)]
            edge[axis] = slice(0, step) if sign > 0 else slice(-step, None)
            shifted[tuple(edge)] = False
            out |= shifted
        return out

    below = beside(0, 1)
    low = slice(0, int(_GAP_M / CELL_M))
    below[low] |= ~np.any(wall[low], axis=0, keepdims=True)
    return np.asarray(wall | (beside(1, 1) & beside(1, -1) & beside(0, -1) & below))
