"""The cameras of a simulation: what is wrong with them stands here, and named rigs are files in `rigs/`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import yaml

from flightlog import config
from flightlog.config import option
from flightlog.errors import ConfigError, UsageError
from simulator.chance import generator
from simulator.optics import MODELS, RADTAN, STRAIGHT_DOWN, Lens, turn
from simulator.textures import BANDS

Array = npt.NDArray[np.float64]

_FOLDER: Final = files("simulator") / "rigs"


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """A camera: what it is, what is believed of it, and what is wrong."""

    bands: tuple[str, ...] = option(
        ("red", "green", "blue"), f"of {', '.join(BANDS)}; three make a JPEG, one a PNG of 16 bit"
    )
    width_px: int = option(1600, "columns", minimum=16, maximum=20_000)
    height_px: int = option(1200, "rows", minimum=16, maximum=20_000)
    focal_px: float = option(1250.0, "true focal length [px]; of a fish-eye: pixels a radian", minimum=1, maximum=1e6)
    distortion_model: str = option(RADTAN, "of the lens", choices=MODELS)
    distortion_coeffs: tuple[float, ...] = option(
        (-0.05, 0.015, 0.0004, -0.0003), "true ones: k1, k2, p1, p2, k3, or k1 to k4"
    )
    believed_coeffs: tuple[float, ...] = option((), "what rig.yaml says of them; none: zeros")
    focal_spread_px: float = option(
        10.0, "rig.yaml's focal length is off by up to this, uniform over seeds", minimum=0, maximum=1e4
    )
    centre_spread_px: float = option(6.0, "and its principal point from the true one", minimum=0, maximum=1e4)
    turn_deg: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "nominal turn about its axes from looking straight down", minimum=-180, maximum=180
    )
    position_m: tuple[float, float, float] = option(
        (0.0, 0.1, -0.1), "nominal lever arm: right, forward, up", minimum=-5, maximum=5
    )
    boresight_spread_deg: float = option(
        0.8, "true turn about each axis is off by up to this, uniform over seeds", minimum=0, maximum=20
    )
    lever_spread_m: float = option(
        0.02, "true lever arm is off by up to this, uniform over seeds", minimum=0, maximum=1
    )
    interval_s: float = option(2.3, "time between exposures", minimum=0.05, maximum=1e4)
    first_s: float = option(3.0, "true time of the first one", minimum=0, maximum=1e5)
    clock_offset_s: float = option(0.05, "its clock minus UTC, in EXIF", minimum=-1e8, maximum=1e8)
    clock_digits: int = option(3, "of the seconds' fraction in EXIF", minimum=0, maximum=6)
    line_delay_s: float = option(0.0, "rolling shutter, a row", minimum=0, maximum=0.01)
    line_delay_known: float = option(1.0, "rig.yaml's line delay in parts of the true one", minimum=0, maximum=2)
    feedback: bool = option(True, "the autopilot notes each exposure: CAMERA_FEEDBACK, and CAM on its card")
    feedback_delay_s: float = option(0.0, "and this much late", minimum=-1, maximum=1)
    feedback_lost: float = option(0.0, "part of those messages that nobody notes", minimum=0, maximum=1)
    noise: float = option(0.006, "of a pixel, one sigma, in parts of the full scale", minimum=0, maximum=1)
    temperature_noise_k: float = option(0.05, "of a thermal pixel, one sigma [K]", minimum=0, maximum=100)
    vignetting: tuple[float, float, float] = option(
        (-0.25, 0.05, 0.0), "1 + a r2 + b r4 + c r6, r 1 in the farthest corner", minimum=-1, maximum=1
    )
    exposure_spread: float = option(
        0.1, "exposure times differ by this, one sigma, relative; EXIF states them", minimum=0, maximum=1
    )
    transfer: str = option("srgb", "how numbers follow the light", choices=("srgb", "linear"))
    black_level: float = option(0.0, "number without light, in parts of the full scale", minimum=0, maximum=0.5)
    quality: int = option(94, "of JPEG", minimum=30, maximum=100)
    samples: int = option(2, "rays across a pixel", minimum=1, maximum=8)

    def __post_init__(self) -> None:
        wrong = [band for band in self.bands if band not in BANDS]
        if wrong or len(self.bands) not in (1, 3):
            raise ValueError(f"bands: {list(self.bands)} found, expected one or three of {', '.join(BANDS)}")
        if "temperature" in self.bands and len(self.bands) > 1:
            raise ValueError("bands: temperature found with others, expected it alone")
        most = 5 if self.distortion_model == RADTAN else 4
        for name in ("distortion_coeffs", "believed_coeffs"):
            if len(getattr(self, name)) > most:
                raise ValueError(f"{name}: {len(getattr(self, name))} found, expected {most} at most")


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera as it is, and as rig.yaml has it.

    Attributes
    ----------
    name : str
    options : CameraOptions
    lens, believed : Lens
    mat_cam_ins, believed_mat : ndarray, shape (3, 3)
    position_m : ndarray, shape (3,)
        Projection centre in the ins frame.
    """

    name: str
    options: CameraOptions
    lens: Lens
    believed: Lens
    mat_cam_ins: Array
    believed_mat: Array
    position_m: Array

    @property
    def middle_row_px(self) -> float:
        """The row whose exposure is the image's time."""
        return (self.options.height_px - 1) / 2.0

    def exposures_s(self, duration_s: float) -> Array:
        """True times of its images."""
        rolls_s = self.options.line_delay_s * self.options.height_px
        return np.asarray(np.arange(self.options.first_s, duration_s - rolls_s - 1e-3, self.options.interval_s))


