"""Core points on the surfaces of a cloud: one in each voxel, with its normal and the area that it stands for."""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from groundproc.numerics.normals import normals
from groundproc.numerics.voxelhash import assign

Array = npt.NDArray[np.float64]

EDGES_M: Final = (0.15, 0.3, 0.6, 1.2)
HALO_M: Final = 4.0 * EDGES_M[-1]
_STEEP: Final = 0.2
"""A normal less upright than this [-] is that of a wall: which side of it is free has to be found."""
_BESIDE_M: Final = 2.0


class Cores(NamedTuple):
    """Core points.

    Attributes
    ----------
    row : ndarray of int64, shape (k,)
        Of the point of the cloud.
    normal : ndarray, shape (k, 3)
        Out of the ground: upwards, or away from what is behind a wall.
    area_m2 : ndarray, shape (k,)
        Of the surface that each stands for.
    """

    row: npt.NDArray[np.int64]
    normal: Array
    area_m2: Array


def cores(xyz_m: Array, spacing_m: float) -> Cores:
    """Choose core points.

    Parameters
    ----------
    xyz_m : ndarray, shape (n, 3)
        From a corner at a multiple of the spacing, so that neighbouring pieces choose alike.
    spacing_m : float

    Returns
    -------
    Cores
        None in leaves, which are no surface.
    """
    lies = normals(xyz_m, EDGES_M)
    on = np.flatnonzero(np.isfinite(lies.sigma_rad))
    if not len(on):
        return Cores(on, np.empty((0, 3)), np.empty(0))
    index = on[_middle_of_each(xyz_m[on], spacing_m)]
    normal = _outward(xyz_m, xyz_m[index], lies.normal[index])
    return Cores(index, normal, _areas(np.floor(xyz_m[index] / spacing_m).astype(np.int64), normal, spacing_m))


def _middle_of_each(xyz: Array, edge_m: float) -> npt.NDArray[np.int64]:
    """The point of each voxel that is nearest to the mean of its points."""
    voxel, voxels = assign(xyz, edge_m)
    count = np.bincount(voxel, minlength=voxels)
    mean = np.stack([np.bincount(voxel, xyz[:, axis], voxels) / count for axis in range(3)], axis=1)
    away = np.square(xyz - mean[voxel]).sum(axis=1)
    order = np.lexsort((away, voxel))
    return np.asarray(order[np.r_[0, np.cumsum(count)[:-1]]], np.int64)


def _outward(xyz: Array, places: Array, normal: Array) -> Array:
    """Normals upwards; those of walls towards the side whose ground is lower, where the other holds the wall up."""
    out = np.where(normal[:, 2:] < 0.0, -normal, normal)
    steep = np.flatnonzero(out[:, 2] < _STEEP)
    if len(steep):
        voxel, voxels = assign(xyz, 0.5)
        count = np.bincount(voxel, minlength=voxels)
        mean = np.stack([np.bincount(voxel, xyz[:, axis], voxels) / count for axis in range(3)], axis=1)
        plan = cKDTree(mean[:, :2])
        level = out[steep].copy()
        level[:, 2] = 0.0
        level /= np.linalg.norm(level, axis=1)[:, None]
        heights = [_highest(plan, mean, (places[steep] + side * _BESIDE_M * level)[:, :2]) for side in (1.0, -1.0)]
        turned = heights[0] > heights[1]
        out[steep[turned]] *= -1.0
    return np.asarray(out)


def _highest(plan: Any, mean: Array, places: Array) -> Array:
    """Height of what is nearest in plan; where nothing is, that of nothing."""
    away, at = plan.query(places, distance_upper_bound=1.0)
    found = np.isfinite(away)
    return np.where(found, mean[np.where(found, at, 0), 2], -np.inf)


def _areas(voxel: npt.NDArray[np.int64], normal: Array, spacing_m: float) -> Array:
    """Of the surface in each column of voxels along the axis that the normal is nearest to, shared by those that lie in it."""
    axis = np.argmax(np.abs(normal), axis=1)
    across = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    rows = np.arange(len(voxel))
    keys = np.column_stack([axis, voxel[rows, across[:, 0]], voxel[rows, across[:, 1]], voxel[rows, axis]])
    order = np.lexsort(keys.T[::-1])
    step = np.diff(keys[order], axis=0)
    new = np.r_[True, (step[:, :3] != 0).any(axis=1) | (step[:, 3] > 1)]
    run = np.cumsum(new) - 1
    shared = np.empty(len(voxel))
    shared[order] = np.bincount(run)[run]
    return np.asarray(spacing_m**2 / np.abs(normal[rows, axis]) / shared)
