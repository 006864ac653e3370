"""A cloud as images look at it: in squares of ground, local coordinates, with the distance to the neighbours of each point.

It lies on the disk and is mapped, so that clouds of any size can be looked at from any side, square by square.
"""

import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from numba import njit

from flightlog.errors import CaptureError, SourceError
from groundproc.cloud import reader
from groundproc.cloud.selection import CLASS, standing
from groundproc.cloud.spool import Spool
from groundproc.imagery.painting.planes import Known, columns, surfaces
from groundproc.imagery.painting.visibility import Surface
from groundproc.imagery.site import Site
from groundproc.machine.system import cores, take_disk
from groundproc.numerics.voxelhash import sorted_by

Array = npt.NDArray[np.float64]
T = TypeVar("T")
U = TypeVar("U")

SIDE_M: Final = 32.0
"""Of a square of ground."""
_RECORD: Final = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("number", "i8")])
_HALF: Final = 1 << 31
_TILE: Final = 8
"""Columns along each side of a tile."""


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
    tiles : Tiles
    """

    points: slice
    centre_m: Array
    radius_m: float
    spacing_m: float
    tiles: "Tiles"

    def spans(self, place_m: Array, axis: Array, half_angle_rad: float) -> npt.NDArray[np.int64]:
        """Points of the tiles that a cone from a place about an axis meets, first and that after the last, shape (k, 2)."""
        met = np.flatnonzero(
            _meets(self.centre_m + self.tiles.centre_m, self.tiles.radius_m, place_m, axis, half_angle_rad)
        )
        return np.stack([self.tiles.first[met], self.tiles.first[met + 1]], axis=1)


class Tiles(NamedTuple):
    """Small parts of a square; their points follow each other.

    Attributes
    ----------
    first : ndarray of int64, shape (k + 1,)
        First point of each, and that after the last one's; from the square's first.
    centre_m : ndarray, shape (k, 3)
        From the square's centre.
    radius_m : ndarray, shape (k,)
        Of the ball about it that holds them all.
    """

    first: npt.NDArray[np.int64]
    centre_m: Array
    radius_m: Array


class Scene:
    """A cloud in squares: what stands of it. Noise and what moves hide nothing and are seen by nobody; they lie in no square.

    Parameters
    ----------
    cloud : Cloud
    site : Site
        What its coordinates mean.
    folder : Path
        For some 56 bytes a point.
    progress : callable
        Told of points read.
    all_classes : bool
        Noise and what moves stand too.

    Raises
    ------
    CaptureError
        Nothing stands.
    """

    def __init__(
        self,
        cloud: reader.Cloud,
        site: Site,
        folder: Path,
        progress: Callable[[int], object],
        all_classes: bool = False,
    ) -> None:
        spool, base_m = _spooled(cloud, folder, progress, all_classes)
        self.size = cloud.points
        """Of the file, and of all arrays by point."""
        self.standing = sum(spool.counts.values())
        if not self.standing:
            why = "has no points" if not self.size else "has noise and what moved only (classes 7, 18 and 69)"
            raise CaptureError(f"{cloud.path}: {why}; expected points of surfaces, on which images are laid")
        self.xyz_m = mapped(folder / "xyz", np.float32, (self.size, 3))
        """From the centre of each point's square."""
        self.spacing_m = mapped(folder / "spacing", np.float32, (self.size,))
        self.number = mapped(folder / "number", np.int64, (self.size,))
        """Place of each point in the file."""
        self._normal = mapped(folder / "normal", np.float32, (self.size, 3))
        self._rough_m = mapped(folder / "rough", np.float32, (self.size,))
        self._above_m = mapped(folder / "above", np.float32, (self.size,))
        self.squares: list[Square] = []
        self.squares.extend(side_by_side(self._squared, _pieces(spool, site, base_m)))

    def _squared(self, piece: "_Piece") -> Square:
        """Fill in what is known about the points of a square."""
        site, corner_m, records, first = piece
        local = localised(site, corner_m, np.stack([records[axis] for axis in "xyz"], axis=1))
        centre_m = 0.5 * (local.min(axis=0) + local.max(axis=0))
        local -= centre_m
        # neighbours follow each other: what they look up in pictures lies side by side
        key, count = _order(local)
        order, begins = sorted_by(key, count)
        local = local[order]
        points = slice(first, first + len(records))
        self.xyz_m[points], self.number[points] = local, records["number"][order]
        known = Known(self.spacing_m[points], self._normal[points], self._rough_m[points], self._above_m[points])
        usual_m = surfaces(local, known)
        radius_m = float(np.sqrt(np.einsum("ij,ij->i", local, local).max()))
        return Square(points, centre_m, radius_m, usual_m, _tiles(local, begins[:: _TILE**2]))

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


