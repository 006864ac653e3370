"""Beams of an epoch that went through voxels: what they passed was free."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.cloud.voxels import find
from groundproc.numerics.voxelhash import spread, voxel_key
from groundproc.numerics.voxelwalk import begin, next_axis

Array = npt.NDArray[np.float64]


class Side(NamedTuple):
    """Points of an epoch, and where they were seen from.

    Attributes
    ----------
    xyz : ndarray, shape (n, 3)
    away : ndarray, shape (n, 3)
        To the sensor [m]; zero where it is not known.
    """

    xyz: Array
    away: Array


def passes(keys: npt.NDArray[np.int64], side: Side, edge_m: float) -> npt.NDArray[np.int64]:
    """How many beams of an epoch went through each voxel, shape (v,).

    Parameters
    ----------
    keys : ndarray of int64, shape (v, 3)
        Numbers of the voxels on each axis.
    side : Side
    edge_m : float
    """
    table = np.full(1 << int(np.ceil(np.log2(max(4 * len(keys), 1 << 10)))), -1, np.int32)
    found = np.zeros(len(keys), np.int64)
    _through(keys, side.xyz, side.away, edge_m, table, found)
    return found


@njit(cache=True, nogil=True)
def _entered(keys: Any, edge_m: float, table: Any) -> Any:
    """Enter voxels into an empty table; their keys, and the least and largest of their numbers on each axis."""
    mask, per_m = len(table) - 1, 1.0 / edge_m
    packed = np.empty(len(keys), np.int64)
    low, high = np.full(3, 1 << 60), np.full(3, -(1 << 60))
    for v in range(len(keys)):
        for a in range(3):
            low[a], high[a] = min(low[a], keys[v, a]), max(high[a], keys[v, a])
        packed[v] = voxel_key(
            (keys[v, 0] + 0.5) * edge_m, (keys[v, 1] + 0.5) * edge_m, (keys[v, 2] + 0.5) * edge_m, per_m
        )
        slot = spread(packed[v]) & mask
        while table[slot] >= 0:
            slot = (slot + 1) & mask
        table[slot] = v
    return packed, low, high


@njit(cache=True, nogil=True)
def _through(keys: Any, xyz: Any, away: Any, edge_m: float, table: Any, passes: Any) -> None:
    """Count the beams that went through voxels: from the echo towards the sensor, as long as they can meet one."""
    per_m = 1.0 / edge_m
    packed, low, high = _entered(keys, edge_m, table)
    at, step = np.empty(3, np.int64), np.empty(3, np.int64)
    following, each = np.empty(3), np.empty(3)
    for n in range(len(xyz)):
        if away[n, 0] == 0.0 and away[n, 1] == 0.0 and away[n, 2] == 0.0:
            continue
        gone = False
        for a in range(3):
            at[a] = np.int64(np.floor(xyz[n, a] * per_m))
        begin(xyz[n], away[n], at, edge_m, step, following, each)
        for a in range(3):
            gone = gone or (at[a] > high[a] and step[a] > 0) or (at[a] < low[a] and step[a] < 0)
        while not gone:
            a = next_axis(following)
            if following[a] >= 1.0:
                break
            at[a] += step[a]
            following[a] += each[a]
            gone = (step[a] > 0 and at[a] > high[a]) or (step[a] < 0 and at[a] < low[a])
            key = ((at[0] & 0x1FFFFF) << 42) | ((at[1] & 0x1FFFFF) << 21) | (at[2] & 0x1FFFFF)
            v = find(key, table, packed)
            if v >= 0:
                passes[v] += 1
