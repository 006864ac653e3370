"""Rasters as Cloud-Optimized GeoTIFF: tiled, compressed, with overviews, written block by block and read window by window."""

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog import __version__
from flightlog.errors import CaptureError, SourceError
from groundproc.machine.system import without
from groundproc.raster.grid import Grid, Window

with without("boto3"):  # rasterio's own way to S3
    import rasterio
    from rasterio._err import CPLE_BaseError  # what GDAL says where rasterio has no word of its own for it
    from rasterio.enums import ColorInterp
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.shutil import copy
    from rasterio.transform import from_origin

BLOCK: Final = 512
NO_DATA: Final = -9999.0
"""Of rasters of floating numbers, as GDAL's own tools have it."""
_TROUBLE: Final = (RasterioError, CPLE_BaseError, OSError)
_FARTHEST_M: Final = 1e5
"""Heights on the earth, in metres or feet, lie well within."""
_NONE_THERE: Final = (-9999.0, -32767.0, -32768.0)
"""What programs put where there is no height; a file that does not say so has pits as deep."""
_FARTHEST_PLACE_M: Final = 1e8
_CELL_M: Final = 1e-3, 1e5


@dataclass(frozen=True, slots=True)
class Band:
    """What one band holds.

    Attributes
    ----------
    name, unit : str
    dtype : str
    no_data : float or None
        Stored where there is no value; None: every cell has one.
    resampling : str
        How overviews are made: "average" for what varies smoothly, "nearest" for what may not be mixed.
    scale, offset : float
        The quantity is so many times the stored number, plus the offset: as programs show it.
    """

    name: str
    unit: str = ""
    dtype: str = "float32"
    no_data: float | None = NO_DATA
    resampling: str = "average"
    scale: float = 1.0
    offset: float = 0.0


def write(
    path: Path,
    grid: Grid,
    crs: pyproj.CRS | None,
    band: Band | Sequence[Band],
    block: Callable[[Window], npt.NDArray[Any]],
    corner_m: tuple[float, float] | None = None,
) -> None:
    """Write a raster, a block at a time.

    Parameters
    ----------
    path : Path
        Written to in place: the caller writes aside. A temporary file lies beside it meanwhile.
    grid : Grid
    crs : pyproj.CRS or None
    band : Band or sequence of Band
        Several of one type and one value for no data.
    block : callable
        Gives the values of a window, shape (rows, columns), of several bands (rows, columns, bands), the first row in the north; NaN
        where there is none.
    corner_m : tuple of 2 floats, optional
        West and north edge, where they are no whole multiples of the cell: those of another program's raster.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    plain = path.with_name(f"{path.name}.plain")
    bands = [band] if isinstance(band, Band) else list(band)
    dtype, no_data = bands[0].dtype, bands[0].no_data
    assert all((each.dtype, each.no_data) == (dtype, no_data) for each in bands), bands
    profile = {
        "driver": "GTiff", "width": grid.columns, "height": grid.rows, "count": len(bands), "dtype": dtype,
        "nodata": no_data, "transform": from_origin(*(corner_m or (grid.west_m, grid.north_m)), grid.cell_m, grid.cell_m),
        "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "bigtiff": "IF_SAFER", "sparse_ok": True,
    }  # fmt: skip
    if crs is not None:
        profile["crs"] = rasterio.crs.CRS.from_wkt(crs.to_wkt("WKT2_2019"))
    try:
        # a corner of 0, 0 and cells of 1 m are a place as good as any
        with _georeferenced_or_not(), rasterio.open(plain, "w", **profile) as file:
            file.update_tags(TIFFTAG_SOFTWARE=f"swath {__version__}")
            _describe(file, bands)
            for window in grid.blocks(BLOCK):
                values = np.atleast_3d(np.asarray(block(window)))
                if no_data is not None and values.dtype.kind == "f":
                    values = np.where(np.isfinite(values), values, no_data)
                file.write(np.moveaxis(values.astype(dtype), -1, 0), window=_window(grid, window))
        predictor = "3" if np.dtype(dtype).kind == "f" else "2"
        copy(
            plain, path, driver="COG", compress="DEFLATE", predictor=predictor, blocksize=BLOCK,
            overview_resampling=bands[0].resampling, bigtiff="IF_SAFER", num_threads="ALL_CPUS",
        )  # fmt: skip
    except _TROUBLE as error:
        raise SourceError(f"{path}: cannot be written ({_sentence(error)})") from None
    finally:
        with contextlib.suppress(OSError):
            plain.unlink(missing_ok=True)


@contextlib.contextmanager
def _georeferenced_or_not() -> Iterator[None]:
    """Without rasterio's warning: what a place has to be, is said here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


