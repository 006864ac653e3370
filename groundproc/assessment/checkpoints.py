"""A cloud against surveyed points: the surface at each, the nearest point, or the centre of a target."""

import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError
from groundproc.assessment import targets
from groundproc.assessment.surface import RADII_M, patch_at
from groundproc.assessment.target import Target
from groundproc.assessment.targets import Wanted
from groundproc.cloud import reader
from groundproc.cloud.metres import METRES, Metres
from groundproc.text import Table, open_text, table_of

Array = npt.NDArray[np.float64]

MODES: Final = ("point", "plane", "target")
NEAR_M: Final = 0.05
"""A point of the cloud so near is the surveyed point itself, where neither a target nor a mode says otherwise."""
_NAMES: Final = {
    "id": ("id", "name", "point", "point_id"), "x": ("x", "e", "east", "easting"), "y": ("y", "n", "north", "northing"),
    "z": ("z", "h", "height", "elevation", "up"),
}  # fmt: skip
_SIGMAS: Final = (
    ("sigma_x", "sx", "sigma_e", "sigma_h", "sigma"), ("sigma_y", "sy", "sigma_n", "sigma_h", "sigma"),
    ("sigma_z", "sz", "sigma_u", "sigma_v", "sigma"),
)  # fmt: skip
"""Names of columns of the survey's sigma of each axis, the most special first."""
_LARGEST_SIGMA_M: Final = 1e3
REACH_M: Final = max(RADII_M[-1], targets.REACH_M)
"""Points so far from a surveyed point are looked at."""
_FARTHEST_POINT_M: Final = RADII_M[-1]
_FARTHEST_M: Final = 1e8


@dataclass(frozen=True, slots=True)
class CheckPoint:
    """A surveyed point.

    Attributes
    ----------
    id : str
    place_m : ndarray, shape (3,)
        In the CRS of the cloud.
    sigma_m : ndarray, shape (3,)
        Of the survey; NaN where it is not stated.
    """

    id: str
    place_m: Array
    sigma_m: Array


@dataclass(frozen=True, slots=True)
class Near:
    """Points of the cloud about a surveyed point.

    Attributes
    ----------
    xyz_m : ndarray, shape (n, 3)
    intensity : ndarray, shape (n,), or None
        None where the cloud has none.
    """

    xyz_m: Array
    intensity: Array | None = None


@dataclass(frozen=True, slots=True)
class Compared:
    """A point that the cloud could be held against.

    Attributes
    ----------
    id : str
    d_m : ndarray, shape (3,)
        Cloud less point; NaN where an axis cannot be told.
    sigma_m : ndarray, shape (3,)
        Of the cloud's surface or target there, by the scatter of its points; NaN where it is not known.
    mode : str
    target : Target or None
    """

    id: str
    d_m: Array
    sigma_m: Array
    mode: str
    target: Target | None = None


@dataclass(frozen=True, slots=True)
class Unmatched:
    """A point that could not be compared, and why."""

    id: str
    reason: str


