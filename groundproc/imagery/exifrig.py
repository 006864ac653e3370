"""A rig from what images say of their cameras: Pix4D's XMP (Parrot, MicaSense, senseFly), else the focal length of EXIF."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Final

import numpy as np

from groundproc.imagery.camera import POLYNOMIAL, RADTAN, Camera
from groundproc.imagery.photos import Picture
from groundproc.imagery.rig import Rig, RigCamera, band_name
from groundproc.imagery.rotations import STRAIGHT_DOWN

_DIAGONAL_35MM: Final = math.hypot(36.0, 24.0)
_UNIT_MM: Final = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 1e-3}
"""Of FocalPlaneResolutionUnit (EXIF 2.3, section 4.6.5; 4 and 5 of the TIFF technical notes)."""
_FOCAL_SHARE: Final = 0.1
"""Sigma of a focal length of EXIF, which is rounded, and moves with the focus."""
_GUESSED_SHARE: Final = 0.3
_CENTRE_SHARE: Final = 0.02
_ESTIMATE: Final = ("f", "pu", "pv", "k1", "k2", "p1", "p2")


def rig_of(pictures: Sequence[Picture]) -> tuple[Rig, list[int], list[str]]:
    """A camera for each make, model, size and band; the camera of each picture; and what had to be guessed, in words."""
    keys: dict[tuple[object, ...], int] = {}
    cameras: list[RigCamera] = []
    numbers, notes = [], []
    for picture in pictures:
        key = (*picture.maker, picture.tags.get("BandName", ""), picture.tags.get("ModelType", ""))
        if key not in keys:
            keys[key] = len(cameras)
            camera, note = _camera(picture, f"cam{len(cameras)}")
            cameras.append(camera)
            notes += [note] if note else []
        numbers.append(keys[key])
    names = [picture.name for picture in pictures]
    return named(Rig(tuple(cameras)), names, numbers), numbers, notes


def named(rig: Rig, images: Sequence[str], camera: Sequence[int]) -> Rig:
    """The rig with a prefix or a pattern for each camera, so that who reads it knows whose an image is; else with their names.

    A folder or an ending (`*_NIR.TIF`) fits the next flight too.
    """
    if len(rig.cameras) < 2:
        return rig
    of = [[name for name, one in zip(images, camera, strict=True) if one == n] for n in range(len(rig.cameras))]
    patterns = [_pattern(own, [name for name in images if name not in set(own)]) for own in of]
    if all(patterns):
        return Rig(tuple(replace(one, image_prefix=p) for one, p in zip(rig.cameras, patterns, strict=True)))
    return Rig(tuple(replace(one, images=tuple(own)) for one, own in zip(rig.cameras, of, strict=True)))


def _beginning(names: Sequence[str]) -> str:
    """What all names begin with, letter by letter."""
    low, high = min(names), max(names)
    same = next((n for n, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), min(len(low), len(high)))
    return low[:same]


def _pattern(own: Sequence[str], others: Sequence[str]) -> str:
    """A folder, an ending or the beginning of a name that fits all of some names and none of others; empty where there is none."""
    ends = _beginning([name[::-1] for name in own])[::-1]
    ends = ends[max(ends.find("_"), ends.find("-"), 0) :]
    begins = _beginning([PurePosixPath(name).stem for name in own]).rstrip("0123456789")
    folder = _beginning(own).rpartition("/")[0]
    for pattern in (f"{folder}/" if folder else "", f"*{ends}" if ends[:1] in ("_", "-") else "", begins):
        probe = RigCamera("", Camera(1, 1, 1.0, (0.0, 0.0)), image_prefix=pattern)
        if pattern and not any(letter in pattern.lstrip("*") for letter in "*?[") and not any(map(probe.takes, others)):
            return pattern
    return ""


def _camera(picture: Picture, name: str) -> tuple[RigCamera, str]:
    found = _of_xmp(picture, name)
    if found is not None:
        return found, ""
    tags, width, height = picture.tags, picture.width_px, picture.height_px
    focal, share, note = _focal_px(picture), _FOCAL_SHARE, ""
    if not math.isfinite(focal):
        focal, share = 0.9 * max(width, height), _GUESSED_SHARE
        what = " ".join(str(tags.get(key, "")) for key in ("make", "model")).strip() or "the camera"
        note = f"{picture.name}: says no focal length; {focal:.0f} px taken for {what}, give a --rig to know better"
    camera = Camera(width, height, focal, ((width - 1) / 2.0, (height - 1) / 2.0), RADTAN, (0.0,) * 5)
    sigma = {
        "f": share * focal,
        "pu": _CENTRE_SHARE * width,
        "pv": _CENTRE_SHARE * width,
        "k1": 0.2,
        "k2": 0.2,
        "p1": 0.01,
        "p2": 0.01,
    }
    return RigCamera(name, camera, bands=_bands_of(picture), estimate=_ESTIMATE, sigma=sigma), note


def _bands_of(picture: Picture) -> tuple[str, ...]:
    """Bands as XMP names them."""
    text = str(picture.tags.get("BandName", ""))
    return tuple(map(band_name, text.split(","))) if text else ()


def _pixels_a_mm(picture: Picture) -> float:
    """Pixels of this file a millimetre of the sensor; not a number where it does not say."""
    tags = picture.tags
    resolution = float(tags["plane_resolution"]) / _UNIT_MM.get(float(tags["plane_unit"]), math.nan)
    share = picture.width_px / float(tags["width"])
    return resolution * (share if math.isfinite(share) and share > 0.0 else 1.0)


def _focal_px(picture: Picture) -> float:
    """By the sensor's resolution, else by what the lens is on 35 mm film, whose diagonal is meant."""
    pixels = _pixels_a_mm(picture) * float(picture.tags["focal_mm"])
    if math.isfinite(pixels) and 0.2 < pixels / picture.width_px < 50.0:
        return pixels
    film = float(picture.tags["focal_35mm"])
    found = film / _DIAGONAL_35MM * math.hypot(picture.width_px, picture.height_px)
    return found if math.isfinite(found) and found > 0.0 else math.nan


