"""Colours and indices against pictures made by rays: for benchmarks/imagery.py."""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio
import rendered

from groundproc.cli import main
from groundproc.cloud import reader
from groundproc.imagery.painting import block, colour, paint
from groundproc.imagery.painting.scene import Scene
from groundproc.imagery.poses import NO_TIME, ImagePoses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import mat_world_camera

Array = npt.NDArray[np.float64]

DENSITY = 60.0
DENSE = 500.0
"""Points a square metre: where it is asked who sees what, and where time is taken."""
GAIN = {"red": 1.9e4, "nir": 2.6e4}
BLACK = 800.0
PANELS = {"dark": (-12.0, 8.0, 0.05, 0.06), "grey": (12.0, 9.0, 0.3, 0.32), "light": (10.0, -10.0, 0.6, 0.62)}
"""Place, red, near infrared; discs of 1.5 m."""


def figures(folder: Path) -> dict[str, Any]:
    """Who sees what, how fast, and how right the index is."""
    rendered.write_block(folder / "images", rendered.shots(), epsg=None)
    measured, true = rendered.points(DENSITY, 1)
    rendered.write_cloud(folder / "cloud.laz", measured, epsg=None)
    return seen(folder, true) | speed(folder) | {"ndvi_error": ndvi(folder)}


def seen(folder: Path, true: Array) -> dict[str, Any]:
    """Parts of hidden ground that is coloured, of open ground that is refused, of what any image sees that has a colour."""
    cloud = reader.look(folder / "cloud.laz")
    found = block.load(folder / "images", None, None, cloud.path)
    ground = true[:, 2] == 0.0
    hidden_all, shining, open_all, refused = 0, 0, 0, 0
    ever, given = np.zeros(len(true), np.bool_), np.zeros(len(true), np.bool_)
    with tempfile.TemporaryDirectory() as aside:
        scene = Scene(cloud, found.site, Path(aside), lambda _: None)
        for image, shot in zip(found.layers[0].images, rendered.shots(), strict=True):
            sees = np.zeros(len(true), np.bool_)
            for square, some, _ in paint.visible(found, image, scene):
                sees[scene.number[square.points][some.number]] = True
            mat = mat_world_camera(*np.deg2rad(np.array(shot.angles_deg))[:, None])[0]
            _, inside = rendered.CAMERA.project((true - shot.place_m) @ mat)
            hidden = rendered.hidden(shot.place_m, true)
            hidden_all += int((inside & hidden & ground).sum())
            shining += int((inside & hidden & ground & sees).sum())
            open_all += int((inside & ~hidden & ground).sum())
            refused += int((inside & ~hidden & ground & ~sees).sum())
            ever |= inside & ~hidden
            given |= sees
    return {
        "hidden_coloured_fraction": round(shining / hidden_all, 6),
        "visible_rejected_fraction": round(refused / open_all, 6),
        "coloured_fraction": round(int((ever & given).sum()) / int(ever.sum()), 6),
    }


def speed(folder: Path) -> dict[str, Any]:
    """Points times pictures in a second of the whole command, a million points in sixteen pictures."""
    measured, _ = rendered.points(DENSE, 2)
    rendered.write_cloud(folder / "dense.laz", measured, epsg=None)
    for name in ("cloud", "dense"):  # what is compiled at first use is so after the first
        begun, used = time.monotonic(), time.process_time()
        task = colour.Task(folder / f"{name}.laz", folder / "images", folder / f"{name}_coloured.laz")
        colour.colour(task, lambda stage, done: None)
        took_s, busy_s = time.monotonic() - begun, time.process_time() - used
    pairs = len(measured) * len(rendered.shots()) / 1e6
    return {"mpoint_views_per_s": round(pairs / took_s, 2), "mpoint_views_per_cpu_s": round(pairs / busy_s, 2)}


def reflectances(x: Array, y: Array) -> dict[str, Array]:
    """Of the plain, by band: crops that change, and panels."""
    red, nir = 0.07 + 0.03 * np.cos(0.2 * x + 0.1 * y), 0.4 + 0.15 * np.sin(0.22 * y - 0.1 * x)
    for east, north, in_red, in_nir in PANELS.values():
        on = np.hypot(x - east, y - north) < 1.5
        red, nir = np.where(on, in_red, red), np.where(on, in_nir, nir)
    return {"red": red, "nir": nir}


def ndvi(folder: Path) -> float:
    """RMS error of the index on the plain, of pictures of 16 bits with a black level, noise of 1 % and panels."""
    bands = folder / "bands"
    bands.mkdir()
    rng = np.random.default_rng(4)
    camera, taken = rendered.CAMERA, rendered.shots()[:12]
    shape = camera.height_px, camera.width_px
    row, column = np.mgrid[: shape[0], : shape[1]]
    rays, _ = camera.unproject(np.stack([column.ravel(), row.ravel()], axis=1).astype(float))
    for number, shot in enumerate(taken):
        world = rays @ mat_world_camera(*np.deg2rad(np.array(shot.angles_deg))[:, None])[0].T
        distance, box = rendered.hit(shot.place_m, world)
        at = shot.place_m + world * distance[:, None]
        for band, plane in reflectances(at[:, 0], at[:, 1]).items():
            light = GAIN[band] * np.where(box, 0.2, plane).reshape(shape) * rng.normal(1.0, 0.01, shape)
            values = np.rint(np.clip(BLACK + light, 0, 65535)).astype(np.uint16)
            with rasterio.open(
                bands / f"{band}_{number:02d}.tif", "w", driver="GTiff", width=shape[1], height=shape[0], count=1, dtype="uint16"
            ) as file:  # fmt: skip
                file.write(values, 1)
    names = tuple(f"{band}_{number:02d}.tif" for number in range(len(taken)) for band in GAIN)
    nothing = np.full((len(names), 3), np.nan)
    places = np.repeat([shot.place_m for shot in taken], 2, axis=0)
    angles = np.deg2rad(np.repeat([shot.angles_deg for shot in taken], 2, axis=0))
    write_poses(bands / "poses.csv", ImagePoses(names, np.full(len(names), NO_TIME), places, angles, nothing, nothing))
    cameras = (RigCamera(band, camera, image_prefix=band, bands=(band,), black_level=BLACK) for band in GAIN)
    write_rig(bands / "rig.yaml", Rig(tuple(cameras)))
    rows = [f"{name},{x},{y},0,1.2,{red},,,{nir}" for name, (x, y, red, nir) in PANELS.items()]
    (folder / "panels.csv").write_text("\n".join(["name,x,y,z,radius,red,green,blue,nir", *rows]) + "\n")
    words = [
        "--images",
        str(bands),
        "--gsd",
        "0.25",
        "-o",
        str(folder / "ndvi.tif"),
        "--panels",
        str(folder / "panels.csv"),
    ]
    if main(["ndvi", str(folder / "cloud.laz"), *words]):
        raise RuntimeError("swath ndvi failed")
    with rasterio.open(folder / "ndvi.tif") as file:
        shown, transform = file.read(1, masked=True).filled(np.nan), file.transform
    row, column = np.mgrid[: shown.shape[0], : shown.shape[1]]
    x, y = transform * (column + 0.5, row + 0.5)
    told = reflectances(x, y)
    plain = ((np.abs(x) > 5.5) | (np.abs(y) > 4.5)) & np.isfinite(shown)
    for east, north, *_ in PANELS.values():
        plain &= np.abs(np.hypot(x - east, y - north) - 1.5) > 0.4
    error = (shown - (told["nir"] - told["red"]) / (told["nir"] + told["red"]))[plain]
    return round(float(np.sqrt(np.mean(error**2))), 4)