def read_points(path: Path, unit: Metres = METRES) -> tuple[CheckPoint, ...]:
    """Read a table with columns id, x, y, z, and where they are wanted sigmas.

    These are one `sigma`, or `sigma_x`, `sigma_y`, `sigma_z`, or `sigma_h`, `sigma_v`.

    Parameters
    ----------
    path : Path
    unit : Metres
        Of the numbers in the table; what is returned is in metres.

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
            of_sigma = [next((names.index(word) for word in words if word in names), None) for words in _SIGMAS]
            points = [_point(table, words, column, of_sigma, number) for number, words in table.rows()]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not points:
        raise CaptureError(f"{path}: holds no points")
    counted = Counter(point.id for point in points)
    doubled = next((name for name, count in counted.items() if count > 1), None)
    if doubled is not None:
        raise CaptureError(f"{path}: point {doubled!r} stands there twice, expected each once")
    return tuple(CheckPoint(each.id, unit.of(each.place_m), unit.of(each.sigma_m)) for each in points)


def _point(
    table: Table, row: Sequence[str], column: dict[str, int], of_sigma: Sequence[int | None], number: int
) -> CheckPoint:
    """What one line says."""
    where, sigma = np.full(3, np.nan), np.full(3, np.nan)
    with contextlib.suppress(ValueError):
        where = np.array([float(row[column[axis]]) for axis in "xyz"])
    name = row[column["id"]].strip()
    if not (np.abs(where) <= _FARTHEST_M).all() or not name:
        expected = "an id and x, y, z as numbers with a decimal point"
        raise CaptureError(f"{table.place}: line {number}: {table.blame(row, expected)}")
    for axis, which in enumerate(of_sigma):
        if which is None or not row[which].strip():
            continue
        try:
            sigma[axis] = float(row[which])
        except ValueError:
            sigma[axis] = np.nan
        if not 0.0 <= sigma[axis] <= _LARGEST_SIGMA_M:
            raise CaptureError(f"{table.place}: line {number}: {row[which]!r} found, expected a sigma of 0 or more")
    return CheckPoint(name, where, sigma)


def around(
    cloud: reader.Cloud, points: Sequence[CheckPoint], unit: Metres, progress: Callable[[int], object]
) -> list[Near]:
    """Points of a cloud within a square of `REACH_M` to each side of each of some places."""
    valued = "intensity" in cloud.columns
    found: list[list[Array]] = [[] for _ in points]
    cells: dict[tuple[int, int], list[int]] = {}
    for number, point in enumerate(points):
        low = np.floor((point.place_m[:2] - REACH_M) / REACH_M).astype(int)
        high = np.floor((point.place_m[:2] + REACH_M) / REACH_M).astype(int)
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                cells.setdefault((x, y), []).append(number)
    keys = np.array(sorted(x * _STRIDE + y for x, y in cells))
    for chunk in reader.chunks(cloud, columns=("intensity",) if valued else ()):
        xyz = unit.of(chunk.points.xyz_m)
        value = chunk.points["intensity"].astype(np.float64) if valued else np.full(len(xyz), np.nan)
        key = np.floor(xyz[:, 0] / REACH_M).astype(np.int64) * _STRIDE + np.floor(xyz[:, 1] / REACH_M).astype(np.int64)
        some = np.flatnonzero(np.isin(key, keys))
        for one in np.unique(key[some]):
            which = some[key[some] == one]
            inside = np.column_stack([xyz[which], value[which]])
            x = int(np.floor(inside[0, 0] / REACH_M))
            for number in cells[x, int(one) - x * _STRIDE]:
                near = np.abs(inside[:, :2] - points[number].place_m[:2]).max(axis=1) <= REACH_M
                if near.any():
                    found[number].append(inside[near])
        progress(len(xyz))
    return [_near(parts, valued) for parts in found]


def _near(parts: Sequence[Array], valued: bool) -> Near:
    whole = np.concatenate(parts) if parts else np.empty((0, 4))
    # a cloud without strengths has the same of all points, mostly 0
    valued = valued and len(whole) > 0 and bool(np.ptp(whole[:, 3]) > 0.0)
    return Near(whole[:, :3], whole[:, 3] if valued else None)


_STRIDE: Final = 1 << 32


def compare(
    points: Sequence[CheckPoint], near: Sequence[Near], mode: str | None = None, wanted: Wanted | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> tuple[list[Compared], list[Unmatched]]:  # fmt: skip
    """Hold the cloud against each point.

    Parameters
    ----------
    points : sequence of CheckPoint
    near : sequence of Near
        Points of the cloud round each.
    mode : str, optional
        Of `MODES`. By default the centre of a target where one is found; else heights come from the surface, and places in plan from a
        point of the cloud within `NEAR_M`.
    wanted : Wanted, optional
        Targets that are looked for. Default: all kinds, of any size.
    progress : callable
        Is told of each point.
    """
    compared: list[Compared] = []
    unmatched: list[Unmatched] = []
    for point, cloud in zip(points, near, strict=True):
        found = _held(point, cloud, mode, wanted or Wanted())
        if isinstance(found, Compared):
            compared.append(found)
        else:
            unmatched.append(Unmatched(point.id, found))
        progress(1)
    return compared, unmatched


def _held(point: CheckPoint, cloud: Near, mode: str | None, wanted: Wanted) -> Compared | str:
    """The cloud against one point, or why it cannot be."""
    if mode == "point":
        return _nearest(point, cloud.xyz_m)
    if mode == "plane":
        return _surface(point, cloud.xyz_m, plain=True)
    target = targets.find(point.place_m, cloud.xyz_m, cloud.intensity, wanted)
    if isinstance(target, Target):
        return Compared(point.id, target.centre_m - point.place_m, target.sigma_m, "target", target)
    if mode == "target" or target.ambiguous:
        return target.reason
    return _surface(point, cloud.xyz_m, plain=False)


def _nearest(point: CheckPoint, cloud: Array) -> Compared | str:
    if not len(cloud):
        return f"no point within {_FARTHEST_POINT_M:g} m"
    d = cloud - point.place_m
    nearest = d[np.argmin(np.einsum("ij,ij->i", d, d))]
    distance = float(np.linalg.norm(nearest))
    if distance > _FARTHEST_POINT_M:
        return f"the nearest point is {distance:.2f} m away, expected one within {_FARTHEST_POINT_M:g} m"
    return Compared(point.id, nearest, np.full(3, np.nan), "point")


def _surface(point: CheckPoint, cloud: Array, plain: bool) -> Compared | str:
    patch = patch_at(point.place_m, cloud)
    if isinstance(patch, str):
        return patch
    d = np.array([np.nan, np.nan, patch.height_m - point.place_m[2]])
    sigma = np.array([np.nan, np.nan, patch.sigma_m])
    if not plain:
        offset = cloud - point.place_m
        nearest = offset[np.argmin(np.einsum("ij,ij->i", offset, offset))]
        if np.linalg.norm(nearest) <= NEAR_M:
            return Compared(point.id, np.append(nearest[:2], d[2]), sigma, "point")
    return Compared(point.id, d, sigma, "plane")
