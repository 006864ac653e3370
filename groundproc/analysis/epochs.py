"""Two epochs of a place, the later one laid on the earlier: what `swath change` and its surfaces look at."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CoverageError, GeodesyError
from groundproc.analysis.registration import MOST, Registration, register
from groundproc.cloud import reader
from groundproc.cloud.metres import Metres, agreed_metres
from groundproc.cloud.reader import Chunk, Cloud
from groundproc.cloud.sameness import same
from groundproc.cloud.selection import CLASS, standing
from groundproc.radiometry.sensorpath import Flown, SensorPath, Tally

Array = npt.NDArray[np.float64]
Progress = Callable[[str, int], object]

_SQUARE_M: Final = 5.0


@dataclass(frozen=True, slots=True)
class Epochs:
    """The earlier and the later cloud.

    Attributes
    ----------
    clouds : tuple of 2 Cloud
    paths : tuple of 2 (SensorPath or None)
        Where the sensor was.
    low, high : ndarray, shape (3,)
        What both span, before the later one is moved [m].
    per_m2 : float
        Points on a square metre of the sparser one.
    registration : Registration
        The later on the earlier.
    registered : bool
        They were taken as they are; the registration is none.
    trajectories : tuple of 2 (Path or None)
        Files that the paths are of.
    all_classes : bool
        Noise and what moves are in surfaces too.
    """

    clouds: tuple[Cloud, Cloud]
    paths: tuple[SensorPath | None, SensorPath | None]
    low: Array
    high: Array
    per_m2: float
    registration: Registration
    registered: bool
    trajectories: tuple[Path | None, Path | None] = (None, None)
    all_classes: bool = False

    @property
    def crs(self) -> pyproj.CRS | None:
        """Horizontal, of both."""
        return agreed_crs(self.clouds)

    @property
    def metres(self) -> Metres:
        """The unit of both."""
        return agreed_metres(self.clouds)

    def standing(self, chunk: Chunk) -> npt.NDArray[np.bool_]:
        """Which points of a chunk surfaces are made of."""
        return standing(chunk.points, self.all_classes)

    def chunks(self, number: int, columns: tuple[str, ...] = ()) -> Iterator[tuple[Chunk, Array, Array]]:
        """Chunks of an epoch, their places in metres in the frame of A, and the way from them to the sensor (0: not known)."""
        metres = self.metres
        path, trajectory = self.paths[number], self.trajectories[number]
        tally = (
            Tally(trajectory, path, self.clouds[number]) if trajectory is not None and isinstance(path, Flown) else None
        )
        for chunk in reader.chunks(self.clouds[number], None if path is None else path.clock, (*columns, CLASS)):
            xyz = metres.of(chunk.points.xyz_m)
            away = np.zeros((len(xyz), 3))
            if path is not None:
                place, known = path.at(chunk)
                away[known] = (metres.of(place) - xyz)[known]
                if tally is not None:
                    tally.add(away, known)
            if number == 1:
                xyz, away = self.registration.move(xyz), away @ self.registration.matrix[:3, :3].T
            yield chunk, xyz, away
        if tally is not None:
            tally.check()


class Squares:
    """Squares of the map that hold points of a cloud."""

    def __init__(self) -> None:
        self._held: set[tuple[float, float]] = set()

    def add(self, xyz_m: Array) -> None:
        """Take points, shape (n, 3)."""
        self._held.update(map(tuple, np.unique(np.floor(xyz_m[:, :2] / _SQUARE_M), axis=0).tolist()))

    def meet(self, other: "Squares") -> bool:
        """Whether one of them is a square of another cloud, or next to one."""
        return any((i + a, j + b) in other._held for i, j in self._held for a in (-1, 0, 1) for b in (-1, 0, 1))


def laid(
    clouds: tuple[Cloud, Cloud],
    paths: tuple[SensorPath | None, SensorPath | None],
    registered: bool,
    progress: Progress,
    trajectories: tuple[Path | None, Path | None] = (None, None),
    all_classes: bool = False,
) -> Epochs:
    """Look at both, and lay the later one on the earlier unless they lie so already.

    Raises
    ------
    CoverageError
        They have no place in common, or do not fit.
    GeodesyError
        They differ in their CRS, or are no map coordinates.
    """
    agreed_crs(clouds)
    samples, low, high, per_m2 = _look(clouds, all_classes, progress)
    what = f"{clouds[0].path} and {clouds[1].path}"
    found = _unmoved(samples, what) if registered else register(samples[0], samples[1], what)
    return Epochs(clouds, paths, low, high, per_m2, found, registered, trajectories, all_classes)


def agreed_crs(clouds: tuple[Cloud, Cloud]) -> pyproj.CRS | None:
    """The CRS of both; None where neither says.

    Raises
    ------
    GeodesyError
        They differ.
    """
    a, b = (cloud.horizontal for cloud in clouds)
    if a is not None and b is not None and not same(a, b):
        raise GeodesyError(f"{clouds[1].path}: is in {b.name}, but {clouds[0].path} in {a.name}; expected one CRS")
    return a if a is not None else b


def _look(
    clouds: tuple[Cloud, Cloud], all_classes: bool, progress: Progress
) -> tuple[list[Array], Array, Array, float]:
    """A sample of both for the registration, what they span, and points on a square metre of the sparser."""
    samples, density = [], []
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    metres = agreed_metres(clouds)
    for cloud in clouds:
        step = max(1, -(-cloud.points // MOST))
        parts, cells, held = [], np.empty(0, np.int64), 0
        for chunk in reader.chunks(cloud, columns=(CLASS,)):
            progress("looking", len(chunk.points))
            xyz = metres.of(chunk.points.xyz_m[standing(chunk.points, all_classes)])
            if not len(xyz):
                continue
            held += len(xyz)
            low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
            parts.append(xyz[::step])
            cell = np.floor(xyz[:, :2]).astype(np.int64)
            cells = np.union1d(cells, (cell[:, 0] << 32) + (cell[:, 1] & 0xFFFFFFFF))
        if not held:
            raise CoverageError(f"{cloud.path}: holds nothing but noise and what moves, expected points of surfaces")
        samples.append(np.concatenate(parts))
        density.append(held / max(len(cells), 1))
    return samples, low, high, min(density)


def _unmoved(samples: list[Array], what: str) -> Registration:
    a, b = Squares(), Squares()
    a.add(samples[0])
    b.add(samples[1])
    if not b.meet(a):
        raise CoverageError(
            f"{what}: have no place in common, expected clouds that lie on each other; are they of one place?"
        )
    return Registration(np.eye(4), samples[0].mean(axis=0), np.zeros((6, 6)), 0.0, 1.0, 1.0)
