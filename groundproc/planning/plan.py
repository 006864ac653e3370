"""A flight planned: from area, height and speed to lines, density and battery."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyproj
import shapely

from flightlog.errors import UsageError
from flightlog.mount import Mount
from groundproc import sensors
from groundproc.geodesy import projected_crs
from groundproc.planning.coverage import Swath, spacing_for, swath
from groundproc.planning.route import Route, route
from groundproc.sensors.shots import Gate
from groundproc.vectors.features import read_features

_LEAN_DEG_S_M: Final = 1.5
"""By which a multirotor of some kilograms leans forward for each metre a second: 7 to 8 deg at 5 m/s."""
_MOST_LEAN_DEG: Final = 20.0


@dataclass(frozen=True, slots=True)
class Wish:
    """What is asked for.

    Attributes
    ----------
    area : Path
        A polygon with a CRS.
    height_m, speed_m_s : float
    spacing_m, density, overlap : float, optional
        One of them: distance of lines; points a square metre everywhere; share of a strip that its neighbour covers too.
    heading_deg : float, optional
    battery_s : float, optional
        Flying time of one battery.
    calibrate : bool
    mount : Mount
    pitch_deg : float, optional
        Of the aircraft on the line, nose up; default: a multirotor's, which leans into the wind that it makes.
    gate : Gate
    margin_m : float
    """

    area: Path
    height_m: float
    speed_m_s: float
    spacing_m: float | None = None
    density: float | None = None
    overlap: float | None = None
    heading_deg: float | None = None
    battery_s: float | None = None
    calibrate: bool = False
    mount: Mount = field(default_factory=Mount)
    gate: Gate = field(default_factory=lambda: Gate(255.0, 105.0, 0.0, 70.0))
    margin_m: float = 10.0
    pitch_deg: float | None = None

    def leaning(self) -> Mount:
        """The mount as it hangs under the aircraft on a line."""
        pitch = -min(_LEAN_DEG_S_M * self.speed_m_s, _MOST_LEAN_DEG) if self.pitch_deg is None else self.pitch_deg
        return self.mount.with_lidar(pitch_deg=self.mount.lidar.pitch_deg + pitch)


@dataclass(frozen=True, slots=True)
class Plan:
    """What comes of it.

    Attributes
    ----------
    area : shapely Polygon
        In `crs`.
    crs : pyproj.CRS
    route : Route
    swath : Swath
    spacing_m : float
    batteries : int
    """

    area: Any
    crs: pyproj.CRS
    route: Route
    swath: Swath
    spacing_m: float
    batteries: int

    def places_deg(self) -> tuple[Any, Any]:
        """Latitude and longitude of the turning points."""
        transformer = pyproj.Transformer.from_crs(self.crs, 4326, always_xy=True)
        longitude, latitude = transformer.transform(*self.route.places_m.T)
        return np.asarray(latitude), np.asarray(longitude)

    def figures(self) -> dict[str, Any]:
        """For programs."""
        lines = self.swath.of_lines(self.spacing_m)
        return {
            "crs": f"EPSG:{self.crs.to_epsg()}", "lines": self.route.lines, "spacing_m": self.spacing_m,
            "heading_deg": self.route.heading_deg, "length_m": self.route.length_m, "seconds": self.route.seconds,
            "batteries": self.batteries, "area_m2": float(self.area.area), "width_m": self.swath.width_m(),
            "overlap": 1.0 - self.spacing_m / self.swath.width_m(),
            "density": {"least": float(lines.min()), "mean": float(lines.mean()), "most": float(lines.max())},
        }  # fmt: skip


def plan(wish: Wish) -> Plan:
    """Plan a flight.

    Raises
    ------
    UsageError, CaptureError, GeodesyError
    """
    area, crs = _area(wish.area)
    strip = swath(sensors.lidar("HDL-32E"), wish.leaning(), wish.gate, wish.height_m, wish.speed_m_s)
    spacing = _spacing(wish, strip)
    flown = route(area, spacing, wish.speed_m_s, wish.heading_deg, wish.margin_m, wish.calibrate)
    batteries = 1 if wish.battery_s is None else flown.batteries(wish.battery_s)
    return Plan(area, crs, flown, strip, spacing, batteries)


def _spacing(wish: Wish, strip: Swath) -> float:
    if wish.density is not None:
        return spacing_for(strip, wish.density)
    if wish.spacing_m is not None:
        return wish.spacing_m
    return strip.width_m() * (1.0 - (0.5 if wish.overlap is None else wish.overlap))


def _area(path: Path) -> tuple[Any, pyproj.CRS]:
    """The polygon in metres."""
    features = read_features(path, "Polygon")
    if features.crs is None:
        raise UsageError(f"{path}: states no CRS, expected one: a mission needs latitude and longitude")
    shapes: Sequence[Any] = [part for each in features.geometry for part in getattr(each, "geoms", [each])]
    if len(shapes) != 1:
        raise UsageError(f"{path}: {len(shapes)} polygons found, expected one area to fly over")
    if features.crs.is_projected and features.crs.axis_info[0].unit_name == "metre":
        crs = features.crs
    else:
        middle = features.into(pyproj.CRS.from_epsg(4326)).geometry[0].centroid
        zone = int((middle.x + 180.0) // 6.0) % 60 + 1
        crs = projected_crs(f"EPSG:{(32600 if middle.y >= 0.0 else 32700) + zone}")
    found = features.into(crs).geometry[0]
    found = found.geoms[0] if found.geom_type == "MultiPolygon" else found
    if not found.is_valid or found.area < 1.0:
        raise UsageError(f"{path}: expected a polygon of at least 1 m2 whose edge does not cross itself")
    return shapely.force_2d(found), crs
