"""Figures of reflectance, on a made-up field and on recorded strips: a part of `uses.py`, which says what they are."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Figures = dict[str, Any]


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


FIGURES: Final[dict[str, Callable[[], Figures]]] = {"reflectance": reflectance, "strips": strips}
