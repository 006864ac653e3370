"""Surfaces of known reflectance on the ground, as polygons."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from flightlog.errors import CaptureError
from groundproc.vectors.features import Features, read_features

Array = npt.NDArray[np.float64]

_COLUMN: Final = re.compile(r"^reflectance(?:_(\d+(?:\.\d+)?))?$", re.IGNORECASE)
_IDS: Final = ("id", "name", "ID", "Name")
_MARGIN: Final = 0.08
"""Of the square root of a target's area, left out along its edge: a beam there hits the target in part."""
_MOST_MARGIN_M: Final = 0.3


@dataclass(frozen=True, slots=True)
class Target:
    """A polygon and the reflectance within it.

    Attributes
    ----------
    id : str
    polygon : shapely geometry
        In the CRS of the clouds; the edge that beams hit in part is taken off.
    incidence_rad, reflectance : ndarray, shape (k,)
        Angles of incidence, ascending, and the reflectance at each; between them it is interpolated.
    """

    id: str
    polygon: Any
    incidence_rad: Array
    reflectance: Array

    def at(self, incidence_rad: Array) -> Array:
        """Reflectance at angles of incidence, shape (n,)."""
        return np.asarray(np.interp(incidence_rad, self.incidence_rad, self.reflectance))


def read_targets(path: Path, crs: pyproj.CRS | None) -> list[Target]:
    """Targets of a file: a column `reflectance`, or columns `reflectance_0`, `reflectance_15`, ... by degrees of incidence.

    Parameters
    ----------
    path : Path
        GeoPackage or GeoJSON.
    crs : pyproj.CRS or None
        Of the clouds.

    Raises
    ------
    CaptureError, GeodesyError
        It cannot be read, states no reflectance, or one that none is.
    """
    features = read_features(path, "Polygon")
    if crs is not None:
        features = features.into(crs)
    columns = _columns(path, features)
    found = []
    for number, shape in enumerate(features.geometry):
        name = next((str(features.columns[key][number]) for key in _IDS if key in features.columns), str(number + 1))
        angles, values = [], []
        for angle_deg, column in columns:
            value = _number(features.columns[column][number])
            if np.isfinite(value):
                angles.append(np.deg2rad(angle_deg))
                values.append(value)
        if not values or min(values) <= 0.0 or max(values) > 1.0:
            what = f"{min(values):g} to {max(values):g}" if values else "none"
            raise CaptureError(f"{path}: {name}: reflectance {what} found, expected a share above 0 and up to 1")
        margin = min(_MARGIN * float(np.sqrt(shape.area)), _MOST_MARGIN_M)
        inner = shape.buffer(-margin)
        found.append(Target(name, shape if inner.is_empty else inner, np.array(angles), np.array(values)))
    for each in found:
        shapely.prepare(each.polygon)
    return found


def _columns(path: Path, features: Features) -> list[tuple[float, str]]:
    """Columns of reflectance with their angles of incidence [deg], ascending."""
    found = [(float(match[1] or 0.0), name) for name in features.columns if (match := _COLUMN.match(name))]
    if len({angle for angle, _ in found}) < len(found):  # `reflectance` beside `reflectance_0`
        found = [(angle, name) for angle, name in found if "_" in name]
    if not found:
        had = ", ".join(features.columns) or "none"
        raise CaptureError(
            f"{path}: has no column reflectance, nor reflectance_0, reflectance_15, ... by degrees of incidence; its columns: {had}"
        )
    return sorted(found)


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")
