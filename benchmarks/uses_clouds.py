"""Figures of ground, detection, wires, trees and buildings, on recordings and on places of known truth: a part of `uses.py`.

Recordings are found by SWATH_RECORDINGS; figures that need them are null without. The last line is one JSON object:

ground_total_error_percent, ground_kappa_percent
                     means over the ISPRS samples that are there, one setting
ground_points_per_cpu_s
                     the filter alone, cells of 0.5 m, a wood of 14 points/m2
detection_rate_at_5_per_ha
                     of 160 cars put into four real woods
wire_found_fraction, wire_sag_worst_m, wire_false
                     of simulated spans seen by five passes; the largest error of a sag; wires that are none
tree_within_half_metre
                     of the trees of two simulated woods
footprint_iou_least  of the houses of three simulated villages
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
import pyogrio
import pyproj
import shapely

from groundproc.analysis.terrain.filter import bare_ground
from groundproc.analysis.terrain.floor import Floor
from groundproc.analysis.terrain.settings import Settings
from groundproc.cli import main as swath
from groundproc.cloud import reader
from groundproc.raster.cells import Cells
from groundproc.raster.sampling import bilinear
from simulator import outdoors, powerline

Array = npt.NDArray[np.float64]
ORIGIN: Final = np.array([533_000.0, 6_472_000.0, 0.0])
FALSE_PER_HA: Final = 5.0


def recordings(pattern: str) -> list[Path]:
    """Files of the recordings, none where they are not there."""
    folder = os.environ.get("SWATH_RECORDINGS")
    return sorted(Path(folder).glob(pattern)) if folder else []


def write_cloud(path: Path, xyz: Array) -> Path:
    """A cloud of a place, moved to where a CRS has metres."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, ORIGIN
    header.add_crs(pyproj.CRS.from_epsg(32633))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (xyz + ORIGIN).T
    las.write(path)
    return path


def run(*words: str | Path) -> None:
    """A command, its figures left aside."""
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
        assert swath([*map(str, words), "--force"]) == 0, words


def features(path: Path) -> tuple[npt.NDArray[Any], dict[str, npt.NDArray[Any]]]:
    """Geometries at the origin of their place, and their columns."""
    meta, _, wkb, fields = pyogrio.raw.read(path)
    shapes = shapely.from_wkb(wkb)
    moved = shapely.transform(
        shapes, lambda xyz: xyz - ORIGIN[: xyz.shape[1]], include_z=bool(shapely.has_z(shapes).any())
    )
    return moved, dict(zip(meta["fields"], fields, strict=True))


def is_ground(xyz: Array, settings: Settings) -> npt.NDArray[np.bool_]:
    """The ground filter in memory."""
    cells = Cells(settings.cell_m, {"min"})
    cells.add(xyz, xyz[:, 2])
    grid = cells.grid()
    assert grid is not None
    bare = bare_ground(cells.window(grid, "min"), settings)
    return np.asarray(np.abs(xyz[:, 2] - bilinear(bare.height_m, grid, xyz)) <= bilinear(bare.reach_m, grid, xyz))


def ground(_: Path) -> dict[str, Any]:
    """Agreement with classes that people gave, and speed."""
    figures = []
    for path in recordings("clouds/isprs/*.laz"):
        las = laspy.read(path)
        truth, found = np.asarray(las.classification) == 2, is_ground(las.xyz, Settings())
        error = float(np.mean(found != truth))
        chance = found.mean() * truth.mean() + (1 - found.mean()) * (1 - truth.mean())
        figures.append((100 * error, 100 * (1 - error - chance) / (1 - chance)))
        print(f"{path.stem}: total error {figures[-1][0]:.2f} %, kappa {figures[-1][1]:.1f} %", flush=True)
    speed = None
    for path in recordings("clouds/lasR_bcts_2.laz"):
        xyz = np.ascontiguousarray(laspy.read(path).xyz)
        is_ground(xyz, Settings(cell_m=0.5))  # compiled
        start = time.process_time()
        is_ground(xyz, Settings(cell_m=0.5))
        speed = len(xyz) / (time.process_time() - start)
    total, kappa = np.mean(figures, axis=0).tolist() if figures else (None, None)
    return {"ground_total_error_percent": total, "ground_kappa_percent": kappa, "ground_points_per_cpu_s": speed}


