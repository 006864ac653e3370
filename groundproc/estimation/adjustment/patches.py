"""What a window saw, in little memory: its clusters of five seconds merged into patches, for the joining."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from groundproc.estimation.observations.planes import placed, places
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEPS
from groundproc.estimation.odometry.spline import Path
from groundproc.estimation.odometry.track import even_shares
from groundproc.machine.aside import aside
from groundproc.machine.system import let_go
from groundproc.numerics.planes import Placed, add_scatter, flattest_of
from groundproc.numerics.voxelhash import assign, sorted_by, spread, voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

PATCH_M: Final = 1.0
"""Edge of the voxels that patches are of."""
CHUNK: Final = 50
"""Slices that are merged: the correction of a path between windows changes by less than the noise in 5 s."""
KEPT: Final = 1500
"""Patches of a chunk, at most."""
FEWEST: Final = 12
"""Returns of a patch."""
THICKEST_M: Final = 0.06
"""Deviation from a plane beyond which a voxel makes no patch."""
NARROWEST: Final = 0.12
"""Its least width, one sigma, in voxels."""
MOST: Final = 1_500_000
"""Patches of a flight: those of an hour and a half; a longer one keeps fewer of each place."""


@dataclass(slots=True)
class Patches:
    """Patches of planes, each seen within five seconds.

    Attributes
    ----------
    clusters : Clusters
        Mean time; mean place in the frame of the coarse path (`coarse`) at that time; scatter in the local frame; returns.
    draw : ndarray of float32, shape (n,)
        In [0, 1), the same for all patches of a place: those below a share are the places that are kept.
    window : ndarray of int32, shape (n,)
        Number of the window.
    """

    clusters: Clusters
    draw: npt.NDArray[np.float32]
    window: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.draw)

    def set_aside(self) -> None:
        """Have all of them in a file until they are read."""
        c = self.clusters
        time_ns, xyz_m, scatter_m2, count, self.draw, self.window = aside(
            c.time_ns, c.xyz_m, c.scatter_m2, c.count, self.draw, self.window
        )
        self.clusters = Clusters(time_ns, xyz_m, scatter_m2, count)

    def of(self, which: npt.NDArray[Any]) -> "Patches":
        """Some of them, by a mask or numbers."""
        c = self.clusters
        return Patches(
            Clusters(c.time_ns[which], c.xyz_m[which], c.scatter_m2[which], c.count[which]), self.draw[which], self.window[which]
        )  # fmt: skip


def all_of(parts: Sequence[Patches], most: int = MOST) -> Patches:
    """Patches of several windows as one, thinned to about `most` by their places."""
    count = sum(len(part) for part in parts)
    if count > most:
        # the low bits of the draw: its high ones were used up when a chunk's patches were thinned
        parts = [part.of(np.modf(part.draw * 4096.0)[0] < most / count) for part in parts]
    clusters = [part.clusters for part in parts]
    return Patches(
        Clusters(
            np.concatenate([c.time_ns for c in clusters]),
            np.concatenate([c.xyz_m for c in clusters]),
            np.concatenate([c.scatter_m2 for c in clusters]),
            np.concatenate([c.count for c in clusters]),
        ),
        np.concatenate([part.draw for part in parts]),
        np.concatenate([part.window for part in parts]),
    )


def coarse(path: Path) -> Path:
    """The poses at slice boundaries; between them it is straight, and its matrices are no rotations exactly."""
    return Path(path.start_ns, path.quat[::STEPS].copy(), path.position_m[::STEPS].copy(), SLICE_NS)


def patches_of(gathered: Clusters, path: Path, window: int) -> Patches:
    """Patches of a window's clusters where its path places them."""
    chunk = (gathered.time_ns - path.start_ns) // (SLICE_NS * CHUNK)
    edges = np.searchsorted(chunk, np.arange(chunk[-1] + 2)) if len(chunk) else np.zeros(1, np.int64)
    parts = []
    for first, last in pairwise(edges):
        if last > first:
            parts.append(_merged(gathered, path, slice(int(first), int(last))))
            let_go()  # of a window's clusters no more is in memory than those of a chunk
    none = np.zeros(0)
    time_ns, place, scatter, count, draw = (
        (np.concatenate([part[i] for part in parts]) for i in range(5)) if parts else (none, none.reshape(0, 3), none, none, none)
    )  # fmt: skip
    frame = coarse(path)
    clusters = Clusters(
        time_ns.astype(np.int64), np.zeros((len(draw), 3), np.float32), scatter.reshape(-1, 6).astype(np.float32),
        count.astype(np.int32),
    )  # fmt: skip
    origin, mats = placed(clusters, frame)
    inside = np.linalg.solve(mats.reshape(-1, 3, 3).astype(np.float64), (place - origin)[:, :, None])[:, :, 0]
    clusters.xyz_m = inside.astype(np.float32)
    return Patches(clusters, draw.astype(np.float32), np.full(len(draw), window, np.int32))


