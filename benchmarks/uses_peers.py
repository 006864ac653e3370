"""CPU time and errors beside libraries that do the same, one thread each: a part of `uses.py`.

Left out where a library is not installed, as pgeof, which nothing else needs. py4dgeo is beside `swath change --surface` in
uses_change.py, GDAL beside `swath viewshed` in uses_sight.py; trees of neighbours are scipy's own.

registration_cpu_s, registration_corner_mm
                     of two clouds of hills with boxes, 100 x 100 m, 1 cm of noise, 0.3 m and 0.3 deg apart: time, worst corner
registration_block_corner_mm
                     where a block of 30 % has moved by 18 cm in between
registration_..._small_gicp
                     the same by its GICP on voxels of 0.25 m
normals_cpu_s, normals_deg, ..._pgeof
                     normals of hills with 1 cm of noise: time, median error; pgeof's features of 24 neighbours, found by itself
"""

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Figures = dict[str, Any]
SIDE_M: Final = 100.0
POINTS: Final = 500_000
BOXES: Final = 15
NEIGHBOURS: Final = 24
TURN: Final = Rotation.from_rotvec(np.radians([0.1, -0.05, 0.28]))
SHIFT_M: Final = np.array([0.2, -0.18, 0.12])


def hills(seed: int, points: int = POINTS) -> Array:
    """Hills with boxes of their own walls, always the same, sampled anew."""
    rng, places = np.random.default_rng(seed), np.random.default_rng(1)
    xy = rng.uniform(0, SIDE_M, (points, 2))
    z = 1.5 * np.sin(xy[:, 0] / 11) + 1.1 * np.cos(xy[:, 1] / 8)
    parts = []
    for _ in range(BOXES):
        middle, half, top = places.uniform(8, SIDE_M - 8, 2), places.uniform(2, 5, 2), places.uniform(3, 7)
        z[(np.abs(xy - middle) < half).all(axis=1)] = top
        for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
            count = int(points / SIDE_M**2 * 4 * half[1 - axis])
            wall = np.column_stack([middle + half * rng.uniform(-1, 1, (count, 2)), rng.uniform(0, top, count)])
            wall[:, axis] = middle[axis] + sign * half[axis]
            parts.append(wall)
    xyz = np.concatenate([np.column_stack([xy, z]), *parts])
    return np.asarray(xyz + rng.normal(0, 0.01, xyz.shape))


def registration() -> Figures:
    """Two clouds laid on each other, with and without a block that moved."""
    from groundproc.analysis.registration import register

    a, b = hills(1), hills(2)
    moved = b.copy()
    moved[(b[:, :2] < 0.55 * SIDE_M).all(axis=1)] += (0.1, 0.0, -0.15)
    register(a[::10], b[::10])  # compiled
    found: Figures = {}
    for name, lay in (("", lambda a, b: register(a, b).matrix), ("_small_gicp", _by_small_gicp)):
        if name and find_spec("small_gicp") is None:
            continue
        begun = time.process_time()
        found[f"registration_corner_mm{name}"] = _worst_mm(lay(a, _off(b)))
        found[f"registration_cpu_s{name}"] = round(time.process_time() - begun, 2)
        found[f"registration_block_corner_mm{name}"] = _worst_mm(lay(a, _off(moved)))
    return found


def _off(xyz: Array) -> Array:
    return np.asarray(TURN.inv().apply(xyz - SHIFT_M))


def _worst_mm(matrix: Array) -> float:
    """How far the worst corner of the place is off."""
    corners = SIDE_M * np.stack(np.meshgrid([0, 1], [0, 1], [0.0]), axis=-1).reshape(-1, 3)
    laid = _off(corners) @ matrix[:3, :3].T + matrix[:3, 3]
    return round(1000.0 * float(np.linalg.norm(laid - corners, axis=1).max()), 2)


def _by_small_gicp(a: Array, b: Array) -> Array:
    import small_gicp

    (target, tree), (source, _) = (
        small_gicp.preprocess_points(each, downsampling_resolution=0.25, num_threads=1) for each in (a, b)
    )
    return np.asarray(small_gicp.align(target, source, tree, max_correspondence_distance=1.0).T_target_source)


def normals() -> Figures:
    """Normals of hills, those of boxes and their walls aside."""
    from groundproc.numerics.normals import normals as ours

    xyz = hills(3)
    up = np.column_stack([-1.5 / 11 * np.cos(xyz[:, 0] / 11), 1.1 / 8 * np.sin(xyz[:, 1] / 8), np.ones(len(xyz))])
    up /= np.linalg.norm(up, axis=1)[:, None]
    hill = np.abs(xyz[:, 2] - 1.5 * np.sin(xyz[:, 0] / 11) - 1.1 * np.cos(xyz[:, 1] / 8)) < 0.05
    ours(xyz[::50])  # compiled
    found: Figures = {}
    for name, made in (("", lambda xyz: ours(xyz).normal), ("_pgeof", _by_pgeof)):
        if name and find_spec("pgeof") is None:
            continue
        begun = time.process_time()
        normal = made(xyz)
        found[f"normals_cpu_s{name}"] = round(time.process_time() - begun, 2)
        cosine = np.abs(np.einsum("ni,ni->n", normal, up))[hill]
        found[f"normals_deg{name}"] = round(float(np.rad2deg(np.arccos(min(np.nanmedian(cosine), 1.0)))), 3)
    return found


def _by_pgeof(xyz: Array) -> Array:
    import pgeof

    places = np.ascontiguousarray(xyz, np.float32)
    near, _ = pgeof.knn_search(places, places, NEIGHBOURS)
    first = np.arange(0, NEIGHBOURS * len(places) + 1, NEIGHBOURS, dtype=np.uint32)
    features = pgeof.compute_features(places, np.ascontiguousarray(near.ravel(), np.uint32), first)
    return np.asarray(features[:, 4:7], np.float64)


FIGURES: Final[dict[str, Callable[[], Figures]]] = {"registration": registration, "normals": normals}
