"""Points to clusters: what was seen of one voxel within a tenth of a second; a bounded number of them, whatever the cloud."""

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.numerics.layout import to_read
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Singles = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int32]

CLUSTER: Final = np.dtype(
    [
        ("time_ns", "<i8"), ("place", "<f8", (3,)), ("arm", "<f4", (3,)), ("quat", "<f4", (4,)), ("scatter", "<f4", (6,)),
        ("count", "<i4"), ("strip", "<i4"),
    ]
)  # fmt: skip
"""Mean time of the points [UTC]; their mean [map, m]; the way there from the scanner as given [map, m]; attitude, map from body; their
scatter about the mean, xx xy xz yy yz zz, summed [m^2]; how many they are; and their strip."""
_ALL: Final = 1 << 31
COARSE: Final = 8
"""Voxels are thinned by blocks of so many along each axis, so that what is kept can be put into larger voxels too."""


@dataclass(slots=True)
class Gatherer:
    """Collects clusters; beyond the limit it keeps the voxels of half the hashes, then of a quarter, in all strips alike.

    Parameters
    ----------
    voxel_m : float
        Edge of a cluster's voxel.
    limit : int
        Clusters kept.
    merge : bool
        Clusters of one voxel and strip are made one before any is given up: right where points are split by strips.
    """

    voxel_m: float
    limit: int
    merge: bool = False
    below: int = _ALL
    total: int = 0
    _parts: list[npt.NDArray[np.void]] = field(default_factory=list)
    _held: int = 0

    def add(
        self, time_ns: Ints, xyz_m: Array, sensor_m: Array, quat: Array, strip: npt.NDArray[np.int32], split: Ints
    ) -> None:
        """Take points, shape (n, 3), seen from places, shape (n, 3), with attitudes, shape (n, 4).

        Points with different numbers in `split`, shape (n,), are never of one cluster: bins of time, or strips.
        """
        if not len(time_ns):
            return
        keys, order = _keys(split, xyz_m, self.voxel_m, self.below)
        order = order[np.argsort(keys[order], kind="stable")]
        out = np.zeros(len(order), CLUSTER)
        found = _gather(
            order,
            keys,
            _Points(to_read(time_ns), to_read(xyz_m), to_read(sensor_m), to_read(quat), to_read(strip)),
            _Columns(*(out[name] for name in CLUSTER.names or ())),
        )
        self._parts.append(out[:found].copy())
        self._held += found
        self.total += found
        if self._held > self.limit and self.merge:
            self._parts = [merged(np.concatenate(self._parts), self.voxel_m)]
            self._held = len(self._parts[0])
        while self._held > self.limit:
            self.below //= 2
            self._parts = [part[_hashes(part["place"], self.voxel_m) < self.below] for part in self._parts]
            self._held = sum(len(part) for part in self._parts)

    @property
    def share(self) -> float:
        """Part of the voxels that was kept."""
        return self.below / _ALL

    def clusters(self) -> npt.NDArray[np.void]:
        """All clusters kept, in order of time."""
        whole = np.concatenate(self._parts) if self._parts else np.zeros(0, CLUSTER)
        if self.merge:
            whole = merged(whole, self.voxel_m)
        return whole[np.argsort(whole["time_ns"], kind="stable")]


def merged(parts: npt.NDArray[np.void], voxel_m: float) -> npt.NDArray[np.void]:
    """Clusters of one voxel and strip made one; arm, attitude and time are those of the first."""
    if not len(parts):
        return parts
    cells = np.floor(parts["place"] / voxel_m).astype(np.int64)
    order = np.lexsort((parts["strip"], cells[:, 2], cells[:, 1], cells[:, 0]))
    ordered, cells = parts[order], cells[order]
    new = np.ones(len(ordered), np.bool_)
    new[1:] = (np.diff(cells, axis=0) != 0).any(axis=1) | (np.diff(ordered["strip"]) != 0)
    first = np.flatnonzero(new)
    out = ordered[first].copy()
    count = ordered["count"].astype(np.float64)
    out["count"] = np.add.reduceat(ordered["count"], first)
    off = ordered["place"] - np.repeat(out["place"], np.diff(np.append(first, len(ordered))), axis=0)
    mean = np.add.reduceat(count[:, None] * off, first) / out["count"][:, None]
    second = np.stack([count * off[:, i] * off[:, j] for i, j in _SIX], axis=1) + ordered["scatter"]
    total = np.add.reduceat(second, first)
    for k, (i, j) in enumerate(_SIX):
        out["scatter"][:, k] = total[:, k] - out["count"] * mean[:, i] * mean[:, j]
    out["place"] += mean
    return np.asarray(out)


