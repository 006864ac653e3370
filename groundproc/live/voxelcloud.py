"""The live cloud: one point for each voxel that was hit, in the order of the first hits, in bounded memory."""

import threading
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.odometry.grid import STEP_NS
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics.rotations import mat_of_quat
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]

COARSER: Final = 1.5
"""When the cloud is full its voxels grow by this."""
_FIRST_ROWS: Final = 1 << 16


class _Cells(NamedTuple):
    """The kept points, and the table that finds them by voxel.

    Attributes
    ----------
    table : ndarray of int32, shape (2^k,)
        Number of a point by the hash of its voxel; -1 where there is none.
    keys : ndarray of int64, shape (rows,)
        Key of each point's voxel.
    xyz, intensity, time_ns : ndarray, shape (rows, 3) and (rows,)
        As `_Placed`.
    """

    table: npt.NDArray[np.int32]
    keys: npt.NDArray[np.int64]
    xyz: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint8]
    time_ns: npt.NDArray[np.int64]


class _Placed(NamedTuple):
    """Points to be added.

    Attributes
    ----------
    xyz : ndarray of float32, shape (n, 3)
        In the local frame [m].
    intensity : ndarray of uint8, shape (n,)
    time_ns : ndarray of int64, shape (n,)
    """

    xyz: npt.NDArray[np.float32]
    intensity: npt.NDArray[np.uint8]
    time_ns: npt.NDArray[np.int64]


class VoxelCloud:
    """Points in the local frame.

    Parameters
    ----------
    voxel_m : float
        Edge of the voxels to begin with.
    most : int
        Points kept; when more come, the voxels become coarser.

    Attributes
    ----------
    generation : int
        Counts how often they did: point numbers of one generation mean nothing in the next.
    lock : Lock
        Held while points are added; readers of other threads take it.
    """

    def __init__(self, voxel_m: float, most: int) -> None:
        self.voxel_m, self.most, self.generation, self.count = voxel_m, most, 0, 0
        self.lock = threading.Lock()
        self._table = np.full(4 * _FIRST_ROWS, -1, np.int32)
        self._keys = np.empty(_FIRST_ROWS, np.int64)
        self._xyz = np.empty((_FIRST_ROWS, 3), np.float32)
        self._intensity = np.empty(_FIRST_ROWS, np.uint8)
        self._time_ns = np.empty(_FIRST_ROWS, np.int64)

    def add(self, time_ns: npt.NDArray[np.int64], xyz_m: Any, intensity: Any, path: Path) -> None:
        """Place the returns of a slice with its path and keep those in new voxels.

        Parameters
        ----------
        time_ns : ndarray of int64, shape (n,)
            On the scale of the path.
        xyz_m : ndarray of float32, shape (n, 3)
            In the sensor frame.
        intensity : ndarray of uint8, shape (n,)
        path : Path
        """
        world = np.empty((len(time_ns), 3), np.float32)
        _place(time_ns, xyz_m, path.start_ns, path.quat, path.position_m, world)
        self._insert(_Placed(world, intensity, time_ns))

    def _cells(self) -> _Cells:
        return _Cells(self._table, self._keys, self._xyz, self._intensity, self._time_ns)

    def _insert(self, points: _Placed) -> None:
        start = 0
        with self.lock:
            while start < len(points.xyz):
                most = min(len(self._keys), self.most)
                start, self.count = _insert(self._cells(), self.count, points, start, 1.0 / self.voxel_m, most)
                if start < len(points.xyz):
                    self._make_room()

    def _make_room(self) -> None:
        if len(self._keys) < self.most:
            rows = min(2 * len(self._keys), self.most)
            more = rows - len(self._keys)
            self._keys = np.concatenate([self._keys, np.empty(more, np.int64)])
            self._xyz = np.concatenate([self._xyz, np.empty((more, 3), np.float32)])
            self._intensity = np.concatenate([self._intensity, np.empty(more, np.uint8)])
            self._time_ns = np.concatenate([self._time_ns, np.empty(more, np.int64)])
        else:
            self.voxel_m *= COARSER
            self.generation += 1
        size = 1 << int(np.ceil(np.log2(4 * len(self._keys))))
        self._table = np.full(size, -1, np.int32)
        many = slice(self.count)
        kept = _Placed(self._xyz[many].copy(), self._intensity[many].copy(), self._time_ns[many].copy())
        _, self.count = _insert(self._cells(), 0, kept, 0, 1.0 / self.voxel_m, len(self._keys))

    def part(self, generation: int, start: int, most: int) -> tuple[int, int, Any, Any]:
        """Generation, number of the first, positions (n, 3) and intensities (n,) of points from a number on.

        All anew where the generation has changed.
        """
        with self.lock:
            if generation != self.generation or not 0 <= start <= self.count:
                start = 0
            part = slice(start, min(start + most, self.count))
            return self.generation, start, self._xyz[part].copy(), self._intensity[part].copy()

    def points(self) -> tuple[Any, Any, Any]:
        """Positions, intensities and times of all."""
        with self.lock:
            return self._xyz[: self.count], self._intensity[: self.count], self._time_ns[: self.count]


@njit(cache=True, nogil=True)
def _place(time_ns: Any, xyz: Any, start_ns: int, quat: Any, position: Any, world: Any) -> None:
    nodes = len(quat)
    mats = np.empty((nodes, 3, 3))
    for i in range(nodes):
        mat_of_quat(quat[i], mats[i])
    for n in range(len(time_ns)):
        u = (time_ns[n] - start_ns) / STEP_NS
        i = min(max(int(u), 0), nodes - 2)
        u -= i
        for r in range(3):
            total = position[i, r] + u * (position[i + 1, r] - position[i, r])
            for c in range(3):
                total += (mats[i, r, c] + u * (mats[i + 1, r, c] - mats[i, r, c])) * xyz[n, c]
            world[n, r] = total


@njit(cache=True, nogil=True)
def _insert(cells: Any, count: int, points: Any, start: int, per_m: float, most: int) -> Any:
    """Add points from `start` on; gives where it stopped for want of room, and the new count."""
    table, keys, out_xyz, out_intensity, out_time = cells
    xyz, intensity, time_ns = points
    mask = len(table) - 1
    for n in range(start, len(xyz)):
        key = voxel_key(np.float64(xyz[n, 0]), np.float64(xyz[n, 1]), np.float64(xyz[n, 2]), per_m)
        slot = spread(key) & mask
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & mask
        if table[slot] >= 0:
            continue
        if count >= most:
            return n, count
        table[slot], keys[count] = count, key
        out_xyz[count, 0], out_xyz[count, 1], out_xyz[count, 2] = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        out_intensity[count], out_time[count] = intensity[n], time_ns[n]
        count += 1
    return len(xyz), count
