"""Packets to slices of the flight, and each slice to clusters: what the lidar saw of one voxel at one instant.

All lasers look along one azimuth at a time, so the returns of one small voxel within one revolution fall within milliseconds: their
mean is one measurement of a surface from one pose, with the noise of the ranges averaged out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.method import Given, Progress
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS
from groundproc.estimation.odometry.spline import PathArrays
from groundproc.flight.shots import shots as shots_of
from groundproc.numerics.rotations import mat_of_quat
from groundproc.numerics.voxelhash import spread, voxel_key
from groundproc.sensors.shots import Gate

Array = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

CLUSTER_DTYPE: Final = np.dtype(
    [
        ("time_ns", "<i8"), ("xyz", "<f4", (3,)), ("scatter", "<f4", (6,)), ("count", "<i4"), ("range_m", "<f4"),
        ("laser", "<i4"),
    ]
)  # fmt: skip
"""Mean time of the returns [UTC]; their mean in the sensor frame [m] at that time; their scatter about it in the local frame, xx xy xz yy
yz zz, summed over the returns [m^2]; how many they are; their mean range [m]; and their laser, 0 where lasers are not told apart."""


@dataclass(frozen=True, slots=True)
class Slice:
    """Returns of one slice, in order of time.

    Attributes
    ----------
    number : int
        The slice begins at number * SLICE_NS after the start of the grid.
    time_ns : ndarray of int64, shape (n,)
        UTC.
    xyz_m : ndarray of float32, shape (n, 3)
        In the sensor frame.
    laser : ndarray of uint8, shape (n,), optional
        Given where the clusters of each laser are to be told apart.
    """

    number: int
    time_ns: npt.NDArray[np.int64]
    xyz_m: npt.NDArray[np.float32]
    laser: npt.NDArray[np.uint8] | None = None


def slices(given: Given, start_ns: int, progress: Progress, apart: bool = False) -> Iterator[Slice]:
    """Stream the flight in slices; those without a return are left out.

    Parameters
    ----------
    given : Given
    start_ns : int
        Start of the grid [UTC].
    progress : Progress
    apart : bool
        Whether lasers are to be told apart.
    """
    survey = given.survey
    gate = Gate(*survey.fov_deg, survey.min_range_m, survey.max_range_m)
    times: list[npt.NDArray[np.int64]] = []
    points: list[npt.NDArray[np.float32]] = []
    lines: list[npt.NDArray[np.uint8]] = []
    number = -1

    def told(done: int) -> None:
        progress("adjust", done)

    for shots in shots_of(given.readers, given.timeline, gate, given.lasers, progress=told):
        # at a change of leg the clock may step back by what the synchronisations differ by
        slot = (shots.time_ns - start_ns) // SLICE_NS
        edges = np.flatnonzero(np.diff(slot)) + 1
        for first, last in zip([0, *edges.tolist()], [*edges.tolist(), len(slot)], strict=True):
            if first == last:
                continue
            if slot[first] != number and times:
                if number >= 0:
                    yield _slice(number, times, points, lines)
                times, points, lines = [], [], []
            number = int(slot[first])
            times.append(shots.time_ns[first:last])
            points.append(shots.xyz_m[first:last])
            if apart:
                lines.append(shots.laser[first:last])
        del shots  # the next piece takes their memory, but for what the slice at the edge holds
    if times and number >= 0:
        yield _slice(number, times, points, lines)


def _slice(
    number: int,
    times: Sequence[npt.NDArray[np.int64]],
    points: Sequence[npt.NDArray[np.float32]],
    lines: Sequence[npt.NDArray[np.uint8]],
) -> Slice:
    return Slice(number, np.concatenate(times), np.concatenate(points), np.concatenate(lines) if lines else None)


TABLE_SIZE: Final = 1 << 16


class Clusterer:
    """Makes the clusters of slices; keeps its working memory between them.

    Parameters
    ----------
    voxel_m : float
        Edge of the voxels.
    """

    def __init__(self, voxel_m: float) -> None:
        self.voxel_m = voxel_m
        self._table = np.full(TABLE_SIZE, -1, np.int32)
        self._keys = np.empty(TABLE_SIZE, np.int64)
        # fresh memory of four megabytes for each slice would take as long as filling it
        self._sums = np.empty((TABLE_SIZE // 2, 15))

    def __call__(
        self, piece: Slice, start_ns: int, quat: Array, position_m: Array, apart: bool = False
    ) -> tuple[npt.NDArray[np.void], Array]:
        """Clusters of a slice.

        Parameters
        ----------
        piece : Slice
        start_ns : int
            UTC of the first of the poses.
        quat, position_m : ndarray, shape (STEPS + 1, 4) and (STEPS + 1, 3)
            Poses of the sensor on the grid over the slice, "local from sensor".
        apart : bool
            Whether a cluster is of one laser only; the slice has to have them.

        Returns
        -------
        clusters : ndarray of CLUSTER_DTYPE, shape (m,)
        world_m : ndarray, shape (m, 3)
            Their means in the local frame with these poses.
        """
        count = len(piece.time_ns)
        sums = self._sums[:count]
        laser = piece.laser if apart and piece.laser is not None else np.zeros(count, np.uint8)
        lasers = np.zeros(len(sums), np.int32)
        poses = PathArrays(start_ns, STEP_NS, quat, position_m)
        table = _Table(self.voxel_m, self._table, self._keys)
        found = _gather(_Returns(piece.time_ns, piece.xyz_m, laser), poses, table, sums, lasers)
        clusters = np.empty(found, CLUSTER_DTYPE)
        world = np.empty((found, 3))
        columns = _Columns(
            clusters["time_ns"], clusters["xyz"], clusters["scatter"], clusters["count"], clusters["range_m"]
        )
        _finish(sums[:found], poses, columns, world)
        clusters["laser"] = lasers[:found]
        return clusters, world


class _Returns(NamedTuple):
    """Returns of a slice; the fields are those of `Slice`, lasers of zeros where they are not told apart."""

    time_ns: Ints
    xyz_m: Singles
    laser: npt.NDArray[np.uint8]


class _Table(NamedTuple):
    """Working memory for voxels, empty before and after.

    Attributes
    ----------
    voxel_m : float
    rows : ndarray of int32, shape (TABLE_SIZE,)
        Of the sums, by the hashes of the voxels' keys; -1: none.
    keys : ndarray of int64, shape (TABLE_SIZE,)
    """

    voxel_m: float
    rows: npt.NDArray[np.int32]
    keys: Ints


class _Columns(NamedTuple):
    """Columns of clusters to be filled in: of CLUSTER_DTYPE, and described there."""

    time_ns: Ints
    xyz_m: Singles
    scatter_m2: Singles
    returns: npt.NDArray[np.int32]
    range_m: Singles


@njit(cache=True, nogil=True)
def _gather(returns: _Returns, poses: PathArrays, voxels: _Table, sums: Array, lasers: npt.NDArray[np.int32]) -> int:
    """Sums of each voxel and laser: count, time, world x y z, its six second moments, range; about the voxel's centre, which follows."""
    time_ns, xyz, laser = returns
    voxel_m, table, keys = voxels
    start_ns, quat, position = poses.start_ns, poses.quat, poses.position_m
    nodes = len(quat)
    mats = np.empty((nodes, 3, 3))
    for i in range(nodes):
        mat_of_quat(quat[i], mats[i])
    m = np.empty((3, 4))
    per_m, mask = 1.0 / voxel_m, len(table) - 1
    found, last = 0, np.int64(-1)
    slots = np.empty(len(sums), np.int32)
    for n in range(len(time_ns)):
        since = time_ns[n] - start_ns
        if since != last:
            last = since
            u = since / poses.step_ns
            i = min(max(int(u), 0), nodes - 2)
            u -= i
            # between nodes a point moves on a straight line: a sagitta of theta^2 / 8, 3e-6 rad at 60 deg/s
            for r in range(3):
                for c in range(3):
                    m[r, c] = mats[i, r, c] + u * (mats[i + 1, r, c] - mats[i, r, c])
                m[r, 3] = position[i, r] + u * (position[i + 1, r] - position[i, r])
        a, b, c_ = np.float64(xyz[n, 0]), np.float64(xyz[n, 1]), np.float64(xyz[n, 2])
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c_ + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c_ + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c_ + m[2, 3]
        # the upper bits of an axis are its sign again within 2^15 voxels: room for the laser
        key = voxel_key(x, y, z, per_m) ^ (np.int64(laser[n]) << 58)
        slot = spread(key) & mask
        while table[slot] >= 0 and keys[slot] != key:
            slot = (slot + 1) & mask
        row = table[slot]
        if row < 0:
            if found == len(sums):
                continue
            row = found
            lasers[row] = laser[n]
            table[slot], keys[slot], slots[found] = row, key, slot
            found += 1
            sums[row, :12] = 0.0
            sums[row, 12] = (np.floor(x * per_m) + 0.5) * voxel_m
            sums[row, 13] = (np.floor(y * per_m) + 0.5) * voxel_m
            sums[row, 14] = (np.floor(z * per_m) + 0.5) * voxel_m
        s = sums[row]
        x -= s[12]
        y -= s[13]
        z -= s[14]
        s[0] += 1.0
        s[1] += since
        s[2] += x
        s[3] += y
        s[4] += z
        s[5] += x * x
        s[6] += x * y
        s[7] += x * z
        s[8] += y * y
        s[9] += y * z
        s[10] += z * z
        s[11] += np.sqrt(a * a + b * b + c_ * c_)
    for row in range(found):
        table[slots[row]] = -1
    return found


