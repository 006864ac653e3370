"""Compiles or loads what painting runs, on a few pictures of a made-up plain, so that the first cloud does not wait for it."""

from pathlib import Path
from typing import Final

import laspy
import numpy as np
from PIL import Image

from groundproc.imagery.camera import Camera
from groundproc.imagery.painting import colour, indices, mesh, ortho, widefolder
from groundproc.imagery.painting.block import COLOURS, POSES, RIG
from groundproc.imagery.poses import ImagePoses, write_poses
from groundproc.imagery.rig import Rig, RigCamera, write_rig

_HALF_M: Final = 6.0
_HIGH_M: Final = 10.0


def warm_up(folder: Path) -> None:
    """Colour a cloud, and make a mosaic, an index, a mesh and a wide image of it, in a folder."""
    rng = np.random.default_rng(0)
    cloud = folder / "cloud.las"
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.xyz = np.column_stack([rng.uniform(-_HALF_M, _HALF_M, (4000, 2)), rng.normal(0.0, 0.01, 4000)])
    las.write(cloud)
    images = folder / "images"
    images.mkdir()
    kinds = {"rgb": COLOURS, "nir": ("nir",), "red": ("red",)}
    names, places = [], []
    for kind, bands in kinds.items():
        for number in range(2):
            names.append(f"{kind}_{number}.tif")
            places.append((number - 0.5, 0.0, _HIGH_M))
            shown = rng.integers(50, 200, (48, 64, 3))
            of_kind = shown.astype(np.uint8) if len(bands) == 3 else (200 * shown[..., 0]).astype(np.uint16)
            Image.fromarray(of_kind).save(images / names[-1])
    down = np.zeros((len(names), 3))
    unknown = np.full((len(names), 3), np.nan)
    times = np.tile(np.arange(2) * 10**9, len(kinds))
    write_poses(images / POSES, ImagePoses(tuple(names), times, np.array(places), down, unknown, unknown))
    lens = Camera(64, 48, 50.0, (31.5, 23.5))
    cameras = [RigCamera(kind, lens, image_prefix=kind, bands=bands) for kind, bands in kinds.items()]
    write_rig(images / RIG, Rig(tuple(cameras)))

    def quiet(*_: object) -> None:
        return None

    colour.colour(colour.Task(cloud, images, folder / "colour.las"), quiet)
    ortho.ortho(ortho.Task(cloud, images, folder / "ortho.tif", 0.2), quiet)
    indices.indices(indices.Task(cloud, images, folder / "ndvi.tif", 0.2, draped=folder / "ndvi.las"), quiet)
    mesh.mesh(mesh.Task(cloud, images, folder / "mesh.glb"), quiet)
    widefolder.wide(widefolder.Task(cloud, images, folder / "wide"), quiet)
