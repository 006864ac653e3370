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
from groundproc.analysis.corridor.spans import SAME_M

Array = npt.NDArray[np.float64]

_ON_M: Final = 0.15
"""Nearer points are on a wire ..."""
_BESIDE_M: Final = 0.35
"""... and nearer ones than that beside it. See `thin`."""
_PRICE: Final = 1.5
"""Points on a wire that one beside it outweighs."""
_STRIPE_M: Final = 0.2
_CROWDED: Final = 0.6
"""Share of the points so near to a wire that are nearer than half of that, at least: with 7 cm of noise it is 0.65, about a stripe of a
surface 0.5 ..."""
_CROWDED_FLAT: Final = 0.75
"""... and where the points' cross-section is flat, as about the edge of a surface, where it is up to 0.7."""
_FLAT: Final = 3.0
"""A cross-section is flat that is so many times as wide as it is thin."""
_TIP_M: Final = 5.0
"""How much of an end may be what it is fastened to."""
_FEWEST: Final = 10
_KEPT: Final = 64
"""Points of a metre of wire that are kept, by chance."""
_CROWD: Final = 1 << 20
"""Points after which those of each metre are thinned again."""


class Whole:
    """Takes points, and fits each wire to those on it.

    Memory: 40 bytes for each of 64 points on a metre of wire, and 50 MB.

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
            near = np.hypot(off, up) < _BESIDE_M
            self._kept.append(np.column_stack([np.full(len(s), number), s, mine])[near])
            self._fresh += len(s)
        if self._fresh > _CROWD:
            self._thin()

    def fitted(self) -> list[Catenary]:
        """All wires, those that turn out to lie on each other as one; a wire of which hardly a point was met as it was."""
        self._thin()
        rows = np.concatenate([*self._kept, np.empty((0, 5))])
        numbers = list(range(len(self._wires)))
        found = {number: self._fit(rows, number) for number in numbers}
        for number in sorted(numbers, key=lambda each: found[each].length_m):
            longer = [each for each in found if each != number and found[each].length_m >= found[number].length_m]
            onto = next((each for each in longer if _same(found[number], found[each])), None)
            if onto is not None:
                del found[number]
                rows[rows[:, 0] == number, 0] = onto
                found[onto] = self._fit(rows, onto)
        return [found[number] for number in numbers if number in found and _hangs_free(rows, number, found[number])]

    def _fit(self, rows: Array, number: int) -> Catenary:
        """One wire by its rows."""
        wire = self._wires[number]
        on = _on(rows[rows[:, 0] == number, 2:], wire)
        return _ended(fitted(on), on) if len(on) >= _FEWEST else wire

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


def _hangs_free(rows: Array, number: int, wire: Catenary) -> bool:
    """Whether points crowd about a wire as noise has it, and do not lie side by side like those of a roof, a wall or their edges."""
    s, off, up = wire.local(rows[rows[:, 0] == number, 2:])
    near = np.hypot(off, up)
    mine = (near < _STRIPE_M) & (s > wire.start_m) & (s < wire.end_m)
    if mine.sum() < _FEWEST:
        return True
    thin, wide = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(off[mine], up[mine])), 0.0))
    least = _CROWDED if wide < _FLAT * thin else _CROWDED_FLAT
    return bool(np.mean(near[mine] < 0.5 * _STRIPE_M) >= least)


def _same(wire: Catenary, other: Catenary) -> bool:
    """Whether a wire lies on a longer one."""
    s, off, up = other.local(wire.places(1.0))
    within = (s > other.start_m - 1.0) & (s < other.end_m + 1.0)
    return bool(np.median(np.where(within, np.hypot(off, up), np.inf)) < SAME_M)


def _ended(wire: Catenary, xyz_m: Array) -> Catenary:
    """A wire that ends where its points do: noise carries the outermost of many beyond the end, of few it lies short of it.

    Points of one density up to an end, each off by a normal error, have 0.4 of what there is within one sigma beyond it. The outermost has
    ln 2 of a point beyond it, the next one more, as a median.
    """
    s, _, _ = wire.local(xyz_m)
    sigma_m = wire.rms_m / np.sqrt(2.0)
    off = []
    for inwards in (np.sort(s - s.min()), np.sort(s.max() - s)):
        to_the_metre = np.count_nonzero(inwards < 1.0)
        place = sigma_m / np.sqrt(2.0 * np.pi) * to_the_metre - np.log(2.0)
        off.append(np.interp(place, np.arange(len(inwards)), inwards) if place > 0.0 else place / to_the_metre)
    return wire.between(float(s.min() + off[0]), float(s.max() - off[1]))


def _on(xyz_m: Array, wire: Catenary) -> Array:
    """Points on a wire without those at its ends that are of a roof, a wall or a crown: there are as many beside it."""
    s, off, up = wire.local(xyz_m)
    on = np.hypot(off, up) < _ON_M
    worth, keep = np.where(on, 1.0, -_PRICE), on.copy()
    for inwards in (s - wire.start_m, wire.end_m - s):
        order = np.argsort(inwards)
        order = order[inwards[order] < _TIP_M]
        total = np.cumsum(worth[order])
        if len(total) and total.min() < 0.0:
            keep[order[: int(np.argmin(total)) + 1]] = False
    return xyz_m[keep]
