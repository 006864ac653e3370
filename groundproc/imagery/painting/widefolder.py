"""`swath wide` as a whole: instants found, their wide images written with poses and the camera that stands for the rig."""

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CaptureError, UsageError
from groundproc.files import make_folder, written_aside
from groundproc.imagery import pictures
from groundproc.imagery.painting.block import POSES, RIG, Block, Image, of_cloud
from groundproc.imagery.painting.scene import laid_out
from groundproc.imagery.painting.wide import Instant, Wide, instants, merged, posed, wide_of
from groundproc.imagery.poses import NO_TIME, ImagePoses, read_poses, write_poses
from groundproc.imagery.radiance import evened
from groundproc.imagery.rig import Rig, RigCamera, write_rig
from groundproc.imagery.rotations import photogrammetric

Progress = Callable[[str, int], object]
Array = npt.NDArray[np.float64]

JSON: Final = "wide.json"
NAME: Final = "wide"


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    cloud, images, output : Path
    photos : Path, optional
    within_s : float
        Images of one instant are no further apart.
    crs : pyproj.CRS, optional
    balance : bool
    all_classes : bool
        Noise and what moves stand too.
    """

    cloud: Path
    images: Path
    output: Path
    photos: Path | None = None
    within_s: float = 0.05
    crs: pyproj.CRS | None = None
    balance: bool = True
    all_classes: bool = False


@dataclass(frozen=True, slots=True)
class Made:
    """What came of it.

    Attributes
    ----------
    images : tuple of str
        The wide ones.
    sources : tuple of tuple of str
        What each is made of.
    width_px, height_px : int
    bands : tuple of str
    cameras : tuple of str
    field_deg : float
        Across the picture.
    spread_deg : float
        How far, rms, cameras turned against each other between instants.
    filled : float
        Share of pixels that some camera sees.
    alone : int
        Images that no other was taken with.
    left_out : tuple of str
    """

    images: tuple[str, ...]
    sources: tuple[tuple[str, ...], ...]
    width_px: int
    height_px: int
    bands: tuple[str, ...]
    cameras: tuple[str, ...]
    field_deg: float
    spread_deg: float
    filled: float
    alone: int
    left_out: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def wide(task: Task, progress: Progress) -> Made:
    """Make a wide image of each instant.

    Raises
    ------
    CaptureError, ConfigError, UsageError, SourceError
    """
    cloud, block = of_cloud(task.cloud, task.images, task.photos, task.crs)
    found, alone = _instants(task, block)
    stands = wide_of(block, found)
    kinds = {image.name: layer for layer in block.layers for image in layer.images}
    bands = tuple(dict.fromkeys(band for layer in block.layers for band in layer.bands))
    dtype = np.dtype(np.uint8) if all(layer.dtype == np.uint8 for layer in block.layers) else np.dtype(np.uint16)

    def shown(image: Image) -> tuple[tuple[str, ...], npt.NDArray[np.float32]]:
        layer = kinds[image.name]
        shown = evened(pictures.picture(image.path), block.rig.cameras[image.camera])
        return layer.bands, shown.astype(np.float32) / np.float32(layer.full)

    make_folder(task.output)
    names: list[str] = []
    done: list[Instant] = []
    failed: list[str] = []
    filled = 0.0
    with laid_out(cloud, block.site, task.output, progress, task.all_classes) as (scene, _):
        for number, instant in enumerate(found, 1):
            try:
                values = merged(block, scene, stands, instant, bands, shown, task.balance)
            except CaptureError as error:
                failed.append(str(error))
                continue
            name = f"{NAME}_{number:04d}.tif"
            _write(task.output / name, values, dtype, bands)
            filled += float(np.isfinite(values).any(axis=-1).mean())
            names.append(name)
            done.append(instant)
            progress("wide images", 1)
    if not names:
        raise CaptureError(f"{task.images}: no wide image could be made ({failed[0]})")
    _tell(task.output, block, stands, done, names, bands)
    lens = stands.camera
    cameras = tuple(block.rig.cameras[number].name for number in sorted(stands.mat_wide_cam))
    ends, _ = lens.unproject(np.array([[0.0, lens.centre_px[1]], [lens.width_px - 1.0, lens.centre_px[1]]]))
    field_deg = float(np.rad2deg(np.arctan2(ends[1, 0], ends[1, 2]) - np.arctan2(ends[0, 0], ends[0, 2])))
    return Made(
        tuple(names), tuple(tuple(image.name for image in each.images) for each in done), lens.width_px, lens.height_px, bands,
        cameras, field_deg, float(np.rad2deg(stands.spread_rad)), filled / len(names), alone, (*block.left_out, *failed),
    )  # fmt: skip


def _instants(task: Task, block: Block) -> tuple[list[Instant], int]:
    """What was taken at once, and how many images were taken alone.

    Raises
    ------
    UsageError
        There is nothing of the kind.
    """
    poses = read_poses(task.images / POSES)
    stamps = dict(zip(poses.images, poses.utc_ns.tolist(), strict=True))
    images = [image for layer in block.layers for image in layer.images]
    timed = [image for image in images if stamps[image.name] != NO_TIME]
    if not timed:
        raise UsageError(
            f"{task.images / POSES}: no image has a time (utc_ns); expected them, by which instants are found"
        )
    found = instants(timed, [stamps[image.name] for image in timed], task.within_s)
    if not found:
        cameras = len({image.camera for image in timed})
        raise UsageError(
            f"{task.images}: no two cameras expose within {task.within_s:g} s ({len(timed)} images of {cameras} cameras); "
            "expected a rig whose cameras expose together, or a larger --within"
        )
    return found, len(images) - sum(len(each.images) for each in found)


def _write(path: Path, values: npt.NDArray[np.float32], dtype: np.dtype[Any], bands: tuple[str, ...]) -> None:
    """A TIFF of a plane a band; 0 where no camera sees, 1 for black."""
    full = float(np.iinfo(dtype).max)
    with np.errstate(invalid="ignore"):
        numbers = np.clip(np.rint(values * full), 1.0, full)
    kept = np.where(np.isfinite(values), numbers, 0.0).astype(dtype)
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings(), written_aside(path) as aside:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            aside, "w", driver="GTiff", width=kept.shape[1], height=kept.shape[0], count=len(bands), dtype=dtype.name, nodata=0,
            compress="deflate", predictor=2, photometric="RGB" if bands[:3] == ("red", "green", "blue") else "MINISBLACK",
            bigtiff="IF_SAFER",
        ) as file:  # fmt: skip
            for number, band in enumerate(bands, 1):
                file.write(kept[..., number - 1], number)
                file.set_band_description(number, band)


def _tell(
    folder: Path, block: Block, stands: Wide, done: list[Instant], names: list[str], bands: tuple[str, ...]
) -> None:
    """poses.csv and rig.yaml of the wide images."""
    turns, places = zip(*(posed(stands, instant) for instant in done), strict=True)
    local = np.array(places)
    mats = np.swapaxes(block.site.mat_local_grid(local), 1, 2) @ np.array(turns)
    nothing = np.full((len(names), 3), np.nan)
    stamps = np.array([instant.utc_ns for instant in done], np.int64)
    poses = ImagePoses(
        tuple(names), stamps, block.site.map(local), np.stack(photogrammetric(mats), axis=1), nothing, nothing
    )
    write_poses(folder / POSES, poses)
    write_rig(folder / RIG, Rig((RigCamera(NAME, stands.camera, image_prefix=NAME, bands=bands),)))
