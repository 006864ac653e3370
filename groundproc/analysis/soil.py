"""From one cloud, or two of one place, to disturbed soil: patches that stand out by height and reflectance (see `patches`).

Of one cloud the ground is held against the plane around each place. Of two the later one is laid on the earlier, and what is looked at is
how much each cell changed, so that stones, ruts and tufts that stayed do not count. Memory: that of the ground, and a square of a million
points.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.ndimage import distance_transform_edt
from scipy.special import erfc

from flightlog.errors import CoverageError, UsageError
from groundproc.analysis.epochs import laid
from groundproc.analysis.patches import Field, Patch, patches
from groundproc.analysis.terrain.building import outlines
from groundproc.analysis.terrain.floor import Floor
from groundproc.analysis.terrain.surfaces import Sheet
from groundproc.cloud import reader
from groundproc.cloud.classes import GROUND, NO_SURFACE, PANE, UNCLASSIFIED
from groundproc.cloud.metres import unstated
from groundproc.cloud.tiles import Tile, Tiles, side_for
from groundproc.files import written_aside
from groundproc.raster.grid import Grid, Window
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]
Progress = Callable[[int], object]

SIZE_M: Final = 0.5
LEAST_SCORE: Final = 5.0
LEAST_M: Final = 0.01
_HALO: Final = 12.0
"""Sizes of a patch."""
_PER_CELL: Final = 2.0
_CELLS: Final = (3.0, 10.0)
"""Cells in a patch's side, at least and at most."""
_FEWEST: Final = 10.0
"""Points of ground on a patch, below which heights are not known well enough."""
_LEAST_ON_PATCH: Final = 0.1
"""With fewer a wide cloud is refused: cells of a raster over it are nearly all empty."""
_SMALL_M2: Final = 1e4
_STANDING_M: Final = 3.0
"""What stands lower than this above the ground, and is none: walls, shrubs, cars, branches. Its foot passes for ground ..."""
_BESIDE_M: Final = 0.5
"""... up to here."""
_TRIES: Final = 4.0
"""Places that are looked at on the area of a patch and differ from each other."""
_BY_CHANCE: Final = 1.0
"""Claims that the whole area may have by chance: the larger it is, the more unusual each has to be."""
_STRENGTHS: Final = ("reflectance", "intensity")


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath soil`.

    Attributes
    ----------
    cloud, output : Path
    before : Path or None
        The same place, earlier.
    size_m, least_score, least_m : float
        As for `patches.patches`.
    registered : bool
        The clouds lie on each other already.
    """

    cloud: Path
    output: Path
    before: Path | None = None
    size_m: float = SIZE_M
    least_score: float = LEAST_SCORE
    least_m: float = LEAST_M
    registered: bool = False


@dataclass(frozen=True, slots=True)
class Place:
    """A patch on the map.

    Attributes
    ----------
    patch : Patch
    outline : shapely.Polygon
        In metres.
    middle_m : ndarray, shape (3,)
    area_m2 : float
    """

    patch: Patch
    outline: Any
    middle_m: Array
    area_m2: float

    @property
    def volume_m3(self) -> float:
        """Raised or, below 0, taken away."""
        return self.patch.height_m * self.area_m2


@dataclass(slots=True)
class Made:
    """What was found."""

    strength: str | None
    density_m2: float = 0.0
    cell_m: float = 0.0
    registration_sigma_m: float | None = None
    ground_points: int = 0
    looked_m2: float = 0.0
    places: list[Place] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        raised = [each for each in self.places if each.patch.height_m > 0]
        return {
            "patches": len(self.places), "raised": len(raised), "sunk": len(self.places) - len(raised),
            "raised_m3": sum(each.volume_m3 for each in raised),
            "sunk_m3": -sum(each.volume_m3 for each in self.places if each.patch.height_m <= 0),
            "strength": self.strength, "ground_points": self.ground_points, "ground_points_per_m2": self.density_m2,
            "cell_m": self.cell_m, "looked_m2": self.looked_m2,
            "registration_sigma_m": self.registration_sigma_m, "warnings": self.warnings,
        }  # fmt: skip


def work(task: Task, progress: Progress) -> Made:
    """Find patches, and write them; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError, UsageError
        A file is not as it should be.
    """
    if not 0.1 <= task.size_m <= 20.0:
        raise UsageError(f"--size {task.size_m:g} m: expected 0.1 to 20 m, for example {SIZE_M:g}")
    later = reader.look(task.cloud)
    clouds = [later] if task.before is None else [reader.look(task.before), later]
    strength = next((name for name in _STRENGTHS if all(name in each.columns for each in clouds)), None)
    made = Made(strength, warnings=unstated(*clouds))
    with written_aside(task.output) as aside:
        floor = Floor(clouds[0], task.output.parent, progress)
        tiles, standing = _ground(task, clouds, floor, strength, made)
        found: list[Place] = []
        seen = False
        for tile in tiles:
            grid, cells = _field(tile, floor, standing, made.cell_m, len(clouds))
            seen |= bool(np.isfinite(cells.strength).any())
            made.looked_m2 += float(np.isfinite(cells.height_m).sum() * made.cell_m**2 * tile.core.mean())
            found += _of_tile(tile, grid, cells, floor, task)
            progress(int(tile.core.sum()))
        tries = _TRIES * made.looked_m2 / task.size_m**2
        made.places = [each for each in _once(found, task.size_m) if tries * _chance(each.patch, seen) <= _BY_CHANCE]
        if not seen:
            made.strength = None
            made.warnings.append(
                f"{task.cloud}: no reflectance or intensity on its ground, so that height alone is looked at"
            )
        _write(aside, task.output.suffix, floor, made.places)
    return made


def _chance(patch: Patch, lit: bool) -> float:
    """How often even ground is as unusual at one place: of two strengths together, or of height alone."""
    return float(np.exp(-0.5 * patch.score**2) if lit else erfc(patch.score / np.sqrt(2.0)))


def _ground(
    task: Task, clouds: list[reader.Cloud], floor: Floor, strength: str | None, made: Made
) -> tuple[Tiles, Sheet]:
    """Points of ground in squares, and where things stand; sizes of cells go by how many there are."""
    grid = floor.grid
    halo = _HALO * task.size_m
    side = side_for(
        sum(each.points for each in clouds), (0.0, 0.0), (grid.columns * grid.cell_m, grid.rows * grid.cell_m), halo
    )
    tiles = Tiles(task.output.parent, {"epoch": "u1", "strength": "f4"}, side, halo)
    counts, squares = np.zeros(len(clouds)), np.empty(0, np.int64)
    standing = Sheet(floor.grid, task.output.parent, np.uint8)
    for epoch, xyz, none, values in _pieces(task, clouds, floor, strength, made):
        above, kind = floor.heights(xyz, none)
        _mark(standing, xyz[(kind == UNCLASSIFIED) & ~none & (above < _STANDING_M)])
        bare = kind == GROUND
        tiles.add(xyz[bare], {"epoch": np.full(int(bare.sum()), epoch, np.uint8), "strength": values[bare]})
        counts[epoch] += bare.sum()
        if epoch == len(clouds) - 1:
            square = np.floor(xyz[bare, :2]).astype(np.int64)
            squares = np.union1d(squares, (square[:, 0] << 32) + (square[:, 1] & 0xFFFFFFFF))
        floor.progress(len(xyz))
    if not counts.all():
        raise CoverageError(
            f"{task.cloud}: no point of it lies on the ground of {clouds[0].path}; are they of one place?"
        )
    wide = np.unique(((squares >> 35) << 32) + ((squares & 0xFFFFFFFF) >> 3))
    on_patch = float(counts.min()) / (64.0 * len(wide)) * task.size_m**2
    if on_patch < _LEAST_ON_PATCH and grid.columns * grid.rows * grid.cell_m**2 > _SMALL_M2:
        raise CoverageError(
            f"{task.cloud}: {on_patch:.2g} points of ground on a patch of {task.size_m:g} m, expected {_LEAST_ON_PATCH:g} or more; larger "
            "ones are found, see --size"
        )
    made.ground_points, made.density_m2 = int(counts.sum()), float(counts.min() / max(len(squares), 1))
    most, least = (task.size_m / each for each in _CELLS)
    made.cell_m = float(np.clip(np.sqrt(_PER_CELL / made.density_m2), least, most))
    if made.density_m2 * task.size_m**2 < _FEWEST:
        made.warnings.append(
            f"{task.cloud}: {made.density_m2:.0f} points of ground on a square metre, fewer than {_FEWEST:g} on a patch of "
            f"{task.size_m:g} m; larger ones are found, see --size"
        )
    return tiles, standing


def _mark(standing: Sheet, xyz: Array) -> None:
    """Note the cells that points of standing things lie in."""
    grid = standing.grid
    column = np.floor((xyz[:, 0] - grid.west_m) / grid.cell_m).astype(np.int64)
    down = np.floor((grid.north_m - xyz[:, 1]) / grid.cell_m).astype(np.int64)
    inside = (column >= 0) & (column < grid.columns) & (down >= 0) & (down < grid.rows)
    standing.mark(down[inside], column[inside], 1)


def _open(standing: Sheet, xy: Array, reach_m: float) -> npt.NDArray[np.bool_]:
    """Places that nothing stands within a reach of, shape (n,)."""
    grid = standing.grid
    column, down = (xy[:, 0] - grid.west_m) / grid.cell_m, (grid.north_m - xy[:, 1]) / grid.cell_m
    out = np.ones(len(xy), np.bool_)
    low, high = np.floor([down.min(), column.min()]), np.ceil([down.max(), column.max()])
    pad = int(np.ceil(reach_m / grid.cell_m)) + 1
    top, left = (max(int(each) - pad, 0) for each in low)
    rows, columns = min(int(high[0]) + pad, grid.rows) - top, min(int(high[1]) + pad, grid.columns) - left
    if rows <= 0 or columns <= 0:
        return out
    part = standing.window(Window(grid.column + left, grid.row + grid.rows - top - rows, columns, rows)) > 0
    if not part.any():
        return out
    # from the middle of a cell with a thing in it: half a cell more is certain to be of it
    away = distance_transform_edt(~part) * grid.cell_m
    i = (np.floor(down).astype(np.int64) - top).clip(0, part.shape[0] - 1)
    j = (np.floor(column).astype(np.int64) - left).clip(0, part.shape[1] - 1)
    return np.asarray(away[i, j] > reach_m)


def _pieces(
    task: Task, clouds: list[reader.Cloud], floor: Floor, strength: str | None, made: Made
) -> Iterator[tuple[int, Array, npt.NDArray[np.bool_], npt.NDArray[np.float32]]]:
    """Epoch, places in metres, which belong to no ground by their class, and strengths."""
    asked = {"classification"} | ({strength} if strength else set())
    if len(clouds) == 1:
        for chunk in reader.chunks(clouds[0], columns=asked & set(clouds[0].columns)):
            xyz = np.ascontiguousarray(floor.metres.of(chunk.points.xyz_m))
            yield 0, xyz, _none(chunk), _strength(chunk, strength)
        return
    epochs = laid((clouds[0], clouds[1]), (None, None), task.registered, lambda stage, count: floor.progress(count))
    made.registration_sigma_m = None if task.registered else epochs.registration.sigma_m
    for number in range(2):
        for chunk, xyz, _ in epochs.chunks(number, tuple(asked & set(clouds[number].columns))):
            yield number, np.ascontiguousarray(xyz), _none(chunk), _strength(chunk, strength)


def _none(chunk: reader.Chunk) -> npt.NDArray[np.bool_]:
    kind = chunk.points.columns.get("classification", np.zeros(len(chunk.points), np.uint8))
    return np.isin(kind, (*NO_SURFACE, PANE))


def _strength(chunk: reader.Chunk, name: str | None) -> npt.NDArray[np.float32]:
    if name is None:
        return np.full(len(chunk.points), np.nan, np.float32)
    return np.asarray(chunk.points[name]).astype(np.float32)


def _field(tile: Tile, floor: Floor, standing: Sheet, cell_m: float, epochs: int) -> tuple[Grid, Field]:
    """Cells of a square and around it: of two epochs how much they changed."""
    cell = np.floor(tile.xyz_m[:, :2] / cell_m).astype(np.int64)
    low = cell.min(axis=0)
    columns, rows = (int(each) for each in cell.max(axis=0) - low + 1)
    grid = Grid(int(low[0]), int(low[1]), columns, rows, cell_m)
    key = (cell[:, 1] - low[1]) * columns + cell[:, 0] - low[0]
    # above a smooth surface, which is added again in the middle: a slope within a cell does no harm
    over = tile.xyz_m[:, 2] - floor.base.bilinear(tile.xyz_m)
    middles = _middles(grid)
    level = floor.base.bilinear(middles) if epochs == 1 else 0.0
    parts = []
    for epoch in range(epochs):
        some = tile.columns["epoch"] == epoch
        parts.append(_cells(key[some], over[some], tile.columns["strength"][some], rows * columns))
    height = parts[-1][0] - (parts[0][0] if epochs == 2 else 0.0) + level
    height = np.where(_open(standing, middles, _BESIDE_M), height, np.nan)
    variance = sum(each[1] for each in parts)
    strength = parts[-1][2] - (parts[0][2] if epochs == 2 else 0.0)
    shape = rows, columns
    return grid, Field(height.reshape(shape), np.asarray(variance).reshape(shape), strength.reshape(shape), cell_m)


def _middles(grid: Grid) -> Array:
    east = (grid.column + np.arange(grid.columns) + 0.5) * grid.cell_m
    north = (grid.row + np.arange(grid.rows) + 0.5) * grid.cell_m
    return np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)


def _cells(
    key: npt.NDArray[np.int64], over: Array, strength: npt.NDArray[np.float32], size: int
) -> tuple[Array, Array, Array]:
    """Mean height, its variance, and logarithm of the mean strength of each cell."""
    count = np.bincount(key, minlength=size)
    mean = np.bincount(key, over, size) / np.maximum(count, 1)
    spread = float(np.sum((over - mean[key]) ** 2)) / max(len(key) - int((count > 0).sum()), 1)
    known = np.isfinite(strength) & (strength > 0.0)
    lit = np.bincount(key[known], minlength=size)
    light = np.bincount(key[known], strength[known], size) / np.maximum(lit, 1)
    with np.errstate(divide="ignore"):
        log = np.where(lit > 0, np.log(light), np.nan)
    return np.where(count > 0, mean, np.nan), spread / np.maximum(count, 1), log


def _of_tile(tile: Tile, grid: Grid, cells: Field, floor: Floor, task: Task) -> list[Place]:
    """Patches whose middle lies in the square itself."""
    found = []
    for patch in patches(cells, task.size_m, task.least_score, task.least_m):
        xy = np.array([grid.column + patch.column + 0.5, grid.row + patch.row + 0.5]) * grid.cell_m
        if not tile.core[int(np.argmin(((tile.xyz_m[:, :2] - xy) ** 2).sum(axis=1)))]:
            continue
        shapes = outlines(patch.cells[::-1], grid)
        if not shapes:
            continue
        z = float(floor.base.bilinear(xy[None])[0])
        outline = max(shapes, key=lambda each: each.area)
        area = float(patch.cells.sum()) * grid.cell_m**2
        found.append(Place(patch, outline, np.array([*xy, z]), area))
    return found


def _once(found: list[Place], size_m: float) -> list[Place]:
    """The most unusual first; one that two squares tell is told once."""
    out: list[Place] = []
    for each in sorted(found, key=lambda place: -place.patch.score):
        if all(np.hypot(*(each.middle_m - other.middle_m)[:2]) > size_m / 2.0 for other in out):
            out.append(each)
    return out


def _write(aside: Path, ending: str, floor: Floor, places: list[Place]) -> None:
    metres = floor.metres
    middles = np.array([metres.back(each.middle_m[None])[0] for each in places]).reshape(-1, 3)

    def column(value: Callable[[Place], float]) -> Array:
        return np.array([value(each) for each in places], np.float64)

    columns: dict[str, npt.NDArray[Any]] = {
        "kind": np.array(["raised" if each.patch.height_m > 0 else "sunk" for each in places], object),
        "score": column(lambda each: each.patch.score),
        "height_m": column(lambda each: each.patch.height_m),
        "height_sigma_m": column(lambda each: each.patch.height_sigma_m),
        "reflectance_step": column(lambda each: each.patch.step),
        "area_m2": column(lambda each: each.area_m2),
        "volume_m3": column(lambda each: each.volume_m3),
        "x": middles[:, 0], "y": middles[:, 1], "z": middles[:, 2],
    }  # fmt: skip
    shapes = [shapely.transform(each.outline, lambda xy: xy / metres.across) for each in places]
    write_features(
        aside, Features(np.array(shapes, object), columns, floor.cloud.horizontal), "Polygon", "soil", ending
    )
