"""The map's own surface at given places: planes through the clusters around them, and how clusters move them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from groundproc.estimation.observations.planes import RANGE_SIGMA_M, ROUGHNESS_M, placed
from groundproc.estimation.odometry.clusters import Clusters
from groundproc.estimation.odometry.matching import GROUND
from groundproc.estimation.odometry.spline import Path
from groundproc.numerics import robust
from groundproc.numerics.planerows import HUBER

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

RADII_M: Final = (0.4, 0.7, 1.2, 2.0)
"""How far around a place clusters are taken for its plane: the first radius that gives one."""
FEWEST: Final = 8
THICKEST_M: Final = 0.04
"""Spread across a plane beyond which it is none."""
ACROSS_M: Final = 0.06
"""Clusters as near to a plane as this are of it."""
ALIKE: Final = 0.94
"""Cosine between a stated normal and the surface's, at least: 20 deg."""
CHUNK: Final = 200_000
TRIPLES: Final = 40


@dataclass(frozen=True, slots=True)
class Near:
    """Clusters in reach of some places.

    Attributes
    ----------
    index : ndarray of int64, shape (m,)
        Among all clusters.
    world_m : ndarray, shape (m, 3)
    mats : ndarray, shape (m, 3, 3)
        Local from sensor.
    body_m : ndarray, shape (m, 3)
        In the sensor frame.
    time_ns, count : ndarray, shape (m,)
    scatter_m2 : ndarray, shape (m, 6)
    """

    index: Index
    world_m: Array
    mats: Array
    body_m: Array
    time_ns: Index
    count: Array
    scatter_m2: Array

    def moved(self, mat: Array, about_m: Array, shift_m: Array) -> "Near":
        """The same turned about a point and shifted."""
        return Near(
            self.index,
            about_m + (self.world_m - about_m) @ mat.T + shift_m,
            mat @ self.mats,
            self.body_m,
            self.time_ns,
            self.count,
            self.scatter_m2,
        )


def near(clusters: Clusters, path: Path, places_m: Array, reach_m: float) -> Near:
    """Clusters within reach of any of the places, shape (k, 3), where the path puts them."""
    tree = cKDTree(places_m)
    low, high = places_m.min(axis=0) - reach_m, places_m.max(axis=0) + reach_m
    found: list[tuple[Index, Array, Array]] = []
    for first in range(0, len(clusters), CHUNK):
        part = slice(first, first + CHUNK)
        piece = Clusters(clusters.time_ns[part], clusters.xyz_m[part], clusters.scatter_m2[part], clusters.count[part])
        world, rotation = placed(piece, path)
        kept = np.flatnonzero(((world > low) & (world < high)).all(axis=1))
        kept = kept[np.isfinite(tree.query(world[kept], distance_upper_bound=reach_m)[0])]
        found.append((kept + first, world[kept], rotation[kept].reshape(-1, 3, 3).astype(np.float64)))
    index, world, mats = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Near(
        index,
        world,
        mats,
        clusters.xyz_m[index].astype(np.float64),
        clusters.time_ns[index],
        clusters.count[index].astype(np.float64),
        clusters.scatter_m2[index].astype(np.float64),
    )


@dataclass(frozen=True, slots=True)
class Surface:
    """The plane at a place.

    Attributes
    ----------
    along : ndarray, shape (3,)
        What distances from it are measured along: the vertical for ground, whose normal leans by chance, else the normal.
    slope : float
        Tangent of the ground's lean, which the vertical leaves out; 0 where the normal serves.
    distance_m : float
        Of the place from the surface, along that.
    rows : ndarray of int64, shape (m,)
        Clusters of the plane, in `Near`.
    shares : ndarray, shape (m,)
        What each moves the surface there by when it moves along; their sum is 1, or nearly.
    sigma_m : float
        Of the surface there, along.
    """

    along: Array
    slope: float
    distance_m: float
    rows: Index
    shares: Array
    sigma_m: float


def surfaces(
    seen: Near, places_m: Array, normals: Sequence[Array | None], gate_m: float, deflation: float
) -> list[Surface | None]:
    """The surface at each place, None where there is none.

    Parameters
    ----------
    seen : Near
    places_m : ndarray, shape (k, 3)
    normals : sequence of ndarray or None
        Stated for some places: only surfaces like them count.
    gate_m : float
        Where several surfaces are in reach, one within about so much is taken before larger ones.
    deflation : float
        What the clusters' information is divided by.
    """
    if not len(seen.index):
        return [None] * len(places_m)
    tree = cKDTree(seen.world_m)
    return [
        _surface(seen, tree, place, normal, gate_m, deflation) for place, normal in zip(places_m, normals, strict=True)
    ]


