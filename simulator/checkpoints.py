"""What a surveyor would bring home of a place that is photographed: points on open ground with their marks, and panels."""

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from simulator.chance import generator
from simulator.photographs import Studio
from simulator.textures import BANDS, TABLE_OF_LOOKS, is_panel

Array = npt.NDArray[np.float64]

CHECKS: Final = 20
_MARK_SIGMA_PX: Final = 0.3
_CHECK_SIGMA_M: Final = 0.005


def write(studio: Studio, folder: Path) -> None:
    """`control.csv` and `marks.csv`, and `panels.csv` where there are panels."""
    texts = dict(zip(("control.csv", "marks.csv"), _surveyed(studio), strict=True))
    if text := _panels(studio):
        texts["panels.csv"] = text
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def _surveyed(studio: Studio) -> tuple[str, str]:
    """Surveyed points on open ground that several images see, their marks in the images."""
    rng = generator(studio.seed, "check points")
    chosen = _seen_spots(studio, rng)
    names = [f"check{n + 1}" for n in range(len(chosen))]
    grid = studio.on_grid(chosen) if len(chosen) else np.empty((0, 3))
    control = ["name,x,y,z,sigma,use"]
    control += [
        f"{name},{x:.4f},{y:.4f},{z:.4f},{_CHECK_SIGMA_M},check" for name, (x, y, z) in zip(names, grid, strict=True)
    ]
    marks = ["image,point,x_px,y_px,sigma"]
    for one in studio.exposures:
        pixels = studio.pixels_of(one, chosen)
        for name, pixel in zip(names, pixels, strict=True):
            if np.isfinite(pixel).all():
                x, y = pixel + _MARK_SIGMA_PX * rng.standard_normal(2)
                marks.append(f"{studio.name_of(one)},{name},{x:.3f},{y:.3f},{_MARK_SIGMA_PX}")
    return "\n".join(control) + "\n", "\n".join(marks) + "\n"


def _seen_spots(studio: Studio, rng: np.random.Generator) -> Array:
    """Places, shape (n, 3), that three images or more see, far from each other."""
    centres = np.array(
        [studio.poses(studio.cameras[one.camera], np.array([one.time_s]))[0][0] for one in studio.exposures]
    )
    if not len(centres):
        return np.empty((0, 3))
    low, high = centres[:, :2].min(axis=0), centres[:, :2].max(axis=0)
    tried = np.column_stack(
        [rng.uniform(low - 5.0, high + 5.0, (40 * CHECKS, 2)), np.full(40 * CHECKS, centres[:, 2].max())]
    )
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(tried), 1))
    hits = studio.surfaces.opaque(tried.astype(np.float32), down)
    tried, hits = tried[hits >= 0], hits[hits >= 0]
    planes = studio.surfaces.planes[hits]
    flat = np.abs(planes[:, 2]) > 0.9
    tried, planes = tried[flat], planes[flat]
    tried[:, 2] = (planes[:, 3] - np.einsum("ni,ni->n", planes[:, :2], tried[:, :2])) / planes[:, 2]
    seen = np.zeros(len(tried), np.int64)
    for one in studio.exposures:
        seen += np.isfinite(studio.pixels_of(one, tried)).all(axis=1)
    good = tried[seen >= 3]
    apart = 0.6 * float(np.sqrt(np.prod(high - low + 10.0) / CHECKS))
    kept: list[Array] = []
    for place in good:
        if len(kept) < CHECKS and all(np.linalg.norm(place[:2] - other[:2]) > apart for other in kept):
            kept.append(place)
    return np.array(kept).reshape(-1, 3)


def _panels(studio: Studio) -> str:
    """Panels that lie flat: place, radius and reflectance; empty where there are none."""
    world = studio.world
    flat = is_panel(world.material) & (np.abs(world.normals()[:, 2]) > 0.99)
    lines = []
    for surface in np.unique(world.surface[flat]):
        own = flat & (world.surface == surface)
        corners = world.triangles_m[own].reshape(-1, 3)
        radius = 0.4 * float((corners.max(axis=0) - corners.min(axis=0))[:2].min())
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
        x, y, z = studio.on_grid(middle[None])[0]
        values = TABLE_OF_LOOKS[world.material[own][0]]
        numbers = ",".join(f"{values[BANDS.index(band)]:.3f}" for band in ("red", "green", "blue", "nir"))
        lines.append(f"{world.names[surface].replace(',', ' ')},{x:.3f},{y:.3f},{z:.3f},{radius:.2f},{numbers}")
    return "\n".join(["name,x,y,z,radius,red,green,blue,nir", *lines]) + "\n" if lines else ""
