"""Conductors by all points of a cloud that lie on them.

They are looked for among one point of each small voxel. Where many passes met a voxel that is a point of one pass, whose strip may lie some
centimetres beside the others; and where a wire runs along a side of voxels, the few points beyond that side count as much as all on this.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from groundproc.analysis.corridor.catenary import Catenary, fitted
from groundproc.analysis.corridor.clearance import Clearance

Array = npt.NDArray[np.float64]

_ON_M: Final = 0.15
"""Nearer points are on a wire ..."""
_BESIDE_M: Final = 0.35
"""... and nearer ones than that beside it. See `thin`."""
_PRICE: Final = 1.5
"""Points on a wire that one beside it outweighs."""
_TIP_M: Final = 5.0
"""How much of an end may be what it is fastened to."""
_FEWEST: Final = 10
_KEPT: Final = 64
"""Points of a metre of wire that are kept, by chance."""
_CROWD: Final = 1 << 20
"""Points after which those of each metre are thinned again."""


class Whole:
    """Takes points, and fits each wire to those on it.

    Memory: 48 bytes for each of 64 points on a metre of wire, and 50 MB.

    Parameters
    ----------
    wires : sequence of Catenary
    """

    def __init__(self, wires: Sequence[Catenary]) -> None:
        self._wires, self._near = list(wires), Clearance(wires)
        self._rng = np.random.default_rng(len(wires))
        self._kept: list[Array] = []
        self._fresh = 0

    def add(self, xyz_m: Array) -> None:
        """Take points, shape (n, 3)."""
        if not self._wires:
            return
        _, wire = self._near.of(xyz_m, _BESIDE_M)
        for number in np.unique(wire[wire >= 0]):
            mine = xyz_m[wire == number]
            s, off, up = self._wires[number].local(mine)
            apart = np.hypot(off, up)
            rows = np.column_stack([np.full(len(s), number), s, apart, mine])
            self._kept.append(rows[apart < _BESIDE_M])
            self._fresh += len(rows)
        if self._fresh > _CROWD:
            self._thin()

    def fitted(self) -> list[Catenary]:
        """All wires, in their order; one of which hardly a point was met as it was."""
        self._thin()
        rows = np.concatenate([*self._kept, np.empty((0, 6))])
        out = []
        for number, wire in enumerate(self._wires):
            mine = _without_tips(rows[rows[:, 0] == number], wire)
            on = mine[mine[:, 2] < _ON_M, 3:]
            out.append(fitted(on) if len(on) >= _FEWEST else wire)
        return out

    def _thin(self) -> None:
        """Keep so many points of each metre, each with the same chance."""
        if not self._kept:
            return
        rows = np.concatenate(self._kept)
        rows = rows[self._rng.permutation(len(rows))]
        rows = rows[np.lexsort((np.floor(rows[:, 1]), rows[:, 0]))]
        metre = np.column_stack([rows[:, 0], np.floor(rows[:, 1])])
        first = np.flatnonzero(np.append(True, (np.diff(metre, axis=0) != 0).any(axis=1)))
        rank = np.arange(len(rows)) - np.repeat(first, np.diff(np.append(first, len(rows))))
        self._kept, self._fresh = [rows[rank < _KEPT]], 0


def _without_tips(rows: Array, wire: Catenary) -> Array:
    """Points of a wire without those at its ends that are of a roof, a wall or a crown: there are as many beside it."""
    worth = np.where(rows[:, 2] < _ON_M, 1.0, -_PRICE)
    keep = np.ones(len(rows), np.bool_)
    for inwards in (rows[:, 1] - wire.start_m, wire.end_m - rows[:, 1]):
        order = np.argsort(inwards)
        order = order[inwards[order] < _TIP_M]
        total = np.cumsum(worth[order])
        if len(total) and total.min() < 0.0:
            keep[order[: int(np.argmin(total)) + 1]] = False
    return rows[keep]
