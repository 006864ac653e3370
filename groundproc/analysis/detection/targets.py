"""Something solid with a flat top: where pulses that came down did not reach the ground, and stopped at one height.

At each cell a rectangle is laid in several directions. Of the pulses that came down inside it some met the ground, some stopped at one
height (two layers), some at others. Under leaves that go on growing all of it these shares are those of the surroundings; over a solid body
nearly all stop at its top. A thicket stops all as well, but not at one height. The score is the logarithm of how much likelier the counts
are by a body than by the likelier of the others, and so is a sum over pulses: few pulses that came down can make no high score, however
dense the bush. Pulses are counted, not points in cubes; where half the light comes down the same body has half the points and the same
shares.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import maximum_filter, uniform_filter

from groundproc.analysis.detection.layers import SIDE, STEP_M, Layers

Array = npt.NDArray[np.float64]

SIZES_M: Final = ((4.4, 1.9), (2.2, 1.5), (7.0, 2.6))
"""Length and width of what is looked for; a body may be larger or smaller than its rectangle."""
TURNS: Final = 8
AROUND_M: Final = 24.0
"""Side of the square whose shares are those of the surroundings."""
_HALO_M: Final = AROUND_M / 2.0 + 6.0
"""What lies farther from a cell does not matter to its score: half of that square, or the largest rectangle with its rim."""
_TOP, _BELOW, _OVER, _GROUND = 0.80, 0.12, 0.05, 0.03
"""Shares over a solid body: at its top, at its sides, above it, and beside it on the ground."""
_MOST: Final = 6.0
"""Pulses of one cell that count: in a dense cloud neighbours are no independent witnesses."""
_LEAST_SHARE: Final = 0.01
_FEWEST, _MOSTLY = 3.0, 0.6
_SPREAD: Final = 3
"""Layers up and down over which leaves spread what they stop."""
_RIM: Final = 0.5
"""Cells beside the rectangle on all sides count against it by so much, if they look like it: a thicket goes on."""


@dataclass(frozen=True, slots=True)
class Target:
    """A place that scores.

    Attributes
    ----------
    row, column : int
        Cell of its middle.
    size, turn : int
        Number in `SIZES_M`, and of the direction of its length from east, of `TURNS` in half a turn.
    top : int
        Number of the layer of its top.
    score : float
    """

    row: int
    column: int
    size: int
    turn: int
    top: int
    score: float


def scan(layers: Layers, least_score: float) -> list[Target]:
    """Places that score, the best first, each further from the others than its own size.

    Parameters
    ----------
    layers : Layers
    least_score : float
    """
    grid, usual = layers.grid, np.ones(layers.layers + 1)
    for _, _, tile in layers:
        usual += _weighted(tile.counts).sum(axis=(0, 1), dtype=np.float64)
    halo = round(_HALO_M / grid.cell_m)
    found = [np.empty((0, 6))]
    for row, column, _ in layers:
        top, left = max(row - halo, 0), max(column - halo, 0)
        low, right = min(row + SIDE + halo, grid.rows), min(column + SIDE + halo, grid.columns)
        counts = _weighted(layers.window(top, left, low - top, right - left).counts)
        core = slice(row - top, row - top + SIDE), slice(column - left, column - left + SIDE)
        places = _peaks(*_scored(counts, usual, core, grid.cell_m), core, least_score)
        places[:, :2] += (top, left)
        found.append(places)
    return _apart(np.concatenate(found), grid.cell_m)


def _scored(
    counts: npt.NDArray[np.float32], usual: Array, core: tuple[slice, slice], cell_m: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int16]]:
    """The best score of each cell of a core and the cells next to it, and what it is of: size, turn, top."""
    shares = _surroundings(counts, usual, cell_m)
    worth = np.zeros(counts.shape[:2], np.bool_)
    some = tuple(slice(max(each.start - 1, 0), each.stop + 1) for each in core)
    worth[some] = _worth(counts)[some]
    best = np.full(counts.shape[:2], -np.inf, np.float32)
    kind = np.zeros((*counts.shape[:2], 3), np.int16)
    for size, sides in enumerate(SIZES_M):
        for turn in range(TURNS):
            inner, rim = _cells(sides, np.pi * turn / TURNS, cell_m)
            _score(counts, shares, worth, (inner, rim), best, kind, np.array([size, turn], np.int16))
    return best, kind


def _weighted(numbers: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
    """Counts, no cell with more than so many."""
    counts = np.minimum(numbers.astype(np.float32), np.float32(200.0))
    total = counts.sum(axis=2, keepdims=True)
    counts *= np.minimum(1.0, _MOST / np.maximum(total, 1.0))
    return counts


def _worth(counts: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Cells around which some pulses stopped above the ground, and most of those that came down did."""
    ground = uniform_filter(counts[..., 0], 3, mode="constant") * 9.0
    up = uniform_filter(counts[..., 1:].sum(axis=2), 3, mode="constant") * 9.0
    return np.asarray((up > _FEWEST - 0.5) & (up > _MOSTLY * (ground + up)))


def _surroundings(counts: npt.NDArray[np.float32], usual: Array, cell_m: float) -> npt.NDArray[np.float32]:
    """Shares of layers around each cell, shape (rows, columns, layers + 1); `usual` are the counts of all."""
    side = max(round(AROUND_M / cell_m), 3)
    mean = np.stack([uniform_filter(counts[..., k], side, mode="nearest") for k in range(counts.shape[2])], axis=2)
    prior = usual / usual.sum() * 1e-3
    mean = np.maximum(mean, 0.0) + prior.astype(np.float32)
    return np.asarray(np.maximum(mean / mean.sum(axis=2, keepdims=True), _LEAST_SHARE), np.float32)


