"""A cloud as images look at it: in squares of ground, local coordinates, with the distance to the neighbours of each point.

It lies on the disk and is mapped, so that clouds of any size can be looked at from any side, square by square.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from groundproc.cloud import reader
from groundproc.cloud.spool import Spool
from groundproc.imagery.painting.planes import surfaces
from groundproc.imagery.painting.visibility import Surface
from groundproc.imagery.site import Site

Array = npt.NDArray[np.float64]

SIDE_M: Final = 32.0
"""Of a square of ground."""
_RECORD: Final = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("number", "i8")])
_HALF: Final = 1 << 31


@dataclass(frozen=True, slots=True)
class Square:
    """Points of one square.

    Attributes
    ----------
    points : slice
        Of the scene's arrays.
    centre_m : ndarray, shape (3,)
        Local; the points' coordinates are from here.
    radius_m : float
        Of the ball about it that holds them all.
    spacing_m : float
        Usual distance of neighbours.
    """

    points: slice
    centre_m: Array
    radius_m: float
    spacing_m: float


class Scene:
    """A cloud in squares.

    Parameters
    ----------
    cloud : Cloud
    site : Site
        What its coordinates mean.
    folder : Path
        For some 56 bytes a point.
    progress : callable
        Told of points read.
    """

    def __init__(self, cloud: reader.Cloud, site: Site, folder: Path, progress: Callable[[int], object]) -> None:
        spool, base_m = _spooled(cloud, folder, progress)
        self.size = cloud.points
        self.xyz_m = mapped(folder / "xyz", np.float32, (self.size, 3))
        """From the centre of each point's square."""
        self.spacing_m = mapped(folder / "spacing", np.float32, (self.size,))
        self.number = mapped(folder / "number", np.int64, (self.size,))
        """Place of each point in the file."""
        self._normal = mapped(folder / "normal", np.float32, (self.size, 3))
        self._rough_m = mapped(folder / "rough", np.float32, (self.size,))
        self._above_m = mapped(folder / "above", np.float32, (self.size,))
        self.squares: list[Square] = []
        first = 0
        for place in sorted(spool.counts):
            records = spool.take(place)
            points = slice(first, first + len(records))
            first += len(records)
            corner_m = np.array([place[0] * SIDE_M, place[1] * SIDE_M, base_m])
            local = localised(site, corner_m, np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float64))
            centre_m = 0.5 * (local.min(axis=0) + local.max(axis=0))
            local -= centre_m
            self.xyz_m[points], self.number[points] = local, records["number"]
            usual_m = self._know(points, local)
            radius_m = float(np.sqrt((local**2).sum(axis=1).max()))
            self.squares.append(Square(points, centre_m, radius_m, usual_m))

    def _know(self, points: slice, local: Array) -> float:
        """Fill in what follows from the neighbours of points; gives their usual distance."""
        usual_m, known = surfaces(local)
        self.spacing_m[points], self._normal[points], self._rough_m[points], self._above_m[points] = known
        return usual_m

    def surface(self, square: Square) -> Surface:
        """What is known of the points of a square, in coordinates from its centre."""
        points = square.points
        return Surface(
            self.xyz_m[points],
            self.spacing_m[points],
            self._normal[points],
            self._rough_m[points],
            self._above_m[points],
        )


def mapped(path: Path, dtype: npt.DTypeLike, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """An array of zeros in a file of its own."""
    found = np.lib.format.open_memmap(path.with_suffix(".npy"), mode="w+", dtype=np.dtype(dtype), shape=shape)
    return np.asarray(found)  # compiled code wants plain arrays


def _spooled(cloud: reader.Cloud, folder: Path, progress: Callable[[int], object]) -> tuple[Spool, float]:
    """Points by square, from its corner, and the height that theirs are from."""
    spool, seen, base_m = Spool(_RECORD, folder), 0, None
    for chunk in reader.chunks(cloud, columns=()):
        xyz = chunk.points.xyz_m
        base_m = float(np.floor(xyz[0, 2])) if base_m is None else base_m
        place = np.floor(xyz[:, :2] / SIDE_M).astype(np.int64)
        packed, number = np.unique(place[:, 0] << 32 | (place[:, 1] + _HALF), return_inverse=True)
        places = np.stack([packed >> 32, (packed & 0xFFFFFFFF) - _HALF], axis=1)
        records = np.empty(len(xyz), _RECORD)
        for axis, name in enumerate("xy"):
            records[name] = xyz[:, axis] - place[:, axis] * SIDE_M
        records["z"] = xyz[:, 2] - base_m
        records["number"] = np.arange(seen, seen + len(xyz))
        spool.add_sorted(records, number.reshape(-1).astype(np.int32), [(int(x), int(y)) for x, y in places])
        seen += len(xyz)
        progress(len(xyz))
    return spool, base_m or 0.0


def localised(site: Site, corner_m: Array, xyz_m: Array) -> Array:
    """Local coordinates of map coordinates from a corner: by a polynomial of second degree, exact over a square to micrometres."""
    low, high = xyz_m.min(axis=0), xyz_m.max(axis=0)
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1.0)
    steps = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = site.local(corner_m + middle + steps * half)
    terms, *_ = np.linalg.lstsq(_terms(steps), local, rcond=None)
    return np.asarray(_terms((xyz_m - middle) / half) @ terms)


def _terms(u: Array) -> Array:
    x, y, z = u.T
    return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=1)


def towards(squares: list[Square], place_m: Array, axis: Array, half_angle_rad: float) -> Iterator[Square]:
    """Squares that a cone from a place about an axis meets."""
    for square in squares:
        way = square.centre_m - place_m
        distance = float(np.linalg.norm(way))
        if distance <= square.radius_m:
            yield square
            continue
        angle = np.arccos(np.clip(way @ axis / distance, -1.0, 1.0))
        if angle - np.arcsin(square.radius_m / distance) <= half_angle_rad:
            yield square
