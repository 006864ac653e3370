"""A cloud freed of the sensor's noise: points moved onto the surface that they and their fellows tell, where there is one.

First the noise and the spacing are measured on whole cells of ground all over the cloud. Then it is smoothed square by square, so memory
is that of a square of a million points and of the sample. What lies on no surface stays where it is and says so.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt

from flightlog import __version__
from flightlog.errors import CaptureError, CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.metres import Metres, metres_of, unstated
from groundproc.cloud.reader import Cloud
from groundproc.cloud.rewriter import Rewriter
from groundproc.cloud.selection import standing
from groundproc.cloud.tiles import Found, Tile, Tiles, side_for
from groundproc.files import written_aside
from groundproc.numerics import movingsurface
from groundproc.numerics.cellsample import CellSample
from groundproc.numerics.movingsurface import NO_SURFACE, RADII, RATIO, ROUGH, SMOOTHED, TOO_FAR, TOO_FEW
from groundproc.numerics.normals import Normals, normals

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

_FARTHEST: Final = 3.0
"""Sigmas of the noise by which a point is moved, at most: one farther off is no point of that surface."""
SYSTEM: Final = "MODIFICATION smoothed"
"""What the header says of where the points are from (LAS 1.4 R15, table 5, and what was done)."""
RECORD: Final = ("swath", 2, "how it was smoothed, JSON")
"""User, number and words of the record that tells all of it."""
_LEFT_OUT: Final = 5
"""State of points of a class that is no surface, and of echoes of two surfaces."""
_WORDS: Final = {
    SMOOTHED: "smoothed", NO_SURFACE: "on no surface", ROUGH: "rougher than noise", TOO_FEW: "too few around",
    TOO_FAR: "farther off than noise", _LEFT_OUT: "noise, moving or mixed",
}  # fmt: skip
_SAMPLE: Final = 600_000
_SAMPLE_CELL_M: Final = 4.0
_SMOOTHEST: Final = 0.25
"""The noise is the roughness that this share of the points on surfaces falls below: plaster and paving, not grass."""
_ROUGHEST: Final = 2.0
"""Noises: range and incidence make it larger in places, grass and gravel are rougher."""
_RADIUS_SIGMAS: Final = 5.0
"""The least radius in sigmas: a disc so wide holds the noise, and tells a slope to the tenth of a radian."""
_RADIUS_POINTS: Final = 20.0
"""Points that half of all points have within it."""
_EDGES: Final = (2.0 / 3.0, 4.0 / 3.0, 8.0 / 3.0)
"""Edges of the voxels that normals are told by, in radii: three side by side are as wide as the least disc, twice, and four times."""
_FEWEST: Final = 1000
_LEAST_M, _MOST_M = 0.0005, 1.0
"""Noises that are believed."""
_KEPT: Final = {"usable": "?"}
_FOUND: Final = {"x": "f4", "y": "f4", "z": "f4", "smoothed": "u1", "moved": "f4", "sigma": "f4"}
ADDED: Final = ("smoothed", "smoothing", "smoothing_sigma")


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath smooth`."""

    cloud: Path
    output: Path
    sigma_m: float | None = None


@dataclass(frozen=True, slots=True)
class Scale:
    """By what is smoothed.

    Attributes
    ----------
    sigma_m : float
        Noise along the normals of surfaces.
    stated : bool
        The user said so; else it was measured.
    radius_m : float
        The least.
    """

    sigma_m: float
    stated: bool
    radius_m: float

    @property
    def edges_m(self) -> tuple[float, ...]:
        """Of the voxels that normals are told by."""
        return tuple(each * self.radius_m for each in _EDGES)

    @property
    def farthest_m(self) -> float:
        """By which a point is moved at most."""
        return _FARTHEST * self.sigma_m

    @property
    def halo_m(self) -> float:
        """How far from a point others decide on its place."""
        return self.radius_m * RATIO ** (RADII - 1) + 4.0 * max(self.edges_m)