def _numbers(text: object) -> list[float]:
    try:
        return [float(word) for word in str(text).replace(";", ",").split(",")]
    except ValueError:
        return []


def _of_xmp(picture: Picture, name: str) -> RigCamera | None:
    """Pix4D's camera of XMP (pix4d.com/camera/1.0): lengths in mm from the sensor's upper left corner."""
    tags, scale = picture.tags, _pixels_a_mm(picture)
    centre = _numbers(tags.get("PrincipalPoint"))
    if len(centre) != 2 or not math.isfinite(scale):
        return None
    middle = (centre[0] * scale - 0.5, centre[1] * scale - 0.5)
    width, height = picture.width_px, picture.height_px
    delay_s = 0.0
    if tags.get("ModelType") == "fisheye":
        matrix, polynomial = _numbers(tags.get("FisheyeAffineMatrix")), _numbers(tags.get("FisheyePolynomial"))
        if len(matrix) != 4 or len(polynomial) != 4 or not min(matrix[0], matrix[3]) > 0.0:
            return None
        c, d, e, f = (value * 2.0 / math.pi for value in matrix)
        camera = Camera(width, height, c, middle, POLYNOMIAL, tuple(polynomial), f / c, 0.0, (d, e))
    else:
        focal, distortion = _numbers(tags.get("PerspectiveFocalLength")), _numbers(tags.get("PerspectiveDistortion"))
        if len(focal) != 1 or len(distortion) != 5 or not focal[0] > 0.0:
            return None
        k1, k2, k3, p1, p2 = distortion
        camera = Camera(width, height, focal[0] * scale, middle, RADTAN, (k1, k2, p1, p2, k3))
        readout_s = _numbers(tags.get("LineReadoutTime"))
        delay_s = readout_s[0] * 1e-6 / height if readout_s and 0.0 < readout_s[0] < 1e6 else 0.0
    estimate = ("f", "pu", "pv", "k1", "k2") if camera.model == RADTAN else ("f", "pu", "pv")
    sigma = {"f": 0.01 * camera.focal_px, "pu": 0.005 * width, "pv": 0.005 * width, "k1": 0.05, "k2": 0.1}
    relative = _numbers(tags.get("RigRelatives"))
    mat = mat_of_relatives(relative) @ STRAIGHT_DOWN if len(relative) == 3 else STRAIGHT_DOWN
    return RigCamera(
        name, camera, mat, line_delay_s=delay_s, bands=_bands_of(picture), estimate=estimate,
        sigma={key: value for key, value in sigma.items() if key in estimate},
    )  # fmt: skip


def mat_of_relatives(angles_deg: Sequence[float]) -> np.ndarray:
    """Camera from rig of RigRelatives: Rx Ry Rz of the three angles in the camera's frame, transposed."""
    x, y, z = np.deg2rad(np.asarray(angles_deg, np.float64))
    cx, sx, cy, sy, cz, sz = np.cos(x), np.sin(x), np.cos(y), np.sin(y), np.cos(z), np.sin(z)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((about_x @ about_y @ about_z).T)
