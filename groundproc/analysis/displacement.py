"""How places moved between two epochs, as vectors in space: patches of the later cloud laid on the earlier one.

A distance along a normal says nothing about ground that slides along itself. A patch with relief is determined in all
three directions: its later points are laid on the earlier ones with a shift and a rotation of their own
(`registration`). Without relief, the prior of a metre is left, and the sigma says so. Memory: a square of a million
points.
"""

import warnings as python_warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.spatial import cKDTree
from scipy.stats import f

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis.epochs import Epochs, laid
from groundproc.analysis.registration import register
from groundproc.cloud import reader
from groundproc.cloud.metres import unstated
from groundproc.cloud.tiles import Tile, Tiles, side_for
from groundproc.files import written_aside
from groundproc.numerics.normals import normals
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

RADIUS_M: Final = 6.0
_MOST: Final = 15_000
"""Points of a patch in each epoch: more tell nothing new."""
_FEWEST: Final = 400
_GROUP_M: Final = 4.0
"""Residuals within a square like this are one group in the covariance of a registration."""
_RELIEF: Final = 10.0
"""A direction is told where normals lean towards it by so many times the square of their sigma, at least ..."""
_LEAST_RELIEF_RAD: Final = 0.03
"""... and this."""
_LEAST_GROUPS: Final = 8.0
"""Fewer tell no covariance of six unknowns."""
_ROUNDED_M: Final = 1e-4
"""No coordinate is written better: a cloud against itself has no other error."""
_UNTOLD_M: Final = 0.5
"""A direction whose sigma is that large was not told by the relief."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath displacement`.

    Attributes
    ----------
    a, b, output : Path
    radius_m : float
        Of a patch.
    spacing_m : float or None
        Between patches; default: the radius.
    registered : bool
        They lie on each other already.
    """

    a: Path
    b: Path
    output: Path
    radius_m: float = RADIUS_M
    spacing_m: float | None = None
    registered: bool = False


@dataclass(frozen=True, slots=True)
class Vector:
    """How a patch moved.

    Attributes
    ----------
    place_m, moved_m : ndarray, shape (3,)
    covariance : ndarray, shape (3, 3)
        That of laying the epochs on each other included.
    groups : float
        That it was told from.
    turn_rad : float
    fit : float
        Share of its points that lie on the earlier ones in the end.
    """

    place_m: Array
    moved_m: Array
    covariance: Array
    groups: float
    turn_rad: float
    fit: float

    @property
    def significant(self) -> bool:
        """Whether it moved, at 95 %: by Hotelling's test, as the covariance is told from a few groups only."""
        free = self.groups - 1
        level = 3.0 * free / (free - 2) * f.ppf(0.95, 3, free - 2)
        covariance = self.covariance + _ROUNDED_M**2 * np.eye(3)
        return bool(self.moved_m @ np.linalg.solve(covariance, self.moved_m) > level)


@dataclass(slots=True)
class Made:
    """What was found."""

    registration_sigma_m: float | None
    vectors: list[Vector] = field(default_factory=list)
    without: int = 0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        sure = [each for each in self.vectors if each.significant]
        return {
            "patches": len(self.vectors), "moved": len(sure), "patches_without_relief_or_points": self.without,
            "largest_m": max((float(np.linalg.norm(each.moved_m)) for each in sure), default=None),
            "registration_sigma_m": self.registration_sigma_m, "warnings": self.warnings,
        }  # fmt: skip


def work(task: Task, progress: Progress) -> Made:
    """Measure, and write; `progress` is told of points done.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file is not as it should be.
    """
    spacing = task.spacing_m or task.radius_m
    for word, value in (("radius", task.radius_m), ("spacing", spacing)):
        if not 0.5 <= value <= 500.0:
            raise UsageError(f"--{word} {value:g} m: expected 0.5 to 500 m, for example {RADIUS_M:g}")
    clouds = (reader.look(task.a), reader.look(task.b))
    epochs = laid(clouds, (None, None), task.registered, lambda stage, count: progress(count))
    made = Made(None if task.registered else epochs.registration.sigma_m)
    made.warnings += unstated(*clouds)
    shift = np.zeros((3, 3)) if task.registered else epochs.registration.covariance[:3, :3]
    with written_aside(task.output) as aside:
        for tile in _tiles(task, epochs, progress):
            found, without = _of_tile(tile, task.radius_m, spacing, shift)
            made.vectors += found
            made.without += without
            progress(int(tile.core.sum()))
        _write(aside, task.output.suffix, epochs, made.vectors)
    if not made.vectors:
        made.warnings.append(
            f"{task.b}: no patch of {task.radius_m:g} m has {_FEWEST} points on surfaces in both epochs, and relief; see --radius"
        )
    return made