class _Merged(NamedTuple):
    """The merged clusters of each voxel.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (voxels,)
        Mean time.
    mean_m : ndarray, shape (voxels, 3)
    scatter_m2 : ndarray, shape (voxels, 6)
    returns : ndarray, shape (voxels,)
    kind : ndarray of int64, shape (voxels,)
        0 for ground, 1 for other planes, -1 for no plane.
    draw : ndarray, shape (voxels,)
        In [0, 1), by the place.
    """

    time_ns: Ints
    mean_m: Array
    scatter_m2: Array
    returns: Array
    kind: Ints
    draw: Array


def _merged(gathered: Clusters, path: Path, chunk: slice) -> tuple[npt.NDArray[Any], ...]:
    """Time, place, scatter, returns and draw of the patches of a chunk."""
    place = places(
        Clusters(gathered.time_ns[chunk], gathered.xyz_m[chunk], gathered.scatter_m2[chunk], gathered.count[chunk]),
        path,
    )
    voxel, voxels = assign(place, PATCH_M)
    order, first = sorted_by(voxel, voxels)
    out = _Merged(
        np.empty(voxels, np.int64), np.empty((voxels, 3)), np.empty((voxels, 6)), np.empty(voxels), np.empty(voxels, np.int64),
        np.empty(voxels),
    )  # fmt: skip
    # the chunk is some seconds long: its clusters need no knots and no groups
    none = np.empty(0, np.int32)
    seen = Placed(place, gathered.scatter_m2[chunk], gathered.count[chunk], none, none)
    _merge(first, order, gathered.time_ns[chunk], seen, out)
    shares = np.append(even_shares(np.bincount(out.kind[out.kind >= 0], minlength=2), KEPT), 0.0)
    kept = out.draw < shares[out.kind]
    return out.time_ns[kept], out.mean_m[kept], out.scatter_m2[kept], out.returns[kept], out.draw[kept]


@njit(cache=True, nogil=True)
def _merge(first: Ints, order: Ints, time_ns: Ints, seen: Placed, out: _Merged) -> None:
    """Sum up each voxel."""
    world, scatter, returns = seen.world_m, seen.scatter_m2, seen.returns
    normal = np.empty(3)
    for v in range(len(first) - 1):
        total, since = 0.0, 0.0
        begin_ns = time_ns[order[first[v]]]
        m, s = out.mean_m[v], out.scatter_m2[v]
        m[:], s[:] = 0.0, 0.0
        for at in range(first[v], first[v + 1]):
            n = order[at]
            w = np.float64(returns[n])
            total += w
            since += w * (time_ns[n] - begin_ns)
            for c in range(3):
                m[c] += w * world[n, c]
        m /= total
        for at in range(first[v], first[v + 1]):
            n = order[at]
            w = np.float64(returns[n])
            add_scatter(s, 1.0, scatter[n], w, (world[n, 0] - m[0], world[n, 1] - m[1], world[n, 2] - m[2]))
        out.time_ns[v], out.returns[v] = begin_ns + np.int64(since / total), total
        out.draw[v] = (spread(voxel_key(m[0], m[1], m[2], 1.0 / PATCH_M) * 7919) & 0xFFFFF) / 1048576.0
        out.kind[v] = -1
        if total >= FEWEST:
            low, middle = flattest_of(s, 1.0 / total, normal)
            if low < THICKEST_M**2 and middle > (NARROWEST * PATCH_M) ** 2 and low < 0.15 * middle:
                out.kind[v] = 0 if abs(normal[2]) > 0.9 else 1
