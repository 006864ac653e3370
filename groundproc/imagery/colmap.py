"""COLMAP's text files: cameras.txt, images.txt, points3D.txt and rig_config.json written, cameras.txt read.

COLMAP's pixel (0.5, 0.5) is the centre of the upper left one, and its images are camera from world (colmap.github.io/format.html). Its
models have no photogrammetric direction of distortion: such a camera is written as the OPENCV model that fits it over the picture.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from flightlog import frames
from flightlog.errors import CaptureError
from groundproc.files import written_aside
from groundproc.imagery.camera import EQUIDISTANT, NONE, RADTAN, Camera
from groundproc.imagery.rig import Rig, RigCamera
from groundproc.text import open_text

Array = npt.NDArray[np.float64]

_SHIFT_PX: Final = 0.5
_GRID: Final = 15


def camera_line(number: int, camera: Camera) -> str:
    """A line of cameras.txt."""
    name, values = model_of(camera)
    return f"{number} {name} {camera.width_px} {camera.height_px} " + " ".join(f"{value:.17g}" for value in values)


def model_of(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's name and parameters of a camera."""
    if camera.model not in (NONE, RADTAN, EQUIDISTANT) or any(camera.skew_px):
        camera = fitted(camera)
    u, v = (value + _SHIFT_PX for value in camera.centre_px)
    values = [camera.focal_px, camera.focal_px * camera.aspect, u, v]
    given = [*camera.coefficients, *[0.0] * 5][:5]
    if camera.model == EQUIDISTANT:
        return "OPENCV_FISHEYE", values + given[:4]
    if camera.model == NONE:
        return "PINHOLE", values
    if given[4]:
        return "FULL_OPENCV", [*values, *given, 0.0, 0.0, 0.0]
    return "OPENCV", values + given[:4]


def fitted(camera: Camera) -> Camera:
    """The camera of COLMAP's that is nearest over the picture: radtan, or equidistant for a fish-eye."""
    axes = [np.linspace(0.02, 0.98, _GRID) * (size - 1) for size in (camera.width_px, camera.height_px)]
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays, reached = camera.unproject(pixels)
    pixels, rays = pixels[reached], rays[reached]
    wide = camera.kind == 3 or bool((rays[:, 2] < 0.2).any())
    model = EQUIDISTANT if wide else RADTAN
    names = ("f", "pu", "pv", "aspect", *(("k1", "k2", "k3", "k4") if wide else ("k1", "k2", "p1", "p2", "k3")))
    first = Camera(camera.width_px, camera.height_px, camera.focal_px, camera.centre_px, model, (), camera.aspect)
    scale = np.array([camera.focal_px, 100.0, 100.0, 1.0, *[0.1] * (len(names) - 4)])
    start = np.array([first.values()[name] for name in names])

    def off(x: Array) -> Array:
        values = dict(zip(names, start + x * scale, strict=True))
        values["f"], values["aspect"] = max(values["f"], 1.0), max(values["aspect"], 0.1)
        found, _ = first.with_values(values).project(rays)
        return np.where(np.isfinite(found), found - pixels, 1e3).ravel()

    best = least_squares(off, np.zeros(len(names)), method="lm", xtol=1e-14, ftol=1e-14)
    return first.with_values(dict(zip(names, start + best.x * scale, strict=True)))


