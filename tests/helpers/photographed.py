"""Photographs of a simulated flight over level ground: what a camera that looks down sees of a pattern painted on it."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

from flightlog import frames
from groundproc.imagery.camera import Camera
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import STRAIGHT_DOWN

Array = npt.NDArray[np.float64]

CAMERA = Camera(320, 480, 400.0, (160.5, 238.0), "radtan", (-0.05, 0.01))
"""Narrow across the flight: pictures overlap along it, and features are what an adjustment takes its time for."""
CELL_M = 0.04
HALF_M = 60.0


def pattern(seed: int) -> Array:
    """Colours of the ground, shape (n, n, 3), 0 to 1, of cells of 4 cm about the origin: noise of several sizes."""
    rng = np.random.default_rng(seed)
    size = int(2 * HALF_M / CELL_M)
    grey = sum(
        ndimage.zoom(rng.normal(0.0, 1.0, (-(-size // step), -(-size // step))), step, order=1)[:size, :size]
        for step in (4, 10, 25)
    )
    tint = np.stack([0.1 * np.sin(np.arange(size) / 200.0)] * size)
    shades = 0.5 + 0.09 * np.asarray(grey)
    return np.clip(np.stack([shades + tint, shades, shades - tint], axis=-1), 0.0, 1.0)


def colour_at(ground: Array, east_m: Array, north_m: Array) -> Array:
    """Of places on the ground, shape (n, 3)."""
    place = [(north_m + HALF_M) / CELL_M, (east_m + HALF_M) / CELL_M]
    planes = [ndimage.map_coordinates(ground[..., plane], place, order=1, mode="nearest") for plane in range(3)]
    return np.stack(planes, axis=-1)


def photograph(poses: npt.NDArray[Any], row: int, ground: Array) -> npt.NDArray[np.uint8]:
    """What the camera sees at a row of truth.csv; it looks straight down of the ins and sits at its place."""
    pose = poses[row]
    angles = np.deg2rad([pose["heading_deg"], pose["pitch_deg"], pose["roll_deg"]])
    mat = frames.mat_local_ins(*angles[:, None])[0]
    down, right = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    rays, _ = CAMERA.unproject(np.stack([right.ravel(), down.ravel()], axis=1).astype(float))
    world = rays @ STRAIGHT_DOWN @ mat.T
    reach = -pose["up_m"] / world[:, 2]
    seen = colour_at(ground, pose["east_m"] + reach * world[:, 0], pose["north_m"] + reach * world[:, 1])
    return np.rint(255.0 * seen).astype(np.uint8).reshape(CAMERA.height_px, CAMERA.width_px, 3)


def write_photographs(
    folder: Path, poses: npt.NDArray[Any], span_s: tuple[float, float], every_s: float, seed: int
) -> list[str]:
    """JPEG files of a part of the flight, times.csv and rig.yaml beside them; gives their names."""
    folder.mkdir(parents=True)
    ground = pattern(seed)
    rate_hz = 1e9 / (poses["utc_ns"][1] - poses["utc_ns"][0])
    first, end, step = (int(seconds * rate_hz) for seconds in (*span_s, every_s))
    lines = ["image,utc_ns"]
    names = []
    for row in range(first, end, step):
        names.append(f"img{row:05d}.jpg")
        Image.fromarray(photograph(poses, row, ground)).save(folder / names[-1], quality=95)
        lines.append(f"{names[-1]},{poses['utc_ns'][row]}")
    (folder.parent / "times.csv").write_text("\n".join(lines) + "\n")
    write_rig(folder.parent / "rig.yaml", Rig((RigCamera("cam0", CAMERA, STRAIGHT_DOWN.copy()),)))
    return names
