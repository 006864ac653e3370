"""Image files: which there are, how large, when and where they were taken as far as they say so themselves (EXIF, XMP)."""

import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from flightlog.clock import is_plausible
from flightlog.errors import CaptureError
from groundproc.imagery.pictures import reason_of, size_of
from groundproc.imagery.poses import NO_TIME

Array = npt.NDArray[np.float64]

ENDINGS: Final = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
_TIFF: Final = (".tif", ".tiff")
_MOST_PIXELS: Final = 500_000_000
_XMP_BYTES: Final = 8 << 20
_EXIF_IFD: Final = 0x8769
_GPS_IFD: Final = 0x8825
_DATE: Final = re.compile(r"(\d{4})[:/-](\d{2})[:/-](\d{2})[ T](\d{2}):(\d{2}):(\d{2})")
_ATTRIBUTE: Final = re.compile(rb"""([A-Za-z][\w-]*):([A-Za-z]\w*)\s*=\s*["']([^"']*)["']""")
_ELEMENT: Final = re.compile(rb"<([A-Za-z][\w-]*):([A-Za-z]\w*)>([^<]{1,4000})</")
_LIST: Final = re.compile(rb"<([A-Za-z][\w-]*):([A-Za-z]\w*)>\s*<rdf:(?:Seq|Bag)>(.*?)</rdf:(?:Seq|Bag)>", re.DOTALL)
_ITEM: Final = re.compile(rb"<rdf:li>([^<]*)</rdf:li>")

# the limit of this room stands above; Pillow's own would only warn
Image.MAX_IMAGE_PIXELS = None


