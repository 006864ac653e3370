"""What fills its voxel instead of lying on a plane (leaves, tufts, hedges, crops), as rows of the adjustment.

Such a voxel gives three rows for each cluster, one along each axis of its scatter, as in the odometry (`matching`).
The mean along each axis is solved for within, as a plane's offset is: these are rows of planes without tilts.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.odometry.matching import FILLED_RETURNS, FILLED_SIGMA_M
from groundproc.estimation.odometry.voxels import FEWEST_SCATTERED, LEAST_SPREAD_M
from groundproc.numerics.planes import FEWEST_CLUSTERS, MOST_RETURNS, Placed, add_scatter, by_halves, flattest_of
from groundproc.numerics.voxelhash import spread

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

LEAST_MOVES: Final = 0.05
"""An axis along which the voxel is filled from face to face, so that its mean moves by less than this share, is left out."""


class FilledRows(NamedTuple):
    """Rows of what fills its voxel; those of a mean follow each other.

    Attributes
    ----------
    cluster : ndarray of int64, shape (n,)
    first : ndarray of int64, shape (means + 1,)
        Where the rows of each mean begin.
    axis, mean_m : ndarray, shape (means, 3)
        The direction that it is about, and its place so far.
    variance_m2 : ndarray, shape (n,)
    """

    cluster: Ints
    first: Ints
    axis: Array
    mean_m: Array
    variance_m2: Array


class Fillings(NamedTuple):
    """What fills voxels.

    Attributes
    ----------
    axes : ndarray, shape (voxels, 3, 3)
        Rows: directions of the least, the middle and the largest spread.
    spread_m2 : ndarray, shape (voxels, 3)
        Variances along them; 0 where a voxel is not filled.
    mean_m : ndarray, shape (voxels, 3)
    """

    axes: Array
    spread_m2: Array
    mean_m: Array


def filled_rows(
    first: Ints, order: Ints, placed: Placed, voxel_m: float, taken: Flags, intervals: int, most: int
) -> FilledRows:
    """Rows of the voxels that are no planes and are filled, seen from two intervals or more.

    Parameters
    ----------
    first, order : ndarray of int64
        Clusters of each voxel, as of `find_planes`.
    placed : Placed
    voxel_m : float
    taken : ndarray of bool, shape (voxels,)
        Those that are planes.
    intervals, most : int
        Of the spline, and clusters of one interval that are used.
    """
    voxels = len(first) - 1
    fillings = Fillings(np.zeros((voxels, 3, 3)), np.zeros((voxels, 3)), np.zeros((voxels, 3)))

    def find(some: slice) -> None:
        part = Fillings(fillings.axes[some], fillings.spread_m2[some], fillings.mean_m[some])
        _find(first[some.start : some.stop + 1], order, placed, taken[some], part)

    by_halves(find, first)
    found = np.flatnonzero(fillings.spread_m2[:, 0] > 0.0)
    counts = np.zeros(intervals, np.int64)
    _count(found, first, order, placed.knot, counts)
    keep = np.zeros(len(order), np.bool_)
    kept = _thin(found, first, order, placed.knot, most / np.maximum(counts, 1), keep)
    means = 3 * len(found)
    out = FilledRows(
        np.empty(3 * kept, np.int64), np.zeros(means + 1, np.int64), np.empty((means, 3)), np.empty((means, 3)), np.empty(3 * kept)
    )  # fmt: skip
    means = _lay(found, first, order, (placed.returns, keep), (fillings, voxel_m), out)
    rows = int(out.first[means])
    return FilledRows(
        out.cluster[:rows], out.first[: means + 1], out.axis[:means], out.mean_m[:means], out.variance_m2[:rows]
    )


@njit(cache=True, nogil=True)
def _find(first: Ints, order: Ints, placed: Placed, taken: Flags, fillings: Fillings) -> None:
    world, scatter, count, knot = placed.world_m, placed.scatter_m2, placed.returns, placed.knot
    s, mean, largest = np.empty(6), np.empty(3), np.empty(3)
    for v in range(len(first) - 1):
        if taken[v] or first[v + 1] - first[v] < FEWEST_CLUSTERS:
            continue
        total, low, high = 0.0, 1 << 30, -1
        mean[:], s[:] = 0.0, 0.0
        for at in range(first[v], first[v + 1]):
            n = order[at]
            w = min(np.float64(count[n]), MOST_RETURNS)
            total += w
            for c in range(3):
                mean[c] += w * world[n, c]
            low, high = min(low, knot[n]), max(high, knot[n])
        if high == low or total < FEWEST_SCATTERED:
            continue
        mean /= total
        for at in range(first[v], first[v + 1]):
            n = order[at]
            w = min(np.float64(count[n]), MOST_RETURNS)
            away = (world[n, 0] - mean[0], world[n, 1] - mean[1], world[n, 2] - mean[2])
            add_scatter(s, w / count[n], scatter[n], w, away)
        a = fillings.axes[v]
        least, middle = flattest_of(s, 1.0 / total, a[0])
        if least <= LEAST_SPREAD_M**2:
            continue
        negative, _ = flattest_of(s, -1.0 / total, largest)
        a[2, :] = largest
        a[1, 0] = a[2, 1] * a[0, 2] - a[2, 2] * a[0, 1]
        a[1, 1] = a[2, 2] * a[0, 0] - a[2, 0] * a[0, 2]
        a[1, 2] = a[2, 0] * a[0, 1] - a[2, 1] * a[0, 0]
        spreads = fillings.spread_m2[v]
        spreads[0], spreads[1], spreads[2] = least, middle, -negative
        fillings.mean_m[v] = mean


@njit(cache=True, nogil=True)
def _count(found: Ints, first: Ints, order: Ints, knot: npt.NDArray[np.int32], counts: Ints) -> None:
    """Clusters of each interval that lie in what was found."""
    for v in found:
        for at in range(first[v], first[v + 1]):
            counts[knot[order[at]]] += 1


@njit(cache=True, nogil=True)
def _thin(found: Ints, first: Ints, order: Ints, knot: npt.NDArray[np.int32], share: Array, keep: Flags) -> int:
    """Mark a share of each interval's clusters, and count them.

    By a draw for each voxel, the same in every run, so that the voxels kept are seen by many slices.
    """
    kept = 0
    for v in found:
        draw = (spread(v * 2654435761) & 0xFFFFF) / 0x100000
        for at in range(first[v], first[v + 1]):
            keep[at] = draw < share[knot[order[at]]]
            kept += keep[at]
    return kept


@njit(cache=True, nogil=True)
def _lay(
    found: Ints, first: Ints, order: Ints, clusters: tuple[npt.NDArray[np.int32], Flags], voxels: tuple[Fillings, float],
    out: FilledRows,
) -> int:  # fmt: skip
    """Fill in the rows, voxel by voxel and axis by axis; gives how many means they are about."""
    (returns, keep), (fillings, voxel_m) = clusters, voxels
    rows, means = 0, 0
    for v in found:
        for axis in range(3):
            spread_m2 = fillings.spread_m2[v, axis]
            moves = 1.0 - 12.0 * spread_m2 / voxel_m**2
            if moves < LEAST_MOVES:
                continue
            start = rows
            for at in range(first[v], first[v + 1]):
                if keep[at]:
                    n = order[at]
                    out.cluster[rows] = n
                    out.variance_m2[rows] = (spread_m2 / min(returns[n], FILLED_RETURNS) + FILLED_SIGMA_M**2) / moves
                    rows += 1
            if rows - start < 2:
                rows = start
                continue
            out.axis[means], out.mean_m[means] = fillings.axes[v, axis], fillings.mean_m[v]
            means += 1
            out.first[means] = rows
    return means