def _cells(
    sides: tuple[float, float], turn_rad: float, cell_m: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Steps in rows and columns to the cells of a rectangle, and to those of a rim of a metre around it, shape (n, 2)."""
    reach = int(np.ceil((max(sides) / 2.0 + 1.2) / cell_m))
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    x, y = j * cell_m, -i * cell_m
    u, v = x * np.cos(turn_rad) + y * np.sin(turn_rad), y * np.cos(turn_rad) - x * np.sin(turn_rad)
    # cells that lie within it but for their edges
    inner = (np.abs(u) <= sides[0] / 2.0 - 0.2 * cell_m) & (np.abs(v) <= sides[1] / 2.0 - 0.2 * cell_m)
    rim = (np.abs(u) <= sides[0] / 2.0 + 1.2) & (np.abs(v) <= sides[1] / 2.0 + 1.2)
    rim &= (np.abs(u) > sides[0] / 2.0 + 0.4) | (np.abs(v) > sides[1] / 2.0 + 0.4)
    return np.stack([i[inner], j[inner]], axis=1), np.stack([i[rim], j[rim]], axis=1)


def _peaks(
    best: npt.NDArray[np.float32], kind: npt.NDArray[np.int16], core: tuple[slice, slice], least: float
) -> Array:
    """Cells of a core that score and are the best of their neighbours: row, column, size, turn, top and score, shape (n, 6)."""
    peak = np.zeros(best.shape, np.bool_)
    peak[core] = ((best >= least) & (best == maximum_filter(best, 3)))[core]
    rows, columns = np.nonzero(peak)
    return np.column_stack([rows, columns, kind[rows, columns], best[rows, columns]]).astype(np.float64)


def _apart(places: Array, cell_m: float) -> list[Target]:
    """The best of places, and of the others those that lie beyond its reach, and so on."""
    reaches = [int(np.ceil(0.75 * length / cell_m)) for length, _ in SIZES_M]
    side = max(reaches)
    found: list[Target] = []
    near: dict[tuple[int, int], list[Target]] = {}
    for line in places[np.lexsort((places[:, 1], places[:, 0], -places[:, 5]))].tolist():
        row, column, size, turn, top = map(int, line[:5])
        around = [near.get((row // side + i, column // side + j), []) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        if any(
            max(abs(row - each.row), abs(column - each.column)) <= reaches[each.size]
            for some in around
            for each in some
        ):
            continue
        found.append(Target(row, column, size, turn, top, line[5]))
        near.setdefault((row // side, column // side), []).append(found[-1])
    return found


@njit(cache=True, nogil=True)
def _score(counts: Any, shares: Any, worth: Any, cells: Any, best: Any, kind: Any, number: Any) -> None:
    """Raise the best scores by those of one rectangle, at places that are worth it."""
    inner, rim = cells
    rows, columns, layers = counts.shape
    inside, outside, own = np.zeros(layers), np.zeros(layers), np.zeros(layers)
    for i in range(rows):
        for j in range(columns):
            if not worth[i, j]:
                continue
            inside[:], outside[:] = 0.0, 0.0
            for steps, sums in ((inner, inside), (rim, outside)):
                for n in range(len(steps)):
                    a, b = i + steps[n, 0], j + steps[n, 1]
                    if 0 <= a < rows and 0 <= b < columns:
                        for k in range(layers):
                            sums[k] += counts[a, b, k]
            _thicket(inside, own)
            score, top = _best_top(inside, outside, shares[i, j], own)
            if score > best[i, j]:
                best[i, j] = score
                kind[i, j, 0], kind[i, j, 1], kind[i, j, 2] = number[0], number[1], top


@njit(cache=True, nogil=True)
def _thicket(inside: Any, own: Any) -> None:
    """Shares of what grows there, if that is all: the counts themselves, but no narrower in height than leaves are."""
    layers = len(inside)
    own[:] = _LEAST_SHARE
    own[0] += inside[0]
    for k in range(1, layers):
        low, high = max(k - _SPREAD, 1), min(k + _SPREAD, layers - 1)
        for m in range(low, high + 1):
            own[m] += inside[k] / (high - low + 1)
    own /= own.sum()


@njit(cache=True, nogil=True)
def _best_top(inside: Any, outside: Any, share: Any, own: Any) -> Any:
    """The best score over the heights that its top may have, and that layer."""
    layers = len(inside)
    usual, thicket = 0.0, 0.0
    for k in range(layers):
        usual += inside[k] * np.log(share[k])
        thicket += inside[k] * np.log(own[k])
    nothing = max(usual, thicket)
    best, found = -np.inf, 0
    for top in range(2, layers):
        solid, against = 0.0, 0.0
        for k in range(layers):
            if k == 0:
                chance = _GROUND
            elif k == top or k == top - 1:
                chance = _TOP / 2.0
            elif k < top:
                chance = _BELOW / max(top - 2, 1)
            else:
                chance = _OVER / max(layers - 1 - top, 1)
            solid += inside[k] * np.log(chance)
            if outside[k] > 0.0:
                against += outside[k] * np.log(chance / share[k])
        score = solid - nothing - _RIM * max(against, 0.0)
        if score > best:
            best, found = score, top
    return best, found


def top_m(layers: Layers, target: Target) -> float:
    """Height of a target's top above the ground."""
    return layers.low_m + target.top * STEP_M