@dataclass(frozen=True, slots=True)
class Fix:
    """Where an image says it was taken.

    Attributes
    ----------
    latitude_deg, longitude_deg, height_m : float
        WGS 84; the height's reference is the maker's.
    sigma_m : tuple of float
        East, north, up; of the file's own statement, else what such modules are good for.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    sigma_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Picture:
    """An image file.

    Attributes
    ----------
    name : str
        Path below the common folder.
    path : Path
    width_px, height_px : int
    exif_ns : int
        DateTimeOriginal with its sub-seconds, as UTC where the file states its offset, else as it stands; `NO_TIME` where there is none.
    gps_ns : int
        GPSDateStamp and GPSTimeStamp.
    fix : Fix, optional
    relative_m : float
        Height above take-off; not a number where unknown.
    mat_enu_camera : ndarray, shape (3, 3), optional
        East, north, up from camera, as the gimbal or the autopilot had it: good for degrees.
    tags : dict
        EXIF values by number, XMP values by name.
    """

    name: str
    path: Path
    width_px: int
    height_px: int
    exif_ns: int = NO_TIME
    gps_ns: int = NO_TIME
    fix: Fix | None = None
    relative_m: float = math.nan
    mat_enu_camera: Array | None = None
    tags: dict[str, Any] = field(default_factory=dict)

    @property
    def root(self) -> Path:
        """The common folder that its name is below."""
        return self.path.absolute().parents[self.name.count("/")]

    @property
    def maker(self) -> tuple[str, str, int, int]:
        """Make, model and size: images that share them are of one camera."""
        return (str(self.tags.get("make", "")), str(self.tags.get("model", "")), self.width_px, self.height_px)


def files_of(given: Sequence[Path]) -> list[Path]:
    """Image files among what is given, folders looked through; in the order of their names.

    Raises
    ------
    CaptureError
        Something is not there, or nothing is an image by its name.
    """
    found: dict[Path, None] = {}
    for path in given:
        if path.is_dir():
            inside = sorted(each for each in path.rglob("*") if each.suffix.lower() in ENDINGS and each.is_file())
            found |= dict.fromkeys(inside)
        elif path.is_file():
            found[path] = None
        else:
            raise CaptureError(f"{path}: no such file; expected images or folders of them")
    if not found:
        raise CaptureError(f"{given[0]}: holds no images, expected names that end in {', '.join(ENDINGS)}")
    return sorted(found)


def names_of(files: Sequence[Path]) -> list[str]:
    """Paths of files below their common folder."""
    common = common_folder(files)
    return [path.absolute().relative_to(common).as_posix() for path in files]


def common_folder(files: Sequence[Path]) -> Path:
    """The deepest folder that all files are in or below."""
    return Path(os.path.commonpath([path.absolute().parent for path in files]))


def look(files: Sequence[Path]) -> Iterator[Picture | tuple[str, str]]:
    """Each file as a picture, or its name and why it cannot be read."""
    for path, name in zip(files, names_of(files), strict=True):
        try:
            yield _look(path, name)
        except (OSError, UnidentifiedImageError, ValueError, SyntaxError, EOFError, ZeroDivisionError) as error:
            yield name, f"is no image that can be read ({reason_of(error)})"


def _look(path: Path, name: str) -> Picture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is wrong in EXIF is left out; the picture may be good
        width, height, exif = _head(path)
        # some writers put into the first directory what belongs into the second
        detail, gps = dict(exif) | dict(exif.get_ifd(_EXIF_IFD)), dict(exif.get_ifd(_GPS_IFD))
        head = {"make": exif.get(0x010F, ""), "model": exif.get(0x0110, "")}
    if width * height > _MOST_PIXELS:
        raise ValueError(f"{width} x {height} pixels")
    with path.open("rb") as file:
        xmp = read_xmp(file.read(_XMP_BYTES))
    tags: dict[str, Any] = {key: str(value).strip("\0 ") for key, value in head.items()} | xmp
    tags |= {
        "focal_mm": _number(detail.get(0x920A)), "focal_35mm": _number(detail.get(0xA405)), "serial": str(detail.get(0xA431, "")),
        "plane_resolution": _number(detail.get(0xA20E)), "plane_unit": _number(detail.get(0xA210)),
        "width": _number(detail.get(0xA002)), "height": _number(detail.get(0xA003)),
    }  # fmt: skip
    return Picture(
        name, path, width, height, _exif_ns(detail), _gps_ns(gps), _fix(gps, xmp),
        _number(xmp.get("RelativeAltitude")), _look_of(xmp), tags,
    )  # fmt: skip


def _head(path: Path) -> tuple[int, int, Image.Exif]:
    """Width, height and EXIF; of a TIFF with planes that Pillow does not know (five bands, floating point) by GDAL."""
    try:
        with Image.open(path) as image:
            exif = image.getexif()
            # read while the file is open
            exif.get_ifd(_EXIF_IFD), exif.get_ifd(_GPS_IFD)
            return (*image.size, exif)
    except UnidentifiedImageError:
        if path.suffix.lower() not in _TIFF:
            raise
    try:
        size = size_of(path)
    except CaptureError:
        raise UnidentifiedImageError from None
    exif = Image.Exif()
    with path.open("rb") as file:
        exif.load_from_fp(file)
        exif.get_ifd(_EXIF_IFD), exif.get_ifd(_GPS_IFD)
    return size.width_px, size.height_px, exif


def read_xmp(data: bytes) -> dict[str, str]:
    """Names and texts of an XMP packet in a file's bytes: attributes, elements, and lists joined by commas."""
    begin = data.find(b"<x:xmpmeta")
    end = data.find(b"</x:xmpmeta>", begin)
    if begin < 0 or end < 0:
        return {}
    packet = data[begin:end]
    found: dict[str, str] = {}
    for pattern in (_ATTRIBUTE, _ELEMENT):
        for prefix, key, value in pattern.findall(packet):
            if prefix not in (b"xmlns", b"rdf"):
                found[key.decode("ascii", "replace")] = value.decode("utf-8", "replace").strip()
    for _, key, body in _LIST.findall(packet):
        items = [item.decode("utf-8", "replace").strip() for item in _ITEM.findall(body)]
        found[key.decode("ascii", "replace")] = ",".join(items)
    return found


