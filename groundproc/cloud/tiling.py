"""A cloud as files of squares of the map, with an overview of all of them and an index: memory follows neither points nor squares."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt

from flightlog.errors import SourceError, UsageError
from groundproc.cloud.copc import CopcBuilder
from groundproc.cloud.spool import Place, Records, Spool
from groundproc.cloud.storing import storing

Array = npt.NDArray[np.float64]

FORMATS: Final = {"copc": ".copc.laz", "laz": ".laz"}
OVERVIEW: Final = "overview.copc.laz"
INDEX: Final = "cloud.vpc"
SMALLEST_M, LARGEST_M = 1.0, 100_000.0
_OVERVIEW_POINTS: Final = 1_000_000
"""Of an area without relief; walls and trees have some more."""
_FINEST_M: Final = 0.5
"""Between points of an overview."""
_MOST_TILES: Final = 20_000


@dataclass(frozen=True, slots=True)
class Tile:
    """A file of one square.

    Attributes
    ----------
    square : str
        West and south edge of the square, in the unit of the CRS.
    name : str
        Of the file.
    points : int
    low_m, high_m : ndarray, shape (3,)
        Of its points.
    first_s, last_s : float
        Least and largest time of its points, as stored.
    """

    square: str
    name: str
    points: int
    low_m: Array
    high_m: Array
    first_s: float
    last_s: float


class Tiling:
    """Takes records in any order, and writes them by square.

    A point on an edge is of the square east or south of it, as in rasters. The edges are whole multiples of the size.

    Parameters
    ----------
    header : laspy.LasHeader
        Of LAS 1.4, point format 6 to 8: what all files have but for their totals.
    folder : Path
        For temporary files.
    size_m : float
    unit_m : float
        Of the points' coordinates.

    Raises
    ------
    UsageError
        The size is none.
    """

    def __init__(self, header: laspy.LasHeader, folder: Path, size_m: float, unit_m: float = 1.0) -> None:
        if not SMALLEST_M <= size_m <= LARGEST_M:
            raise UsageError(f"tiles of {size_m:g} m: expected {SMALLEST_M:g} to {LARGEST_M:g} m, such as 250")
        self._header, self._folder, self._unit_m = header, folder, unit_m
        self._size_m, self._size = size_m, size_m / unit_m
        self._spool = Spool(header.point_format.dtype(), folder)

    def add(self, records: Records) -> None:
        """Take records, shape (n,); the array may be used again.

        Raises
        ------
        UsageError
            There are too many squares.
        """
        if not len(records):
            return
        column = np.floor(self._squares(records, 0)).astype(np.int64)
        row = np.ceil(self._squares(records, 1)).astype(np.int64) - 1
        keys, number = np.unique(np.stack([column, row], axis=1), axis=0, return_inverse=True)
        self._spool.add_sorted(records, number.reshape(-1).astype(np.int32), [(int(x), int(y)) for x, y in keys])
        if len(self._spool.counts) > _MOST_TILES:
            raise UsageError(
                f"tiles of {self._size_m:g} m: more than {_MOST_TILES:,} of them; expected a larger size, or a cloud without strays"
            )

    def write(self, folder: Path, form: str, progress: Callable[[int], object]) -> tuple[list[Tile], bool]:
        """Write all files; gives the tiles from south to north and west to east, and whether there is an overview.

        Parameters
        ----------
        folder : Path
            Is there.
        form : str
            Of `FORMATS`.
        progress : callable
            Told of points done.
        """
        places = sorted(self._spool.counts, key=lambda place: (place[1], place[0]))
        overview = (
            _Overview(self._header, self._folder, len(places) * self._size_m**2, self._unit_m)
            if len(places) > 1
            else None
        )
        tiles = [self._write_tile(folder, place, form, overview, progress) for place in places]
        if overview is not None:
            overview.write(folder / OVERVIEW)
        return tiles, overview is not None

    def _write_tile(
        self, folder: Path, place: Place, form: str, overview: "_Overview | None", progress: Callable[[int], object]
    ) -> Tile:
        square = "_".join(f"{each * self._size:.10g}" for each in place)
        path = folder / f"{square}{FORMATS[form]}"
        writer = (_Copc if form == "copc" else _Laz)(self._header, path, self._folder)
        totals = _Totals(self._header)
        for records in self._spool.pieces(place):
            totals.add(records)
            writer.add(records)
            if overview is not None:
                overview.add(records)
            progress(len(records))
        if overview is not None:
            overview.forget()
        writer.close(totals)
        low, high = totals.limits()
        return Tile(square, path.name, totals.points, low, high, totals.times[0], totals.times[1])

    def _squares(self, records: Records, axis: int) -> Array:
        """Places in squares along an axis; what differs from an edge by less than any step lies on it."""
        place = records["XYZ"[axis]] * self._header.scales[axis] + self._header.offsets[axis]
        return np.asarray(np.round(place / self._size, 9))


class _Totals:
    """What a header states of all points."""

    def __init__(self, header: laspy.LasHeader) -> None:
        self._scales, self._offsets = np.asarray(header.scales), np.asarray(header.offsets)
        self._stored = np.array([[np.iinfo(np.int64).max] * 3, [np.iinfo(np.int64).min] * 3])
        self._by_return = np.zeros(16, np.int64)
        self.points = 0
        self.times = [np.inf, -np.inf]

    def add(self, records: Records) -> None:
        for axis, name in enumerate("XYZ"):
            self._stored[0, axis] = min(self._stored[0, axis], int(records[name].min()))
            self._stored[1, axis] = max(self._stored[1, axis], int(records[name].max()))
        self._by_return += np.bincount(records["bit_fields"] & 15, minlength=16)
        time = records["gps_time"]
        self.times = [min(self.times[0], float(time.min())), max(self.times[1], float(time.max()))]
        self.points += len(records)

    def limits(self) -> tuple[Array, Array]:
        low, high = self._stored * self._scales + self._offsets
        return low, high

    def state(self, header: laspy.LasHeader) -> None:
        header.point_count = self.points
        header.mins, header.maxs = self.limits()
        header.number_of_points_by_return[:] = self._by_return[1:]


class _Copc:
    """One file as an octree."""

    def __init__(self, header: laspy.LasHeader, path: Path, folder: Path) -> None:
        self._header, self._path = copy.deepcopy(header), path
        self._builder = CopcBuilder(self._header, folder)

    def add(self, records: Records) -> None:
        self._builder.add(records)

    def close(self, totals: _Totals) -> None:
        totals.state(self._header)
        self._builder.write(self._path)


class _Laz:
    """One file in the order of the points."""

    def __init__(self, header: laspy.LasHeader, path: Path, folder: Path) -> None:
        del folder
        self._path, self._format = path, header.point_format
        try:
            self._las: Any = laspy.open(
                path,
                mode="w",
                header=copy.deepcopy(header),
                laz_backend=laspy.LazBackend.LazrsParallel,
                do_compress=True,
            )
        except OSError as error:
            raise SourceError(f"{path}: cannot be written ({error.strerror})") from None

    def add(self, records: Records) -> None:
        with storing(self._path):
            self._las.write_points(laspy.PackedPointRecord(records, self._format))

    def close(self, totals: _Totals) -> None:
        del totals  # laspy counts itself
        with storing(self._path):
            self._las.close()


class _Overview:
    """A few points of all tiles: the first in each cube of space, the cubes as large as it takes for a million of level ground."""

    def __init__(self, header: laspy.LasHeader, folder: Path, area_m2: float, unit_m: float) -> None:
        self._header = copy.deepcopy(header)
        self._builder, self._totals = CopcBuilder(self._header, folder), _Totals(header)
        self._cube = max(_FINEST_M, float(np.sqrt(area_m2 / _OVERVIEW_POINTS))) / unit_m
        self._seen = np.empty(0, np.int64)

    def add(self, records: Records) -> None:
        """Take what is in a cube of this tile that had no point yet."""
        scales, offsets = self._header.scales, self._header.offsets
        cube = [
            np.floor((records[n] * scales[a] + offsets[a]) / self._cube).astype(np.int64) & 0x1FFFFF
            for a, n in enumerate("XYZ")
        ]
        keys, first = np.unique(cube[0] | cube[1] << 21 | cube[2] << 42, return_index=True)
        new = ~np.isin(keys, self._seen, assume_unique=True)
        if new.any():
            some = records[np.sort(first[new])]
            self._totals.add(some)
            self._builder.add(some)
            self._seen = np.concatenate([self._seen, keys[new]])

    def forget(self) -> None:
        """The next points are of another tile."""
        self._seen = np.empty(0, np.int64)

    def write(self, path: Path) -> None:
        self._totals.state(self._header)
        self._builder.write(path)
