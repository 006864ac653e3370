"""A cloud against surveyed points: the surface at each, the nearest point, or the centre of a target."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.assessment.surface import RADII_M, patch_at
from groundproc.cloud import reader
from groundproc.text import Table, open_text, table_of

Array = npt.NDArray[np.float64]

MODES: Final = ("point", "plane")
NEAR_M: Final = 0.05
"""A point of the cloud so near is the surveyed point itself, where neither a target nor a mode says otherwise."""
_NAMES: Final = {
    "id": ("id", "name", "point", "point_id"), "x": ("x", "e", "east", "easting"), "y": ("y", "n", "north", "northing"),
    "z": ("z", "h", "height", "elevation", "up"),
}  # fmt: skip
REACH_M: Final = RADII_M[-1]
_FARTHEST_M: Final = 1e8


@dataclass(frozen=True, slots=True)
class CheckPoint:
    """A surveyed point.

    Attributes
    ----------
    id : str
    place_m : ndarray, shape (3,)
        In the CRS of the cloud.
    """

    id: str
    place_m: Array


@dataclass(frozen=True, slots=True)
class Compared:
    """A point that the cloud could be held against.

    Attributes
    ----------
    id : str
    d_m : ndarray, shape (3,)
        Cloud less point; NaN where an axis cannot be told.
    sigma_m : float
        Of the cloud's height there; NaN where it is not known.
    mode : str
    """

    id: str
    d_m: Array
    sigma_m: float
    mode: str


@dataclass(frozen=True, slots=True)
class Unmatched:
    """A point that could not be compared, and why."""

    id: str
    reason: str


def read_points(path: Path) -> tuple[CheckPoint, ...]:
    """Read a table with columns id, x, y, z; others, such as sigmas, are passed over.

    Raises
    ------
    CaptureError
        It cannot be read, a column is missing, or a line is no point.
    """
    try:
        with open_text(path) as file:
            table = table_of(file, str(path), _NAMES["x"], CaptureError, "expected id,x,y,z")
            names = [name.lower() for name in table.names]
            missing = [key for key, words in _NAMES.items() if not set(words) & set(names)]
            if missing:
                raise CaptureError(f"{path}: the first line has no column {missing[0]}; expected id,x,y,z")
            column = {key: names.index(next(word for word in words if word in names)) for key, words in _NAMES.items()}
            points = [_point(table, words, column, number) for number, words in table.rows()]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not points:
        raise CaptureError(f"{path}: holds no points")
    counted = Counter(point.id for point in points)
    doubled = next((name for name, count in counted.items() if count > 1), None)
    if doubled is not None:
        raise CaptureError(f"{path}: point {doubled!r} stands there twice, expected each once")
    return tuple(points)


def _point(table: Table, row: Sequence[str], column: dict[str, int], number: int) -> CheckPoint:
    """What one line says."""
    try:
        where = np.array([float(row[column[axis]]) for axis in "xyz"])
    except ValueError:
        where = np.full(3, np.nan)
    name = row[column["id"]].strip()
    if not (np.abs(where) <= _FARTHEST_M).all() or not name:
        expected = "an id and x, y, z as numbers with a decimal point"
        raise CaptureError(f"{table.place}: line {number}: {table.blame(row, expected)}")
    return CheckPoint(name, where)


def around(
    cloud: reader.Cloud, points: Sequence[CheckPoint], reach_m: float, progress: Callable[[int], object]
) -> list[Array]:
    """Points of a cloud within a square of so many metres to each side of each of some places, shape (n, 3) each."""
    found: list[list[Array]] = [[] for _ in points]
    cells: dict[tuple[int, int], list[int]] = {}
    for number, point in enumerate(points):
        low = np.floor((point.place_m[:2] - reach_m) / reach_m).astype(int)
        high = np.floor((point.place_m[:2] + reach_m) / reach_m).astype(int)
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                cells.setdefault((x, y), []).append(number)
    keys = np.array(sorted(x * _STRIDE + y for x, y in cells))
    for chunk in reader.chunks(cloud, columns=()):
        xyz = chunk.points.xyz_m
        key = np.floor(xyz[:, 0] / reach_m).astype(np.int64) * _STRIDE + np.floor(xyz[:, 1] / reach_m).astype(np.int64)
        some = np.flatnonzero(np.isin(key, keys))
        for one in np.unique(key[some]):
            inside = xyz[some[key[some] == one]]
            x = int(np.floor(inside[0, 0] / reach_m))
            for number in cells[x, int(one) - x * _STRIDE]:
                near = np.abs(inside[:, :2] - points[number].place_m[:2]).max(axis=1) <= reach_m
                if near.any():
                    found[number].append(inside[near])
        progress(len(xyz))
    return [np.concatenate(parts) if parts else np.empty((0, 3)) for parts in found]


_STRIDE: Final = 1 << 32


def compare(
    points: Sequence[CheckPoint], near: Sequence[Array], mode: str | None = None
) -> tuple[list[Compared], list[Unmatched]]:
    """Hold the cloud against each point.

    Parameters
    ----------
    points : sequence of CheckPoint
    near : sequence of ndarray, shape (n, 3)
        Points of the cloud round each.
    mode : str, optional
        Of `MODES`. By default heights come from the surface, and places in plan from a point of the cloud within `NEAR_M`.
    """
    compared: list[Compared] = []
    unmatched: list[Unmatched] = []
    for point, cloud in zip(points, near, strict=True):
        found = _nearest(point, cloud) if mode == "point" else _surface(point, cloud, plain=mode == "plane")
        if isinstance(found, Compared):
            compared.append(found)
        else:
            unmatched.append(Unmatched(point.id, found))
    return compared, unmatched


def _nearest(point: CheckPoint, cloud: Array) -> Compared | str:
    if not len(cloud):
        return f"no point within {REACH_M:g} m"
    d = cloud - point.place_m
    nearest = d[np.argmin(np.einsum("ij,ij->i", d, d))]
    distance = float(np.linalg.norm(nearest))
    if distance > REACH_M:
        return f"the nearest point is {distance:.2f} m away, expected one within {REACH_M:g} m"
    return Compared(point.id, nearest, np.nan, "point")


def _surface(point: CheckPoint, cloud: Array, plain: bool) -> Compared | str:
    patch = patch_at(point.place_m, cloud)
    if isinstance(patch, str):
        return patch
    d = np.array([np.nan, np.nan, patch.height_m - point.place_m[2]])
    if not plain:
        offset = cloud - point.place_m
        nearest = offset[np.argmin(np.einsum("ij,ij->i", offset, offset))]
        if np.linalg.norm(nearest) <= NEAR_M:
            return Compared(point.id, np.append(nearest[:2], d[2]), patch.sigma_m, "point")
    return Compared(point.id, d, patch.sigma_m, "plane")
