"""Local level frame, projected coordinates and heights.

All work is done in a local tangent plane; a projection is applied once, at the door. It is exact: over the few hundred metres that a
chunk of points spans, PROJ's own result is fitted by a second-order polynomial whose residual is checked on every chunk.
"""

import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyproj
from pyproj.exceptions import CRSError, ProjError

from flightlog.errors import GeodesyError
from groundproc.machine import system

Array = npt.NDArray[np.float64]

LARGEST_RESIDUAL_M: Final = 1e-4
"""What the polynomial of a chunk may differ from PROJ [m]; a lidar range step is 2 mm."""
AREA_SLACK_DEG: Final = 0.01
"""Areas of use are stated to so much."""
LARGEST_UNDULATION_M: Final = 120.0
"""The geoid lies between -107 m and +86 m of the ellipsoid (EGM 96)."""


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """East, north, up in the plane tangent to the ellipsoid at an origin.

    Heights may be of any reference (sea level, ellipsoid, take-off): the plane's curvature is the same.

    Attributes
    ----------
    latitude_deg, longitude_deg : float
        WGS 84.
    height_m : float
        Height of the origin in the reference that the positions use [m].
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    _transformer: pyproj.Transformer = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        pipeline = (
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} "
            f"+h_0={self.height_m!r}"
        )
        object.__setattr__(self, "_transformer", pyproj.Transformer.from_pipeline(pipeline))

    def from_geodetic(self, latitude_deg: Array, longitude_deg: Array, height_m: Array) -> Array:
        """Local coordinates [m], shape (n, 3), of geodetic ones, shape (n,) each."""
        return np.stack(self._transformer.transform(longitude_deg, latitude_deg, height_m), axis=-1)

    def to_geodetic(self, enu_m: Array) -> tuple[Array, Array, Array]:
        """Latitude [deg], longitude [deg] and height [m] of local coordinates, shape (n, 3)."""
        east, north, up = np.moveaxis(np.asarray(enu_m), -1, 0)
        lon, lat, height = self._transformer.transform(east, north, up, direction="INVERSE")
        return np.asarray(lat), np.asarray(lon), np.asarray(height)


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of the UTM zone (WGS 84) of a place, without the exceptions round Norway and Svalbard.

    Raises
    ------
    GeodesyError
        Beyond 84 deg north or 80 deg south, where UTM ends.
    """
    if not -80.0 <= latitude_deg <= 84.0:
        raise GeodesyError(f"latitude {latitude_deg:.3f} deg: UTM covers -80 to 84; choose a CRS by its EPSG code")
    zone = int((longitude_deg + 180.0) % 360.0 // 6.0) + 1
    return (32600 if latitude_deg >= 0 else 32700) + zone


def projected_crs(code: int | str) -> pyproj.CRS:
    """The CRS of an EPSG code, such as 32633 or "EPSG:32633".

    Raises
    ------
    GeodesyError
        Unknown code, or not a horizontal projected CRS in metres.
    """
    text = str(code).upper().removeprefix("EPSG:").strip()
    if not text.isdigit():
        raise GeodesyError(f"CRS {code!r}: expected an EPSG code such as 32633 or EPSG:32633")
    epsg = int(text)
    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except CRSError:
        raise GeodesyError(f"EPSG:{epsg}: no such coordinate reference system") from None
    units = {axis.unit_name for axis in crs.axis_info}
    if not crs.is_projected or crs.is_compound or units != {"metre"}:
        raise GeodesyError(
            f"EPSG:{epsg} ({crs.name}): a projected horizontal CRS in metres is needed, for example a UTM zone; "
            "heights are chosen with --height"
        )
    return crs


def check_area(crs: pyproj.CRS, latitude_deg: npt.ArrayLike, longitude_deg: npt.ArrayLike) -> None:
    """See that a CRS is made for where a flight was: elsewhere it gives coordinates that are wrong by its distortion, or in the millions.

    Parameters
    ----------
    crs : pyproj.CRS
        One that states no area of use holds for every place.
    latitude_deg, longitude_deg : array_like, shape (n,) or scalars
        WGS 84.

    Raises
    ------
    GeodesyError
        A place lies outside; with the UTM zone that holds it.
    """
    area = crs.area_of_use
    if area is None:
        return
    latitude, longitude = np.atleast_1d(latitude_deg), np.atleast_1d(longitude_deg)
    # eastwards from the western edge: an area may lie across the 180th meridian
    width_deg = (area.east - area.west) % 360.0 or 360.0
    across_deg = (longitude - area.west + AREA_SLACK_DEG) % 360.0
    holds = (latitude >= area.south - AREA_SLACK_DEG) & (latitude <= area.north + AREA_SLACK_DEG)
    holds &= across_deg <= width_deg + 2.0 * AREA_SLACK_DEG
    if holds.all():
        return
    out = int(np.argmin(holds))
    place = float(latitude[out]), float(longitude[out])
    raise GeodesyError(
        f"{_name(crs)}: is made for {_degrees(area.south, 'N', 'S')} to {_degrees(area.north, 'N', 'S')} and "
        f"{_degrees(area.west, 'E', 'W')} to {_degrees(area.east, 'E', 'W')}, but the flight was at "
        f"{_degrees(place[0], 'N', 'S')}, {_degrees(place[1], 'E', 'W')}{_zone(*place)}; --crs-anyway takes it all the same"
    )


def _name(crs: pyproj.CRS) -> str:
    code = crs.to_epsg()
    return f"EPSG:{code} ({crs.name})" if code else str(crs.name)


def _degrees(value: float, positive: str, negative: str) -> str:
    return f"{abs(value):.4g} {positive if value >= 0 else negative}"


def _zone(latitude_deg: float, longitude_deg: float) -> str:
    """Which UTM zone holds a place, in words."""
    try:
        code = utm_epsg(latitude_deg, longitude_deg)
    except GeodesyError:
        return ""
    return f", which EPSG:{code} ({projected_crs(code).name}) holds"


def with_sea_level(crs: pyproj.CRS) -> pyproj.CRS:
    """A horizontal CRS with heights above the geoid of EGM 96, the one that GPS modules carry."""
    return pyproj.CRS.from_user_input(f"EPSG:{crs.to_epsg()}+5773")


def undulation(geoid: float | str, latitude_deg: float, longitude_deg: float) -> float:
    """Height of the geoid above the ellipsoid at a place [m].

    Parameters
    ----------
    geoid : str
        A number [m], or the path of a grid file that PROJ reads.
    latitude_deg, longitude_deg : float

    Raises
    ------
    GeodesyError
        Neither a number nor a readable grid, or a grid that does not cover the place: nothing is taken to be zero.
    """
    try:
        value = float(geoid)
    except ValueError:
        return _grid_undulation(Path(str(geoid)), latitude_deg, longitude_deg)
    if not abs(value) <= LARGEST_UNDULATION_M:
        raise GeodesyError(
            f"geoid {geoid} m: the geoid lies within {LARGEST_UNDULATION_M:.0f} m of the ellipsoid everywhere"
        )
    return value


def _grid_undulation(path: Path, latitude_deg: float, longitude_deg: float) -> float:
    if not path.is_file():
        raise GeodesyError(f"geoid {path}: is neither a number [m] nor a grid file that is there")
    # in a pipeline commas part grids and quotes end them; under a plain name any path will do
    with tempfile.TemporaryDirectory(prefix="swath-geoid-") as folder:
        plain = Path(folder) / f"geoid{path.suffix if path.suffix[1:].isalnum() else ''}"
        system.linked(plain, path)
        pipeline = (
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f'+step +inv +proj=vgridshift +grids="{plain}" +multiplier=1'
        )
        try:
            transformer = pyproj.Transformer.from_pipeline(pipeline)
            *_, height = transformer.transform(longitude_deg, latitude_deg, 0.0, errcheck=True)
        except ProjError:
            height = math.inf
    if not math.isfinite(height) or abs(height) > LARGEST_UNDULATION_M:
        raise GeodesyError(
            f"geoid {path}: gives no height at {latitude_deg:.4f}, {longitude_deg:.4f}; is it a grid that covers it?"
        )
    return -float(height)


@dataclass(frozen=True, slots=True)
class Polynomial:
    """Projected coordinates as a second-order polynomial of local ones about a centre.

    Attributes
    ----------
    centre_m : ndarray, shape (3,)
    coefficients : ndarray, shape (3, 10)
        Rows easting, northing, height; columns 1, e, n, u, ee, nn, uu, en, eu, nu.
    """

    centre_m: Array
    coefficients: Array


class Projection:
    """From a local frame to a projected CRS, for chunks of points.

    Parameters
    ----------
    frame : LocalFrame
    crs : pyproj.CRS
        From `projected_crs`.

    Raises
    ------
    GeodesyError
        No transformation is known, or its grid files are missing: PROJ would silently do without.
    """

    def __init__(self, frame: LocalFrame, crs: pyproj.CRS) -> None:
        self.frame = frame
        self.crs = crs
        group = pyproj.transformer.TransformerGroup("EPSG:4326", crs, always_xy=True)
        if not group.transformers or not group.best_available:
            raise GeodesyError(
                f"EPSG:{crs.to_epsg()} ({crs.name}): the transformation from WGS 84 is not available here"
            )
        self._transformer = group.transformers[0]

    def exact(self, enu_m: Array) -> Array:
        """Easting, northing, height [m] of local coordinates, shape (n, 3), by PROJ itself."""
        latitude, longitude, height = self.frame.to_geodetic(enu_m)
        east, north = self._transformer.transform(longitude, latitude)
        return np.stack([east, north, height], axis=-1)

    def local(self, map_m: Array) -> Array:
        """Local coordinates [m] of easting, northing, height, shape (n, 3), by PROJ itself; not finite where there are none."""
        east, north, height = np.moveaxis(np.asarray(map_m), -1, 0)
        longitude, latitude = self._transformer.transform(east, north, direction="INVERSE")
        return self.frame.from_geodetic(np.asarray(latitude), np.asarray(longitude), height)

    def polynomial(self, low_m: Array, high_m: Array) -> Polynomial:
        """Fit the box between two corners, shape (3,) each [local m].

        Raises
        ------
        GeodesyError
            The residual on the fit's own grid exceeds `LARGEST_RESIDUAL_M`, or a place has no projected coordinates.
        """
        centre, half = (low_m + high_m) / 2.0, np.maximum((high_m - low_m) / 2.0, 1.0)
        axis = np.linspace(-1.0, 1.0, 5)
        grid = np.stack(np.meshgrid(axis, axis, np.linspace(-1.0, 1.0, 3), indexing="ij"), axis=-1).reshape(-1, 3)
        target = self.exact(centre + grid * half)
        if not np.isfinite(target).all():
            raise GeodesyError(f"{self.crs.name}: {self.frame} lies outside what it covers")
        basis = _basis(grid)
        solution, *_ = np.linalg.lstsq(basis, target, rcond=None)
        residual = float(np.abs(basis @ solution - target).max())
        if residual > LARGEST_RESIDUAL_M:
            raise GeodesyError(
                f"{self.crs.name}: a box of {2 * half.max():.0f} m departs from a second-order surface by "
                f"{residual * 1e3:.2f} mm, expected under {LARGEST_RESIDUAL_M * 1e3:.1f} mm"
            )
        return Polynomial(centre, np.ascontiguousarray(solution.T / _basis(half[None])[0]))


def _basis(p: Array) -> Array:
    """The ten monomials of `Polynomial`, shape (n, 10)."""
    e, n, u = p[:, 0], p[:, 1], p[:, 2]
    return np.stack([np.ones_like(e), e, n, u, e * e, n * n, u * u, e * n, e * u, n * u], axis=1)
