"""What is indoors where no beam is known: behind an outer wall, under something, and within the other outer walls.

A wall of a house is an outer one if what lies before it, on one side, is lower than its middle: ground, or the roof of
a garage. Straight behind it, as seen from there, lie rooms, but also the roof, the other walls and the yard beyond the
house, all measured from elsewhere. Roofs are recognised because nothing lies above them; if no roof was seen at all,
as from a car, this test is left out. The yard lies beyond another outer wall.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.analysis.facades import Facade

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_COVERS: Final = ((0.25, 0.5), (0.5, 0.8), (1.0, 1.5))
"""Cells, and how far above a point of them something covers it: more than a roof of 55 deg rises within the cell."""
_BEFORE_M: Final = (0.75, 1.25, 1.75, 2.25)
_STEP_M: Final = 0.5
_OPEN: Final = 0.3
"""Share of a wall's length that is open on one side of an outer wall."""
_ALIKE: Final = 0.8
"""What is as open on both sides as this is a fence or a gable of a ruin; nothing is in it."""
_WALL_M: Final = 0.15
"""Points so near to an outer wall are of it."""
_BEHIND_M: Final = (0.75, 1.25, 1.75, 2.25, 3.0, 4.0)
_ROOFED: Final = 0.5
"""Share of a wall's length behind which something as high as the wall was seen: then the roof was."""
_INNER_M: Final = (0.3, 12.0)
"""An inner wall lies so far behind an outer one."""
_SAME_WAY: Final = 0.9
_EDGE_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class Outer:
    """A wall of a house with its open side.

    Attributes
    ----------
    facade : Facade
    side : float
        1 or -1: the sign of `facade.off` outside.
    roofed : bool
        Whether what covers the rooms behind was seen.
    """

    facade: Facade
    side: float
    roofed: bool

    @property
    def way(self) -> Array:
        """Unit vector outwards in plan."""
        return self.side * self.facade.normal

    def depth_m(self, xyz_m: Array) -> Array:
        """How far places lie straight behind it, shape (n,); NaN for those that do not."""
        depth = -self.side * self.facade.off(xyz_m)
        return np.where((depth > 0.0) & self.facade.holds(xyz_m), depth, np.nan)

    def out_of(self, start_m: Array, end_m: Array) -> Flags:
        """Which straight lines leave through it, from within to without."""
        leaves = (self.side * self.facade.off(start_m) < -_EDGE_M) & (self.side * self.facade.off(end_m) > _EDGE_M)
        leaves[leaves] = np.isfinite(self.facade.through(start_m[leaves], end_m[leaves]))
        return np.asarray(leaves)


class Tops:
    """Highest points in cells of three sizes.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
    """

    def __init__(self, xyz_m: Array) -> None:
        self._low = xyz_m[:, :2].min(axis=0)
        self._sheets = []
        for cell_m, _ in _COVERS:
            cell = self._cell(xyz_m, cell_m)
            sheet = np.full(cell.max(axis=0) + 1, -np.inf)
            np.maximum.at(sheet, (cell[:, 0], cell[:, 1]), xyz_m[:, 2])
            self._sheets.append(sheet)

    def _cell(self, xy_m: Array, cell_m: float) -> npt.NDArray[np.int64]:
        return np.asarray(np.floor((xy_m[:, :2] - self._low) / cell_m).astype(np.int64))

    def at(self, xy_m: Array, level: int = 1) -> Array:
        """Height of the highest point of the cells of places; -inf where there is none."""
        cell, sheet = self._cell(xy_m, _COVERS[level][0]), self._sheets[level]
        inside = np.all((cell >= 0) & (cell < sheet.shape), axis=1)
        out = np.full(len(xy_m), -np.inf)
        out[inside] = sheet[cell[inside, 0], cell[inside, 1]]
        return out

    def covers(self, xyz_m: Array) -> Flags:
        """Whether something lies above points, which are some of those given."""
        above = [self.at(xyz_m, level) - xyz_m[:, 2] > over_m for level, (_, over_m) in enumerate(_COVERS)]
        return np.asarray(np.any(above, axis=0))


def outer_walls(walls: Sequence[Facade], tops: Tops) -> dict[int, Outer]:
    """Walls that have an open side, by their number."""
    found = {}
    for number, facade in enumerate(walls):
        share = [_open(facade, tops, side) for side in (1.0, -1.0)]
        if max(share) < _OPEN or min(share) > _ALIKE * max(share):
            continue
        side = 1.0 if share[0] > share[1] else -1.0
        found[number] = Outer(facade, side, _roofed(facade, tops, side))
    roofless = [each for each in found.values() if not each.roofed]
    return {n: each for n, each in found.items() if not any(_within(each, front) for front in roofless)}


def indoors(wall: Outer, others: Sequence[Outer], tops: Tops, xyz_m: Array) -> Array:
    """How deep behind a wall points are that are in its rooms, shape (n,); NaN for others."""
    depth = wall.depth_m(xyz_m)
    some = np.flatnonzero(np.isfinite(depth))
    end = xyz_m[some]
    out = wall.roofed & ~tops.covers(end)
    start = end.copy()
    start[:, :2] += (depth[some] - 2.0 * _EDGE_M)[:, None] * wall.way
    for each in others:
        if each is not wall:
            out |= ((np.abs(each.facade.off(end)) < _WALL_M) & each.facade.near(end)) | each.out_of(start, end)
    depth[some[out]] = np.nan
    return depth


def _along(facade: Facade, tops: Tops, offs_m: Sequence[float], level: int) -> Array:
    """Tops beside a wall, shape (places along it, offs)."""
    ends = facade.ends
    count = max(round(float(np.linalg.norm(ends[1] - ends[0])) / _STEP_M), 1)
    places = ends[0] + (np.arange(count)[:, None] + 0.5) / count * (ends[1] - ends[0])
    return np.stack([tops.at(places + off * facade.normal, level) for off in offs_m], axis=1)


def _open(facade: Facade, tops: Tops, side: float) -> float:
    """Share of a wall's length before which something was seen, and all of it lower than its middle."""
    beside = _along(facade, tops, [side * off for off in _BEFORE_M], 1)
    middle_m = facade.low_m + facade.height_m / 2.0
    known = np.isfinite(beside)
    return float(np.mean(known.any(axis=1) & np.all(~known | (beside < middle_m), axis=1)))


def _roofed(facade: Facade, tops: Tops, side: float) -> bool:
    beside = _along(facade, tops, [-side * off for off in _BEHIND_M], 2)
    return bool(np.mean(beside.max(axis=1) > facade.low_m + 0.8 * facade.height_m) >= _ROOFED)


def _within(each: Outer, front: Outer) -> bool:
    """Whether a wall is an inner one, seen through another."""
    if each is front or each.way @ front.way < _SAME_WAY:
        return False
    middle = np.append(each.facade.ends.mean(axis=0), each.facade.low_m + each.facade.height_m / 2.0)
    deep = front.depth_m(middle[None])[0]
    return bool(_INNER_M[0] < deep < _INNER_M[1])