def built(name: str, options: CameraOptions, seed: int) -> Camera:
    """The camera of options; chance draws what is wrong with it."""
    rng = generator(seed, f"camera {name}")
    by_chance = rng.uniform(-1.0, 1.0, (4, 3))
    true_centre = (np.array([options.width_px, options.height_px]) - 1.0) / 2.0 + 3.0 * by_chance[2, :2]
    lens = Lens(options.distortion_model, options.focal_px, _pair(true_centre), options.distortion_coeffs)
    centre = true_centre + options.centre_spread_px * by_chance[3, :2]
    focal = options.focal_px + options.focal_spread_px * float(by_chance[3, 2])
    nominal = turn(np.radians(options.turn_deg)) @ STRAIGHT_DOWN
    true = turn(np.radians(options.boresight_spread_deg) * by_chance[0]) @ nominal
    position = np.array(options.position_m) + options.lever_spread_m * by_chance[1]
    return Camera(
        name, options, lens, Lens(lens.model, focal, _pair(centre), options.believed_coeffs), true, nominal, position
    )


def _pair(values: Array) -> tuple[float, float]:
    x, y = values.tolist()
    return x, y


@dataclass(frozen=True, slots=True)
class Exposure:
    """One image.

    Attributes
    ----------
    camera, number : int
        Whose, and which of its images, from 0.
    time_s : float
        True time of the middle row.
    """

    camera: int
    number: int
    time_s: float


def exposures(cameras: tuple[Camera, ...], duration_s: float) -> list[Exposure]:
    """All images of a flight in the order of time."""
    found = [
        Exposure(which, number, time_s)
        for which, camera in enumerate(cameras)
        for number, time_s in enumerate(camera.exposures_s(duration_s).tolist())
    ]
    return sorted(found, key=lambda one: (one.time_s, one.camera))


def noted(cameras: tuple[Camera, ...], taken: list[Exposure], seed: int) -> list[Exposure]:
    """Those images whose exposure the autopilot notes, with the times that it notes."""
    lost = generator(seed, "lost feedback").random(len(taken))
    return [
        replace(one, time_s=one.time_s + cameras[one.camera].options.feedback_delay_s)
        for one, chance in zip(taken, lost.tolist(), strict=True)
        if cameras[one.camera].options.feedback and chance >= cameras[one.camera].options.feedback_lost
    ]


def names() -> tuple[str, ...]:
    """Rigs that come along, in the order of the alphabet."""
    return tuple(sorted(item.name.removesuffix(".yaml") for item in _FOLDER.iterdir() if item.name.endswith(".yaml")))


def rig(name: str) -> dict[str, CameraOptions]:
    """The cameras of a named rig, or of a file.

    Raises
    ------
    UsageError
        There is neither a rig nor a file of that name.
    ConfigError
        The file is none.
    """
    if name in names():
        return _cameras(yaml.safe_load((_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")), f"{name}.yaml")
    if not Path(name).is_file():
        raise UsageError(f"--cameras: {name!r} is neither a rig nor a file; known are {', '.join(names())}")
    return _cameras(config.load_tree(name), name)


def _cameras(tree: Any, place: str) -> dict[str, CameraOptions]:
    if not isinstance(tree, Mapping) or not tree:
        raise ConfigError(f"{place}: holds no cameras, expected names with the options of a camera below")
    found = {}
    for name, entry in tree.items():
        if not (isinstance(name, str) and name.isalnum()):
            raise ConfigError(f"{place}: {name!r} found as a name of a camera, expected letters and digits")
        found[name] = config.from_mapping({} if entry is None else entry, CameraOptions, f"{place}: {name}")
    return found
