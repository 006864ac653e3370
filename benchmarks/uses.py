"""What the uses of a cloud are good for: one function a figure, on made-up scenes with known truth and on recordings.

    make bench-uses            or  benchmarks/uses.py [NAME ...]

Recordings are found by SWATH_RECORDINGS; where it is unset their figures are null. GDAL is the peer of the line of sight: its
`gdal_viewshed` from the package gdal-bin, null where it is not installed. The last line is one JSON object:

reflectance_error         largest error of the mean of a panel or a cell of 1 m with 100 echoes or more, up to 70 deg of incidence
strips_closer             by how many times nearer two strips are to each other than as measured, cells of 1 m, 100 echoes and more
strips_trend_percent      slope of what is left of their difference, in 10 m across
strip_bias_percent        largest difference of a strip of lasR's bcts from the others, single echoes in cells of 1 m with 5 and more
strip_cells_percent       how far single cells of a strip are off, the median, there; `expected`: by the scatter of their own echoes
strip_surface_...         the same of echoes from surfaces, whose incidence is known
change_detection_rate     share of boxes of 1 dm3 found, 1000 points/m2 amid swaying shrubs
change_false_per_100m2    claims that are none, there
(those of uses_clouds.py)  ground, detection, wires, trees, buildings
(those of uses_banks.py)  banks, water lines, slides
(those of uses_closeups.py)  tall grass, the edge of a wood, a road, from 4 m
(those of uses_change.py)  what moved between two flights
(those of uses_ground.py)  soil, moving things, panes, pipes, passability
(those of uses_places.py)  ground of made-up places of other kinds
sight_exact_agreement     share of cells of 200 random surfaces where `exact` says what a dense walk along the line says
sight_fast_agreement      share of cells of a terrain of a million cells where `fast` says what `exact` says
sight_fast_ratio_to_gdal  CPU time of `fast` over that of GDAL, for it
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import uses_banks
import uses_change
import uses_closeups
import uses_clouds
import uses_ground
import uses_places
from scipy.ndimage import gaussian_filter

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT), str(ROOT / "tests" / "helpers")]

Array = npt.NDArray[np.float64]
Figures = dict[str, Any]


def main() -> int:
    """Measure what was asked for, or all."""
    parser = argparse.ArgumentParser(description="Figures of the uses of a cloud.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FIGURES)}; default: all")
    names = parser.parse_args().names or list(FIGURES)
    found: Figures = {}
    for name in names:
        begun = time.process_time()
        found |= FIGURES[name]()
        print(f"{name}: {time.process_time() - begun:.1f} CPU-s", file=sys.stderr)
    print(json.dumps(found))
    return 0


def reflectance() -> Figures:
    """Three panels lying and three tilted on a field, seen from 12 and 40 m; an eighth of the lasers' gain differs."""
    import pyogrio
    import shapely
    from strips import ORIGIN, Scene, Strip, Surface, write_cloud

    from groundproc.radiometry.site import Task
    from groundproc.radiometry.work import run

    values = (0.046, 0.303, 0.813)
    surfaces = [Surface((0, 0, 0.0), (20, 0, 0), (0, 12, 0), 0.35, per_m2=150, texture=0.2)]
    for i, value in enumerate(values):
        slope = np.radians(25 + 15 * i)
        surfaces += [
            Surface((-6 + 6 * i, 0, 0.3), (0.6, 0, 0), (0, 0.6, 0), value, 600),
            Surface((-6 + 6 * i, 6, 1.2), (0.5, 0, 0), (0, 0.5 * np.cos(slope), 0.5 * np.sin(slope)), value, 600),
        ]
    strips = [Strip((-25, -20, 12), (2.5, 0, 0), 0, 20), Strip((-25, 25, 40), (2.5, 0, 0), 40, 20)]
    gains = 1.0 + 0.12 * np.random.default_rng(5).standard_normal(32)
    scene = Scene(surfaces, strips, noise_m=0.02, gains=gains, response=lambda s, r: 80.0 * s)
    echoes = scene.make(8)
    shapes = [
        shapely.transform(shapely.box(-6.6 + 6 * i, -0.6, -5.4 + 6 * i, 0.6), lambda xy: xy + ORIGIN[:2])
        for i in range(3)
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cloud = write_cloud(folder / "a.laz", echoes)
        pyogrio.raw.write(
            folder / "t.gpkg", shapely.to_wkb(np.array(shapes, object)), [np.array(values)], ["reflectance"],
            geometry_type="Polygon", crs="EPSG:32633", driver="GPKG",
        )  # fmt: skip
        track = scene.write_trajectory(folder / "t.csv")
        told = run(Task([cloud], folder / "out", track, folder / "t.gpkg"), lambda stage, count: None)
        import laspy

        value = np.asarray(laspy.read(folder / "out" / "a.laz")["reflectance"], np.float64)
    cell = np.floor(echoes["xyz"][:, :2]).astype(np.int64)
    cell[echoes["surface"] > 0] = 0
    fine = np.isfinite(value) & (echoes["cosine"] > np.cos(np.radians(70.0)))
    keys = np.column_stack([echoes["surface"], echoes["strip"], cell])[fine]
    number = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(number)
    error = (np.bincount(number, value[fine]) - np.bincount(number, echoes["rho"][fine])) / count
    true = 1.0 / 80.0 / gains.mean()
    return {
        "reflectance_error": round(float(np.abs(error[count >= 100]).max()), 4),
        **_between_strips(echoes, value),
        "c_cal_error_in_sigmas": round(abs(told["c_cal"] - true) / told["c_cal_sigma"], 2),
    }


def _between_strips(echoes: dict[str, Any], value: Array) -> Figures:
    """How two strips differ on the field, before and after."""
    field = (echoes["surface"] == 0) & np.isfinite(value)
    cell = np.floor(echoes["xyz"][field, :2]).astype(np.int64)
    keys, number = np.unique(cell, axis=0, return_inverse=True)
    number = number.ravel() * 2 + echoes["strip"][field]
    count = np.bincount(number, minlength=2 * len(keys)).reshape(-1, 2)
    both = (count >= 100).all(axis=1)
    raw, made = (
        np.log(np.divide(*(np.bincount(number, v[field], 2 * len(keys)).reshape(-1, 2)[both] / count[both]).T))
        for v in (echoes["intensity"], value)
    )
    before, after = float(np.median(np.abs(raw))), float(np.median(np.abs(made)))
    return {
        "strips_raw_percent": round(100 * before, 2),
        "strips_after_percent": round(100 * after, 2),
        "strips_closer": round(before / after, 1),
        "strips_trend_percent": round(1000 * abs(float(np.polyfit(keys[both, 1], made, 1)[0])), 3),
    }


def strips() -> Figures:
    """Three strips of an airborne survey over wood, without trajectory or targets."""
    folder = os.environ.get("SWATH_RECORDINGS")
    if folder is None:
        return {"strip_bias_percent": None}
    from groundproc.radiometry.site import Task
    from groundproc.radiometry.work import run

    clouds = sorted((Path(folder) / "clouds").glob("lasR_bcts_*.laz"))
    with tempfile.TemporaryDirectory() as out:
        told = run(Task(clouds, Path(out) / "o"), lambda stage, count: None)
    return {
        name: max(abs(each[column]) for each in told["strips"])
        for name, column in (
            ("strip_bias_percent", "reflectance_percent"),
            ("strip_bias_raw_percent", "raw_percent"),
            ("strip_cells_percent", "reflectance_cells_percent"),
            ("strip_cells_raw_percent", "raw_cells_percent"),
            ("strip_cells_expected_percent", "reflectance_expected_percent"),
            ("strip_surface_bias_percent", "surface_percent"),
            ("strip_surface_cells_percent", "surface_cells_percent"),
            ("strip_surface_expected_percent", "surface_expected_percent"),
        )
    }


def change() -> Figures:
    """Boxes on waves of ground between shrubs that sway by 10 cm, 14 x 14 m, four times."""
    from groundproc.analysis.changebeams import Side
    from groundproc.analysis.changedetection import compare
    from groundproc.analysis.changemodel import Rule, model
    from groundproc.analysis.registration import Registration

    side, per_m2, hits, boxes, false = 14.0, 1000.0, 0, 0, 0
    known = Registration(np.eye(4), np.zeros(3), np.diag([1e-4] * 3 + [1e-8] * 3), 0.01, 1.0, 1.0)
    rule = Rule(0.1, 0.25, known, per_m2)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        shrubs = [(*rng.uniform(1, side - 1, 2), rng.uniform(0.3, 0.8)) for _ in range(6)]
        places = rng.uniform(1, side - 1, (20, 2))
        places = np.array([p for p in places if all(np.hypot(p[0] - x, p[1] - y) > r + 0.4 for x, y, r in shrubs)])
        a, b = (_epoch(rng, each, shrubs, side, per_m2) for each in (places[:0], places))
        at_a, at_b = (model(Side(each, np.zeros_like(each)), rule) for each in (a, b))
        new, gone = compare(at_b, at_a, rule).claims, compare(at_a, at_b, rule).claims
        claimed = np.array([claim.place_m[:2] for claim in new]).reshape(-1, 2)
        apart = np.linalg.norm(claimed[:, None] - places[None], axis=2)
        hits += int((apart.min(axis=0, initial=np.inf) < 0.15).sum())
        boxes += len(places)
        false += int((apart.min(axis=1, initial=np.inf) > 0.2).sum()) + len(gone)
    return {
        "change_detection_rate": round(hits / boxes, 3),
        "change_false_per_100m2": round(false / (4 * side**2 / 100.0), 2),
    }


def _epoch(rng: np.random.Generator, boxes: Array, shrubs: list[Any], side: float, per_m2: float) -> Array:
    xy = rng.uniform(0, side, (int(side**2 * per_m2), 2))
    z = 0.05 * np.sin(xy[:, 0])
    for x, y in boxes:
        z[(np.abs(xy[:, 0] - x) < 0.05) & (np.abs(xy[:, 1] - y) < 0.05)] += 0.1
    parts = [np.column_stack([xy, z]) + rng.normal(0, 1, (len(xy), 3)) * (0.005, 0.005, 0.02)]
    for x, y, radius in shrubs:
        way = rng.standard_normal((int(per_m2 * np.pi * radius**2), 3))
        way *= radius * rng.uniform(0, 1, (len(way), 1)) ** (1 / 3) / np.linalg.norm(way, axis=1)[:, None]
        way[:, 2] = np.abs(way[:, 2])
        parts.append(way + (x, y, 0.0) + rng.normal(0, 0.1, 3) * (1, 1, 0.3) + rng.normal(0, 0.05, (len(way), 3)))
    return np.asarray(np.concatenate(parts) + rng.normal(0, 0.01, 3))


def sight() -> Figures:
    """200 small surfaces by a dense walk along every line, and a terrain of a million cells beside GDAL."""
    from groundproc.analysis.viewshed import FAST, VISIBLE, Sight, height_at, viewshed

    rng = np.random.default_rng(1)
    same = cells = 0
    for number in range(200):
        shape = (int(rng.integers(8, 20)), int(rng.integers(8, 20)))
        z = _surface(rng, shape, number % 3)
        place = rng.uniform(0, 1, 2) * (shape[1] - 1, shape[0] - 1)
        one = Sight(*place, rng.uniform(0, 3), (0.0, 1.5)[number % 2], 0.0, 1.0)
        least = _walked(z, one, height_at(z, one.column, one.row) + one.above_m)
        unsure = np.abs(least) < 1e-3
        agree = (viewshed(z, one) == VISIBLE) == (least >= -1e-9)
        same, cells = same + int((agree | unsure).sum()), cells + z.size
    big = _surface(rng, (1000, 1000), 2).astype(np.float32)
    middle = Sight(500.0, 499.0, 2.0, 0.0, 0.0, 1.0)
    exact, fast = viewshed(big, middle), viewshed(big, middle, FAST)
    spent = []
    for _ in range(5):
        begun = time.process_time()
        viewshed(big, middle, FAST)
        spent.append(time.process_time() - begun)
    gdal_s = _gdal_s(big)
    return {
        "sight_exact_agreement": same / cells,
        "sight_fast_agreement": round(float(np.mean(exact == fast)), 5),
        "sight_fast_ratio_to_gdal": None if gdal_s is None else round(float(np.median(spent)) / gdal_s, 3),
    }


def _surface(rng: np.random.Generator, shape: tuple[int, int], kind: int) -> Array:
    white = rng.standard_normal(shape)
    if kind == 0:
        return np.asarray(3.0 * white)
    if kind == 1:
        return np.asarray(20.0 * gaussian_filter(white, 2))
    rough = 5.0 * gaussian_filter(rng.standard_normal(shape), 2)
    return np.asarray(200.0 * gaussian_filter(white, 8) + rough)


def _walked(z: Array, one: Any, eye: float) -> Array:
    """Least height of the line over the surface, for each cell: at 1500 steps and wherever it crosses an edge of a patch."""
    rows, columns = z.shape
    least = np.empty(z.shape)
    for j in range(rows):
        du, dv = np.arange(columns)[:, None] - one.column, np.full((columns, 1), j - one.row)
        with np.errstate(divide="ignore", invalid="ignore"):
            edges = [(np.arange(columns) - one.column) / du, (np.arange(rows) - one.row) / dv]
        s = np.hstack([np.tile(np.linspace(0, 1, 1501), (columns, 1)), *edges])
        s = np.where((s >= 0.0) & (s <= 1.0), s, 0.0)
        u, v = np.clip(one.column + du * s, 0, columns - 1), np.clip(one.row + dv * s, 0, rows - 1)
        i0, j0 = np.minimum(u.astype(int), columns - 2), np.minimum(v.astype(int), rows - 2)
        p, q = u - i0, v - j0
        north = (1 - p) * z[j0, i0] + p * z[j0, i0 + 1]
        south = (1 - p) * z[j0 + 1, i0] + p * z[j0 + 1, i0 + 1]
        least[j] = (eye + s * (z[j][:, None] + one.target_m - eye) - (1 - q) * north - q * south).min(axis=1)
    return least


def _gdal_s(z: npt.NDArray[np.float32]) -> float | None:
    """CPU time of GDAL for one surface, reading and writing included; None where it is not installed."""
    program = shutil.which("gdal_viewshed")
    if program is None:
        return None
    import rasterio
    from rasterio.transform import from_origin

    with tempfile.TemporaryDirectory() as name:
        given, made = Path(name) / "z.tif", Path(name) / "v.tif"
        with rasterio.open(
            given, "w", driver="GTiff", width=z.shape[1], height=z.shape[0], count=1, dtype="float32", crs="EPSG:32633",
            transform=from_origin(500_000, 6_001_000, 1, 1),
        ) as file:  # fmt: skip
            file.write(z, 1)
        spent = []
        for _ in range(5):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            words = ["-q", "-ox", "500500.5", "-oy", "6000500.5", "-oz", "2", "-md", "5000", "-cc", "0"]
            subprocess.run([program, *words, str(given), str(made)], check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return float(np.median(spent))


FIGURES: Final[dict[str, Callable[[], Figures]]] = {
    "reflectance": reflectance,
    "strips": strips,
    "change": change,
    "sight": sight,
    **uses_banks.FIGURES,
    **uses_change.FIGURES,
    **uses_closeups.FIGURES,
    **uses_clouds.FIGURES,
    **uses_ground.FIGURES,
    **uses_places.FIGURES,
}

if __name__ == "__main__":
    sys.exit(main())
