"""The rig: cameras, where they sit on the aircraft and when they expose; rig.yaml in Kalibr's terms, read and written.

p_cam = T_cam_imu p_ins; t_utc = t_exif + timeshift_cam_imu. Keys of Kalibr's camchain keep their meaning
(github.com/ethz-asl/kalibr/wiki/yaml-formats); those that it lacks stand in `Entry`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import yaml

from flightlog import config
from flightlog.config import option
from flightlog.errors import ConfigError, UsageError
from groundproc.files import written_aside
from groundproc.imagery.camera import COEFFICIENTS, NONE, PHOTOGRAMMETRIC, POLYNOMIAL, RADTAN, Camera
from groundproc.imagery.rotations import STRAIGHT_DOWN

Array = npt.NDArray[np.float64]

MOUNTING: Final = (
    "boresight_x",
    "boresight_y",
    "boresight_z",
    "lever_x",
    "lever_y",
    "lever_z",
    "timeshift",
    "line_delay",
)
"""Unknowns of a camera on the aircraft: turn about the camera's axes [rad], place in the ins frame [m], times [s]."""
_ROTATION_SLACK: Final = 1e-3
_READ_OVER: Final = ("rostopic", "cam_overlaps", "T_cn_cnm1")


@dataclass(frozen=True, slots=True)
class Spread:
    """What is known of a camera after an adjustment.

    Attributes
    ----------
    unknowns : tuple of str
        Values of the camera (f, pu, pv, aspect, k1, ...) and those of `MOUNTING`.
    matrix : ndarray, shape (n, n)
        Covariance; px, rad, m, s and the coefficients' own units.
    """

    unknowns: tuple[str, ...]
    matrix: Array

    def sigma(self, name: str) -> float | None:
        """Of one unknown; None where it was held."""
        if name not in self.unknowns:
            return None
        place = self.unknowns.index(name)
        return float(np.sqrt(max(self.matrix[place, place], 0.0)))


@dataclass(frozen=True, slots=True)
class RigCamera:
    """A camera of the rig.

    Attributes
    ----------
    name : str
    camera : Camera
    mat_cam_ins : ndarray, shape (3, 3)
    origin_cam_m : ndarray, shape (3,)
        The ins origin in the camera frame: p_cam = mat_cam_ins p_ins + origin_cam_m.
    timeshift_s : float
        t_utc = t_exif + timeshift_s.
    line_delay_s : float
        Of a rolling shutter, between rows; the stamp is the middle row's.
    image_prefix : str
        Images whose path below the common folder, or whose name, begins so (or matches, with * or ?); empty: all others.
    bands : tuple of str
        Names of the planes of its images.
    response : object
        How its numbers follow the light; as given.
    black_level : float, optional
    vignetting : object
        As given.
    estimate : tuple of str
        Values to be estimated; the others are fixed.
    sigma : mapping of str to float
        Prior sigmas of those, and of boresight_deg, lever_arm_m, timeshift_s, line_delay_s.
    spread : Spread, optional
    images : tuple of str
        Images that are of this camera whatever they are called, where no prefix or pattern tells.
    """

    name: str
    camera: Camera
    mat_cam_ins: Array = field(default_factory=STRAIGHT_DOWN.copy)
    origin_cam_m: Array = field(default_factory=lambda: np.zeros(3))
    timeshift_s: float = 0.0
    line_delay_s: float = 0.0
    image_prefix: str = ""
    bands: tuple[str, ...] = ()
    response: Any = None
    black_level: float | None = None
    vignetting: Any = None
    estimate: tuple[str, ...] = ()
    sigma: Mapping[str, float] = field(default_factory=dict)
    spread: Spread | None = None
    images: tuple[str, ...] = ()

    @property
    def lever_arm_m(self) -> Array:
        """Projection centre in the ins frame, shape (3,)."""
        return np.asarray(-self.mat_cam_ins.T @ self.origin_cam_m)

    def takes(self, image: str) -> bool:
        """Whether an image, by its path below the common folder, is of this camera."""
        prefix = self.image_prefix
        name = PurePosixPath(image).name
        if any(letter in prefix for letter in "*?["):
            return fnmatchcase(image, prefix) or fnmatchcase(name, prefix)
        return image.startswith(prefix) or name.startswith(prefix)


