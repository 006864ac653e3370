"""LandXML 1.2: surfaces of triangles, as civil engineering programs and machine control take them."""

from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog import __version__
from flightlog.errors import SourceError, UsageError

Array = npt.NDArray[np.float64]

_SCHEMA = "http://www.landxml.org/schema/LandXML-1.2"
_METRIC = '<Metric areaUnit="squareMeter" linearUnit="meter" volumeUnit="cubicMeter" temperatureUnit="celsius" pressureUnit="milliBars"/>'
_IMPERIAL = '<Imperial areaUnit="squareFoot" linearUnit="{}" volumeUnit="cubicYard" temperatureUnit="fahrenheit" pressureUnit="inchHG"/>'
_UNITS = {1.0: _METRIC, 0.3048: _IMPERIAL.format("foot"), 0.304801: _IMPERIAL.format("USSurveyFoot")}
"""By metres in a unit, to a millionth."""


def write_surface(
    path: Path, places: Array, triangles: npt.NDArray[np.int64], name: str, crs: pyproj.CRS | None
) -> None:
    """Write one surface, in place (the caller writes aside).

    Parameters
    ----------
    path : Path
    places : ndarray, shape (n, 3)
        Easting, northing, height of the corners, in the units of the CRS; LandXML has northing first.
    triangles : ndarray of int64, shape (m, 3)
        Rows of `places`.
    name : str
    crs : pyproj.CRS or None
        None: taken as metres, and no coordinate system is stated.

    Raises
    ------
    UsageError
        LandXML has no such unit.
    SourceError
        It cannot be written.
    """
    now = datetime.now(UTC)
    head = (
        f'<LandXML xmlns="{_SCHEMA}" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        f'xsi:schemaLocation="{_SCHEMA} {_SCHEMA}/LandXML-1.2.xsd" version="1.2" date="{now:%Y-%m-%d}" time="{now:%H:%M:%S}" '
        'readOnly="false" language="English">'
    )
    surface = (
        f'<Surfaces><Surface name={quoteattr(name)}><Definition surfType="TIN" area2DSurf="{_area(places, triangles):.3f}" '
        f'elevMax="{places[:, 2].max():.4f}" elevMin="{places[:, 2].min():.4f}">'
    )
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>', head, f"<Units>{_unit(crs)}</Units>", *_coordinate_system(crs),
        f'<Application name="swath" version="{__version__}"/>', surface, "<Pnts>",
    ]  # fmt: skip
    try:
        with path.open("w", encoding="utf-8", newline="\n") as file:
            file.write("\n".join(lines) + "\n")
            file.writelines(
                f'<P id="{n}">{y:.4f} {x:.4f} {z:.4f}</P>\n' for n, (x, y, z) in enumerate(places.tolist(), 1)
            )
            file.write("</Pnts>\n<Faces>\n")
            file.writelines(f"<F>{a} {b} {c}</F>\n" for a, b, c in (triangles + 1).tolist())
            file.write("</Faces></Definition></Surface></Surfaces></LandXML>\n")
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None


def _unit(crs: pyproj.CRS | None) -> str:
    factor = 1.0 if crs is None or not crs.axis_info else float(crs.axis_info[0].unit_conversion_factor)
    found = _UNITS.get(round(factor, 6))
    if found is None:
        raise UsageError(f"a unit of {factor:g} m: LandXML knows metres, feet and US survey feet")
    return found


def _coordinate_system(crs: pyproj.CRS | None) -> list[str]:
    if crs is None:
        return []
    code = crs.to_epsg()
    stated = "" if code is None else f' epsgCode="{code}"'
    return [f"<CoordinateSystem name={quoteattr(crs.name)}{stated} ogcWktCode={quoteattr(crs.to_wkt('WKT1_GDAL'))}/>"]


def _area(places: Array, triangles: npt.NDArray[np.int64]) -> float:
    a, b, c = (places[triangles[:, k], :2] for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return float(np.abs(ux * vy - uy * vx).sum() / 2.0)