def write(
    folder: Path,
    rig: Rig,
    images: Sequence[str],
    camera: npt.NDArray[np.int64],
    place_m: Array,
    mat_world_camera: Array,
    points_m: Array,
    tracks: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array],
    errors_px: Array,
) -> None:
    """Write a model in COLMAP's text form.

    Parameters
    ----------
    folder : Path
        Made where it is not there.
    rig : Rig
    images : sequence of str
    camera : ndarray of int64, shape (i,)
    place_m, mat_world_camera : ndarray, shapes (i, 3), (i, 3, 3)
    points_m : ndarray, shape (p, 3)
        Not a number where one is left out.
    tracks : tuple
        Image, point and pixel of each measurement, sorted by point.
    errors_px : ndarray, shape (p,)
        RMS of each point's residuals.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    image_of, point_of, pixels = tracks
    used = np.asarray(np.isfinite(points_m).all(axis=1))
    _write(folder / "cameras.txt", (camera_line(n + 1, one.camera) for n, one in enumerate(rig.cameras)))
    order = np.argsort(image_of, kind="stable")
    starts = np.searchsorted(image_of[order], np.arange(len(images) + 1))
    index = np.empty(len(order), np.int64)
    lines: list[str] = []
    quats = frames.quat_from_mat(np.swapaxes(mat_world_camera, 1, 2))
    moved = -np.einsum("ikj,ik->ij", mat_world_camera, place_m)
    for number, name in enumerate(images):
        own = order[starts[number] : starts[number + 1]]
        index[own] = np.arange(len(own))
        pose = " ".join(f"{value:.12g}" for value in (*quats[number], *moved[number]))
        lines.append(f"{number + 1} {pose} {camera[number] + 1} {name}")
        lines.append(
            " ".join(
                f"{x + _SHIFT_PX:.4f} {y + _SHIFT_PX:.4f} {p + 1 if used[p] else -1}"
                for (x, y), p in zip(pixels[own].tolist(), point_of[own].tolist(), strict=True)
            )
        )
    _write(folder / "images.txt", lines)
    ends = np.searchsorted(point_of, np.arange(len(points_m) + 1))
    _write(
        folder / "points3D.txt",
        (
            f"{p + 1} {points_m[p, 0]:.6f} {points_m[p, 1]:.6f} {points_m[p, 2]:.6f} 128 128 128 {errors_px[p]:.4f} "
            + " ".join(f"{image_of[k] + 1} {index[k]}" for k in range(ends[p], ends[p + 1]))
            for p in np.flatnonzero(used).tolist()
        ),
    )
    if len(rig.cameras) > 1:
        with written_aside(folder / "rig_config.json") as aside:
            aside.write_text(json.dumps(rig_config(rig), indent=2) + "\n", encoding="utf-8")


def rig_config(rig: Rig) -> list[dict[str, Any]]:
    """What rig_config.json holds: each camera against the first."""
    first = rig.cameras[0]
    entries: list[dict[str, Any]] = []
    for one in rig.cameras:
        entry: dict[str, Any] = {"image_prefix": one.image_prefix}
        if one is first:
            entry["ref_sensor"] = True
        else:
            mat = one.mat_cam_ins @ first.mat_cam_ins.T
            entry["cam_from_rig_rotation"] = frames.quat_from_mat(mat).tolist()
            entry["cam_from_rig_translation"] = (one.origin_cam_m - mat @ first.origin_cam_m).tolist()
        entries.append(entry)
    return [{"cameras": entries}]


def _write(path: Path, lines: Any) -> None:
    with written_aside(path) as aside, aside.open("w", encoding="utf-8", newline="\n") as file:
        for line in lines:
            file.write(line + "\n")


_MODELS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "SIMPLE_PINHOLE": (NONE, ("f", "pu", "pv")),
    "PINHOLE": (NONE, ("fu", "fv", "pu", "pv")),
    "SIMPLE_RADIAL": (RADTAN, ("f", "pu", "pv", "k1")),
    "RADIAL": (RADTAN, ("f", "pu", "pv", "k1", "k2")),
    "OPENCV": (RADTAN, ("fu", "fv", "pu", "pv", "k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (RADTAN, ("fu", "fv", "pu", "pv", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (EQUIDISTANT, ("fu", "fv", "pu", "pv", "k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (EQUIDISTANT, ("f", "pu", "pv", "k1")),
    "RADIAL_FISHEYE": (EQUIDISTANT, ("f", "pu", "pv", "k1", "k2")),
}
"""COLMAP's models that have an equal here, and the order of their parameters."""


def read_cameras(path: Path) -> Rig:
    """The cameras of a cameras.txt, all looking straight down; names are cam and COLMAP's number.

    Raises
    ------
    CaptureError
        It cannot be read, or has a model without an equal here.
    """
    cameras: list[RigCamera] = []
    try:
        with open_text(path) as file:
            for number, line in enumerate(file, 1):
                words = line.split()
                if words and not words[0].startswith("#"):
                    cameras.append(_read_line(words, f"{path}: line {number}"))
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not cameras:
        raise CaptureError(f"{path}: holds no cameras")
    of = _images_beside(path.with_name("images.txt")) if len(cameras) > 1 else {}
    return Rig(tuple(replace(one, images=of.get(one.name, ())) for one in cameras))


def _images_beside(path: Path) -> dict[str, tuple[str, ...]]:
    """Images of each camera by the images.txt of a model: every other line is IMAGE_ID, pose (7 numbers), CAMERA_ID, NAME."""
    found: dict[str, list[str]] = {}
    if path.is_file():
        with open_text(path) as file:
            lines = [line for line in file if not line.startswith("#")]
        for line in lines[::2]:
            words = line.split(maxsplit=9)
            if len(words) == 10:
                found.setdefault(f"cam{words[8]}", []).append(words[9].strip())
    return {name: tuple(images) for name, images in found.items()}


def _read_line(words: list[str], place: str) -> RigCamera:
    model, names = _MODELS.get(words[1] if len(words) > 1 else "", ("", ()))
    if not model:
        raise CaptureError(f"{place}: model {words[1:2]} found, expected one of {', '.join(_MODELS)}")
    try:
        width, height = int(words[2]), int(words[3])
        given = dict(zip(names, (float(word) for word in words[4:]), strict=True))
    except (ValueError, IndexError):
        raise CaptureError(f"{place}: expected a number, {words[1]}, width, height, {', '.join(names)}") from None
    if any(given.get(name) for name in ("k4", "k5", "k6")) and model == RADTAN:
        raise CaptureError(f"{place}: k4, k5, k6 of FULL_OPENCV have no equal here, expected 0")
    fu = given.get("f", given.get("fu", 0.0))
    coefficients = tuple(given.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
    if model == EQUIDISTANT:
        coefficients = tuple(given.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
    if width < 1 or height < 1 or not fu > 0.0 or not given.get("fv", fu) > 0.0:
        raise CaptureError(f"{place}: expected a picture and focal lengths above 0")
    camera = Camera(
        width, height, fu, (given["pu"] - _SHIFT_PX, given["pv"] - _SHIFT_PX), model, () if model == NONE else coefficients,
        given.get("fv", fu) / fu,
    )  # fmt: skip
    return RigCamera(f"cam{words[0]}", camera)
