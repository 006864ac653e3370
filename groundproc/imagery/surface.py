"""The lidar's surface at tie points: planes that points are observed to lie on."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from flightlog.errors import CaptureError
from groundproc.cloud import reader
from groundproc.cloud.selection import SURFACES
from groundproc.imagery.bundle.block import LIDAR, Block, PointRows, joined_rows
from groundproc.imagery.site import Site

Array = npt.NDArray[np.float64]

NEIGHBOURS: Final = 14
FARTHEST_M: Final = 1.0
"""A plane is laid through neighbours within so far of the tie point, in plan."""
ROUGHEST_M: Final = 0.06
"""RMS of those off their plane beyond which there is no surface to lie on."""
STEEPEST: Final = 0.5
"""Vertical component of the normal: a wall is seen from the side and has few points in plan."""
LIDAR_SIGMA_M: Final = 0.03
"""Of a lidar plane at a place, alone."""
MOST_ROWS: Final = 1500
_CELL_M: Final = 0.1
_MOST_POINTS: Final = 8_000_000
_WITHIN_M: Final = 1.0


@dataclass(frozen=True, slots=True)
class Surface:
    """Points of a cloud in the local frame, thinned.

    Attributes
    ----------
    points_m : ndarray, shape (n, 3)
    tree : cKDTree
        Of their plan.
    """

    points_m: Array
    tree: cKDTree

    @property
    def ground_m(self) -> float:
        """Median height."""
        return float(np.median(self.points_m[:, 2]))


def read_surface(path: Path, site: Site, told: Callable[[int], None]) -> Surface:
    """A cloud thinned to one point in a cell of 10 cm, in the local frame.

    Raises
    ------
    CaptureError
        It cannot be read, or has no points.
    """
    cloud = reader.look(path, SURFACES)
    cell = _CELL_M
    parts: list[Array] = []
    total = 0
    for chunk in reader.chunks(cloud, columns=()):
        places = np.asarray(chunk.points.xyz_m, np.float64)
        parts.append(_thinned(places, cell))
        total += len(parts[-1])
        told(len(places))
        if total > _MOST_POINTS:
            cell *= 1.5
            parts = [_thinned(np.concatenate(parts), cell)]
            total = len(parts[0])
    if not total:
        raise CaptureError(f"{path}: has no points")
    points = site.local(_thinned(np.concatenate(parts), cell))
    return Surface(points, cKDTree(points[:, :2]))


def _thinned(places: Array, cell_m: float) -> Array:
    """The first point of each cell."""
    key: npt.NDArray[np.int64] = np.floor((places - places.min(axis=0)) / cell_m).astype(np.int64)
    _, first = np.unique(key, axis=0, return_index=True)
    return np.asarray(places[np.sort(first)])


def held_to(block: Block, surface: Surface) -> Block:
    """The block with rows of the surface in place of those that it had."""
    control = block.rows.masked(block.rows.source != LIDAR)
    rows = rows_at(block, surface)
    return replace(block, rows=joined_rows(control, rows))


def rows_at(block: Block, surface: Surface) -> PointRows:
    """Planes at the tie points that lie on one: three images or more, a smooth surface around, and not far from it."""
    seen = np.bincount(block.measured.point[block.measured.weight > 0.0], minlength=len(block.points_m))
    controlled = np.zeros(len(block.points_m), np.bool_)
    controlled[block.rows.point[block.rows.source != LIDAR]] = True
    chosen = np.flatnonzero((seen >= 2) & ~controlled)
    distance, near = surface.tree.query(block.points_m[chosen, :2], k=NEIGHBOURS, distance_upper_bound=FARTHEST_M)
    full = np.asarray(np.isfinite(distance).all(axis=1))
    chosen, near = chosen[full], np.asarray(near)[full]
    if not len(chosen):
        none = np.empty(0)
        return PointRows(chosen, np.empty((0, 3)), none, none, none, np.empty(0, np.int64))
    neighbours = surface.points_m[near]
    middle = neighbours.mean(axis=1)
    values, axes = np.linalg.eigh(np.einsum("kni,knj->kij", neighbours - middle[:, None], neighbours - middle[:, None]))
    rough = np.sqrt(np.maximum(values[:, 0], 0.0) / NEIGHBOURS)
    normal = axes[:, :, 0] * np.sign(axes[:, 2, 0] + 1e-12)[:, None]
    off = np.einsum("ki,ki->k", normal, block.points_m[chosen] - middle)
    usual = float(np.median(np.abs(off - np.median(off))))
    # a block whose heights are not yet right lies off the surface as a whole
    close = np.abs(off - np.median(off)) < max(_WITHIN_M / 4.0, 4.0 * 1.5 * usual)
    good = (rough < ROUGHEST_M) & (normal[:, 2] > STEEPEST) & close & (values[:, 1] > 4.0 * values[:, 0])
    kept = np.flatnonzero(good)
    if len(kept) > MOST_ROWS:
        kept = kept[np.argsort(-seen[chosen[kept]], kind="stable")[:MOST_ROWS]]
        kept.sort()
    sigma = np.hypot(LIDAR_SIGMA_M, rough[kept])
    count = len(kept)
    return PointRows(
        chosen[kept], normal[kept], np.einsum("ki,ki->k", normal[kept], middle[kept]), sigma, np.ones(count),
        np.full(count, LIDAR),
    )  # fmt: skip
