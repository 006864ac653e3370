"""A trajectory as a line: GeoPackage in the CRS of the points; GPX and KML for maps and phones."""

from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from flightlog.clock import utc_text
from flightlog.errors import SourceError
from groundproc.geodesy import Projection
from groundproc.trajectory.trajectory import Trajectory
from groundproc.vectors.features import Features, write_features

Array = npt.NDArray[np.float64]

_STEP_NS: Final = 200_000_000
"""Between the vertices of a line, which a map cannot show finer."""


def pieces(trajectory: Trajectory) -> list[npt.NDArray[np.int64]]:
    """Knots some 0.2 s apart, of each stretch that is covered without a gap."""
    found = []
    for stretch in np.split(np.arange(len(trajectory)), np.flatnonzero(~trajectory.covered[:-1]) + 1):
        time_ns = trajectory.time_ns[stretch]
        step = (time_ns - time_ns[0]) // _STEP_NS
        chosen = stretch[np.concatenate([[True], np.diff(step) > 0])]
        if chosen[-1] != stretch[-1]:
            chosen = np.append(chosen, stretch[-1])
        if len(chosen) > 1:
            found.append(chosen)
    return found


def write_gpkg(path: Path, trajectory: Trajectory, projection: Projection, crs: pyproj.CRS) -> None:
    """Lines with heights, a feature for each stretch: begin and end in UTC, length, largest sigmas.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    knots = pieces(trajectory)
    places = [projection.exact(trajectory.position_m[some]) for some in knots]
    sigma = trajectory.sigma_position_m
    columns = {
        "begin_utc": np.array([utc_text(int(trajectory.time_ns[some[0]])) for some in knots], object),
        "end_utc": np.array([utc_text(int(trajectory.time_ns[some[-1]])) for some in knots], object),
        "length_m": np.array([float(np.linalg.norm(np.diff(each, axis=0), axis=1).sum()) for each in places]),
        "sigma_plan_m": np.array([float(np.nanmax(np.hypot(*sigma[some, :2].T), initial=0.0)) for some in knots]),
        "sigma_up_m": np.array([float(np.nanmax(sigma[some, 2], initial=0.0)) for some in knots]),
    }
    lines = np.array([shapely.LineString(each) for each in places], object)
    write_features(path, Features(lines, columns, crs), "LineString Z", "trajectory", ".gpkg")


def write_gpx(path: Path, trajectory: Trajectory) -> None:
    """A track of GPX 1.1, in WGS 84 with times; heights are those of the trajectory.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="swath" xmlns="http://www.topografix.com/GPX/1/1"><trk><name>trajectory</name>',
    ]
    for some in pieces(trajectory):
        lines.append("<trkseg>")
        latitude, longitude, height = trajectory.frame.to_geodetic(trajectory.position_m[some])
        lines += [
            f'<trkpt lat="{lat:.9f}" lon="{lon:.9f}"><ele>{up:.3f}</ele><time>{utc_text(time)}</time></trkpt>'
            for lat, lon, up, time in zip(
                latitude.tolist(), longitude.tolist(), height.tolist(), trajectory.time_ns[some].tolist(), strict=True
            )
        ]
        lines.append("</trkseg>")
    _write(path, [*lines, "</trk></gpx>"])


def write_kml(path: Path, trajectory: Trajectory, name: str = "trajectory") -> None:
    """Lines of KML 2.2, drawn at their heights.

    Raises
    ------
    SourceError
        It cannot be written.
    """
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>{escape(name)}</name>',
        '<Style id="line"><LineStyle><color>ff3c14dc</color><width>2</width></LineStyle></Style>',
    ]
    for some in pieces(trajectory):
        places = np.column_stack(trajectory.frame.to_geodetic(trajectory.position_m[some]))
        text = " ".join(f"{lon:.9f},{lat:.9f},{up:.3f}" for lat, lon, up in places.tolist())
        lines.append(
            "<Placemark><styleUrl>#line</styleUrl><LineString><altitudeMode>absolute</altitudeMode>"
            f"<coordinates>{text}</coordinates></LineString></Placemark>"
        )
    _write(path, [*lines, "</Document></kml>"])


def _write(path: Path, lines: list[str]) -> None:
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise SourceError(f"{path}: cannot be written ({error.strerror or error})") from None
