"""Figures of banks, water lines and slides, on places of known truth: a part of `uses.py`.

bank_edge_rms_m, bank_edge_sigmas
                     edges of three banks, upright to 34 deg: errors across (RMS), and in their sigmas
bank_retreat_error_m, bank_volume_error_percent
                     upper edge that went back by 0.8 m: largest error of a stretch; error of the volume lost
water_line_rms_m, water_level_error_m
                     a beach of 7 deg with and without echoes of the water: errors across (RMS); largest error of a level
displacement_rms_m, displacement_sigmas
                     slopes with stones that slid by 0.19 m: errors of vectors (RMS of the three axes), and in their sigmas
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely
from uses_clouds import features, run, write_cloud

from groundproc.analysis.displacement import patch_moved
from simulator import banks, epochs

Array = npt.NDArray[np.float64]

_NOISE_M: Final = 0.02
_END_M: Final = 1.5


def _lines(path: Path, kind: str, epoch: int = 1) -> list[tuple[Array, dict[str, Any]]]:
    shapes, columns = features(path)
    return [
        (shapely.get_coordinates(shape, include_z=True), {name: values[n] for name, values in columns.items()})
        for n, shape in enumerate(shapes)
        if columns["kind"][n] == kind and columns["epoch"][n] == epoch
    ]


def bank(folder: Path) -> dict[str, Any]:
    """Three banks before and after."""
    off, sigmas, retreat, volume, water, level = [], [], 0.0, [], [], 0.0
    for seed, width_m in enumerate((0.05, 1.0, 3.0), 1):
        before, rng = banks.Bank(seed, length_m=48.0, width_m=width_m), np.random.default_rng(seed)
        after = banks.later(before)
        echoes = 5.0 * (seed % 2)
        a = write_cloud(folder / "a.laz", before.points(rng, 80.0, _NOISE_M, echoes))
        b = write_cloud(folder / "b.laz", after.points(rng, 80.0, _NOISE_M, echoes))
        run("banks", b, "--before", a, "--registered", "-o", folder / "o.geojson", "--stretch", "8")
        for kind, edge in (("upper", before.upper_x), ("lower", before.lower_x)):
            for places, told in _lines(folder / "o.geojson", kind):
                y = places[:, 1]
                inner = (y > _END_M) & (y < before.length_m - _END_M)
                away = ((places[:, 0] - edge(y)) * _square(edge, y))[inner]
                off.append(away)
                sigmas.append(away / told["sigma_m"])
        lost = 0.0
        for places, told in _lines(folder / "o.geojson", "stretch"):
            y = places[:, 1]
            retreat = max(retreat, abs(told["retreat_m"] - float(np.mean(after.moved(y) * _square(before.upper_x, y)))))
            lost += told["lost_m3"] - told["gained_m3"]
        grid = np.stack(np.meshgrid(np.arange(5.0, 24.0, 0.02), np.arange(0.25, 48.0, 0.5)), axis=-1).reshape(-1, 2)
        true = float((before.height(grid) - after.height(grid)).sum()) * 0.01
        volume.append(100.0 * abs(lost - true) / true)
        for places, _ in _lines(folder / "o.geojson", "water"):
            y = places[:, 1]
            water.append(places[:, 0] - before.water_x(y))
            level = max(level, float(np.abs(places[:, 2] - before.level_m - before.fall * y).max()))
    return {
        "bank_edge_rms_m": _rms(off), "bank_edge_sigmas": _rms(sigmas), "bank_retreat_error_m": round(retreat, 4),
        "bank_volume_error_percent": round(max(volume), 2), "water_line_rms_m": _rms(water), "water_level_error_m": round(level, 4),
    }  # fmt: skip


def _square(edge: Callable[[Array], Array], y: Array) -> Array:
    """From a way along x to one across an edge."""
    return np.asarray(1.0 / np.hypot(1.0, (edge(y + 0.01) - edge(y - 0.01)) / 0.02))


def _rms(parts: list[Array]) -> float:
    return round(float(np.sqrt(np.mean(np.concatenate(parts) ** 2))), 4)


def slide(_: Path) -> dict[str, Any]:
    """Twelve patches."""
    moved, off, sigmas = np.array([0.15, -0.1, -0.05]), [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        height = epochs.rough(seed, (0.2, 0.1))
        a = epochs.sampled(rng, height, 14.0, 120.0, _NOISE_M)
        b = epochs.sampled(rng, height, 14.0, 120.0, _NOISE_M) + moved
        found = patch_moved(a, b, np.zeros((3, 3)))
        if found is not None:
            off.append(found.moved_m - moved)
            sigmas.append(off[-1] / np.sqrt(np.diag(found.covariance)))
    return {"displacement_rms_m": _rms(off), "displacement_sigmas": _rms(sigmas)}


def _in_a_folder(use: Callable[[Path], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    def measured() -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="swath-uses-") as folder:
            return use(Path(folder))

    return measured


FIGURES: Final[dict[str, Callable[[], dict[str, Any]]]] = {use.__name__: _in_a_folder(use) for use in (bank, slide)}
