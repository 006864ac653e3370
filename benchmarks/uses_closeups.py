"""Figures of what a lidar sees from 4 m, as in figures 4, 25 and 26 of FOI-R--4045--SE: a part of `uses.py`.

trampled_found, trampled_false_per_100m2
                     squares of 30 x 30 cm in grass of 70 cm, between two epochs of the same blades; claims that are none
trampled_found_one_epoch
                     the same in one epoch, amid the grass's own texture
ground_10m_inside_per_m2, ground_10m_inside_error_m
                     echoes of the ground 9 to 11 m inside a wood, from 4 m height outside; how far what `swath ground` classes lies off
                     it (robust sigma)
ground_cells_strongest, ground_cells_last, ground_cells_dual
                     share of cells of 10 cm, up to 15 m inside, with an echo of the ground, by return mode
asphalt_80deg_seen, asphalt_80deg_intensity, grass_80deg_intensity
                     share of beams that meet a road at 79 to 81 deg and 30 m and are answered; mean intensities
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import laspy
import numpy as np
import numpy.typing as npt
from uses_clouds import ORIGIN, features, run, write_cloud

from groundproc.numerics.robust import sigma
from simulator import closeups

Array = npt.NDArray[np.float64]

_SIDE_M: Final = 6.4
_NEAR_M: Final = 0.4


def grass(folder: Path) -> dict[str, Any]:
    """Two meadows of 8 squares in all."""
    found, alone, false, squares = 0, 0, 0, 0
    for seed in (1, 2):
        clouds = []
        for epoch, before in enumerate((True, False)):
            world, middles = closeups.tall_grass(seed, before=before)
            xyz, _ = closeups.seen(world, closeups.over_grass()[:3], 10 * seed + epoch, fov_deg=60.0).points(
                "strongest"
            )
            inside = (np.abs(xyz[:, :2]) < _SIDE_M / 2.0).all(axis=1) & (xyz[:, 2] < 1.5)
            clouds.append(write_cloud(folder / f"{epoch}.laz", xyz[inside]))
        squares += len(middles)
        run("soil", clouds[1], "--before", clouds[0], "--registered", "-o", folder / "t.geojson", "--size", "0.3")
        away = _away(folder / "t.geojson", middles)
        found += int((away.min(axis=0, initial=np.inf) < _NEAR_M).sum())
        false += int((away.min(axis=1, initial=np.inf) > _NEAR_M).sum())
        run("soil", clouds[1], "-o", folder / "s.geojson", "--size", "0.3")
        alone += int((_away(folder / "s.geojson", middles).min(axis=0, initial=np.inf) < _NEAR_M).sum())
    return {
        "trampled_found": round(found / squares, 3),
        "trampled_false_per_100m2": round(100.0 * false / (2 * _SIDE_M**2), 2),
        "trampled_found_one_epoch": round(alone / squares, 3),
    }


def _away(path: Path, middles: Array) -> Array:
    """How far each claim is from each square, shape (claims, squares)."""
    shapes, columns = features(path)
    if not len(shapes):
        return np.empty((0, len(middles)))
    places = np.column_stack([columns["x"], columns["y"]]) - ORIGIN[:2]
    return np.asarray(np.linalg.norm(places[:, None] - middles[None], axis=2))


def wood_edge(folder: Path) -> dict[str, Any]:
    """Along the edge of a wood, 3 m outside."""
    world, relief = closeups.wood_edge(1)
    height = 4.0 + float(relief.at(0.0, -3.0)[2])
    seen = closeups.seen(world, [closeups.Line((-9.0, -3.0, height), (4.5, 0.0, 0.0), 4.0)], 2)
    ground = world.names.index("ground")
    told: dict[str, Any] = {}
    for mode in ("strongest", "last", "dual"):
        xyz, kind = seen.points(mode)
        within = (kind == ground) & (xyz[:, 1] > 0.0) & (xyz[:, 1] < 15.0) & (np.abs(xyz[:, 0]) < 10.0)
        cells = len(np.unique(np.floor(xyz[within, :2] / 0.1).astype(np.int64), axis=0))
        told[f"ground_cells_{mode}"] = round(cells / (15.0 * 20.0 * 100.0), 4)
        if mode == "strongest":
            told["ground_10m_inside_per_m2"] = round(
                float(((xyz[:, 1] > 9) & (xyz[:, 1] < 11) & within).sum()) / 40.0, 1
            )
    near = (np.abs(xyz[:, 0]) < 14.0) & (xyz[:, 1] > -6.0) & (xyz[:, 1] < 19.0)
    run("ground", write_cloud(folder / "w.laz", xyz[near]), "-o", folder / "g.laz")
    las = laspy.read(folder / "g.laz")
    place = np.asarray(las.xyz) - ORIGIN
    band = (np.asarray(las.classification) == 2) & (np.abs(place[:, 1] - 10.0) < 1.0) & (np.abs(place[:, 0]) < 10.0)
    off = place[band, 2] - relief.height(place[band, 0], place[band, 1])
    return told | {"ground_10m_inside_error_m": round(sigma(off, 0.0), 4)}


def road(_: Path) -> dict[str, Any]:
    """From 5.2 m, standing."""
    told: dict[str, Any] = {}
    for material in ("asphalt", "grass"):
        seen = closeups.seen(closeups.road(material), [closeups.Line((0.0, 0.0, 5.2), (0.0, 0.0, 0.0), 0.5)], 1)
        slant = np.rad2deg(np.arccos(np.clip(-seen.direction[:, 2], -1.0, 1.0)))
        some = np.abs(slant - 80.0) < 1.0
        met = seen.range_m[some, 0] > 0.0
        if material == "asphalt":
            told["asphalt_80deg_seen"] = round(float(met.mean()), 3)
        told[f"{material}_80deg_intensity"] = round(float(seen.intensity[some, 0][met].mean()), 1)
    return told


def _in_a_folder(use: Callable[[Path], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    def measured() -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="swath-uses-") as folder:
            return use(Path(folder))

    return measured


FIGURES: Final[dict[str, Callable[[], dict[str, Any]]]] = {
    use.__name__: _in_a_folder(use) for use in (grass, wood_edge, road)
}
