"""From a cloud to its pipelines: cylinders near the ground, put together to lines, with diameter, cover and free spans.

What lies a little above the ground is looked at square by square: places with points in a long strip around them get a cylinder. Pieces
whose axes carry each other on make a pipe. Memory: that of the ground, and a square of a million points.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from groundproc.analysis.corridor.cylinder import Cylinder, cylinder
from groundproc.analysis.terrain.floor import Floor
from groundproc.cloud import reader
from groundproc.cloud.metres import unstated
from groundproc.cloud.tiles import Tile, Tiles, side_for
from groundproc.files import written_aside
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

SMALLEST_M, LARGEST_M = 0.2, 2.5
"""Diameters that are looked for."""
_LOWEST_M, _HIGHEST_M = 0.08, 6.0
"""Heights above ground."""
_REACH_M: Final = 1.5
"""Half the length of a piece."""
_HALO_M: Final = 4.0
_FEWEST: Final = 60
_LONG: Final = 4.0
"""A piece is so many times longer than wide, in the scatter of its points."""
_ROUND: Final = 0.12
"""Scatter about the surface, as a share of the radius, at most ..."""
_LEAST_ROUND_M: Final = 0.03
"""... or this."""
_ARC: Final = np.deg2rad(100.0)
_LEVEL: Final = 0.35
"""Largest rise of an axis."""
_KNOWN: Final = 0.15
"""Relative sigma of a radius, at most."""
_ALIKE_RAD: Final = np.deg2rad(15.0)
_BESIDE_M: Final = 0.7
"""The ground is looked up so far beside the pipe."""
_GROUND_M: Final = 0.02
"""Least sigma of the ground there."""
_FREE_M: Final = 0.1
"""A pipe hangs free where its lower side is so far above the ground."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath pipes`."""

    cloud: Path
    output: Path
    least_length_m: float = 6.0


@dataclass(frozen=True, slots=True)
class Pipe:
    """A pipe.

    Attributes
    ----------
    axis_m : ndarray, shape (n, 3)
    radius_m, sigma_radius_m, sigma_axis_m, rms_m : float
    cover_m : ndarray, shape (n,)
        Ground above its upper side at each vertex; below 0 it stands out.
    sigma_cover_m : float
    points : int
    """

    axis_m: Array
    radius_m: float
    sigma_radius_m: float
    sigma_axis_m: float
    rms_m: float
    cover_m: Array
    sigma_cover_m: float
    points: int

    @property
    def length_m(self) -> float:
        """Of its axis."""
        return float(np.linalg.norm(np.diff(self.axis_m, axis=0), axis=1).sum())

    @property
    def free_m(self) -> float:
        """Length that hangs free."""
        below = -self.cover_m - 2.0 * self.radius_m > _FREE_M
        steps = np.linalg.norm(np.diff(self.axis_m, axis=0), axis=1)
        return float(steps[below[:-1] & below[1:]].sum())

    def figures(self) -> dict[str, Any]:
        """For JSON and features."""
        return {
            "diameter_m": 2.0 * self.radius_m, "diameter_sigma_m": 2.0 * self.sigma_radius_m, "length_m": self.length_m,
            "axis_sigma_m": self.sigma_axis_m, "rms_m": self.rms_m, "cover_m": float(np.median(self.cover_m)),
            "cover_least_m": float(self.cover_m.min()), "cover_sigma_m": self.sigma_cover_m, "free_m": self.free_m,
            "points": self.points,
        }  # fmt: skip