@dataclass(frozen=True, slots=True)
class Rig:
    """All cameras.

    Attributes
    ----------
    cameras : tuple of RigCamera
    """

    cameras: tuple[RigCamera, ...]

    def camera_of(self, image: str, size_px: tuple[int, int] | None = None) -> int | None:
        """Number of the camera that an image is of; None where none takes it.

        The one that lists it, else the one with the longest prefix; of several those of the picture's size, if it is known; then the
        first.
        """
        listing = [number for number, one in enumerate(self.cameras) if image in one.images]
        if listing:
            return listing[0]
        taking = self.taking(image, size_px)
        return taking[0] if taking else None

    def taking(self, image: str, size_px: tuple[int, int] | None = None) -> list[int]:
        """Numbers of the cameras that could have taken an image, by prefix and size: more than one where neither tells."""
        lengths = {number: len(one.image_prefix) for number, one in enumerate(self.cameras) if one.takes(image)}
        longest = [number for number, length in lengths.items() if length == max(lengths.values())]
        lenses = [self.cameras[number].camera for number in longest]
        fitting = [n for n, one in zip(longest, lenses, strict=True) if (one.width_px, one.height_px) == size_px]
        return fitting or longest


_BANDS: Final = ("red", "green", "blue", "nir", "red_edge", "temperature")
_OTHER_WORDS: Final = {
    "rededge": "red_edge",
    "near_infrared": "nir",
    "nearinfrared": "nir",
    "near_ir": "nir",
    "thermal": "temperature",
}


def band_name(text: str) -> str:
    """The name that indices and clouds know a band by, however its maker writes it (NIR, Red edge, RedEdge); others as they stand."""
    plain = text.strip().lower().replace(" ", "_").replace("-", "_")
    plain = _OTHER_WORDS.get(plain, plain)
    return plain if plain in _BANDS else text.strip()


# rig.yaml -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Sigma:
    """Prior sigmas of mounting and times; those of the lens stand beside, under their own names."""

    boresight_deg: float | None = option(None, "about each axis", minimum=0.0)
    lever_arm_m: float | None = option(None, "along each axis", minimum=0.0)
    timeshift_s: float | None = option(None, "of timeshift_cam_imu", minimum=0.0)
    line_delay_s: float | None = option(None, "of line_delay_s", minimum=0.0)


@dataclass(frozen=True, slots=True)
class Entry:
    """A camera as it stands in rig.yaml."""

    intrinsics: tuple[float, ...] = option((), "fu, fv, pu, pv [px]")
    resolution: tuple[int, ...] = option((), "width, height [px]")
    camera_model: str = option("pinhole", "as in Kalibr", choices=("pinhole",))
    distortion_model: str = option(NONE, "radtan, equidistant, brown_photogrammetric, fisheye_polynomial or none")
    distortion_coeffs: tuple[float, ...] = option((), "k1, k2, p1, p2, k3; fish-eyes: k1 to k4, or p0 to p3")
    pixel_mm: float = option(0.0, "width of a pixel, for brown_photogrammetric", minimum=0.0)
    skew: tuple[float, ...] = option((), "what y adds to u, and x to v [px]")
    T_cam_imu: tuple[tuple[float, ...], ...] | None = option(None, "p_cam = T_cam_imu p_ins; rows of a 4 x 4 matrix")
    timeshift_cam_imu: float = option(0.0, "t_utc = t_exif + shift [s]")
    line_delay_s: float = option(0.0, "rolling shutter, a row [s]")
    image_prefix: str = option("", "images whose path or name begins so")
    images: tuple[str, ...] = option((), "images that are of it whatever they are called")
    bands: tuple[str, ...] = option((), "names of the planes of an image")
    response: Any = option(None, "how numbers follow the light")
    black_level: float | None = option(None, "number of no light")
    vignetting: Any = option(None, "fall of light towards the corners")
    estimate: tuple[str, ...] = option((), "values of the lens to estimate; the others are fixed")
    sigma: Any = option(None, "prior sigmas by name")
    covariance: Any = option(None, "what an adjustment left: unknowns, sigma, matrix")


