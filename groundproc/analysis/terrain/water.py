"""Water within breaklines: level, as water lies."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rasterio.features
import shapely
from rasterio.transform import Affine

from flightlog.errors import CoverageError
from groundproc.cloud.metres import Metres
from groundproc.cloud.reader import Cloud
from groundproc.raster.grid import Window
from groundproc.vectors.features import read_features

_SHARE: Final = 10.0
"""The level of water is that of the lowest tenth of the heights within its edge: banks and what grows in it stand higher."""


@dataclass(slots=True)
class Water:
    """Areas of water, and their levels.

    Attributes
    ----------
    areas : list of shapely.Polygon
        In metres.
    levels_m : list of float or None
        As the heights of the breakline state them; else found at the first block that holds some of it, and kept.
    """

    areas: list[Any]
    levels_m: list[float | None]

    def flatten(self, terrain_m: npt.NDArray[np.float32], window: Window, cell_m: float) -> None:
        """Level the terrain of a window within each area."""
        west, north = window.column * cell_m, (window.row + window.rows) * cell_m
        box = shapely.box(west, north - window.rows * cell_m, west + window.columns * cell_m, north)
        transform = Affine(cell_m, 0.0, west, 0.0, -cell_m, north)
        for number, area in enumerate(self.areas):
            if not area.intersects(box):
                continue
            inside = rasterio.features.rasterize([area], terrain_m.shape, transform=transform, dtype="uint8") > 0
            if not inside.any():
                continue
            level = self.levels_m[number]
            if level is None:
                level = self.levels_m[number] = float(np.percentile(terrain_m[inside], _SHARE))
            terrain_m[inside] = level

    def covers(self, xyz_m: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Points that lie within an area, shape (n,)."""
        out = np.zeros(len(xyz_m), np.bool_)
        for area in self.areas:
            low_x, low_y, high_x, high_y = area.bounds
            near = (xyz_m[:, 0] >= low_x) & (xyz_m[:, 0] <= high_x) & (xyz_m[:, 1] >= low_y) & (xyz_m[:, 1] <= high_y)
            some = np.flatnonzero(near)
            out[some[shapely.contains_xy(area, xyz_m[some, 0], xyz_m[some, 1])]] = True
        return out


def read_water(path: Path, cloud: Cloud, metres: Metres, bounds_m: tuple[float, float, float, float]) -> Water:
    """Polygons of a file, in the CRS of a cloud that spans west, south, east, north.

    Raises
    ------
    CaptureError, CoverageError, GeodesyError
        It is not as it should be.
    """
    features = read_features(path, "Polygon")
    if cloud.horizontal is not None:
        features = features.into(cloud.horizontal)
    areas, levels = [], []
    for each in features.geometry:
        for part in shapely.get_parts(each):
            areas.append(shapely.transform(shapely.force_2d(part), lambda xy: xy * metres.across))
            z = shapely.get_coordinates(part, include_z=True)[:, 2]
            known = np.isfinite(z) & bool(shapely.has_z(part))
            levels.append(float(np.mean(z[known])) * metres.up if known.any() else None)
    if areas and not any(each.intersects(shapely.box(*bounds_m)) for each in areas):
        west, south, east, north = (value / metres.across for value in bounds_m)
        raise CoverageError(
            f"{path}: all {len(areas)} polygons lie outside of the cloud, which spans {west:.0f} to {east:.0f} E and {south:.0f} to "
            f"{north:.0f} N"
        )
    return Water(areas, levels)
