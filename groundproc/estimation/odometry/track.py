"""What the forward pass of the odometry found, slice after slice, with what the batch needs of each."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog import frames
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.grid import SLICE_NS, STEP_NS, STEPS
from groundproc.estimation.odometry.growing import Growing
from groundproc.estimation.odometry.motion import Motion, MotionGrid
from groundproc.estimation.odometry.slices import CLUSTER_DTYPE
from groundproc.estimation.odometry.spline import Path, integrated, smooth_path
from groundproc.estimation.odometry.voxels import FLATNESS, NORMAL, MapArrays, PlaneMap, find
from groundproc.numerics.voxelhash import spread, voxel_key

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

KEPT: Final = 1200
"""Clusters of a slice that are kept for the batch."""
GROUND, UPRIGHT, SHAPELESS = 0, 1, 2
"""Kinds of voxels: level planes, other planes, and what is no plane."""
LEANING: Final = 0.03
"""What normals of one wall differ by, one sigma [rad]: no direction of its own."""
NO_CLUSTERS: Final = np.empty(0, CLUSTER_DTYPE)


@dataclass(slots=True)
class Track:
    """What the forward pass found.

    Attributes
    ----------
    first : int
        Number of the first slice.
    quat, position_m : Growing
        Poses of the sensor at the slice boundaries, one more than there are slices.
    velocity_m_s, gyro_bias : Growing
        At the end of each slice.
    sigma : Growing
        Of attitude [rad] and position [m] there.
    clusters : list of ndarray of CLUSTER_DTYPE
        Of each slice; empty where the lidar was silent.
    matched, seen : list of int
        Clusters that found a plane, and all.
    residual_m : list of float
    unheld_m, next_unheld_m : list of float
        Sigmas of the two directions that a slice observes least.
    quats : list of ndarray or None
        Attitudes on the grid of each slice, shape (STEPS + 1, 4); None where nothing was seen.
    restarts : int
        How often it lost the path.
    astray : int
        How often a guide revealed that: what seemed to hold the path did not.
    fixes, late_fixes : int
        Positions that were used, and those that came too late.
    voxel_m : float
        Final edge of the odometry's voxels.
    rejoined : list of dict
        Pieces that were found again on the map before them, for the report.
    apart : int
        Earlier pieces on which the last one was not found.
    """

    first: int
    quat: Growing = field(default_factory=functools.partial(Growing, 4))
    position_m: Growing = field(default_factory=functools.partial(Growing, 3))
    velocity_m_s: Growing = field(default_factory=functools.partial(Growing, 3))
    gyro_bias: Growing = field(default_factory=functools.partial(Growing, 3))
    sigma: Growing = field(default_factory=functools.partial(Growing, 6))
    clusters: list[npt.NDArray[np.void]] = field(default_factory=list)
    matched: list[int] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    residual_m: list[float] = field(default_factory=list)
    unheld_m: list[float] = field(default_factory=list)
    next_unheld_m: list[float] = field(default_factory=list)
    quats: list[Array | None] = field(default_factory=list)
    restarts: int = 0
    astray: int = 0
    fixes: int = 0
    late_fixes: int = 0
    voxel_m: float = 0.5
    rejoined: list[dict[str, float]] = field(default_factory=list)
    apart: int = 0

    def __len__(self) -> int:
        return len(self.clusters)

    def path(self, motion: Motion, start: int, end: int) -> Path:
        """Smooth path over slices `start` to `end`, counted from the first."""
        grid = slice((self.first + start) * STEPS, (self.first + end) * STEPS)
        bias = np.repeat(self.gyro_bias[start:end], STEPS, axis=0)
        rate = motion.rate_rad_s[grid] - bias.mean(axis=0)
        start_ns = motion.start_ns + (self.first + start) * SLICE_NS
        return smooth_path(start_ns, rate, self.quat[start : end + 1], self.position_m[start : end + 1])

    def causal_path(self, motion: MotionGrid, start: int = 0, end: int | None = None) -> Path:
        """The path over slices `start` to `end` as known at the end of each slice: nothing of what came later is in it."""
        end = len(self) if end is None else end
        count = end - start
        grid = slice((self.first + start) * STEPS, (self.first + end) * STEPS)
        rate = motion.rate_rad_s[grid] - np.repeat(self.gyro_bias[start:end], STEPS, axis=0)
        quats, places = self.quat[start : end + 1], self.position_m[start : end + 1]
        speeds = np.array([self.velocity_m_s[max(start - 1, 0)], *self.velocity_m_s[start:end]])
        share = (np.arange(STEPS) / STEPS)[:, None]
        step_s = SLICE_NS * 1e-9
        quat, position = np.empty((count * STEPS + 1, 4)), np.empty((count * STEPS + 1, 3))
        for i in range(count):
            part, found = slice(i * STEPS, (i + 1) * STEPS), self.quats[start + i]
            if found is None:
                free = integrated(rate[i * STEPS : (i + 1) * STEPS], quats[i])
                off = frames.quat_log(frames.quat_multiply(frames.quat_inverse(free[-1:]), quats[i + 1 : i + 2]))
                quat[part] = frames.quat_multiply(free[:-1], frames.quat_exp(share * off))
            else:
                quat[part] = found[:-1]
            rise = places[i + 1] - places[i]
            # a cubic through both ends with the filter's velocities
            position[part] = (
                places[i]
                + share**2 * (3.0 - 2.0 * share) * rise
                + step_s * share * (1.0 - share) * ((1.0 - share) * speeds[i] - share * speeds[i + 1])
            )
        quat[-1], position[-1] = quats[-1], places[-1]
        return Path(motion.start_ns + (self.first + start) * SLICE_NS, quat, position)

    def drop(self, slices: int) -> None:
        """Drop that many slices at the beginning: a flight that goes on needs the last ones only."""
        self.first += slices
        for table in (
            self.quat, self.position_m, self.velocity_m_s, self.gyro_bias, self.sigma, self.clusters, self.matched,
            self.seen, self.residual_m, self.unheld_m, self.next_unheld_m, self.quats,
        ):  # fmt: skip
            del table[:slices]

    def forget(self, before: int) -> None:
        """Drop the clusters of the slices before one."""
        for i in range(before):
            self.clusters[i] = NO_CLUSTERS

    def gathered(self, start: int, end: int, apart: bool = False) -> Clusters:
        """Clusters of slices `start` to `end` as columns; `apart`: with their lasers."""
        parts = self.clusters[start:end]
        return Clusters(
            np.concatenate([p["time_ns"] for p in parts]),
            np.concatenate([p["xyz"] for p in parts]),
            np.concatenate([p["scatter"] for p in parts]),
            np.concatenate([p["count"] for p in parts]),
            np.concatenate([p["laser"] for p in parts]) if apart else None,
        )


def thinned(clusters: npt.NDArray[np.void], world_m: Array, planes: PlaneMap, most: int) -> npt.NDArray[np.void]:
    """At most about `most` clusters, by voxels and not one by one, so that those kept are seen by many slices.

    Ground, other planes, and what is no plane yet share evenly; of the other planes, the directions that they face do.
    """
    if len(clusters) <= most:
        return clusters
    kind, draw, normal = np.empty(len(clusters), np.int64), np.empty(len(clusters)), np.empty((len(clusters), 3))
    _sort_out(world_m, planes.arrays, kind, draw, normal)
    share_of_kind = even_shares(np.bincount(kind, minlength=3), most)
    share, upright = share_of_kind[kind], kind == UPRIGHT
    share[upright] = shares_by_direction(normal[upright], float(share[upright].sum()))
    return clusters[draw < share]


def shares_by_direction(normal: Array, most: float) -> Array:
    """Share of the planes to keep so that every direction, whatever the axes, gets about as much.

    Planes are kept by leverage, n^T (sum of n n^T)^-1 n, which sums up to one for each direction. A plane whose share
    reaches one is kept whole, and leaves the rest to the others. A few ends of cars thus count beside long walls.

    Parameters
    ----------
    normal : ndarray, shape (n, 3)
    most : float
        How many to keep of them, about.

    Returns
    -------
    ndarray, shape (n,)
    """
    share = np.full(len(normal), min(1.0, most / max(len(normal), 1)))
    if not len(normal) or most >= len(normal):
        return share
    information = normal.T @ normal + len(normal) * LEANING**2 * np.eye(3)
    leverage = np.einsum("ni,ij,nj->n", normal, np.linalg.inv(information), normal)
    whole = np.zeros(len(normal), np.bool_)
    for _ in range(4):
        scale = (most - whole.sum()) / max(leverage[~whole].sum(), 1e-12)
        share = np.where(whole, 1.0, np.minimum(scale * leverage, 1.0))
        whole |= share >= 1.0
    return share


def even_shares(counts: Sequence[int] | npt.NDArray[np.int64], most: int) -> Array:
    """Part of each kind to keep: even numbers, and what one kind does not use goes to the others."""
    share, left = np.ones(len(counts)), float(most)
    for rank, i in enumerate(np.argsort(counts)):
        level = left / (len(counts) - rank)
        share[i] = min(1.0, level / max(int(counts[i]), 1))
        left -= min(level, float(counts[i]))
    return share


@njit(cache=True, nogil=True)
def _sort_out(world: Array, planes: MapArrays, kind: Ints, draw: Array, normal: Array) -> None:
    table, keys, voxels, voxel_m = planes
    for n in range(len(world)):
        key = voxel_key(world[n, 0], world[n, 1], world[n, 2], 1.0 / voxel_m)
        row = find(table, keys, key)
        kind[n] = SHAPELESS
        if row >= 0 and voxels[row, FLATNESS] >= 0.0:
            kind[n] = GROUND if abs(voxels[row, NORMAL + 2]) > 0.9 else UPRIGHT
            normal[n] = voxels[row, NORMAL : NORMAL + 3]
        draw[n] = (spread(key * 7919) & 0xFFFFF) / 1048576.0


def boundaries_ns(track: Track, motion: Motion) -> Ints:
    """UTC of the slice boundaries."""
    return motion.start_ns + (track.first + np.arange(len(track) + 1)) * SLICE_NS


def grid_ns(path: Path) -> Ints:
    """UTC of the grid."""
    return path.start_ns + np.arange(len(path.quat)) * STEP_NS
