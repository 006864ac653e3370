"""From the numbers of a picture to light: black level, the fall of light to the corners, exposure; and from light to reflectance.

    light = (number - black) / (vignetting (exposure time) (ISO / 100) / (f-number)^2)

Numbers that follow the light by the sRGB curve (`response: srgb`) are put straight first (IEC 61966-2-1). Reflectance is a line through
panels of known reflectance: gain and offset a band, the gain alone of one panel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.errors import CaptureError, UsageError
from groundproc.imagery import pictures
from groundproc.imagery.irradiance import rows, tags_of
from groundproc.imagery.rig import RigCamera
from groundproc.text import open_text, table_of

Array = npt.NDArray[np.float64]

_EXIF: Final = 0x8769
_EXPOSURE_S: Final = 33434
_F_NUMBER: Final = 33437
_ISO: Final = 34855
_LEAST_LIGHT: Final = 0.05
TEMPERATURE: Final = "temperature"
"""The band of a thermal camera, whose numbers follow what it sees by a scale and an offset."""
TRANSFERS: Final = ("linear", "srgb")
PANELS: Final = "panels"


@dataclass(frozen=True, slots=True)
class Panel:
    """A surface of known reflectance.

    Attributes
    ----------
    name : str
    place_m : ndarray, shape (3,)
        Its middle, in the CRS of the cloud.
    radius_m : float
        Of the disc that is wholly on it.
    reflectance : mapping of str to float
        By band, 0 to 1.
    """

    name: str
    place_m: Array
    radius_m: float
    reflectance: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Line:
    """Reflectance = gain light + offset.

    Attributes
    ----------
    gain, offset : float
    panels : int
        That it rests on; 0: nobody knows, and light stands for reflectance.
    rms : float
        Of what is left at the panels; not a number with fewer than three.
    by : str
        What it rests on: panels, irradiance or lidar; empty: nothing.
    """

    gain: float = 1.0
    offset: float = 0.0
    panels: int = 0
    rms: float = float("nan")
    by: str = ""


def light(path: Path, camera: RigCamera) -> npt.NDArray[np.float32]:
    """The light that a picture caught, shape (height, width, planes), on a scale of its own camera.

    Raises
    ------
    CaptureError
        It cannot be read.
    UsageError
        The rig's response or vignetting is not what it should be.
    """
    shown = pictures.picture(path)
    numbers = shown.astype(np.float32)
    if np.issubdtype(shown.dtype, np.integer):
        numbers /= np.float32(np.iinfo(shown.dtype).max)
        black = (camera.black_level or 0.0) / np.iinfo(shown.dtype).max
    else:
        black = camera.black_level or 0.0
    transfer, unmix = response_of(camera)
    if transfer == "srgb":
        numbers = _straight(numbers)
    numbers = (numbers - np.float32(black)) / vignetting(camera)[..., None] / np.float32(exposure(path))
    more = rows(tags_of(path), shown.shape[0], exposed(path)[0])
    numbers = numbers if more is None else numbers / more
    return numbers if unmix is None else np.asarray(numbers @ unmix.T.astype(np.float32))


def evened(shown: npt.NDArray[Any], camera: RigCamera) -> npt.NDArray[Any]:
    """A picture, shape (height, width, planes), without the fall of light to its corners; of the same type, full scale at most.

    Raises
    ------
    UsageError
        The rig's response or vignetting is not what it should be.
    """
    if camera.vignetting is None or TEMPERATURE in camera.bands:
        return shown
    fall = vignetting(camera)[..., None]
    if not np.issubdtype(shown.dtype, np.integer):
        return np.asarray(shown / fall, shown.dtype)
    most, black = float(np.iinfo(shown.dtype).max), camera.black_level or 0.0
    numbers = shown.astype(np.float32)
    curved = response_of(camera)[0] == "srgb"
    numbers = _encoded(_straight(numbers / most) / fall) * most if curved else (numbers - black) / fall + black
    return np.clip(np.rint(numbers), 0.0, most).astype(shown.dtype)


def _straight(numbers: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Light of numbers of 0 to 1 that follow it by the sRGB curve."""
    return np.where(numbers <= 0.04045, numbers / 12.92, ((numbers + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _encoded(light: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The other way round."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055).astype(
        np.float32
    )


def degrees_of(response: Any) -> tuple[float, float]:
    """Scale and offset of `response: {scale: S, offset: O}`: degrees Celsius are S times the number plus O.

    Raises
    ------
    UsageError
    """
    if response is None:
        return 1.0, 0.0
    try:
        return float(response.get("scale", 1.0)), float(response.get("offset", 0.0))
    except (AttributeError, TypeError, ValueError):
        raise UsageError(f"rig: response: {response!r} found, expected {{scale: S, offset: O}}") from None


def response_of(camera: RigCamera) -> tuple[str, Array | None]:
    """The curve of `response`, and the matrix that takes other bands out of each, if any.

    Raises
    ------
    UsageError
    """
    given = camera.response
    if given is None or isinstance(given, str):
        transfer, unmix = given or "linear", None
    elif isinstance(given, Mapping):
        transfer, unmix = given.get("transfer", "linear"), given.get("unmix")
    else:
        transfer, unmix = given, None
    if transfer not in TRANSFERS:
        raise UsageError(f"rig: {camera.name}: response: {transfer!r} found, expected {' or '.join(TRANSFERS)}")
    if unmix is None:
        return str(transfer), None
    try:
        matrix = np.array(unmix, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (len(camera.bands), len(camera.bands)):
        raise UsageError(f"rig: {camera.name}: response: unmix: expected {len(camera.bands)} rows of as many numbers")
    return str(transfer), matrix


def vignetting(camera: RigCamera) -> npt.NDArray[np.float32]:
    """Share of the light that reaches each pixel, shape (height, width).

    `vignetting: [a, b, c]` is 1 + a r^2 + b r^4 + c r^6, r being 1 in the corner farthest from the principal point;
    `{powers: [[i, j], ...], coefficients: [c, ...]}` is the sum of c x^i y^j, x and y from 0 to 1 over the picture, as the Sequoia has it.

    Raises
    ------
    UsageError
    """
    lens, given = camera.camera, camera.vignetting
    shape = (lens.height_px, lens.width_px)
    if given is None:
        return np.ones(shape, np.float32)
    try:
        found = _of_powers(given, shape) if isinstance(given, Mapping) else _radial(given, shape, lens.centre_px)
    except (TypeError, ValueError, KeyError):
        raise UsageError(
            f"rig: {camera.name}: vignetting: {given!r} found, expected [a, b, c] of r^2, r^4, r^6, or powers and coefficients"
        ) from None
    if not found.min() > _LEAST_LIGHT:
        raise UsageError(f"rig: {camera.name}: vignetting falls to {found.min():.2f}, expected a share of the light")
    return found


def _radial(given: Any, shape: tuple[int, int], centre_px: tuple[float, float]) -> npt.NDArray[np.float32]:
    down, right = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    square = (right - np.float32(centre_px[0])) ** 2 + (down - np.float32(centre_px[1])) ** 2
    square /= square.max()
    found = np.ones(shape, np.float32)
    for power, term in enumerate(given, 1):
        found += np.float32(term) * square**power
    return found


def _of_powers(given: Mapping[str, Any], shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    x, y = np.linspace(0.0, 1.0, shape[1], dtype=np.float32), np.linspace(0.0, 1.0, shape[0], dtype=np.float32)[:, None]
    found = np.zeros(shape, np.float32)
    for (i, j), coefficient in zip(given["powers"], given["coefficients"], strict=True):
        found += np.float32(coefficient) * x ** int(i) * y ** int(j)
    return found


def exposure(path: Path) -> float:
    """Exposure time [s] x ISO / 100 / f-number^2 as EXIF has them; 1 for what it does not say."""
    time_s, iso, stop = exposed(path)
    return time_s * iso / 100.0 / stop**2


def exposed(path: Path) -> tuple[float, float, float]:
    """Exposure time [s], ISO and f-number; 1 s, 100 and 1 for what EXIF does not say."""
    found = _exif(path)

    def number(tag: int, otherwise: float) -> float:
        value = found.get(tag, otherwise)
        try:
            value = float(value[0] if isinstance(value, tuple) else value)
        except (TypeError, ValueError, ZeroDivisionError):
            return otherwise
        return value if np.isfinite(value) and value > 0.0 else otherwise

    return number(_EXPOSURE_S, 1.0), number(_ISO, 100.0), number(_F_NUMBER, 1.0)


def states_exposure(path: Path) -> bool:
    """Whether a picture says how long it was exposed."""
    return _EXPOSURE_S in _exif(path)


def _exif(path: Path) -> Mapping[int, Any]:
    """The tags about the exposure; none where they cannot be read."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as file:
            return file.getexif().get_ifd(_EXIF)
    except (OSError, UnidentifiedImageError, ValueError, Image.DecompressionBombError):
        return {}


def read_panels(path: Path, bands: Sequence[str]) -> list[Panel]:
    """Panels of a table with name, x, y, z, radius and a column a band.

    Raises
    ------
    CaptureError
    """
    needed = ("name", "x", "y", "z", "radius")
    panels = []
    try:
        with open_text(path) as file:
            table = table_of(file, str(path), "name", CaptureError, f"panels have {', '.join((*needed, *bands))}")
            missing = [name for name in (*needed, *bands) if name not in table.names]
            if missing:
                raise CaptureError(f"{path}: column {missing[0]} is missing; expected {', '.join((*needed, *bands))}")
            for number, words in table.rows():
                given = dict(zip(table.names, words, strict=True))
                try:
                    place = np.array([float(given[axis]) for axis in "xyz"])
                    radius = float(given["radius"])
                    values = {band: float(given[band]) for band in bands if given[band]}
                except ValueError:
                    radius, values = float("nan"), {}
                if not (radius > 0.0 and all(0.0 <= value <= 1.0 for value in values.values()) and values):
                    raise CaptureError(
                        f"{path}: line {number}: expected numbers, a radius above 0 and reflectances of 0 to 1"
                    )
                panels.append(Panel(given["name"], place, radius, values))
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror})") from None
    if not panels:
        raise CaptureError(f"{path}: holds no panels")
    return panels


def line(found: Array, known: Array) -> Line:
    """The line from light to reflectance by panels, shape (n,) each; through nothing by one."""
    if len(found) == 0:
        return Line()
    if len(found) == 1:
        return Line(float(known[0] / found[0]), 0.0, 1, by=PANELS)
    design = np.stack([found, np.ones(len(found))], axis=1)
    (gain, offset), *_ = np.linalg.lstsq(design, known, rcond=None)
    left = design @ np.array([gain, offset]) - known
    rms = float(np.sqrt((left**2).sum() / (len(found) - 2))) if len(found) > 2 else float("nan")
    return Line(float(gain), float(offset), len(found), rms, PANELS)
