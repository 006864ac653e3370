"""From a cloud to a list of its trees, square by square.

Memory: that of the ground (see `terrain.floor`) and a square of a million points.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from scipy.spatial import cKDTree

from groundproc.analysis.crowns import Tree, crowns, dead
from groundproc.analysis.terrain.building import LOW_M, roofs
from groundproc.analysis.terrain.floor import Floor
from groundproc.cloud import reader
from groundproc.cloud.classes import BUILDING, HIGH_NOISE, OF_USES
from groundproc.cloud.metres import unstated
from groundproc.cloud.tiles import Tiles, side_for
from groundproc.files import written_aside
from groundproc.raster.cells import Cells
from groundproc.raster.fill import fill
from groundproc.vectors.features import Features, write_features

BUSH_M: Final = 1.0
TREE_M: Final = 3.0
_HALO_M: Final = 10.0
_BUILT: Final = (BUILDING, *OF_USES)
"""Points that were classed as this before grow on no tree."""
_FOOT_M: Final = 1.0
"""What is lower may be ground or a bush at the foot of a wall."""
_DEEPEST_M: Final = -1.0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for: see the options of `swath trees`."""

    cloud: Path
    output: Path
    least_m: float = TREE_M


@dataclass(slots=True)
class Made:
    """Trees, and which are dead."""

    trees: list[Tree] = field(default_factory=list)
    dead: list[bool] = field(default_factory=list)
    points: int = 0
    warnings: list[str] = field(default_factory=list)

    @property
    def kinds(self) -> list[str]:
        """`tree`, `dead` or `bush` for each."""
        return [
            "bush" if each.height_m < TREE_M else "dead" if gone else "tree"
            for each, gone in zip(self.trees, self.dead, strict=True)
        ]

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        heights = [each.height_m for each in self.trees]
        kinds = self.kinds
        return {
            "points": self.points, "trees": kinds.count("tree"), "dead": kinds.count("dead"), "bushes": kinds.count("bush"),
            "stems_seen": sum(each.stem for each in self.trees),
            "median_height_m": float(np.median(heights)) if heights else None, "warnings": self.warnings,
        }  # fmt: skip


def work(task: Task, progress: Callable[[int], object]) -> Made:
    """Find the trees, and write them; `progress` is told of points read.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError, SourceError
        A file is not as it should be.
    """
    cloud = reader.look(task.cloud)
    made = Made(points=cloud.points)
    with written_aside(task.output) as aside:
        floor = Floor(cloud, task.output.parent, progress)
        floor.refuse_thin("trees")
        grid = floor.grid
        side = side_for(cloud.points, (0.0, 0.0), (grid.columns * grid.cell_m, grid.rows * grid.cell_m), _HALO_M)
        tiles = Tiles(task.output.parent, {"above": np.float32}, side, _HALO_M)
        for record, xyz, noise in floor.pieces():
            above, kind = floor.heights(xyz, noise)
            built = np.isin(np.asarray(record.classification), _BUILT) & (above > _FOOT_M)
            _lay_down(xyz, above, built)
            keep = (above > _DEEPEST_M) & (kind != HIGH_NOISE) & ~noise
            tiles.add(xyz[keep], {"above": above[keep]})
        for tile in tiles:
            above = tile.columns["above"]
            _lay_down(tile.xyz_m, above, _on_roofs(tile.xyz_m, above, floor.settings.cell_m))
            found = crowns(tile.xyz_m, above, task.least_m)
            if found:
                # a tree is of the square that its highest point is in
                places = np.array([each.top for each in found])
                nearest = np.asarray(cKDTree(tile.xyz_m[:, :2]).query(places)[1], np.int64)
                made.trees += [each for each, at in zip(found, nearest, strict=True) if tile.core[at]]
        made.trees.sort(key=lambda each: (each.y, each.x))
        made.dead = dead(made.trees)
        _write(aside, task.output.suffix, floor, made)
    made.warnings += unstated(cloud)
    if not made.trees:
        made.warnings.append(f"nothing grows higher than {task.least_m:g} m")
    return made


def _lay_down(xyz_m: Array, above_m: npt.NDArray[np.float32], built: npt.NDArray[np.bool_]) -> None:
    """Put points of what was built on the ground below them, where no canopy is; in place."""
    xyz_m[built, 2] -= above_m[built]
    above_m[built] = 0.0


def _on_roofs(xyz_m: Array, above_m: npt.NDArray[np.float32], cell_m: float) -> npt.NDArray[np.bool_]:
    """Points on buildings, as `swath ground` tells them, shape (n,)."""
    tops, ground, low = Cells(cell_m, {"max"}), Cells(cell_m, {"max"}), Cells(cell_m, {"count"})
    tops.add(xyz_m, xyz_m[:, 2])
    ground.add(xyz_m, xyz_m[:, 2] - above_m)
    low.add(xyz_m[above_m < LOW_M], above_m[above_m < LOW_M])
    grid = tops.grid()
    if grid is None:
        return np.zeros(len(xyz_m), np.bool_)
    roof = roofs(tops.window(grid, "max"), fill(ground.window(grid, "max")), low.window(grid, "count"), cell_m)
    down = np.floor((grid.north_m - xyz_m[:, 1]) / cell_m).astype(np.int64).clip(0, grid.rows - 1)
    right = np.floor((xyz_m[:, 0] - grid.west_m) / cell_m).astype(np.int64).clip(0, grid.columns - 1)
    return np.asarray(roof[down, right] & (above_m > _FOOT_M))


def _write(aside: Path, ending: str, floor: Floor, made: Made) -> None:
    places = np.array([[each.x, each.y, each.foot_m] for each in made.trees]).reshape(-1, 3)
    shapes: npt.NDArray[Any] = np.array(shapely.points(floor.metres.back(places)), object)

    def column(name: str) -> npt.NDArray[Any]:
        return np.array([getattr(each, name) for each in made.trees], np.float64)

    columns = {
        "kind": np.array(made.kinds, object), "height_m": column("height_m"), "crown_m": column("crown_m"),
        "stem": np.array([int(each.stem) for each in made.trees], np.int32), "through": column("through"),
        "points": np.array([each.points for each in made.trees], np.int32),
    }  # fmt: skip
    write_features(aside, Features(shapes, columns, floor.cloud.horizontal), "Point Z", "trees", ending)