def read_rig(path: Path) -> Rig:
    """Read a rig.yaml, ours or a camchain of Kalibr.

    Raises
    ------
    ConfigError
        It cannot be read, or a camera is not what it should be.
    """
    tree = config.load_tree(path)
    if not isinstance(tree, Mapping) or not tree:
        raise ConfigError(f"{path}: holds no cameras, expected cam0: with intrinsics, resolution and distortion_model")
    cameras: list[RigCamera] = []
    for name, entry in tree.items():
        place = f"{path}: {name}"
        if not isinstance(entry, Mapping):
            raise ConfigError(f"{place}: {entry!r} found, expected keys and values of a camera")
        chain = entry.get("T_cn_cnm1") if "T_cam_imu" not in entry and cameras else None
        plain = _numbers({key: value for key, value in entry.items() if key not in _READ_OVER})
        camera = _camera(str(name), config.from_mapping(plain, Entry, place), place)
        if chain is not None:
            camera = _chained(camera, cameras[-1], _numbers(chain), place)
        cameras.append(camera)
    return Rig(tuple(cameras))


def _numbers(value: Any) -> Any:
    """A tree with texts such as 2e-5, which YAML takes for no number, as numbers; names are left."""
    if isinstance(value, Mapping):
        names = ("image_prefix", "images", "bands", "estimate", "camera_model", "distortion_model", "unknowns")
        return {key: item if key in names else _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _camera(name: str, entry: Entry, place: str) -> RigCamera:
    if len(entry.intrinsics) != 4:
        raise ConfigError(f"{place}: intrinsics: {len(entry.intrinsics)} values found, expected fu, fv, pu, pv")
    if len(entry.resolution) != 2 or min(entry.resolution) < 1:
        raise ConfigError(f"{place}: resolution: {list(entry.resolution)} found, expected width, height above 0")
    if len(entry.skew) not in (0, 2):
        raise ConfigError(f"{place}: skew: {len(entry.skew)} values found, expected two")
    fu, fv, pu, pv = entry.intrinsics
    coefficients = entry.distortion_coeffs
    if entry.distortion_model == NONE:
        if any(coefficients):
            raise ConfigError(f"{place}: distortion_coeffs: stand there without a distortion_model")
        coefficients = ()
    if entry.distortion_model == POLYNOMIAL and (len(coefficients) < 2 or coefficients[0] != 0.0):
        raise ConfigError(f"{place}: distortion_coeffs: expected 0, p1, p2, p3 of a fish-eye polynomial")
    if not fu > 0.0 or not fv > 0.0:
        raise ConfigError(f"{place}: intrinsics: fu {fu}, fv {fv} found, expected above 0")
    try:
        camera = Camera(
            entry.resolution[0], entry.resolution[1], fu, (pu, pv), entry.distortion_model, coefficients, fv / fu,
            entry.pixel_mm, (entry.skew[0], entry.skew[1]) if entry.skew else (0.0, 0.0),
        )  # fmt: skip
        for wanted in entry.estimate:
            camera.place_of(wanted)
    except UsageError as error:
        raise ConfigError(f"{place}: {error}") from None
    mat, origin = _transform(entry.T_cam_imu, place)
    return RigCamera(
        name, camera, mat, origin, entry.timeshift_cam_imu, entry.line_delay_s, entry.image_prefix,
        tuple(map(band_name, entry.bands)),
        entry.response, entry.black_level, entry.vignetting, entry.estimate, _sigma(entry, camera, place),
        _spread(entry.covariance, place), entry.images,
    )  # fmt: skip


def _sigma(entry: Entry, camera: Camera, place: str) -> dict[str, float]:
    if entry.sigma is None:
        return {}
    if not isinstance(entry.sigma, Mapping):
        raise ConfigError(f"{place}: sigma: expected names and numbers")
    lens = {name: value for name, value in entry.sigma.items() if name in camera.names}
    for name, value in lens.items():
        if not isinstance(value, (int, float)) or not 0.0 < value < np.inf:
            raise ConfigError(f"{place}: sigma: {name}: {value!r} found, expected a number above 0")
    rest = {name: value for name, value in entry.sigma.items() if name not in lens}
    mounting = config.to_mapping(config.from_mapping(rest, _Sigma, f"{place}: sigma"))
    return {name: float(value) for name, value in (lens | mounting).items() if value is not None}


def _spread(given: Any, place: str) -> Spread | None:
    if given is None:
        return None
    try:
        names, matrix = tuple(str(name) for name in given["unknowns"]), np.array(given["matrix"], np.float64)
    except (TypeError, KeyError, ValueError):
        names, matrix = ("",), np.empty(0)
    if matrix.shape != (len(names), len(names)):
        raise ConfigError(f"{place}: covariance: expected unknowns and their matrix")
    return Spread(names, matrix)


def _transform(rows: Any, place: str, name: str = "T_cam_imu") -> tuple[Array, Array]:
    """Rotation and translation of a 4 x 4 matrix; the rotation is put right where it is rounded."""
    if rows is None:
        return STRAIGHT_DOWN.copy(), np.zeros(3)
    try:
        matrix = np.array(rows, np.float64)
    except ValueError:
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ConfigError(f"{place}: {name}: expected four rows of four numbers")
    u, scale, v = np.linalg.svd(matrix[:3, :3])
    mat = u @ v
    if np.abs(scale - 1.0).max() > _ROTATION_SLACK or np.linalg.det(mat) < 0.0:
        raise ConfigError(f"{place}: {name}: its first three columns are no rotation")
    return mat, matrix[:3, 3]


def _chained(camera: RigCamera, before: RigCamera, rows: Any, place: str) -> RigCamera:
    """A camera that states its place by the one before it (T_cn_cnm1)."""
    mat, origin = _transform(rows, place, "T_cn_cnm1")
    return replace_mounting(camera, mat @ before.mat_cam_ins, mat @ before.origin_cam_m + origin)


def replace_mounting(camera: RigCamera, mat_cam_ins: Array, origin_cam_m: Array) -> RigCamera:
    """The same camera elsewhere on the aircraft."""
    return replace(camera, mat_cam_ins=mat_cam_ins, origin_cam_m=origin_cam_m)


def write_rig(path: Path, rig: Rig, comment: str = "") -> None:
    """Write a rig.yaml that `read_rig` reads again.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    tree = {camera.name: entry_of(camera) for camera in rig.cameras}
    with written_aside(path) as aside:
        text = yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000)
        aside.write_text(head + text, encoding="utf-8")


class _Dumper(yaml.SafeDumper):
    """Lists of scalars on one line; lists and mappings that stand twice are written twice."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        flat = all(not isinstance(item, (list, dict)) for item in sequence)
        return super().represent_sequence(tag, sequence, flow_style=flat)


def entry_of(one: RigCamera) -> dict[str, Any]:
    """A camera as rig.yaml holds it; what is not stated is left out."""
    camera = one.camera
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = one.mat_cam_ins, one.origin_cam_m
    entry: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": _floats([camera.focal_px, camera.focal_px * camera.aspect, *camera.centre_px]),
        "distortion_model": camera.model,
        "distortion_coeffs": _floats(_padded(camera)),
        "resolution": [camera.width_px, camera.height_px],
        "T_cam_imu": [_floats(row) for row in transform],
        "timeshift_cam_imu": float(one.timeshift_s),
        "line_delay_s": float(one.line_delay_s),
    }
    if camera.model == PHOTOGRAMMETRIC or camera.pixel_mm:
        entry["pixel_mm"] = float(camera.pixel_mm)
    if any(camera.skew_px):
        entry["skew"] = _floats(camera.skew_px)
    optional = {
        "image_prefix": one.image_prefix, "images": list(one.images), "bands": list(one.bands), "response": one.response,
        "black_level": one.black_level, "vignetting": one.vignetting, "estimate": list(one.estimate), "sigma": dict(one.sigma),
    }  # fmt: skip
    entry |= {name: value for name, value in optional.items() if value not in (None, "", [], {})}
    if one.spread is not None:
        spread = one.spread
        entry["covariance"] = {
            "unknowns": list(spread.unknowns),
            "sigma": _floats(np.sqrt(np.maximum(np.diag(spread.matrix), 0.0))),
            "matrix": [_floats(row) for row in spread.matrix],
        }
    return entry


def _padded(camera: Camera) -> list[float]:
    """All coefficients of the model; radtan, whose last one Kalibr does not know, with four where that will do."""
    full = [*camera.coefficients, *[0.0] * (len(COEFFICIENTS[camera.model]) - len(camera.coefficients))]
    return full[:4] if camera.model == RADTAN and not full[4] else full


def _floats(values: Sequence[float] | Array) -> list[float]:
    return [float(value) for value in values]