def _surface(
    seen: Near, tree: cKDTree, place: Array, normal: Array | None, gate_m: float, deflation: float
) -> Surface | None:
    for radius in RADII_M:
        rows = np.array(sorted(tree.query_ball_point(place, radius)), np.int64)
        if len(rows) < FEWEST:
            continue
        found = _plane(seen.world_m[rows], seen.count[rows], place, normal, gate_m)
        if found is None:
            continue
        across, members = found
        made = _made(seen, rows[members], across, place, radius, deflation)
        if made is not None:
            return made
    return None


def _plane(
    world: Array, count: Array, place: Array, wanted: Array | None, gate_m: float
) -> tuple[Array, npt.NDArray[np.bool_]] | None:
    """Normal and members of the plane with the most returns, those through the place before others: a consensus of triples."""
    rng = np.random.default_rng(len(world))
    off = world - place
    corners = off[rng.integers(0, len(world), (TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-3
    if wanted is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            good &= np.abs(normals @ wanted) > ALIKE * length
    if not good.any():
        return None
    normals, corner = normals[good] / length[good, None], corners[good, 0]
    level = np.einsum("ni,ni->n", normals, corner)
    member = np.abs(off @ normals.T - level) < ACROSS_M
    score = (np.minimum(count, 20.0)[:, None] * member).sum(axis=0) / (1.0 + np.square(level / gate_m))
    best = int(np.argmax(score))
    members, normal = member[:, best], normals[best]
    for _ in range(2):
        if members.sum() < FEWEST:
            return None
        weights = np.minimum(count[members], 20.0)
        middle = np.average(off[members], axis=0, weights=weights)
        spread = off[members] - middle
        values, vectors = np.linalg.eigh((weights[:, None] * spread).T @ spread / weights.sum())
        normal = vectors[:, 0]
        away = np.abs((off - middle) @ normal)
        members = away < ACROSS_M
    # a slab cut out of other surfaces has as much beside it
    beside = (away < 3.0 * ACROSS_M).sum() - members.sum()
    if values[0] > THICKEST_M**2 or values[1] < 9.0 * values[0] or members.sum() < max(FEWEST, beside):
        return None
    if wanted is not None and abs(normal @ wanted) < ALIKE:
        return None
    return normal if normal[2] >= 0 else -normal, members


def _made(seen: Near, rows: Index, normal: Array, place: Array, radius: float, deflation: float) -> Surface | None:
    """The plane solved for at the place, with what each cluster says of it."""
    off = seen.world_m[rows] - place
    a = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    u, v, distance = off @ a, off @ b, off @ normal
    if np.hypot(u, v).min() > 0.5 * radius:
        return None
    s = seen.scatter_m2[rows]
    x, y, z = normal
    across = (
        x * (s[:, 0] * x + 2 * s[:, 1] * y + 2 * s[:, 2] * z) + y * (s[:, 3] * y + 2 * s[:, 4] * z) + s[:, 5] * z * z
    ) / seen.count[rows]
    whole = 1.0 / (np.maximum(RANGE_SIGMA_M**2, across) / seen.count[rows] + ROUGHNESS_M**2)
    weight = whole
    columns = np.stack([np.ones_like(u), u, v], axis=1)
    for _ in range(3):
        inverse = np.linalg.inv((weight[:, None] * columns).T @ columns + np.diag([1e-9, 1e-3, 1e-3]))
        shares = (columns * weight[:, None]) @ inverse[0]
        plane = inverse @ (columns.T @ (weight * distance))
        off_plane = np.abs(distance - columns @ plane) * np.sqrt(whole)
        weight = whole * robust.huber(off_plane, HUBER)
    ground = z > GROUND
    scale = 1.0 / z if ground else 1.0
    # a place has the relief that the clusters have about their plane
    relief = max(ROUGHNESS_M, float(np.sqrt(np.average(np.square(distance - columns @ plane), weights=weight))))
    sigma = np.hypot(np.sqrt(deflation * inverse[0, 0]), relief) * scale
    return Surface(
        np.array([0.0, 0.0, 1.0]) if ground else normal,
        float(np.hypot(x, y) / z) if ground else 0.0,
        float(-plane[0] * scale),
        rows,
        shares,
        float(sigma),
    )