def _number(value: Any) -> float:
    """A number, whatever it came as; not a number where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def _exif_ns(detail: dict[int, Any]) -> int:
    """DateTimeOriginal, SubSecTimeOriginal and OffsetTimeOriginal."""
    found = _DATE.match(str(detail.get(0x9003) or detail.get(0x0132) or ""))
    if found is None:
        return NO_TIME
    seconds = _date_ns([int(word) for word in found.groups()])
    if seconds == NO_TIME:
        return NO_TIME
    digits = re.match(r"\d{1,9}", str(detail.get(0x9291, "")).strip("\0 "))
    below = int(digits[0].ljust(9, "0")) if digits else 0
    offset = re.match(r"([+-])(\d{2}):(\d{2})", str(detail.get(0x9011, "")))
    east_s = (1 if offset[1] == "+" else -1) * (int(offset[2]) * 3600 + int(offset[3]) * 60) if offset else 0
    return seconds + below - east_s * 10**9


def _gps_ns(gps: dict[int, Any]) -> int:
    day = re.match(r"(\d{4})[:/-](\d{2})[:/-](\d{2})", str(gps.get(29, "")))
    clock = gps.get(7)
    if day is None or not isinstance(clock, Iterable):
        return NO_TIME
    parts = [_number(part) for part in clock]
    if len(parts) != 3 or not all(0.0 <= part < 61.0 for part in parts):
        return NO_TIME
    start = _date_ns([*(int(word) for word in day.groups()), 0, 0, 0])
    if start == NO_TIME:
        return NO_TIME
    seconds = Fraction(parts[0]) * 3600 + Fraction(parts[1]) * 60 + Fraction(parts[2])
    return start + round(seconds * 10**9)


def _date_ns(words: Sequence[int]) -> int:
    """Nanoseconds since 1970 of year, month, day, hour, minute, second."""
    try:
        moment = datetime(words[0], words[1], words[2], words[3], words[4], words[5], tzinfo=UTC)
    except ValueError:
        return NO_TIME
    stamp = int(moment.timestamp()) * 10**9
    return stamp if is_plausible(stamp) else NO_TIME


_PLAIN_SIGMA_M: Final = (3.0, 3.0, 5.0)
"""Of a position from a module without corrections."""
_LEAST_SIGMA_M: Final = 0.01


def _fix(gps: dict[int, Any], xmp: dict[str, str]) -> Fix | None:
    """Position of EXIF, with the sigmas that XMP states (RTK), and its finer digits."""
    latitude, longitude = _angle(gps.get(2), gps.get(1), "S"), _angle(gps.get(4), gps.get(3), "W")
    height = _number(gps.get(6))
    below = gps.get(5)
    if below in (1, b"\x01", "1"):
        height = -height
    finer = (_number(xmp.get("AbsoluteAltitude")), _number(xmp.get("RtkStdHgt")))
    if math.isfinite(finer[0]) and (math.isfinite(finer[1]) or not math.isfinite(height)):
        height = finer[0]
    if (
        not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and math.isfinite(height))
        or latitude == longitude == 0.0
    ):
        return None
    stated = [_number(xmp.get(name)) for name in ("RtkStdLon", "RtkStdLat", "RtkStdHgt")]
    if not all(math.isfinite(value) and value > 0.0 for value in stated):
        plane, up = _number(xmp.get("GPSXYAccuracy")), _number(xmp.get("GPSZAccuracy"))
        known = math.isfinite(plane) and plane > 0.0 and math.isfinite(up) and up > 0.0
        stated = [plane, plane, up] if known else list(_PLAIN_SIGMA_M)
    east, north, up = (max(value, _LEAST_SIGMA_M) for value in stated)
    return Fix(latitude, longitude, height, (east, north, up))


def _angle(parts: Any, letter: Any, negative: str) -> float:
    """Degrees of degrees, minutes, seconds."""
    if not isinstance(parts, Iterable) or isinstance(parts, (str, bytes)):
        return math.nan
    values = [_number(part) for part in parts]
    if not values or len(values) > 3:
        return math.nan
    value = sum(part / 60.0**power for power, part in enumerate(values))
    return -value if str(letter).strip("\0 ").upper().startswith(negative) else value


_NED_OF_ENU: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_AHEAD: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Body (forward, right, down) from a camera that looks ahead."""
_DOWN: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Body from a camera that looks down, its upper edge ahead."""


def _look_of(xmp: dict[str, str]) -> Array | None:
    """How the camera looked: a gimbal's yaw, pitch (-90 is down) and roll; else those of an aircraft whose camera looks down."""
    for prefix, suffix, mat in (("Gimbal", "Degree", _AHEAD), ("", "", _DOWN)):
        angles = [_number(xmp.get(f"{prefix}{name}{suffix}")) for name in ("Yaw", "Pitch", "Roll")]
        if all(abs(value) <= 360.0 for value in angles):
            yaw, pitch, roll = np.deg2rad(angles)
            cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
            turn = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
            nose = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
            wing = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
            return np.asarray(_NED_OF_ENU @ turn @ nose @ wing @ mat)
    return None