@dataclass(frozen=True, slots=True)
class Raster:
    """A raster file of one band on square cells that run north and east.

    Attributes
    ----------
    path : Path
    grid : Grid
        Its first column and row are counted from the raster's own corner where the edges are no whole multiples of the cell.
    west_m, north_m : float
        Its corner.
    crs : pyproj.CRS or None
    file : rasterio.DatasetReader
    """

    path: Path
    grid: Grid
    west_m: float
    north_m: float
    crs: pyproj.CRS | None
    file: Any

    def window(self, window: Window) -> npt.NDArray[np.float32]:
        """Values of a window, shape (rows, columns), the first row in the north; NaN where there is none, or outside.

        Raises
        ------
        CaptureError
            The file is damaged.
        """
        try:
            # what stands for none may be a number that single precision does not have
            with np.errstate(invalid="ignore", over="ignore"):
                read = self.file.read(
                    1, window=_window(self.grid, window), boundless=True, masked=True, out_dtype="float32"
                )
        except _TROUBLE as error:
            raise CaptureError(f"{self.path}: is damaged ({_sentence(error)})") from None
        found = np.asarray(read.filled(np.nan), np.float32)
        largest = float(np.abs(found[np.isfinite(found)]).max(initial=0.0))
        if largest > _FARTHEST_M or np.isinf(found).any():
            raise CaptureError(
                f"{self.path}: values such as {largest:g} found, expected heights within {_FARTHEST_M:g} m; does it not state which "
                "value stands for none?"
            )
        if self.file.nodata is None and (silent := [v for v in _NONE_THERE if (found == v).any()]):
            raise CaptureError(
                f"{self.path}: heights of {silent[0]:g} found, which stand for none, but the file does not say so; gdal_translate "
                f"-a_nodata {silent[0]:g} makes one that does"
            )
        found[np.isnan(found)] = np.nan  # without the bits that make arithmetic complain
        return found


def coarse(raster: Raster, most: int) -> tuple[npt.NDArray[np.float32], float]:
    """The whole raster with at most so many cells along a side, means of the file's own, and the size of a cell [m].

    Of a large file the overviews are read.

    Raises
    ------
    CaptureError
        The file is damaged.
    """
    grid = raster.grid
    step = max(max(grid.columns, grid.rows) / most, 1.0)
    shape = (max(round(grid.rows / step), 1), max(round(grid.columns / step), 1))
    try:
        read = raster.file.read(
            1, out_shape=shape, masked=True, out_dtype="float32", resampling=rasterio.enums.Resampling.average
        )
    except _TROUBLE as error:
        raise CaptureError(f"{raster.path}: is damaged ({_sentence(error)})") from None
    return np.asarray(read.filled(np.nan), np.float32), grid.cell_m * step


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Raster]:
    """A raster file.

    Raises
    ------
    CaptureError
        It cannot be read, is no raster, or its cells are not square or are turned.
    """
    try:
        with _georeferenced_or_not():
            file = rasterio.open(path)
    except _TROUBLE as error:
        raise CaptureError(f"{path}: cannot be read as a raster ({_sentence(error)})") from None
    with file:
        transform = file.transform
        if not np.isfinite(transform).all():
            raise CaptureError(f"{path}: its corner or cells are no numbers")
        if transform.is_identity or transform.b or transform.d or not np.isclose(transform.a, -transform.e, rtol=1e-6):
            raise CaptureError(f"{path}: cells of {transform.a:g} x {-transform.e:g} found, expected squares, north up")
        cell_m = float(transform.a)
        if not (_CELL_M[0] <= cell_m <= _CELL_M[1] and max(abs(transform.c), abs(transform.f)) <= _FARTHEST_PLACE_M):
            raise CaptureError(
                f"{path}: cells of {cell_m:g} m at {transform.c:g}, {transform.f:g} found, expected {_CELL_M[0]:g} to {_CELL_M[1]:g} m "
                "in a projected CRS"
            )
        column, row = round(transform.c / cell_m), round(transform.f / cell_m) - file.height
        crs = None if file.crs is None else pyproj.CRS.from_wkt(file.crs.to_wkt())
        grid = Grid(column, row, file.width, file.height, cell_m)
        yield Raster(path, grid, float(transform.c), float(transform.f), crs, file)


def _describe(file: Any, bands: Sequence[Band]) -> None:
    """What each band is; programs show red, green and blue as a picture."""
    colours = {"red": ColorInterp.red, "green": ColorInterp.green, "blue": ColorInterp.blue}
    for number, band in enumerate(bands, 1):
        file.set_band_description(number, band.name)
        if band.unit:
            file.set_band_unit(number, band.unit)
    if any((band.scale, band.offset) != (1.0, 0.0) for band in bands):
        file.scales, file.offsets = [band.scale for band in bands], [band.offset for band in bands]
    if len(bands) > 1:
        file.colorinterp = [colours.get(band.name, ColorInterp.undefined) for band in bands]


def _window(grid: Grid, window: Window) -> Any:
    """A window in rasterio's terms: from the upper left corner."""
    down = grid.row + grid.rows - window.row - window.rows
    return rasterio.windows.Window(window.column - grid.column, down, window.columns, window.rows)


def _sentence(error: BaseException) -> str:
    """What an error of GDAL says, on one line."""
    told = error.__cause__ or error
    return " ".join(str(told).split()) or type(error).__name__
