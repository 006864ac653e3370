"""Features in GeoPackage and GeoJSON: geometries with attributes, in a CRS that the file states."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import shapely
from pyproj.exceptions import CRSError

from flightlog.errors import CaptureError, GeodesyError, SourceError, UsageError
from groundproc.machine.system import without

with without("pandas", "geopandas", "pyarrow"):  # data frames: a second, and 60 MB
    import pyogrio
    from pyogrio.errors import DataLayerError, DataSourceError

DRIVERS: Final = {".gpkg": "GPKG", ".geojson": "GeoJSON", ".json": "GeoJSON"}
_SAME: Final = 90
"""Confidence of pyproj in a code: the same CRS, by whatever name."""
_DAMAGE: Final = (DataSourceError, DataLayerError, shapely.errors.ShapelyError, ValueError, RuntimeError)


_FARTHEST_M: Final = 1e8
_NAMES: Final = ("id", "name", "ID", "Name")
"""Columns that features are called by."""


@dataclass(frozen=True, slots=True)
class Features:
    """Geometries and what is known of each.

    Attributes
    ----------
    geometry : ndarray of shapely geometries, shape (n,)
    columns : mapping of str to ndarray, shape (n,)
    crs : pyproj.CRS or None
    """

    geometry: npt.NDArray[Any]
    columns: Mapping[str, npt.NDArray[Any]]
    crs: pyproj.CRS | None

    def __len__(self) -> int:
        return len(self.geometry)

    def into(self, crs: pyproj.CRS) -> "Features":
        """The features in another CRS; heights stay as they are.

        Raises
        ------
        GeodesyError
            There is no way from one to the other.
        """
        if self.crs is None or self.crs.equals(crs, ignore_axis_order=True):
            return self
        transformer = pyproj.Transformer.from_crs(self.crs, crs, always_xy=True)

        def across(places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            return np.column_stack([*transformer.transform(places[:, 0], places[:, 1]), places[:, 2:]])

        solid = shapely.has_z(self.geometry)
        moved = np.array(self.geometry, object)
        for some in (solid, ~solid):  # shapely would drop the heights of the one or make some up for the other
            if some.any():
                moved[some] = shapely.transform(moved[some], across, include_z=bool(some is solid))
        if not np.isfinite(shapely.get_coordinates(moved)).all():
            raise GeodesyError(f"features in {self.crs.name} have no place in {crs.name}")
        return Features(moved, self.columns, crs)


def read_features(path: Path, kind: str) -> Features:
    """Read all features of a file's first layer.

    Parameters
    ----------
    path : Path
    kind : str
        "Polygon", "LineString" or "Point": what all of them have to be, single or multiple.

    Raises
    ------
    CaptureError
        It cannot be read, holds nothing, or something else.
    """
    if path.suffix.lower() not in DRIVERS:
        raise CaptureError(f"{path}: expected a name that ends in {' or '.join(DRIVERS)}")
    try:
        with (
            warnings.catch_warnings()
        ):  # what GDAL takes for a trifle, such as a ring that is open, is said below or is none
            warnings.simplefilter("ignore", RuntimeWarning)
            meta, _, wkb, fields = pyogrio.raw.read(path)
        geometry = shapely.from_wkb(wkb)
    except _DAMAGE as error:
        raise CaptureError(f"{path}: cannot be read ({' '.join(str(error).split())})") from None
    if not len(geometry):
        raise CaptureError(f"{path}: holds no feature")
    for number, each in enumerate(geometry, 1):
        if each is None or each.is_empty or each.geom_type not in (kind, f"Multi{kind}"):
            found = "nothing" if each is None or each.is_empty else each.geom_type
            raise CaptureError(f"{path}: feature {number} is {found}, expected {kind}")
    farthest = float(np.abs(shapely.get_coordinates(geometry)).max())
    if not farthest <= _FARTHEST_M:
        raise CaptureError(f"{path}: a coordinate of {farthest:g} found, expected {_FARTHEST_M:g} at most")
    try:
        crs = pyproj.CRS.from_user_input(meta["crs"]) if meta["crs"] else None
    except CRSError as error:
        raise CaptureError(f"{path}: its CRS cannot be understood ({error})") from None
    return Features(geometry, dict(zip(meta["fields"], fields, strict=True)), crs)


def names_of(features: Features) -> list[str]:
    """What features are called: by their column id or name, else by number."""
    for name in _NAMES:
        if name in features.columns:
            values = features.columns[name]
            return [str(value) if value not in (None, "") else str(n) for n, value in enumerate(values.tolist(), 1)]
    return [str(n) for n in range(1, len(features) + 1)]


def write_features(path: Path, features: Features, kind: str, layer: str, ending: str | None = None) -> None:
    """Write a file in place (the caller writes aside).

    Parameters
    ----------
    path : Path
    features : Features
    kind : str
        Geometry type, such as "LineString Z".
    layer : str
        GeoJSON names a CRS by its EPSG code; features in a CRS that has none are written in WGS 84 there.
    ending : str, optional
        What decides on the format where the name of `path` does not.

    Raises
    ------
    UsageError
        No format has such a name.
    SourceError
        It cannot be written.
    """
    suffix = (ending or path.suffix).lower()
    if suffix not in DRIVERS:
        raise UsageError(f"{path}: expected a name that ends in {' or '.join(DRIVERS)}")
    if DRIVERS[suffix] == "GeoJSON":
        features = _nameable(features)
    names = list(features.columns)
    named = path.with_name(f"{path.name}{suffix}")  # GDAL looks at the ending too
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)  # not known is not known
            pyogrio.raw.write(
                named, shapely.to_wkb(features.geometry, output_dimension=3 if kind.endswith(" Z") else 2),
                [_storable(features.columns[name]) for name in names], names,
                layer=layer, driver=DRIVERS[suffix], geometry_type=kind,
                crs=None if features.crs is None else features.crs.to_wkt(),
            )  # fmt: skip
        named.replace(path)
    except (*_DAMAGE, OSError) as error:
        raise SourceError(f"{path}: cannot be written ({' '.join(str(error).split())})") from None
    finally:
        named.unlink(missing_ok=True)


def _nameable(features: Features) -> Features:
    """Features whose CRS GeoJSON can name, by an EPSG code; else in WGS 84, which is what a file without a name is taken for."""
    if features.crs is None or not len(features):
        return features
    code = features.crs.to_epsg(_SAME)
    if code is None:
        return features.into(pyproj.CRS.from_epsg(4326))
    return Features(features.geometry, features.columns, pyproj.CRS.from_epsg(code))


def _storable(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Types that all formats have."""
    if values.dtype.kind == "U":
        return values.astype(object)
    return values.astype(np.int32) if values.dtype.kind in "iub" and values.dtype.itemsize < 4 else values
