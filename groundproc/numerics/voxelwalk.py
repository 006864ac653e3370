"""Along a line from voxel to voxel (Amanatides and Woo 1987), for kernels.

How far along the line the next wall is, on each axis, is held as a share of the line: at 1 it has ended.
"""

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, inline="always")
def begin(place: Any, way: Any, at: Any, edge_m: float, step: Any, following: Any, each: Any) -> None:
    """Get ready to go from a place along a way; fills what `step`, `following` and `each` say.

    Parameters
    ----------
    place, way : ndarray, shape (3,)
    at : ndarray of int64, shape (3,)
        The voxel of the place.
    edge_m : float
        Of a voxel.
    step : ndarray of int64, shape (3,)
        1 or -1: to which neighbour the line goes on each axis.
    following : ndarray, shape (3,)
        Share of the way up to the next wall on each axis; infinite where there is none.
    each : ndarray, shape (3,)
        From wall to wall.
    """
    for a in range(3):
        step[a] = 1 if way[a] > 0.0 else -1
        if way[a] != 0.0:
            wall = (at[a] + (1 if step[a] > 0 else 0)) * edge_m
            following[a], each[a] = (wall - place[a]) / way[a], edge_m / abs(way[a])
        else:
            following[a] = each[a] = np.inf


@njit(cache=True, nogil=True, inline="always")
def next_axis(following: Any) -> Any:
    """The axis whose wall comes next; of walls at one place the first axis."""
    if following[0] <= following[1] and following[0] <= following[2]:
        return 0
    return 1 if following[1] <= following[2] else 2
