"""The surface that the lidar saw as a mesh with the photographs on it."""

import io
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CaptureError, UsageError
from groundproc.imagery.painting.block import COLOURS, Block, Layer, of_cloud
from groundproc.imagery.painting.charts import Chart, charts
from groundproc.imagery.painting.gltf import Piece, write_glb
from groundproc.imagery.painting.scene import Scene, laid_out
from groundproc.imagery.painting.surface import surface_of
from groundproc.imagery.painting.texture import textured
from groundproc.imagery.painting.wavefront import write_obj

Progress = Callable[[str, int], object]

SUFFIXES: Final = (".glb", ".obj")
_QUALITY: Final = 90
_FINEST_M: Final = 0.002
_MOST_TEXELS: Final = 400_000_000


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    cloud, images, output : Path
    photos : Path, optional
    cell_m : float
        Of the mesh; 0: as fine as the points allow.
    texel_m : float
        Of the texture; 0: as a pixel of the images on the ground.
    crs : pyproj.CRS, optional
    balance : bool
    all_classes : bool
        Noise and what moves stand too.
    """

    cloud: Path
    images: Path
    output: Path
    photos: Path | None = None
    cell_m: float = 0.0
    texel_m: float = 0.0
    crs: pyproj.CRS | None = None
    balance: bool = True
    all_classes: bool = False


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    vertices, triangles, textures : int
    cell_m, texel_m : float
    seen : float
        Share of the texels that an image sees; the others are grey.
    walls : float
        Share of the triangles that stand steeply.
    origin_m : tuple of float
        Easting, northing, height that coordinates in the file are from.
    crs : str or None
    left_out : tuple of str
    """

    vertices: int
    triangles: int
    textures: int
    cell_m: float
    texel_m: float
    seen: float
    walls: float
    origin_m: tuple[float, float, float]
    crs: str | None
    left_out: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def mesh(task: Task, progress: Progress) -> Made:
    """Make it.

    Raises
    ------
    CaptureError, ConfigError, UsageError, SourceError
    """
    cloud, block = of_cloud(task.cloud, task.images, task.photos, task.crs)
    crs = task.crs or cloud.horizontal
    layer = _colours(block, task.images)
    with laid_out(cloud, block.site, task.output, progress, task.all_classes) as (scene, folder):
        spacing_m = float(np.median([square.spacing_m for square in scene.squares]))
        surface = surface_of(cloud, spacing_m, task.cell_m or _FINEST_M, task.all_classes)
        texel_m = task.texel_m or _pixel_m(block, layer, scene)
        area_m2 = np.count_nonzero(np.isfinite(surface.height_m)) * surface.grid.cell_m**2
        if area_m2 / texel_m**2 > _MOST_TEXELS:
            raise UsageError(
                f"--texel {texel_m:g}: {area_m2 / texel_m**2:,.0f} texels, expected {_MOST_TEXELS:,} at most; a larger one, or a part"
            )
        made = list(charts(surface, texel_m))
        if not made:
            raise CaptureError(f"{task.cloud}: too few points for a surface")
        painted = textured(
            block, layer, scene, made, surface.grid.cell_m, folder, task.balance, lambda n: progress("images", n)
        )
    origin = np.floor(np.concatenate([chart.vertex_m for chart in made]).min(axis=0))
    pieces = [
        Piece(chart.vertex_m - origin, chart.uv, chart.triangle, _jpeg(picture))
        for chart, picture in zip(made, painted.pictures, strict=True)
    ]
    code = None if crs is None or crs.to_epsg() is None else f"EPSG:{crs.to_epsg()}"
    east, north, height = origin.tolist()
    _write(task.output, pieces, (east, north, height), code)
    return Made(
        sum(len(chart.vertex_m) for chart in made), _triangles(made), len(made), surface.grid.cell_m, texel_m,
        painted.seen / painted.texels, _triangles([chart for chart in made if chart.steep]) / _triangles(made),
        (east, north, height), code, (*block.left_out, *painted.failed),
    )  # fmt: skip


def _triangles(made: list[Chart]) -> int:
    return sum(len(chart.triangle) for chart in made)


def _colours(block: Block, images: Path) -> Layer:
    """The images with colours: those of most images where there are several kinds."""
    having = [layer for layer in block.layers if layer.bands == COLOURS]
    if not having:
        known = "; ".join(", ".join(layer.bands) for layer in block.layers)
        raise UsageError(f"{images}: a texture needs pictures with red, green, blue; these have {known}")
    return max(having, key=lambda layer: len(layer.images))


def _pixel_m(block: Block, layer: Layer, scene: Scene) -> float:
    """Size of a pixel on the surface, as the nearest square of ground of each image has it; the median of the images."""
    centres = np.array([square.centre_m for square in scene.squares])
    found = [
        float(np.linalg.norm(centres - image.eye.place_m, axis=1).min())
        / block.rig.cameras[image.camera].camera.focal_px
        for image in layer.images
    ]
    return round(max(float(np.median(found)), _FINEST_M), 4)


def _jpeg(picture: npt.NDArray[np.uint8]) -> bytes:
    from PIL import Image

    held = io.BytesIO()
    Image.fromarray(picture).save(held, "JPEG", quality=_QUALITY)
    return held.getvalue()


def _write(path: Path, pieces: list[Piece], origin: tuple[float, float, float], crs: str | None) -> None:
    if path.suffix.lower() == ".glb":
        write_glb(path, pieces, {"origin_m": list(origin), "crs": crs})
        return
    head = [
        "made by swath; x east, y north, z up, in metres",
        f"origin {origin[0]:.3f} {origin[1]:.3f} {origin[2]:.3f}: add it for coordinates on the map",
        f"crs {crs}",
    ]
    write_obj(path, pieces, head)