def _tiles(task: Task, epochs: Epochs, progress: Progress) -> Tiles:
    halo = 2.0 * task.radius_m
    points = sum(cloud.points for cloud in epochs.clouds)
    tiles = Tiles(
        task.output.parent, {"epoch": "u1"}, side_for(points, epochs.low.tolist(), epochs.high.tolist(), halo), halo
    )
    for number in range(2):
        for chunk, xyz, _ in epochs.chunks(number):
            some = xyz[epochs.standing(chunk)]
            tiles.add(some, {"epoch": np.full(len(some), number, np.uint8)})
            progress(len(xyz))
    return tiles


def _of_tile(tile: Tile, radius_m: float, spacing_m: float, shift: Array) -> tuple[list[Vector], int]:
    """Vectors of the patches whose middle lies in the square itself, and how many patches tell none."""
    a, b = (tile.xyz_m[tile.columns["epoch"] == number] for number in range(2))
    if not len(a) or not len(b):
        return [], 0
    core = tile.xyz_m[tile.core]
    cells = np.unique(np.floor(core[:, :2] / spacing_m).astype(np.int64), axis=0)
    middles = (cells + 0.5) * spacing_m
    trees = [cKDTree(each[:, :2]) for each in (a, b)]
    every = cKDTree(tile.xyz_m[:, :2])
    found, without = [], 0
    for middle in middles:
        # of two squares it is that of the point next to it
        if not tile.core[int(every.query(middle)[1])]:
            continue
        near = [np.sort(np.array(tree.query_ball_point(middle, radius_m), np.int64)) for tree in trees]
        parts = [each[rows] for each, rows in zip((a, b), near, strict=True)]
        vector = patch_moved(parts[0], parts[1], shift) if min(map(len, parts)) >= _FEWEST else None
        if vector is None:
            without += 1
        else:
            found.append(vector)
    return found, without


def patch_moved(a_m: Array, b_m: Array, shift: Array) -> Vector | None:
    """How a patch moved from the earlier points to the later ones; None where too little of it is surface.

    Parameters
    ----------
    a_m, b_m : ndarray, shape (n, 3)
    shift : ndarray, shape (3, 3)
        Covariance of laying the epochs on each other.
    """
    _, count = np.unique(np.floor(b_m[:, :2] / _GROUP_M).astype(np.int64), axis=0, return_counts=True)
    groups = float(len(b_m) ** 2 / np.sum(count.astype(np.float64) ** 2))  # those cut by the rim count for less
    if groups < _LEAST_GROUPS:
        return None
    a, b = (each[:: max(1, len(each) // _MOST)] for each in (a_m, b_m))
    try:
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("error", RuntimeWarning)
            found = register(a, b, "a patch")
    except (CoverageError, RuntimeWarning):
        return None
    middle = b.mean(axis=0)
    back = found.move(middle[None])[0]
    covariance = found.covariance[:3, :3] + shift + _untold(a)
    turn = float(np.arccos(np.clip((np.trace(found.matrix[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return Vector(back, middle - back, covariance, groups, turn, found.fit)


def _untold(xyz_m: Array) -> Array:
    """Covariance of directions that no relief tells: normals differ there by no more than their own noise does.

    That noise looks like relief to least squares, which then hold a plane that slides along itself.
    """
    planes = normals(xyz_m)
    good = np.isfinite(planes.sigma_rad)
    normal, noise = planes.normal[good], float(np.median(planes.sigma_rad[good])) ** 2
    values, ways = np.linalg.eigh(normal.T @ normal / max(len(normal), 1))
    blind = ways[:, values < _RELIEF * noise + _LEAST_RELIEF_RAD**2]
    return np.asarray(blind @ blind.T)


def _write(aside: Path, ending: str, epochs: Epochs, vectors: list[Vector]) -> None:
    """A line from where each patch was to where it is."""
    sigma = np.array([np.sqrt(np.diag(each.covariance)) for each in vectors]).reshape(-1, 3)
    moved = np.array([each.moved_m for each in vectors]).reshape(-1, 3)
    length = np.linalg.norm(moved, axis=1)
    along = moved / np.maximum(length, 1e-9)[:, None]
    columns: dict[str, npt.NDArray[Any]] = {"moved_m": length}
    columns["sigma_m"] = np.array(
        [np.sqrt(way @ each.covariance @ way) for way, each in zip(along, vectors, strict=True)], np.float64
    )
    for axis, name in enumerate(("east", "north", "up")):
        columns[f"{name}_m"], columns[f"{name}_sigma_m"] = moved[:, axis], sigma[:, axis]
    columns["significant"] = np.array([int(each.significant) for each in vectors], np.int32)
    columns["told"] = np.array([int(np.max(row) < _UNTOLD_M) for row in sigma], np.int32)
    columns["turn_deg"] = np.array([np.rad2deg(each.turn_rad) for each in vectors], np.float64)
    columns["fit"] = np.array([each.fit for each in vectors], np.float64)
    ends = [np.array([each.place_m, each.place_m + each.moved_m]) for each in vectors]
    shapes = [shapely.LineString(epochs.metres.back(each)) for each in ends]
    write_features(
        aside, Features(np.array(shapes, object), columns, epochs.crs), "LineString Z", "displacement", ending
    )
