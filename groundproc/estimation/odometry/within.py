"""Rotations within a slice: the error of the sensor's attitude at each moment of it, from the slice's own returns.

Between two corrections of the filter, a tenth of a second apart, the gyro's noise adds up to some hundredths of a
degree. That noise is white, plus vibration faster than the sampling, which aliases. The filter corrects a slice as one
rigid piece. But the returns of a slice have known times, so they tell more. They determine a chain of rotations every
10 ms, tied to each other by the gyro's noise, to what was found at the end of the slice before, and to the surfaces of
the map. The chain is small, and is solved at once.

The filter's rotation stays the slow part: the chain is drawn back to it, like the error of a gyro that something else
corrects. Neither positions nor the map nor the filter's own state are changed. Fed back, the map would keep the errors
of the chain.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.estimation.odometry.grid import STEP_NS, STEPS
from groundproc.estimation.odometry.matching import (
    FILLED_RETURNS,
    FILLED_SIGMA_M,
    GROUND,
    INFLATION,
    RANGE_SIGMA_M,
    SURFACE_SIGMA_M,
)
from groundproc.estimation.odometry.voxels import FLATNESS, LEVEL, LONGEST, MEAN, NORMAL, SPREAD, TILT, MapArrays, find
from groundproc.numerics.voxelhash import voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

APART: Final = 2
"""Grid steps between two turns of the chain."""
NODES: Final = STEPS // APART + 1
BACK_S: Final = 0.1
"""Within so long the filter brings errors back."""
SHARED_M: Final = np.sqrt(INFLATION) * SURFACE_SIGMA_M
"""What neighbouring clusters are off their planes alike, one sigma: as the filter has it."""
CLEAN_SIGMA_M: Final = 0.015
"""Returns scatter by this about a plane that is one; what is beyond it is common to a cluster."""
GATE_M: Final = 0.15
HUBER: Final = 2.0
"""Sigmas beyond which a cluster loses weight."""
ROUNDS: Final = 2
FLOOR_RAD: Final = np.deg2rad(0.003)
"""The attitude at the end of a slice is not taken to be known better than this."""


class Seen(NamedTuple):
    """Clusters of a slice.

    Attributes
    ----------
    since_ns : ndarray of int64, shape (n,)
        Since the slice's start.
    world_m : ndarray, shape (n, 3)
        Where the filter's pose places them.
    returns : ndarray of int32, shape (n,)
    """

    since_ns: Ints
    world_m: Array
    returns: npt.NDArray[np.int32]


class Within:
    """Finds the turns within slices, one after the other.

    Parameters
    ----------
    density : float
        Noise of the gyro [rad/sqrt(s)].
    """

    def __init__(self, density: float) -> None:
        self._chain = _chain(density)
        self._last, self._information = np.zeros(3), np.zeros((3, 3))

    def __call__(self, seen: Seen, place_m: Array, turn: Array, planes: tuple[MapArrays, Array]) -> Array:
        """By how much the attitudes on the grid of a slice are to be turned, about the axes of the map, shape (STEPS + 1, 3).

        Parameters
        ----------
        seen : Seen
        place_m : ndarray, shape (STEPS + 1, 3)
            Positions of the sensor on the grid.
        turn : ndarray, shape (3, 3)
            By which the filter has just corrected the slice: the one before ended without it.
        planes : tuple of (MapArrays, ndarray)
            Of the slices before; and the ground's mean normal, of any length.
        """
        start = self._last - frames.quat_log(frames.quat_from_mat(turn[None]))[0]
        arrays, ground = planes
        up = ground / max(float(np.linalg.norm(ground)), 1e-12)
        found = np.zeros((NODES, 3))
        voxel = np.empty(len(seen.world_m), np.int64)
        _look_up(seen.world_m, arrays, voxel)
        for _ in range(ROUNDS):
            rows, pull = np.zeros_like(self._chain), np.zeros(3 * NODES)
            _add((seen, voxel), place_m, arrays, up, found, (rows, pull))
            rows += self._chain
            rows[:3, :3] += self._information
            pull[:3] += self._information @ start
            found[:] = np.linalg.solve(rows, pull).reshape(NODES, 3)
        self._last = found[-1]
        self._information = np.linalg.inv(np.linalg.inv(rows)[-3:, -3:] + FLOOR_RAD**2 * np.eye(3))
        steps = np.arange(STEPS + 1) / APART
        return np.stack([np.interp(steps, np.arange(NODES), axis) for axis in found.T], axis=1).astype(np.float64)

    def forget(self) -> None:
        """What was found at the end of the last slice tells nothing of the next."""
        self._last, self._information = np.zeros(3), np.zeros((3, 3))


def _chain(density: float) -> Array:
    """Information that the gyro's noise gives on the turns, shape (3 NODES, 3 NODES): an Ornstein-Uhlenbeck process about nothing."""
    keep = np.exp(-APART * STEP_NS * 1e-9 / BACK_S)
    variance = 0.5 * density**2 * BACK_S
    tie = 1.0 / (variance * (1.0 - keep**2))
    matrix = np.zeros((NODES, NODES))
    matrix[0, 0] = 1.0 / variance
    for i in range(NODES - 1):
        matrix[i + 1, i + 1] += tie
        matrix[i, i] += tie * keep**2
        matrix[i, i + 1] = matrix[i + 1, i] = -tie * keep
    return np.asarray(np.kron(matrix, np.eye(3)), np.float64)


