"""Pictures as arrays: every format that GDAL reads, all planes, as the file holds the numbers."""

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

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
