"""Rasters of several bands read at places: thermal, multi- and hyperspectral images of any program."""

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from flightlog.errors import CaptureError

Array = npt.NDArray[np.float64]

_MOST_VALUES: Final = 50_000_000
"""Read at once."""


@dataclass(frozen=True, slots=True)
class Bands:
    """An open raster.

    Attributes
    ----------
    path : Path
    crs : pyproj.CRS or None
    file : rasterio.DatasetReader
    """

    path: Path
    crs: pyproj.CRS | None
    file: Any

    @property
    def count(self) -> int:
        """Of bands."""
        return int(self.file.count)

    def cells(self, xy: Array) -> Array:
        """Column and row of places, as fractions: the middle of the first cell is 0, 0; shape (n, 2)."""
        a = ~self.file.transform
        return np.column_stack([
            a.a * xy[:, 0] + a.b * xy[:, 1] + a.c - 0.5, a.d * xy[:, 0] + a.e * xy[:, 1] + a.f - 0.5
        ])  # fmt: skip

    def at(self, xy: Array) -> npt.NDArray[np.float32]:
        """Values at places, linear between the middles of cells, shape (n, bands); NaN outside and beside cells without a value.

        Raises
        ------
        CaptureError
            The file is damaged.
        """
        place = self.cells(xy)
        out = np.full((len(xy), self.count), np.nan, np.float32)
        wide, high = self.file.width, self.file.height
        inside = np.flatnonzero(
            (place[:, 0] > -0.5) & (place[:, 0] < wide - 0.5) & (place[:, 1] > -0.5) & (place[:, 1] < high - 0.5)
        )
        for some in self._groups(place, inside):
            out[some] = self._linear(place[some])
        return out

    def _groups(self, place: Array, inside: npt.NDArray[np.int64]) -> Iterator[npt.NDArray[np.int64]]:
        """Places whose windows are small enough to be read."""
        side = max(int(np.sqrt(_MOST_VALUES / self.count)), 64)
        square = np.floor(place[inside] / side).astype(np.int64)
        keys, number = np.unique(square, axis=0, return_inverse=True)
        for each in range(len(keys)):
            yield inside[number.ravel() == each]

    def _linear(self, place: Array) -> npt.NDArray[np.float32]:
        wide, high = self.file.width, self.file.height
        u, v = np.clip(place[:, 0], 0.0, wide - 1.0), np.clip(place[:, 1], 0.0, high - 1.0)
        left, top = int(u.min()), int(v.min())
        right, bottom = min(int(u.max()) + 2, wide), min(int(v.max()) + 2, high)
        window = rasterio.windows.Window(left, top, right - left, bottom - top)
        try:
            read = self.file.read(window=window, masked=True, out_dtype="float32")
        except (RasterioError, OSError) as error:
            raise CaptureError(f"{self.path}: is damaged ({' '.join(str(error).split())})") from None
        values = np.asarray(read.filled(np.nan), np.float32)
        j, i = (u - left).astype(np.int64), (v - top).astype(np.int64)
        j2, i2 = np.minimum(j + 1, values.shape[2] - 1), np.minimum(i + 1, values.shape[1] - 1)
        fu, fv = (u - left - j).astype(np.float32), (v - top - i).astype(np.float32)
        upper = values[:, i, j] * (1 - fu) + values[:, i, j2] * fu
        lower = values[:, i2, j] * (1 - fu) + values[:, i2, j2] * fu
        # exactly in a row or column of cells the next one does not count, whatever it holds
        upper = np.where(fu == 0, values[:, i, j], upper)
        lower = np.where(fu == 0, values[:, i2, j], lower)
        return np.asarray(np.where(fv == 0, upper, upper * (1 - fv) + lower * fv).T)


@contextlib.contextmanager
def opened_bands(path: Path) -> Iterator[Bands]:
    """A raster of any number of bands.

    Raises
    ------
    CaptureError
        It cannot be read as a raster, or does not say where it lies.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            file = rasterio.open(path)
        except (RasterioError, OSError) as error:
            raise CaptureError(f"{path}: cannot be read as a raster ({' '.join(str(error).split())})") from None
    with file:
        if file.transform.is_identity or not np.isfinite(file.transform).all():
            raise CaptureError(f"{path}: does not say where it lies; expected a georeferenced raster (GeoTIFF)")
        yield Bands(path, None if file.crs is None else pyproj.CRS.from_wkt(file.crs.to_wkt()), file)
