"""A raster in tiles on whole multiples of their size, with an index that opens them all: a virtual raster of GDAL's."""

import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog.errors import CoverageError, UsageError
from groundproc.files import written_folder
from groundproc.raster import geotiff
from groundproc.raster.geotiff import Band
from groundproc.raster.grid import Grid, Window

_MOST_TILES = 20_000
_GDAL_TYPES = {"float32": "Float32", "uint8": "Byte"}


class Gathered(Protocol):
    """What a raster is made of: see `kinds.Gathering`."""

    @property
    def band(self) -> Band:
        """What it holds."""

    def made(self, path: Path) -> tuple[Grid, Callable[[Window], npt.NDArray[Any]]]:
        """The grid, and what gives its windows."""


@contextlib.contextmanager
def claimed(folder: Path, force: bool) -> Iterator[Path]:
    """A folder to write tiles into; see `written_folder`.

    Raises
    ------
    UsageError
        It holds files.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file, expected a folder to write tiles into")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise UsageError(f"{folder}: holds files already; give another folder, or --force to write tiles anew")
    before = (
        {name for index in folder.glob("*.vrt") for name in (index.name, *_named(index))} if folder.is_dir() else set()
    )
    with written_folder(folder, "", before) as aside:
        yield aside


def write(folder: Path, name: str, gathered: Gathered, crs: pyproj.CRS | None, size_m: float) -> Grid:
    """Write `NAME_WEST_SOUTH.tif` for each tile that has values, and NAME.vrt; gives the grid of all.

    Raises
    ------
    UsageError
        The size is not a whole multiple of a cell, or there are too many tiles.
    CoverageError
        Nothing has a value.
    SourceError
        A tile cannot be written.
    """
    grid, block = gathered.made(folder / f"{name}.vrt")
    cells = round(size_m / grid.cell_m) if np.isfinite(size_m) and size_m > 0.0 else 0
    if cells < 1 or not np.isclose(cells * grid.cell_m, size_m, rtol=1e-9):
        raise UsageError(f"tiles of {size_m:g} m: expected a whole multiple of the cell, {grid.cell_m:g} m")
    places = [
        (x, y)
        for y in range(grid.row // cells, (grid.row + grid.rows - 1) // cells + 1)
        for x in range(grid.column // cells, (grid.column + grid.columns - 1) // cells + 1)
    ]
    if len(places) > _MOST_TILES:
        raise UsageError(f"tiles of {size_m:g} m: {len(places):,} of them; expected a larger size")
    written = {}
    for x, y in places:
        path = folder / f"{name}_{x * size_m:.10g}_{y * size_m:.10g}.tif"
        tile = Grid(x * cells, y * cells, cells, cells, grid.cell_m)
        if _write_tile(path, tile, crs, gathered.band, block):
            written[path.name] = tile
    if not written:
        raise CoverageError(f"{name}: not one cell has a value")
    whole = _around(list(written.values()))
    (folder / f"{name}.vrt").write_text(_index(whole, written, crs, gathered.band), encoding="utf-8")
    return whole


def _write_tile(
    path: Path, tile: Grid, crs: pyproj.CRS | None, band: Band, block: Callable[[Window], npt.NDArray[Any]]
) -> bool:
    """Write one tile; whether there is anything in it, else it goes."""
    seen = False

    def watched(window: Window) -> npt.NDArray[Any]:
        nonlocal seen
        values = block(window)
        known = np.isfinite(values) if values.dtype.kind == "f" and band.no_data is not None else values != 0
        seen = seen or bool(known.any())
        return values

    geotiff.write(path, tile, crs, band, watched)
    if not seen:
        path.unlink()
    return seen


def _around(tiles: list[Grid]) -> Grid:
    low = min(each.column for each in tiles), min(each.row for each in tiles)
    high = max(each.column + each.columns for each in tiles), max(each.row + each.rows for each in tiles)
    return Grid(low[0], low[1], high[0] - low[0], high[1] - low[1], tiles[0].cell_m)


def _index(whole: Grid, tiles: dict[str, Grid], crs: pyproj.CRS | None, band: Band) -> str:
    """The virtual raster."""
    none = "" if band.no_data is None else f"<NoDataValue>{band.no_data:g}</NoDataValue>"
    kind = "SimpleSource" if band.no_data is None else "ComplexSource"
    sources = []
    for name, tile in tiles.items():
        right, down = tile.column - whole.column, whole.row + whole.rows - tile.row - tile.rows
        nodata = "" if band.no_data is None else f"<NODATA>{band.no_data:g}</NODATA>"
        size = f'xSize="{tile.columns}" ySize="{tile.rows}"'
        sources.append(
            f'<{kind}><SourceFilename relativeToVRT="1">{escape(name)}</SourceFilename><SourceBand>1</SourceBand>'
            f'<SrcRect xOff="0" yOff="0" {size}/><DstRect xOff="{right}" yOff="{down}" {size}/>{nodata}</{kind}>'
        )
    srs = "" if crs is None else f"<SRS>{escape(crs.to_wkt('WKT2_2019'))}</SRS>"
    unit = f"<UnitType>{escape(band.unit)}</UnitType>" if band.unit else ""
    place = f"{whole.west_m!r}, {whole.cell_m!r}, 0.0, {whole.north_m!r}, 0.0, {-whole.cell_m!r}"
    return (
        f'<VRTDataset rasterXSize="{whole.columns}" rasterYSize="{whole.rows}">{srs}<GeoTransform>{place}</GeoTransform>'
        f'<VRTRasterBand dataType="{_GDAL_TYPES[band.dtype]}" band="1"><Description>{escape(band.name)}</Description>{none}{unit}\n'
        + "\n".join(sources)
        + "\n</VRTRasterBand></VRTDataset>\n"
    )


def _named(index: Path) -> list[str]:
    """Tiles that an index names."""
    try:
        text = index.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return []
    return re.findall(r'relativeToVRT="1">([^<>/\\]+\.tif)<', text)