@njit(cache=True, nogil=True)
def _look_up(world: Array, planes: MapArrays, voxel: Ints) -> None:
    """Row of the voxel that each cluster lies in, -1 where there is none."""
    per_m = 1.0 / planes.voxel_m
    for n in range(len(world)):
        voxel[n] = find(planes.table, planes.keys, voxel_key(world[n, 0], world[n, 1], world[n, 2], per_m))


@njit(cache=True, nogil=True)
def _add(
    clusters: tuple[Seen, Ints], place_m: Array, planes: MapArrays, up: Array, turn: Array, system: tuple[Array, Array]
) -> None:  # fmt: skip
    """Add what clusters say of the turns before and after them; `turn` as known so far, by which they lose weight; `voxel` of the map."""
    (seen, voxel), voxels = clusters, planes.voxels
    arm, axis = np.empty(3), np.empty((3, 3))
    last = len(turn) - 1
    for n in range(len(seen.since_ns)):
        row = voxel[n]
        if row < 0:
            continue
        x, y, z = seen.world_m[n, 0], seen.world_m[n, 1], seen.world_m[n, 2]
        v = voxels[row]
        if v[FLATNESS] < 0.0 and v[SPREAD] <= 0.0:
            continue
        step = min(max(seen.since_ns[n] / STEP_NS, 0.0), STEPS - 1e-9)
        i = int(step)
        for c in range(3):
            between = place_m[i, c] + (step - i) * (place_m[i + 1, c] - place_m[i, c])
            arm[c] = seen.world_m[n, c] - between
        node = min(int(step / APART), last - 1)
        share = step / APART - node
        off = (x - v[MEAN], y - v[MEAN + 1], z - v[MEAN + 2])
        if v[FLATNESS] >= 0.0:
            away = off[0] ** 2 + off[1] ** 2 + off[2] ** 2
            variance = max(RANGE_SIGMA_M**2, v[FLATNESS]) / seen.returns[n]
            variance += max(v[FLATNESS] - CLEAN_SIGMA_M**2, 0.0) + SHARED_M**2 + v[TILT] * away
            e = v[NORMAL] * x + v[NORMAL + 1] * y + v[NORMAL + 2] * z - v[LEVEL]
            if abs(e) > GATE_M:
                continue
            lean = v[NORMAL] * up[0] + v[NORMAL + 1] * up[1] + v[NORMAL + 2] * up[2]
            axis[0, :] = v[NORMAL : NORMAL + 3]
            if abs(lean) > GROUND:
                # the ground's relief does not tell the heading
                axis[0, :] = up if lean > 0.0 else -up
            _row(arm, axis[0], e, variance, (node, share), turn, system)
            continue
        axis[0, :], axis[2, :] = v[NORMAL : NORMAL + 3], v[LONGEST : LONGEST + 3]
        axis[1, 0] = axis[2, 1] * axis[0, 2] - axis[2, 2] * axis[0, 1]
        axis[1, 1] = axis[2, 2] * axis[0, 0] - axis[2, 0] * axis[0, 2]
        axis[1, 2] = axis[2, 0] * axis[0, 1] - axis[2, 1] * axis[0, 0]
        for k in range(3):
            moves = max(1.0 - 12.0 * v[SPREAD + k] / planes.voxel_m**2, 1e-3)
            variance = (v[SPREAD + k] / min(seen.returns[n], FILLED_RETURNS) + FILLED_SIGMA_M**2) / moves
            e = axis[k, 0] * off[0] + axis[k, 1] * off[1] + axis[k, 2] * off[2]
            _row(arm, axis[k], e, variance, (node, share), turn, system)


@njit(cache=True, nogil=True, inline="always")
def _row(
    arm: Array, normal: Array, off: float, variance: float, where: tuple[int, float], turn: Array, system: tuple[Array, Array]
) -> None:  # fmt: skip
    """Add a row: a distance along a normal, at a share of the way from one turn of the chain to the next."""
    node, share = where
    information, pull = system
    j = (
        arm[1] * normal[2] - arm[2] * normal[1],
        arm[2] * normal[0] - arm[0] * normal[2],
        arm[0] * normal[1] - arm[1] * normal[0],
    )
    left = off
    for a in range(3):
        left += j[a] * ((1.0 - share) * turn[node, a] + share * turn[node + 1, a])
    weight = min(1.0, HUBER * np.sqrt(variance) / max(abs(left), 1e-9)) / variance
    before, after = 1.0 - share, share
    at = 3 * node
    for a in range(3):
        pull[at + a] -= weight * before * off * j[a]
        pull[at + 3 + a] -= weight * after * off * j[a]
        for b in range(3):
            both = weight * j[a] * j[b]
            information[at + a, at + b] += before * before * both
            information[at + 3 + a, at + 3 + b] += after * after * both
            information[at + a, at + 3 + b] += before * after * both
            information[at + 3 + a, at + b] += before * after * both
