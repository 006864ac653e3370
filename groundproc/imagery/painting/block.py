"""The images of a block as painters use them: which picture lies where, by which camera, in which layer."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CaptureError, UsageError
from groundproc.cloud import reader
from groundproc.imagery import pictures
from groundproc.imagery.camera import Camera
from groundproc.imagery.painting.visibility import Eye
from groundproc.imagery.poses import NO_TIME, ImagePoses, read_poses
from groundproc.imagery.rig import Rig, RigCamera, read_rig
from groundproc.imagery.site import Site, cartesian, georeferenced

Array = npt.NDArray[np.float64]

POSES: Final = "poses.csv"
RIG: Final = "rig.yaml"
COLOURS: Final = ("red", "green", "blue")
"""What the planes of a picture of three are, where the rig does not say."""
_STRIP_S: Final = 10.0
"""Images of one strip follow each other sooner; beyond lies a turn."""
_EVEN: Final = 3.0
"""Where one neighbour in time is so much farther than the other, it tells less than nothing."""


@dataclass(frozen=True, slots=True)
class Image:
    """One image.

    Attributes
    ----------
    name : str
        As in poses.csv.
    path : Path
    camera : int
        Of the rig.
    eye : Eye
    """

    name: str
    path: Path
    camera: int
    eye: Eye

    @property
    def axis(self) -> Array:
        """Where it looks, in the local frame, shape (3,)."""
        return np.asarray(self.eye.mat_cam_local[2])


@dataclass(frozen=True, slots=True)
class Layer:
    """Images whose planes mean the same.

    Attributes
    ----------
    bands : tuple of str
        What the planes are: names of point attributes, such as red, green, blue, nir.
    images : tuple of Image
    dtype : numpy.dtype
        Of the numbers.
    """

    bands: tuple[str, ...]
    images: tuple[Image, ...]
    dtype: np.dtype[Any]

    @property
    def full(self) -> float:
        """Full scale of the numbers."""
        return float(np.iinfo(self.dtype).max) if np.issubdtype(self.dtype, np.integer) else 1.0


@dataclass(frozen=True, slots=True)
class Block:
    """All images of a folder.

    Attributes
    ----------
    rig : Rig
    site : Site
    layers : tuple of Layer
    left_out : tuple of str
        Images that cannot be used, and why.
    """

    rig: Rig
    site: Site
    layers: tuple[Layer, ...]
    left_out: tuple[str, ...]


def of_cloud(cloud: Path, images: Path, photos: Path | None, crs: pyproj.CRS | None) -> tuple[reader.Cloud, Block]:
    """A cloud and the images of its place.

    Raises
    ------
    UsageError, CaptureError, ConfigError
    """
    look = reader.look(cloud)
    return look, load(images, photos, crs or look.horizontal, cloud)


def load(folder: Path, photos: Path | None, crs: pyproj.CRS | None, cloud: Path) -> Block:
    """The images of a folder that `swath images` wrote, or that holds poses.csv and rig.yaml beside the pictures.

    Parameters
    ----------
    folder : Path
    photos : Path, optional
        Where the pictures lie. Default: the folder itself, else where `swath images` found them.
    crs : pyproj.CRS or None
        Of the cloud.
    cloud : Path
        Its name, for sentences.

    Raises
    ------
    UsageError, CaptureError, ConfigError
    """
    for name in (POSES, RIG):
        if not (folder / name).is_file():
            raise UsageError(
                f"{folder}: holds no {name}; expected a folder of `swath images`, or of pictures with {POSES} and {RIG}"
            )
    rig, poses = read_rig(folder / RIG), read_poses(folder / POSES)
    site = _site(crs, poses.place_m, folder, cloud)
    place_m = site.local(poses.place_m)
    mat_local_cam = site.mat_local_grid(place_m) @ poses.mat_grid_camera()
    roots = [photos] if photos is not None else [folder, *_found_before(folder)]
    left_out: list[str] = []
    looked: dict[int, tuple[Path, int, pictures.Size]] = {}
    for number, name in enumerate(poses.images):
        try:
            looked[number] = _looked_up(name, roots, rig)
        except CaptureError as error:
            left_out.append(str(error))
    by_name = [
        rig.camera_of(name) for name in poses.images
    ]  # of a picture that is not here too: it tells how fast others moved
    of_camera = [looked[n][1] if n in looked else -1 if named is None else named for n, named in enumerate(by_name)]
    moves, unknown = _rolling(rig, np.array(of_camera, np.int64), poses, place_m)
    layers: dict[tuple[tuple[str, ...], np.dtype[Any]], list[Image]] = {}
    for number, (path, which, size) in looked.items():
        camera = rig.cameras[which]
        eye = eye_of(camera.camera, mat_local_cam[number], place_m[number], moves[number])
        try:
            bands = _bands(camera, size.planes, path)
        except CaptureError as error:
            left_out.append(str(error))
            continue
        layers.setdefault((bands, size.dtype), []).append(Image(poses.images[number], path, which, eye))
    left_out += unknown
    if not layers:
        reason = left_out[0] if left_out else "there are none"
        raise CaptureError(f"{folder}: none of {len(poses)} images can be used ({reason})")
    found = tuple(Layer(bands, tuple(images), dtype) for (bands, dtype), images in layers.items())
    return Block(rig, site, found, tuple(left_out))


def eye_of(camera: Camera, mat_local_cam: Array, place_m: Array, row_m: Array | None = None) -> Eye:
    """A camera at a place, for the kernels; with a rolling shutter it moves from row to row."""
    size = np.array([camera.width_px, camera.height_px], np.int64)
    moves = np.zeros(3) if row_m is None else np.ascontiguousarray(row_m)
    mat = np.ascontiguousarray(mat_local_cam.T)
    return Eye(camera.kind, camera.lens(), mat, np.ascontiguousarray(place_m), size, moves)


def velocities(utc_ns: npt.NDArray[np.int64], place_m: Array) -> Array:
    """Velocity at places with times, shape (n, 3), by those before and after, by one of them where the other is far [m/s].

    Not a number where no other is within `_STRIP_S`.
    """
    found = np.full((len(utc_ns), 3), np.nan)
    order = np.argsort(utc_ns, kind="stable")
    time_s = (utc_ns[order] - utc_ns[order[0]]) * 1e-9 if len(order) else np.empty(0)
    place = place_m[order]
    for n in range(len(order)):
        before, after = n - 1 if n else None, n + 1 if n + 1 < len(order) else None
        slopes, gaps = [], []
        for other in (before, after):
            gap = abs(time_s[other] - time_s[n]) if other is not None else np.inf
            if other is not None and 0.0 < gap <= _STRIP_S:
                slopes.append((place[other] - place[n]) / (time_s[other] - time_s[n]))
                gaps.append(gap)
        if len(gaps) == 2 and max(gaps) > _EVEN * min(gaps):
            slopes, gaps = [slopes[int(np.argmin(gaps))]], [1.0]  # the other one is beyond a turn
        if gaps:
            share = np.array(gaps[::-1]) / sum(gaps)
            found[order[n]] = share @ np.array(slopes)
    return found


def _rolling(
    rig: Rig, cameras: npt.NDArray[np.int64], poses: ImagePoses, place_m: Array
) -> tuple[Array, tuple[str, ...]]:
    """How images move from row to row, shape (n, 3), 0 of those without a rolling shutter; and cameras of which nobody knows."""
    moves, unknown = np.zeros((len(poses), 3)), []
    for number, camera in enumerate(rig.cameras):
        own = np.flatnonzero(cameras == number)
        if not camera.line_delay_s or not len(own):
            continue
        timed = own[poses.utc_ns[own] != NO_TIME]
        moves[timed] = velocities(poses.utc_ns[timed], place_m[timed]) * camera.line_delay_s
        lost = len(own) - np.count_nonzero(np.isfinite(moves[own]).all(axis=1)) + len(own) - len(timed)
        if lost:
            unknown.append(
                f"rolling shutter of camera {camera.name}: how fast {lost} of {len(own)} images moved is not known, as {POSES} "
                "has no times of theirs or of those next to them; their rows are taken to be of one moment"
            )
    return np.nan_to_num(moves), tuple(unknown)


def half_angle_rad(camera: Camera) -> float:
    """Of the cone about the axis that holds the picture."""
    right, below = camera.width_px - 0.5, camera.height_px - 0.5
    across, down = np.linspace(-0.5, right, 9), np.linspace(-0.5, below, 9)
    sides = [(u, v) for u in across for v in (-0.5, below)] + [(u, v) for u in (-0.5, right) for v in down]
    rays, reached = camera.unproject(np.array(sides))
    if not reached.all():
        return float(np.pi)
    return float(np.arccos(np.clip(rays[:, 2].min(), -1.0, 1.0)))


def _site(crs: pyproj.CRS | None, place_m: Array, folder: Path, cloud: Path) -> Site:
    """The frame that the block and the cloud are put in."""
    stated = _told(folder).get("crs")
    code = None if crs is None else crs.to_epsg()
    if stated is not None and code is not None and stated != f"EPSG:{code}":
        raise UsageError(f"{folder}: poses are in {stated}, {cloud} is in EPSG:{code}; expected one CRS for both")
    if stated is None and code is None:
        return cartesian(place_m)
    return georeferenced(code if code is not None else str(stated), place_m)


def _told(folder: Path) -> dict[str, object]:
    """What the adjustment says of itself, if it lies there."""
    try:
        found = json.loads((folder / "bundle.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _found_before(folder: Path) -> list[Path]:
    """Where `swath images` found the pictures."""
    where = _told(folder).get("images_folder")
    return [Path(where)] if isinstance(where, str) else []


def _looked_up(name: str, roots: Sequence[Path], rig: Rig) -> tuple[Path, int, pictures.Size]:
    """Path, camera and kind of an image.

    Raises
    ------
    CaptureError
        Why it cannot be used.
    """
    path = next((root / name for root in roots if (root / name).is_file()), None)
    if path is None:
        raise CaptureError(f"{name}: is not in {' or '.join(map(str, roots))}; --photos says where the pictures are")
    size = pictures.size_of(path)
    which = rig.camera_of(name, (size.width_px, size.height_px))
    if which is None:
        raise CaptureError(f"{name}: is of no camera of the rig ({', '.join(one.name for one in rig.cameras)})")
    camera = rig.cameras[which].camera
    if (size.width_px, size.height_px) != (camera.width_px, camera.height_px):
        raise CaptureError(
            f"{path}: has {size.width_px} x {size.height_px} pixels, camera {rig.cameras[which].name} of the rig "
            f"{camera.width_px} x {camera.height_px}"
        )
    return path, which, size


def _bands(camera: RigCamera, planes: int, path: Path) -> tuple[str, ...]:
    """What the planes of a picture are."""
    planes = 3 if planes == 4 and not camera.bands else planes  # the fourth says what is transparent
    if camera.bands:
        if len(camera.bands) != planes:
            raise CaptureError(
                f"{path}: has {planes} planes, camera {camera.name} of the rig names {len(camera.bands)} bands"
            )
        return camera.bands
    if planes == len(COLOURS):
        return COLOURS
    raise CaptureError(f"{path}: has {planes} planes; expected bands of camera {camera.name} in the rig: what each is")
