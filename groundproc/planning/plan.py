"""A flight planned: from area, height and speed to lines, density and battery."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from flightlog.errors import UsageError
from flightlog.mount import Mount
from groundproc import sensors
from groundproc.geodesy import projected_crs
from groundproc.planning.coverage import Coverage
from groundproc.planning.route import Route, evened, route
from groundproc.sensors.shots import Gate
from groundproc.vectors.features import read_features

Array = npt.NDArray[np.float64]

_LEAN_DEG_S_M: Final = 1.5
"""By which a multirotor of some kilograms leans forward for each metre a second: 7 to 8 deg at 5 m/s."""
_MOST_LEAN_DEG: Final = 20.0
_PLACES: Final = 2000
_MOST_TRIED: Final = 100_000
"""Places of an area at which its density is found, and of the box about it, of which a thin area fills little."""
_NEXT: Final = 0.98
_FIRST: Final = 0.8
"""From one spacing that is tried to the next, finely and coarsely."""
_LEAST_SPACING_M: Final = 1.0
_GAP: Final = 1.0
"""Fewer points a square metre are a gap."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What is asked for.

    Attributes
    ----------
    area : Path
        A polygon with a CRS.
    height_m, speed_m_s : float
    spacing_m, density, overlap : float, optional
        One of them: distance of lines; points a square metre everywhere in the area; share of a strip that its neighbour covers too.
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

    def leaning_deg(self) -> float:
        """Pitch of the aircraft on a line."""
        return -min(_LEAN_DEG_S_M * self.speed_m_s, _MOST_LEAN_DEG) if self.pitch_deg is None else self.pitch_deg


@dataclass(frozen=True, slots=True)
class Plan:
    """What comes of it.

    Attributes
    ----------
    area : shapely Polygon
        In `crs`.
    crs : pyproj.CRS
    route : Route
    coverage : Coverage
    spacing_m : float
    batteries : int
    density : ndarray, shape (n,)
        Points a square metre, evenly over the area.
    edge_density : ndarray, shape (k,)
        Along the area's edge.
    """

    area: Any
    crs: pyproj.CRS
    route: Route
    coverage: Coverage
    spacing_m: float
    batteries: int
    density: Array
    edge_density: Array

    @property
    def gaps(self) -> float:
        """Share of the area that gets less than a point a square metre."""
        return float((self.density < _GAP).mean())

    def places_deg(self) -> tuple[Any, Any]:
        """Latitude and longitude of the turning points."""
        transformer = pyproj.Transformer.from_crs(self.crs, 4326, always_xy=True)
        longitude, latitude = transformer.transform(*self.route.places_m.T)
        return np.asarray(latitude), np.asarray(longitude)

    def figures(self) -> dict[str, Any]:
        """For programs."""
        width = self.coverage.swath.width_m()
        least = min(float(self.density.min()), float(self.edge_density.min()))
        return {
            "crs": f"EPSG:{self.crs.to_epsg()}", "lines": self.route.lines, "spacing_m": self.spacing_m,
            "heading_deg": self.route.heading_deg, "length_m": self.route.length_m, "seconds": self.route.seconds,
            "batteries": self.batteries, "area_m2": float(self.area.area), "width_m": width,
            "overlap": max(0.0, 1.0 - self.spacing_m / width), "gaps": self.gaps,
            "density": {
                "least": least, "tenth": float(np.percentile(self.density, 10.0)), "mean": float(self.density.mean()),
                "most": float(self.density.max()),
            },
        }  # fmt: skip


def plan(wish: Wish) -> Plan:
    """Plan a flight.

    Raises
    ------
    UsageError, CaptureError, GeodesyError
    """
    area, crs = _area(wish.area)
    coverage = Coverage(
        sensors.lidar("HDL-32E"), wish.mount, wish.gate, wish.height_m, wish.speed_m_s, np.deg2rad(wish.leaning_deg())
    )
    inside, edge = _places(area), _edge(area)
    if wish.spacing_m is not None:
        spacing = wish.spacing_m
    elif wish.density is not None:
        spacing = _dense(area, np.concatenate([edge, inside]), coverage, wish, wish.density)
    else:
        overlap = 0.5 if wish.overlap is None else wish.overlap
        spacing = evened(area, coverage.swath.width_m() * (1.0 - overlap), wish.heading_deg)
    flown = _route(area, spacing, wish)
    batteries = 1 if wish.battery_s is None else flown.batteries(wish.battery_s)
    density, edge_density = (coverage.density(places, flown.places_m) for places in (inside, edge))
    return Plan(area, crs, flown, coverage, spacing, batteries, density, edge_density)


def _route(area: Any, spacing_m: float, wish: Wish) -> Route:
    return route(area, spacing_m, wish.speed_m_s, wish.heading_deg, wish.margin_m, wish.calibrate)


def _dense(area: Any, places_m: Array, coverage: Coverage, wish: Wish, density: float) -> float:
    """The spacing of as few lines as leave no place of the area with fewer points than asked for, looked for in steps of 2 %.

    Raises
    ------
    UsageError
        Not even lines side by side are enough.
    """

    @functools.cache
    def of_lines(spacing_m: float) -> float:
        return float(coverage.density(places_m, _route(area, spacing_m, wish).places_m).min())

    def least(spacing_m: float) -> float:
        return of_lines(evened(area, spacing_m, wish.heading_deg))

    # of wider lines even the mean would be less; and strips side by side, lest the ways between lines make up for missing lines
    widest = min(coverage.straight.rate / wish.speed_m_s / density, coverage.swath.width_m())
    spacing = most = max(_LEAST_SPACING_M, widest)
    while (found := least(spacing)) < density:
        if spacing == _LEAST_SPACING_M:
            raise UsageError(
                f"--density {density:g}: lines {spacing:g} m apart give {found:.0f} points a square metre where they give least; "
                "fly slower or lower, or begin lines farther out (--margin)"
            )
        spacing = max(_LEAST_SPACING_M, spacing * _FIRST)
    finer = min(most, spacing / _FIRST)
    while (finer := finer * _NEXT) > spacing:
        if least(finer) >= density:
            spacing = finer
            break
    return evened(area, spacing, wish.heading_deg)


def _places(area: Any) -> Array:
    """Places evenly over an area, shape (n, 2), in no step that lines could have too (Roberts' R2 sequence)."""
    low, high = np.reshape(area.bounds, (2, 2))
    count = min(_MOST_TRIED, int(_PLACES * np.prod(high - low) / area.area))
    places = low + (np.arange(1, count + 1)[:, None] * [0.7548776662466927, 0.5698402909980532] % 1.0) * (high - low)
    places = places[shapely.contains_xy(area, *places.T)]
    return places if len(places) else np.array(area.representative_point().coords)


def _edge(area: Any) -> Array:
    """Places along the edge of an area, its corners too, shape (n, 2)."""
    return np.asarray(shapely.get_coordinates(area.exterior.segmentize(4.0 * area.exterior.length / _PLACES)))


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