_SIX: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@njit(cache=True, nogil=True)
def _hashes(place: Array, voxel_m: float) -> Any:
    out = np.empty(len(place), np.int64)
    for i in range(len(place)):
        out[i] = spread(voxel_key(place[i, 0], place[i, 1], place[i, 2], 1.0 / (COARSE * voxel_m)))
    return out


@njit(cache=True, nogil=True)
def _keys(split: Ints, xyz: Array, voxel_m: float, below: int) -> Any:
    """A key for each point's voxel and split, and the points whose voxels are kept."""
    keys, kept, count = np.empty(len(split), np.int64), np.empty(len(split), np.int64), 0
    for i in range(len(split)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        if below < _ALL and spread(voxel_key(x, y, z, 1.0 / (COARSE * voxel_m))) >= below:
            continue
        key = voxel_key(x, y, z, 1.0 / voxel_m)
        # a mix of both; two clusters that meet by chance, one in 1e7 of a chunk's, are told apart by their scatter
        mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
        mixed = (mixed + np.uint64(split[i])) * np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
        keys[i] = np.int64(mixed >> np.uint64(1))
        kept[count] = i
        count += 1
    return keys, kept[:count]


class _Points(NamedTuple):
    """Points, and where and how they were seen from; shapes (n,), (n, 3), (n, 3), (n, 4), (n,). See `Gatherer.add`."""

    time_ns: Ints
    xyz_m: Array
    sensor_m: Array
    quat: Array
    strip: Numbers


class _Columns(NamedTuple):
    """Columns of clusters to be filled in: of CLUSTER, in its order, and described there; scatter is zero before."""

    time_ns: Ints
    place_m: Array
    arm_m: Singles
    quat: Singles
    scatter_m2: Singles
    points: Numbers
    strip: Numbers


@njit(cache=True, nogil=True)
def _gather(order: Ints, keys: Ints, points: _Points, out: _Columns) -> int:
    """Clusters of points with the same key, which follow each other in `order`; gives how many there are."""
    time_ns, xyz, sensor, quat, strip = points
    out_time, out_place, out_arm, out_quat, out_scatter, out_count, out_strip = out
    found, at = 0, 0
    while at < len(order):
        first, end = order[at], at + 1
        while end < len(order) and keys[order[end]] == keys[first]:
            end += 1
        n = end - at
        since, x, y, z, a, b, c = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(at, end):
            i = order[k]
            since += time_ns[i] - time_ns[first]
            x += xyz[i, 0] - xyz[first, 0]
            y += xyz[i, 1] - xyz[first, 1]
            z += xyz[i, 2] - xyz[first, 2]
            a += sensor[i, 0] - sensor[first, 0]
            b += sensor[i, 1] - sensor[first, 1]
            c += sensor[i, 2] - sensor[first, 2]
        x, y, z = xyz[first, 0] + x / n, xyz[first, 1] + y / n, xyz[first, 2] + z / n
        out_place[found, 0], out_place[found, 1], out_place[found, 2] = x, y, z
        out_arm[found, 0] = x - sensor[first, 0] - a / n
        out_arm[found, 1] = y - sensor[first, 1] - b / n
        out_arm[found, 2] = z - sensor[first, 2] - c / n
        out_time[found] = time_ns[first] + np.int64(since / n)
        # the attitude nearest to the mean time: within a bin
        middle = order[at + n // 2]
        for k in range(4):
            out_quat[found, k] = quat[middle, k]
        for k in range(at, end):
            i = order[k]
            dx, dy, dz = xyz[i, 0] - x, xyz[i, 1] - y, xyz[i, 2] - z
            out_scatter[found, 0] += dx * dx
            out_scatter[found, 1] += dx * dy
            out_scatter[found, 2] += dx * dz
            out_scatter[found, 3] += dy * dy
            out_scatter[found, 4] += dy * dz
            out_scatter[found, 5] += dz * dz
        out_count[found], out_strip[found] = n, strip[first]
        found += 1
        at = end
    return found