@dataclass(slots=True)
class Made:
    """What became of the points."""

    points: int
    scale: Scale
    states: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(_WORDS), np.int64))
    square_m2: float = 0.0
    known_m2: float = 0.0
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        smoothed = max(int(self.states[SMOOTHED]), 1)
        return {
            "points": self.points,
            "sigma_m": round(self.scale.sigma_m, 5),
            "sigma_stated": self.scale.stated,
            "radii_m": [round(self.scale.radius_m * RATIO**step, 4) for step in range(RADII)],
            "largest_move_m": round(self.scale.farthest_m, 5),
            "moved_rms_m": round(math.sqrt(self.square_m2 / smoothed), 5),
            "left_sigma_m": round(math.sqrt(self.known_m2 / smoothed), 5),
            "states": {words: int(self.states[state]) for state, words in _WORDS.items()},
            "warnings": self.warnings,
        }


def output_for(cloud: Path) -> Path:
    """Where the smoothed copy of a cloud goes by default."""
    stem = cloud.name.removesuffix(cloud.suffix).removesuffix(".copc")
    return cloud.with_name(f"{stem}_smooth.laz")


def work(task: Task, progress: Progress) -> Made:
    """Smooth a cloud, and write it; `progress` is told of points done, of each three times.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file is not as it should be.
    """
    if task.sigma_m is not None and not _LEAST_M <= task.sigma_m <= _MOST_M:
        raise UsageError(f"--sigma {task.sigma_m:g} m: expected {_LEAST_M:g} to {_MOST_M:g} m, for example 0.015")
    cloud = reader.look(task.cloud)
    if "smoothed" in cloud.columns:
        raise CaptureError(
            f"{cloud.path}: is smoothed already, and would lose what is no noise; expected the cloud that it was made of"
        )
    metres = metres_of(cloud)
    with written_aside(task.output) as aside:
        scale, low, high = _measured(cloud, metres, task.sigma_m, progress)
        made = Made(cloud.points, scale)
        made.warnings += unstated(cloud)
        side = side_for(cloud.points, low.tolist(), high.tolist(), scale.halo_m)
        tiles = Tiles(task.output.parent, _KEPT, side, scale.halo_m)
        for chunk in reader.chunks(cloud, columns=("classification", "mixed")):
            tiles.add(metres.of(chunk.points.xyz_m), {"usable": _usable(chunk)})
            progress(0)
        found = Found(task.output.parent, _FOUND, cloud.points)
        for tile in tiles:
            _smooth(tile, made, found)
            progress(int(tile.core.sum()))
        _write(cloud, metres, made, found, aside, task.output.suffix != ".las", progress)
    return made


def _usable(chunk: reader.Chunk) -> npt.NDArray[np.bool_]:
    """Points that may lie on a surface."""
    columns = chunk.points.columns
    usable = standing(chunk.points)
    if "mixed" in columns:
        usable &= columns["mixed"] == 0
    return usable


def _measured(cloud: Cloud, metres: Metres, stated_m: float | None, progress: Progress) -> tuple[Scale, Array, Array]:
    """Noise and spacing of a cloud, and the corners between which it lies.

    Raises
    ------
    CoverageError
        It has no surface that tells its noise.
    """
    sample = CellSample(_SAMPLE_CELL_M, _SAMPLE)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    bound = _Stated()
    for chunk in reader.chunks(cloud, columns=("classification", "mixed", "sigma_h", "sigma_v")):
        xyz = metres.of(chunk.points.xyz_m)
        low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
        sample.add(xyz[_usable(chunk)])
        bound.add(chunk)
        progress(len(xyz))
    return scale_of(sample.points(), stated_m, bound.largest_m, cloud.path), low, high


class _Stated:
    """The sigma that the cloud states of its points: noise is a part of it, so it is no larger."""

    def __init__(self) -> None:
        self._sum, self._count = 0.0, 0

    def add(self, chunk: reader.Chunk) -> None:
        """Take some points."""
        columns = chunk.points.columns
        if "sigma_h" in columns and "sigma_v" in columns:
            square = (2.0 * np.square(columns["sigma_h"], dtype=np.float64) + np.square(columns["sigma_v"])) / 3.0
            known = np.isfinite(square)
            self._sum += float(square[known].sum())
            self._count += int(known.sum())

    @property
    def largest_m(self) -> float:
        """RMS along any direction; infinite where nothing is stated."""
        return math.sqrt(self._sum / self._count) if self._count else math.inf


