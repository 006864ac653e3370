"""Classes that cleaning gives: what moved, and noise (`mixing` has echoes that are mixed of two surfaces). No point is deleted.

Moving is what beams passed through before or after it was hit (`freespace`). A single such voxel may be a leaf, so a beginning needs
company; from there it grows to neighbours that any beam contradicts, and to what belongs to no surface and was hit at the same time only.
What lies on a surface that stands, such as a pane in a wall, does not move.

Noise is what nothing else is near, or what is nearly alone and contradicted.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.classes import HIGH_NOISE, LOW_NOISE, MOVING, UNCLASSIFIED
from groundproc.cloud.freespace import AFTER, BEFORE, BETWEEN, SAME, Looks
from groundproc.cloud.surroundings import Surroundings, has_plane, off_plane
from groundproc.cloud.voxels import Voxels, beside, find

Bytes = npt.NDArray[np.uint8]

SEED_LOOKS: Final = 8
COMPANY: Final = 2
"""A beginning: so many looks through it and its neighbours, and so many neighbours that are contradicted too."""
APART_MS: Final = 500
"""What belongs to something that moves was hit within so long of it."""
ROUNDS: Final = 3
"""Of growing by time: three voxels, what feet and wheels are from what beams pass through."""
ALONE: Final = 3
"""Points, at most, in 3 m around what is noise by itself."""
NEARLY: Final = 12
"""And around what is noise because beams pass through it, too."""
FREE_LOOKS: Final = 8
_CLEAR: Final = 4
"""What moves hides what is behind it, a pane does not: of so many looks that hit it, one may go through it too, beside an edge."""
_STAYS: Final = 3
"""What was hit in so many looks and more for each one through it stays where it is."""
MOST_CONTRADICTED: Final = 0.03
"""Share of the voxels that may be contradicted: among cars and people it is one in a hundred."""
STAYS_MS: Final = 2000
MOST_STAYED: Final = 0.002
"""Share of the points that may be contradicted and in voxels hit for so long: where a path comes back beside itself, whole walls are."""
_METRE: Final = 2
_FOUR_METRES: Final = 4
"""Levels of the larger voxels."""
_SURFACES: Final = (2, 3)
"""Levels of a metre and two, whose planes tell a surface that stands."""
_STANDS: Final = 0.3
"""Share of its points that nothing contradicts."""
_ON_M: Final = 0.05
"""And what is so near to its plane belongs to it: a pane to its frame and the wall."""
_DOWN: Final = 10
"""Voxels of four metres below a point that are searched for the ground."""
_GROUND_POINTS: Final = 20

_EDGE, _NEW, _INSIDE = 1, 2, 3
"""Of what moves: grown to in the last round, in this one, before."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """What cleaning says of a stretch of flight.

    Attributes
    ----------
    contradicted : float
        Share of the voxels that beams passed through.
    trusted : bool
        Whether that is so little that things moved; else the path did, and what beams passed through tells nothing.
    """

    contradicted: float
    trusted: bool


@dataclass(frozen=True, slots=True)
class Classes:
    """What cleaning says of the voxels of a stretch of flight: ndarray of uint8, shape (used,); and of the stretch."""

    of_voxel: Bytes
    of_stretch: Stretch


def classify(around: Surroundings, looks: Looks) -> Classes:
    """Class of each voxel by what beams passed through, as `Evidence` has it; that is written over."""
    classes, moving = np.full(around.used, UNCLASSIFIED, np.uint8), np.zeros(around.used, np.uint8)
    for level in _SURFACES:
        cubes, parent = around.levels[level]
        _spare(around.voxels, around.edge_m, parent, cubes.voxels, cubes.edge_m, looks)
    seeds, stayed = _begin(around.table, around.voxels, looks, moving)
    share = seeds / max(around.used, 1)
    points = int(around.voxels.many[: around.used].sum())
    trusted = bool(share <= MOST_CONTRADICTED and stayed <= MOST_STAYED * points)
    if not trusted:
        looks[:], moving[:] = 0, 0
    (metre, in_metre), (four, in_four) = around.levels[_METRE], around.levels[_FOUR_METRES]
    crowd = np.zeros(metre.used, np.int32)
    _crowds(metre.table, metre.voxels, metre.used, crowd)
    _noise(around.table, around.voxels, looks, crowd[in_metre], classes)
    _heights(in_four, four.table, four.voxels, classes)
    while _grow(around.table, around.voxels, looks, moving, False):
        pass
    moving[moving > 0] = _EDGE
    for _ in range(ROUNDS):
        _grow(around.table, around.voxels, looks, moving, True)
    classes[moving > 0] = MOVING
    return Classes(classes, Stretch(share, trusted))


@njit(cache=True, nogil=True)
def _crowds(table: Any, voxels: Voxels, used: int, out: Any) -> None:
    """Points in each voxel and its neighbours."""
    neighbours = np.empty(27, np.int64)
    for v in range(used):
        for each in range(_around(table, voxels.key, voxels.key[v], neighbours)):
            out[v] += voxels.many[neighbours[each]]


@njit(cache=True, nogil=True)
def _noise(table: Any, voxels: Voxels, looks: Any, crowd: Any, classes: Any) -> None:
    neighbours = np.empty(27, np.int64)
    for v in range(len(classes)):
        if crowd[v] > NEARLY:
            continue
        near = 0
        for each in range(_around(table, voxels.key, voxels.key[v], neighbours)):
            near = near + int(voxels.many[neighbours[each]])
        free = looks[v, BEFORE] + looks[v, BETWEEN] + looks[v, AFTER]
        if crowd[v] <= ALONE or (near <= ALONE and free >= FREE_LOOKS):
            classes[v] = LOW_NOISE


@njit(cache=True, nogil=True)
def _heights(parent: Any, table: Any, voxels: Voxels, classes: Any) -> None:
    """Noise with ground below it is high noise."""
    for v in range(len(classes)):
        if classes[v] != LOW_NOISE:
            continue
        for down in range(1, _DOWN + 1):
            w = find(beside(voxels.key[parent[v]], 0, 0, -down), table, voxels.key)
            if w >= 0 and voxels.many[w] >= _GROUND_POINTS:
                classes[v] = HIGH_NOISE
                break


@njit(cache=True, nogil=True, inline="always")
def _contradicted(voxels: Voxels, looks: Any, v: Any) -> Any:
    """Looks through a voxel before or after it was hit; 0 where they do not outweigh those between, or it was seen through when hit."""
    away = looks[v, BEFORE] + looks[v, AFTER]
    return away if away > 2 * looks[v, BETWEEN] and _CLEAR * looks[v, SAME] <= voxels.looks[v] <= _STAYS * away else 0


@njit(cache=True, nogil=True)
def _around(table: Any, keys: Any, key: Any, out: Any) -> Any:
    """Fill in the numbers of a voxel by its key and of its neighbours, of those that there are; gives how many."""
    many = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                w = find(beside(key, i, j, k), table, keys)
                if w >= 0:
                    out[many] = w
                    many += 1
    return many


@njit(cache=True, nogil=True)
def _spare(voxels: Voxels, edge_m: float, parent: Any, cubes: Voxels, cube_m: float, looks: Any) -> None:
    """Take back what was seen through voxels that lie on a surface which stands."""
    firm = np.zeros(len(cubes.many), np.int64)
    for v in range(len(parent)):
        if _contradicted(voxels, looks, v) == 0:
            firm[parent[v]] += voxels.many[v]
    for v in range(len(parent)):
        w = parent[v]
        stands = has_plane(cubes.normal, w) and firm[w] >= _STANDS * cubes.many[w]
        if stands and off_plane(voxels, v, edge_m, cubes, w, cube_m) < _ON_M:
            looks[v, BEFORE], looks[v, AFTER] = 0, 0


@njit(cache=True, nogil=True)
def _begin(table: Any, voxels: Voxels, looks: Any, moving: Any) -> Any:
    """Mark where something that moves begins; gives how many voxels are contradicted enough for that, and points of those hit for long."""
    neighbours, seeds = np.empty(27, np.int64), 0
    stayed = 0
    for v in range(len(moving)):
        if _contradicted(voxels, looks, v) == 0:
            continue
        company, through = 0, 0
        for each in range(_around(table, voxels.key, voxels.key[v], neighbours)):
            there = _contradicted(voxels, looks, neighbours[each])
            company, through = company + (there > 0), through + there
        if company > COMPANY and through >= SEED_LOOKS:  # it is one of the company
            moving[v] = _EDGE
            seeds += 1
            if voxels.when_ms[v, 1] - voxels.when_ms[v, 0] >= STAYS_MS:
                stayed += int(voxels.many[v])
    return seeds, stayed


@njit(cache=True, nogil=True, inline="always")
def _belongs(voxels: Voxels, looks: Any, v: Any, w: Any) -> Any:
    """Whether a voxel is of no surface, never seen through, and was hit at the time of its neighbour only."""
    together = (
        voxels.when_ms[w, 0] >= voxels.when_ms[v, 0] - APART_MS
        and voxels.when_ms[w, 1] <= voxels.when_ms[v, 1] + APART_MS
    )
    return together and looks[w, BETWEEN] == 0 and not has_plane(voxels.normal, w)


@njit(cache=True, nogil=True)
def _grow(table: Any, voxels: Voxels, looks: Any, moving: Any, by_time: bool) -> Any:
    """One round: mark neighbours that any beam contradicts, by time also those that belong; gives how many."""
    neighbours = np.empty(27, np.int64)
    grown = 0
    edge = np.flatnonzero(moving == _EDGE)
    for n in range(len(edge)):
        v = edge[n]
        for each in range(_around(table, voxels.key, voxels.key[v], neighbours)):
            w = int(neighbours[each])
            if moving[w] == 0 and (_contradicted(voxels, looks, w) > 0 or (by_time and _belongs(voxels, looks, v, w))):
                moving[w] = _NEW
                grown += 1
    for w in range(len(moving)):
        if moving[w] == _EDGE:
            moving[w] = _INSIDE
        elif moving[w] == _NEW:
            moving[w] = _EDGE
    return grown