def detection(folder: Path) -> dict[str, Any]:
    """Cars put into real woods, found at five false alarms a hectare."""
    rates = []
    for source in recordings("clouds/lasR_bcts_*.laz"):
        las = laspy.read(source)
        floor = Floor(reader.look(source), folder, lambda done: None)
        xyz = np.ascontiguousarray(las.xyz)
        moved, boxes = outdoors.with_vehicles(xyz, xyz[:, 2] - floor.base.bilinear(xyz), 1, 40)
        las.z = moved[:, 2]
        las.write(folder / "c.laz")
        run("detect", folder / "c.laz", "-o", folder / "o.geojson", "--min-score", "-20")
        _, columns = features(folder / "o.geojson")
        away = np.hypot(columns["x"][:, None] - boxes[:, 0], columns["y"][:, None] - boxes[:, 1])
        false = np.sort(columns["score"][away.min(axis=1) > 2.5])[::-1]
        hectares = float(np.prod(np.ptp(xyz[:, :2], axis=0))) / 1e4
        limit = false[min(int(FALSE_PER_HA * hectares), len(false) - 1)]
        best = np.where(away <= 2.5, columns["score"][:, None], -np.inf).max(axis=0)
        rates.append(float(np.mean(best > limit)))
        print(
            f"{source.stem}: {rates[-1]:.3f} found at {FALSE_PER_HA:g} false alarms a hectare, score {limit:.1f}",
            flush=True,
        )
    return {"detection_rate_at_5_per_ha": float(np.mean(rates)) if rates else None}


def wires(folder: Path) -> dict[str, Any]:
    """Conductors of simulated lines."""
    spans, found, false, worst = 0, 0, 0, 0.0
    for seed in range(5):
        line = powerline.power_line(seed)
        run("wires", write_cloud(folder / "c.laz", line.xyz), "-o", folder / "w.geojson")
        shapes, columns = features(folder / "w.geojson")
        of = np.isin(columns["kind"], ("conductor", "guard"))
        lines, sags = [shapely.get_coordinates(each, include_z=True) for each in shapes[of]], columns["sag_m"][of]
        met = set()
        for wire in line.wires:
            middle = wire.places(np.array([wire.length_m / 2]))[0]
            away = [np.linalg.norm(each - middle, axis=1).min() for each in lines]
            nearest = int(np.argmin(away))
            if away[nearest] < 0.5 and abs(sags[nearest] - wire.sag_m) < 0.5:
                met.add(nearest)
                worst = max(worst, abs(float(sags[nearest]) - wire.sag_m))
        spans, found, false = spans + len(line.wires), found + len(met), false + len(lines) - len(met)
    print(f"{found} of {spans} spans, {false} that are none, sag within {worst:.3f} m", flush=True)
    return {"wire_found_fraction": found / spans, "wire_sag_worst_m": worst, "wire_false": false}


def trees(folder: Path) -> dict[str, Any]:
    """Trees of simulated woods."""
    away: list[float] = []
    for seed in (0, 1):
        wood = outdoors.wood(seed, 70.0, 60.0)
        run("trees", write_cloud(folder / "c.laz", wood.xyz), "-o", folder / "t.geojson")
        places = shapely.get_coordinates(features(folder / "t.geojson")[0])
        away += [float(np.hypot(*(places - (each.x, each.y)).T).min()) for each in wood.trees]
    return {"tree_within_half_metre": float(np.mean(np.array(away) <= 0.5))}


def footprints(folder: Path) -> dict[str, Any]:
    """Outlines of the houses of simulated villages."""
    overlap = []
    for seed in range(3):
        place = outdoors.village(seed)
        cloud = write_cloud(folder / "c.laz", place.xyz)
        run("ground", cloud, "-o", folder / "g.laz", "--buildings", folder / "b.geojson")
        found = features(folder / "b.geojson")[0]
        for house in place.houses:
            truth = shapely.Polygon(house.corners())
            overlap.append(max(each.intersection(truth).area / each.union(truth).area for each in found))
    return {"footprint_iou_least": float(min(overlap)), "footprint_iou_mean": float(np.mean(overlap))}


def _in_a_folder(use: Callable[[Path], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    def measured() -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="swath-uses-") as folder:
            return use(Path(folder))

    return measured


FIGURES: Final[dict[str, Callable[[], dict[str, Any]]]] = {
    use.__name__: _in_a_folder(use) for use in (ground, detection, wires, trees, footprints)
}


def main() -> int:
    """Measure what was asked for, or all."""
    found: dict[str, Any] = {}
    for name in sys.argv[1:] or list(FIGURES):
        found |= FIGURES[name]()
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