def scale_of(sample_m: Array, stated_m: float | None, largest_m: float, path: Path) -> Scale:
    """Noise and radius of a cloud by a sample of whole cells of it.

    Parameters
    ----------
    sample_m : ndarray, shape (n, 3)
    stated_m : float, optional
        The noise, where the user knows it.
    largest_m : float
        What the noise cannot be larger than.
    path : Path
        Named in errors.

    Raises
    ------
    CoverageError
        Not enough of it is a surface.
    """
    lies = normals(sample_m)
    on = np.isfinite(lies.roughness_m)
    if np.count_nonzero(on) < _FEWEST:
        raise CoverageError(
            f"{path}: {np.count_nonzero(on):,} of {len(on):,} points looked at lie on a surface, expected {_FEWEST:,} or more; "
            "nothing tells noise from shape"
        )
    sigma = float(np.quantile(lies.roughness_m[on], _SMOOTHEST)) if stated_m is None else stated_m
    sigma = min(max(sigma, _LEAST_M), largest_m, _MOST_M)
    per_m2 = _density(sample_m[on])
    radius = max(_RADIUS_SIGMAS * sigma, math.sqrt(_RADIUS_POINTS / (math.pi * per_m2)))
    return Scale(sigma, stated_m is not None, radius)


def _density(xyz_m: Array) -> float:
    """Points on a square metre of surface that half of the points have around them."""
    edge = 0.5
    while True:
        _, which, count = np.unique(
            np.floor(xyz_m / edge).astype(np.int64), axis=0, return_inverse=True, return_counts=True
        )
        middle = float(np.median(count[which.reshape(-1)]))
        if middle >= _RADIUS_POINTS or edge > 100.0:
            return middle / edge**2
        edge *= 2.0


def _smooth(tile: Tile, made: Made, found: Found) -> None:
    """Find the places of the points of a square."""
    scale, usable = made.scale, tile.columns["usable"]
    xyz = tile.xyz_m[usable]
    core = tile.core[usable]
    wanted = np.flatnonzero(core)
    count = len(wanted)
    lies = normals(xyz, scale.edges_m) if count else Normals(np.empty((0, 3)), *(np.empty(0) for _ in range(3)))
    fit = movingsurface.fitted(xyz, lies, scale.sigma_m, _ROUGHEST * scale.sigma_m, scale.radius_m, wanted)
    fit.state[(fit.state == SMOOTHED) & (np.abs(fit.off_m) > scale.farthest_m)] = TOO_FAR
    smoothed = fit.state == SMOOTHED
    off = np.where(smoothed, fit.off_m, 0.0)
    move = off[:, None] * np.where(smoothed[:, None], lies.normal[wanted], 0.0)
    number = tile.number[usable][wanted]
    found.put(number, {
        "x": move[:, 0], "y": move[:, 1], "z": move[:, 2], "smoothed": smoothed,
        "moved": np.where(smoothed, off, np.nan), "sigma": np.where(smoothed, fit.sigma_m, np.nan),
    })  # fmt: skip
    others = tile.number[~usable & tile.core]
    found.put(others, {"moved": np.full(len(others), np.nan), "sigma": np.full(len(others), np.nan)})
    made.states += np.bincount(fit.state, minlength=len(made.states))
    made.states[_LEFT_OUT] += len(others)
    made.square_m2 += float(np.square(off).sum())
    made.known_m2 += float(np.square(fit.sigma_m[smoothed]).sum())


def _write(
    cloud: Cloud, metres: Metres, made: Made, found: Found, aside: Path, compressed: bool, progress: Progress
) -> None:
    if not made.states[SMOOTHED]:
        made.warnings.append(
            "no point lies on a surface that its fellows tell better than itself: all stay as they are"
        )
    figures = made.figures() | {"source": cloud.path.name, "software": f"swath {__version__}"}
    record = laspy.VLR(*RECORD, json.dumps(figures).encode())
    at = 0
    with Rewriter(cloud, aside, compressed, ADDED, system=SYSTEM, records=[record]) as writer:
        for chunk in reader.chunks(cloud, columns=()):
            count = len(chunk.points)
            some = found.take(at, count)
            move = metres.back(np.stack([some[axis] for axis in "xyz"], axis=1).astype(np.float64))
            columns = {"smoothed": some["smoothed"], "smoothing": some["moved"], "smoothing_sigma": some["sigma"]}
            writer.write(chunk.record, move, columns)
            at += count
            progress(count)