@contextmanager
def laid_out(
    cloud: reader.Cloud, site: Site, output: Path, progress: Callable[[str, int], object], all_classes: bool
) -> Iterator[tuple[Scene, Path]]:
    """A cloud as images look at it, and the scratch folder that it lies in: beside the output, and gone when this is left."""
    beside = next(folder for folder in output.resolve().parents if folder.is_dir())
    with tempfile.TemporaryDirectory(prefix=".swath-images-", dir=beside) as scratch:
        scene = Scene(cloud, site, Path(scratch), lambda count: progress("reading", count), all_classes)
        yield scene, Path(scratch)


def _order(local: Array) -> tuple[npt.NDArray[np.int32], int]:
    """Number of the column of each point, tile by tile, and how many there are."""
    column, (rows, across) = columns(local)
    row, column = np.divmod(column, np.int32(across))
    wide = -(-across // _TILE)
    tile = (row // _TILE) * wide + column // _TILE
    return tile * _TILE**2 + (row % _TILE) * _TILE + column % _TILE, -(-rows // _TILE) * wide * _TILE**2


def _tiles(local: Array, first: npt.NDArray[np.int64]) -> Tiles:
    """The tiles that hold points."""
    first = np.append(first[:-1][np.diff(first) > 0], len(local))
    low, high = (np.asarray(edge.reduceat(local, first[:-1], axis=0)) for edge in (np.minimum, np.maximum))
    return Tiles(first, 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1))


class _Piece(NamedTuple):
    """Points of a square as they wait on the disk, and the place of its first one among all."""

    site: Site
    corner_m: Array
    records: npt.NDArray[Any]
    first: int


def _pieces(spool: Spool, site: Site, base_m: float) -> Iterator[_Piece]:
    first = 0
    for place in sorted(spool.counts):
        records = spool.take(place)
        yield _Piece(site, np.array([place[0] * SIDE_M, place[1] * SIDE_M, base_m]), records, first)
        first += len(records)


def side_by_side(work: Callable[[T], U], items: Iterable[T]) -> Iterator[U]:
    """Results of work in the order of the items, on all cores; no more than a few items are held at once."""
    with ThreadPoolExecutor(cores()) as pool:
        running: deque[Future[U]] = deque()
        try:
            for item in items:
                running.append(pool.submit(work, item))
                if len(running) > cores():
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            for each in running:
                each.cancel()


def mapped(path: Path, dtype: npt.DTypeLike, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """An array of zeros in a file of its own.

    Raises
    ------
    SourceError
        The disk has no room for it.
    """
    path = path.with_suffix(".npy")
    found = np.lib.format.open_memmap(path, mode="w+", dtype=np.dtype(dtype), shape=shape)
    with path.open("r+b") as file:
        size = path.stat().st_size
        try:
            take_disk(file.fileno(), size)
        except OSError as error:
            raise SourceError(
                f"{path.parent}: no room for temporary files, {size:,} bytes asked for ({error.strerror})"
            ) from None
    return np.asarray(found)  # compiled code wants plain arrays


def _spooled(
    cloud: reader.Cloud, folder: Path, progress: Callable[[int], object], all_classes: bool
) -> tuple[Spool, float]:
    """Points that stand by square, from its corner, and the height that theirs are from."""
    spool, seen, base_m = Spool(_RECORD, folder), 0, None
    for chunk in reader.chunks(cloud, columns=(CLASS,)):
        number = seen + np.flatnonzero(standing(chunk.points, all_classes))
        seen += len(chunk.points)
        progress(len(chunk.points))
        if not len(number):
            continue
        xyz = chunk.points.xyz_m[number - seen + len(chunk.points)]
        base_m = float(np.floor(xyz[0, 2])) if base_m is None else base_m
        place = np.floor(xyz[:, :2] / SIDE_M).astype(np.int64)
        packed, of_place = np.unique(place[:, 0] << 32 | (place[:, 1] + _HALF), return_inverse=True)
        places = np.stack([packed >> 32, (packed & 0xFFFFFFFF) - _HALF], axis=1)
        records = np.empty(len(xyz), _RECORD)
        for axis, name in enumerate("xy"):
            records[name] = xyz[:, axis] - place[:, axis] * SIDE_M
        records["z"] = xyz[:, 2] - base_m
        records["number"] = number
        spool.add_sorted(records, of_place.reshape(-1).astype(np.int32), [(int(x), int(y)) for x, y in places])
    return spool, base_m or 0.0


def localised(site: Site, corner_m: Array, xyz_m: npt.NDArray[Any]) -> Array:
    """Local coordinates of map coordinates from a corner: by a polynomial of second degree, exact over a square to micrometres."""
    low, high = (edge(axis=0).astype(np.float64) for edge in (xyz_m.min, xyz_m.max))
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1.0)
    steps = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = site.local(corner_m + middle + steps * half)
    terms, *_ = np.linalg.lstsq(_terms(steps), local, rcond=None)
    out = np.empty((len(xyz_m), 3))
    _evaluate(xyz_m, middle, half, np.ascontiguousarray(terms), out)
    return out


def _terms(u: Array) -> Array:
    x, y, z = u.T
    return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=1)


@njit(cache=True, nogil=True)
def _evaluate(xyz: Any, middle: Any, half: Any, terms: Any, out: Any) -> None:
    """The polynomial with terms, shape (10, 3), as `_terms` has them, of each point."""
    for i in range(len(xyz)):
        x, y, z = (
            (xyz[i, 0] - middle[0]) / half[0],
            (xyz[i, 1] - middle[1]) / half[1],
            (xyz[i, 2] - middle[2]) / half[2],
        )
        for axis in range(3):
            t = terms[:, axis]
            out[i, axis] = (
                t[0] + x * (t[1] + t[4] * x + t[7] * y + t[8] * z) + y * (t[2] + t[5] * y + t[9] * z) + z * (t[3] + t[6] * z)
            )  # fmt: skip


def towards(squares: list[Square], place_m: Array, axis: Array, half_angle_rad: float) -> list[Square]:
    """Squares that a cone from a place about an axis meets."""
    centre_m = np.array([square.centre_m for square in squares])
    radius_m = np.array([square.radius_m for square in squares])
    met = np.flatnonzero(_meets(centre_m, radius_m, place_m, axis, half_angle_rad))
    return [squares[number] for number in met]


def _meets(
    centre_m: Array, radius_m: Array, place_m: Array, axis: Array, half_angle_rad: float
) -> npt.NDArray[np.bool_]:
    """Whether balls, shape (n, 3) and (n,), are met by a cone from a place about an axis."""
    way = centre_m - place_m
    distance = np.linalg.norm(way, axis=1)
    far = np.maximum(distance, 1e-9)
    angle = np.arccos(np.clip(way @ axis / far, -1.0, 1.0))
    return np.asarray((distance <= radius_m) | (angle - np.arcsin(np.minimum(radius_m / far, 1.0)) <= half_angle_rad))