@njit(cache=True, nogil=True)
def _finish(sums: Array, poses: PathArrays, columns: _Columns, world: Array) -> None:
    """Mean, scatter, time and range of each voxel from its sums; its mean in the sensor frame at that time."""
    start_ns, quat, position = poses.start_ns, poses.quat, poses.position_m
    time_ns, xyz, scatter, count, range_m = columns
    nodes = len(quat)
    mats = np.empty((nodes, 3, 3))
    for i in range(nodes):
        mat_of_quat(quat[i], mats[i])
    for row in range(len(sums)):
        s = sums[row]
        n = 1.0 / s[0]
        x, y, z = s[2] * n, s[3] * n, s[4] * n
        scatter[row, 0] = s[5] - s[2] * x
        scatter[row, 1] = s[6] - s[2] * y
        scatter[row, 2] = s[7] - s[2] * z
        scatter[row, 3] = s[8] - s[3] * y
        scatter[row, 4] = s[9] - s[3] * z
        scatter[row, 5] = s[10] - s[4] * z
        world[row, 0], world[row, 1], world[row, 2] = x + s[12], y + s[13], z + s[14]
        since = s[1] * n
        time_ns[row] = start_ns + np.int64(np.rint(since))
        u = since / poses.step_ns
        i = min(max(int(u), 0), nodes - 2)
        u -= i
        for c in range(3):
            total = 0.0
            for r in range(3):
                entry = mats[i, r, c] + u * (mats[i + 1, r, c] - mats[i, r, c])
                total += entry * (world[row, r] - position[i, r] - u * (position[i + 1, r] - position[i, r]))
            xyz[row, c] = total
        count[row] = int(s[0])
        range_m[row] = s[11] * n