@dataclass(slots=True)
class Made:
    """What was found."""

    points: int
    pipes: list[Pipe] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON; of each pipe its stations too: way along it and cover."""
        told = []
        for pipe in self.pipes:
            way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pipe.axis_m, axis=0), axis=1))])
            stations = [{"way_m": float(s), "cover_m": float(c)} for s, c in zip(way, pipe.cover_m, strict=True)]
            told.append(pipe.figures() | {"stations": stations})
        return {"points": self.points, "pipes": told, "warnings": self.warnings}


def work(task: Task, progress: Progress) -> Made:
    """Find pipes, and write them; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError
        A file is not as it should be.
    """
    cloud = reader.look(task.cloud)
    made = Made(cloud.points)
    with written_aside(task.output) as aside:
        floor = Floor(cloud, task.output.parent, progress)
        lift = _Lift()
        pieces = [piece for tile in _tiles(task, floor, lift) for piece in _pieces(tile)]
        for some in _joined(pieces):
            pipe = _pipe([pieces[each] for each in some], floor, lift.mean_m)
            if pipe.length_m >= task.least_length_m:
                made.pipes.append(pipe)
        made.pipes.sort(key=lambda each: -each.length_m)
        _write(aside, task.output.suffix, floor, made.pipes)
    made.warnings += unstated(cloud)
    if not made.pipes:
        made.warnings.append("no pipe was found")
    return made


class _Lift:
    """How far bare ground lies above its lowest points, which the floor is made of, on the average."""

    def __init__(self) -> None:
        self._sum, self._count = 0.0, 0

    def add(self, above: npt.NDArray[np.floating]) -> None:
        """Take heights above the floor."""
        bare = above[np.abs(above) < _LOWEST_M]
        self._sum += float(bare.sum(dtype=np.float64))
        self._count += len(bare)

    @property
    def mean_m(self) -> float:
        """Of all of them."""
        return self._sum / max(self._count, 1)


def _tiles(task: Task, floor: Floor, lift: _Lift) -> Iterator[Tile]:
    grid = floor.grid
    extent = (grid.columns * grid.cell_m, grid.rows * grid.cell_m)
    tiles = Tiles(task.output.parent, {}, side_for(floor.cloud.points, (0.0, 0.0), extent, _HALO_M), _HALO_M)
    for _, xyz, noise in floor.pieces():
        above = floor.above(xyz)
        lift.add(above[~noise])
        tiles.add(xyz[~noise & (above > _LOWEST_M) & (above < _HIGHEST_M)])
    yield from tiles


def _pieces(tile: Tile) -> list[Cylinder]:
    """Cylinders of a square: each about a place that no earlier one holds."""
    tree = cKDTree(tile.xyz_m[:, :2])
    left = tile.core.copy()
    found = []
    for seed in np.flatnonzero(tile.core):
        if not left[seed]:
            continue
        near = np.array(tree.query_ball_point(tile.xyz_m[seed, :2], _REACH_M), np.int64)
        near = near[np.abs(tile.xyz_m[near, 2] - tile.xyz_m[seed, 2]) < _REACH_M]
        # the next seed is a third of a piece away, whatever comes of this one
        beside = np.hypot(*(tile.xyz_m[near, :2] - tile.xyz_m[seed, :2]).T) < _REACH_M / 3.0
        left[near[beside]] = False
        piece = _piece(tile.xyz_m[near])
        if piece is not None:
            found.append(piece)
    return found


def _piece(xyz: Array) -> Cylinder | None:
    """A cylinder, if points lie as on one."""
    if len(xyz) < _FEWEST:
        return None
    values, vectors = np.linalg.eigh(np.cov(xyz.T))
    along = vectors[:, 2]
    if values[2] < _LONG**2 / 4.0 * values[1] or abs(along[2]) > _LEVEL:
        return None
    found = cylinder(xyz, along)
    if found is None or not SMALLEST_M <= 2.0 * found.radius_m <= LARGEST_M:
        return None
    round_m = max(_ROUND * found.radius_m, _LEAST_ROUND_M)
    if found.rms_m > round_m or found.arc_rad < _ARC or found.sigma_radius_m > _KNOWN * found.radius_m:
        return None
    return found if abs(found.along[2]) <= _LEVEL else None


def _joined(pieces: Sequence[Cylinder]) -> list[npt.NDArray[np.int64]]:
    """Pieces that carry each other on."""
    if not pieces:
        return []
    middles = np.array([each.middle_m for each in pieces])
    first, second = [], []
    for a, b in cKDTree(middles).query_pairs(2.0 * _REACH_M):
        one, other = pieces[a], pieces[b]
        d = other.middle_m - one.middle_m
        apart = np.linalg.norm(d - (d @ one.along) * one.along)
        alike = abs(one.along @ other.along) > np.cos(_ALIKE_RAD)
        if alike and apart < 0.6 * max(one.radius_m, other.radius_m) and _near(one.radius_m, other.radius_m):
            first.append(a)
            second.append(b)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(pieces), len(pieces)))
    count, number = connected_components(graph, directed=False)
    return [np.flatnonzero(number == each) for each in range(count)]


def _near(a: float, b: float) -> bool:
    return max(a, b) < 1.4 * min(a, b)


def _pipe(pieces: Sequence[Cylinder], floor: Floor, lift_m: float) -> Pipe:
    """A pipe of its pieces, from end to end."""
    middles = np.array([each.middle_m for each in pieces])
    order = _in_order(middles)
    pieces = [pieces[each] for each in order]
    axis = np.array([each.middle_m for each in pieces])
    # from the first piece's outer end to the last one's
    if len(axis) > 1:
        ends = [_farther(pieces[0], axis[1]), _farther(pieces[-1], axis[-2])]
        axis = np.vstack([ends[0], axis, ends[1]])
    else:
        axis = pieces[0].ends
    radii = np.array([each.radius_m for each in pieces])
    weight = np.array([each.sigma_radius_m for each in pieces]) ** -2.0
    radius = float(radii @ weight / weight.sum())
    # pieces overlap by two thirds: a third of them are independent
    formal = np.sqrt(3.0 / weight.sum())
    spread = float(np.std(radii)) / np.sqrt(max(len(radii) / 3.0, 1.0))
    sigma_axis = float(np.median([each.sigma_axis_m for each in pieces]))
    cover, ground_sigma = _cover(axis, radius, floor, lift_m)
    sigma_radius = float(max(formal, spread))
    rms = float(np.sqrt(np.mean([each.rms_m**2 for each in pieces])))
    whole = float(np.sqrt(sigma_axis**2 + sigma_radius**2 + ground_sigma**2))
    return Pipe(axis, radius, sigma_radius, sigma_axis, rms, cover, whole, sum(each.points for each in pieces))


def _farther(piece: Cylinder, place: Array) -> Array:
    """The end of a piece that is farther from a place."""
    first, second = piece.ends
    return np.asarray(first if np.linalg.norm(first - place) > np.linalg.norm(second - place) else second)


def _in_order(places: Array) -> list[int]:
    """From one end along the line: each time the nearest that is left."""
    far = int(
        np.argmax(
            np.linalg.norm(
                places - places[int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))], axis=1
            )
        )
    )
    order, left = [far], set(range(len(places))) - {far}
    while left:
        at = min(left, key=lambda each: float(np.linalg.norm(places[each] - places[order[-1]])))
        order.append(at)
        left.remove(at)
    return order


def _cover(axis: Array, radius: float, floor: Floor, lift_m: float) -> tuple[Array, float]:
    """Ground above the upper side at each vertex, by the ground on both sides; and the sigma of that ground."""
    way = (
        np.gradient(axis[:, :2], axis=0)
        if len(axis) > 2
        else np.repeat((axis[-1] - axis[0])[None, :2], len(axis), axis=0)
    )
    way = way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    side = np.column_stack([-way[:, 1], way[:, 0], np.zeros(len(axis))]) * (radius + _BESIDE_M)
    heights = [axis[:, 2] - floor.above(axis + sign * side).astype(np.float64) for sign in (-1.0, 1.0)]
    ground = 0.5 * (heights[0] + heights[1]) + lift_m
    scatter = float(np.std(np.diff(ground, n=2))) / np.sqrt(6.0) if len(ground) > 4 else 0.0
    return ground - (axis[:, 2] + radius), max(scatter, _GROUND_M)


def _write(aside: Path, ending: str, floor: Floor, pipes: Sequence[Pipe]) -> None:
    shapes = np.array([shapely.LineString(floor.metres.back(each.axis_m)) for each in pipes], object)
    told = [each.figures() for each in pipes]
    names = list(told[0]) if told else ["diameter_m"]
    columns: dict[str, npt.NDArray[Any]] = {
        name: np.array([each[name] for each in told], np.int32 if name == "points" else np.float64) for name in names
    }
    write_features(aside, Features(shapes, columns, floor.cloud.horizontal), "LineString Z", "pipes", ending)
