"""Figures of the line of sight, and GDAL as its peer: a part of `uses.py`, which says what they are."""

import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

Array = npt.NDArray[np.float64]
Figures = dict[str, Any]


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


FIGURES: Final[dict[str, Callable[[], Figures]]] = {"sight": sight}
