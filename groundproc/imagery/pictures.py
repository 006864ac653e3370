"""Pictures as arrays: every format that GDAL reads, all planes, as the file holds the numbers; or one grey plane to match by."""

import contextlib
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from flightlog.errors import CaptureError

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
"""Of pictures, in small letters."""
_MOST_PIXELS = 600_000_000


@dataclass(frozen=True, slots=True)
class Size:
    """What a file says of its picture.

    Attributes
    ----------
    width_px, height_px, planes : int
    dtype : numpy.dtype
    """

    width_px: int
    height_px: int
    planes: int
    dtype: np.dtype[Any]


def size_of(path: Path) -> Size:
    """Size and kind of a picture.

    Raises
    ------
    CaptureError
        It is none, or cannot be read.
    """
    import rasterio

    with _read(path), rasterio.open(path) as file:
        return Size(file.width, file.height, file.count, np.dtype(file.dtypes[0]))


def picture(path: Path) -> npt.NDArray[Any]:
    """The planes of a picture, shape (height, width, planes); one that says what is transparent loses that plane.

    Raises
    ------
    CaptureError
        It cannot be read.
    """
    import rasterio
    from rasterio.enums import ColorInterp

    # half a JPEG is grey below, for GDAL, and half a PNG black: neither is what the camera saw
    with _read(path), rasterio.Env(GDAL_ERROR_ON_LIBJPEG_WARNING="YES"), rasterio.open(path) as file:
        if file.driver == "PNG" and not _is_whole_png(path):
            raise CaptureError(f"{path}: is no picture that can be read (it ends before its last part)")
        if file.width * file.height > _MOST_PIXELS:
            raise CaptureError(f"{path}: {file.width} x {file.height} pixels, expected {_MOST_PIXELS:,} at most")
        planes = [n for n, kind in zip(file.indexes, file.colorinterp, strict=True) if kind != ColorInterp.alpha]
        return np.ascontiguousarray(np.moveaxis(file.read(planes), 0, -1))


def _is_whole_png(path: Path) -> bool:
    """Whether the last chunk is there (PNG specification, 11.2.5)."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 1024))
        return b"IEND" in file.read()


@contextlib.contextmanager
def _read(path: Path) -> Iterator[None]:
    """Errors of GDAL as a sentence, and its remarks on pictures without a map left out."""
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    # for good: filters that are put back when one thread is done are put back for all of them
    warnings.filterwarnings("ignore", category=NotGeoreferencedWarning)
    try:
        yield
    except RasterioError as error:
        if not path.exists():
            raise CaptureError(f"{path}: is not there") from None
        raise CaptureError(f"{path}: is no picture that can be read ({' '.join(str(error).split())})") from None


def reason_of(error: BaseException) -> str:
    """Why Pillow cannot read a file, in a few words."""
    text = str(getattr(error, "strerror", None) or error).split("\n")[0][:80]
    return "cannot be identified" if isinstance(error, UnidentifiedImageError) else text or type(error).__name__


def _plane(path: Path, longest_px: int) -> tuple[npt.NDArray[Any], int]:
    """One plane of a picture as it is decoded, and the file's width; of several planes with more than 8 bits their mean."""
    with contextlib.suppress(UnidentifiedImageError), Image.open(path) as image:
        # Pillow keeps the upper 8 bits of several planes: of 12 that is 16 grey levels
        if len(image.getbands()) == 1 or not any(";16" in str(tile[3]) for tile in image.tile):
            width = image.width
            if image.format == "JPEG":
                image.draft("L", (longest_px, longest_px))
            return np.asarray(image.convert("L") if image.mode not in ("I;16", "I", "F") else image), width
    planes = picture(path)
    return planes.mean(axis=2, dtype=np.float32), planes.shape[1]


def gray(path: Path, longest_px: int) -> tuple[npt.NDArray[np.uint8], float]:
    """An image as one grey plane with sides of so many pixels at most, and the size of its pixels in those of the file.

    Pixel (0, 0) of it is the mean of the file's first ones: x of the file is (x + 0.5) size - 0.5.

    Raises
    ------
    CaptureError
        It cannot be read as a whole.
    """
    try:
        plane, width = _plane(path, longest_px)
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, MemoryError) as error:
        raise CaptureError(f"{path}: is no image that can be read ({reason_of(error)})") from None
    if plane.dtype != np.uint8:
        known = plane[np.isfinite(plane)]
        low, high = np.percentile(known, (0.5, 99.5)) if len(known) else (0.0, 0.0)
        shown = np.clip((np.nan_to_num(plane, nan=low) - low) / max(float(high - low), 1e-9) * 255.0, 0.0, 255.0)
        plane = shown.astype(np.uint8)
    size = width / plane.shape[1]
    if plane.shape[1] != width:  # the decoder scales by powers of two, and pads what is left over
        size = 2.0 ** round(math.log2(size))
    most = max(plane.shape)
    if most > 1.3 * longest_px:
        factor = longest_px / most
        wide, high = round(plane.shape[1] * factor), round(plane.shape[0] * factor)
        size *= plane.shape[1] / wide
        plane = np.asarray(cv2.resize(plane, (wide, high), interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(plane), size
