"""Heights along lines: of rasters between the centres of their cells, of clouds within a band around the line."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from flightlog.errors import CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.classes import NO_SURFACE
from groundproc.cloud.metres import METRES, Metres, metres_in, metres_of
from groundproc.raster import geotiff
from groundproc.raster.sampling import heights_at

Array = npt.NDArray[np.float64]

MOST_STATIONS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Line:
    """A line in plan, and stations on it.

    Attributes
    ----------
    name : str
    places_m : ndarray, shape (n, 2)
        Its vertices.
    along_m : ndarray, shape (m,)
        Ways from its beginning to the stations.
    stations_m : ndarray, shape (m, 2)
    unit : Metres
        Of the CRS that the line was given in.
    """

    name: str
    places_m: Array
    along_m: Array
    stations_m: Array
    unit: Metres = METRES


@dataclass(slots=True)
class Profile:
    """Heights along one line, of one source.

    Attributes
    ----------
    line : Line
    source : str
    height_m : ndarray, shape (m,)
        At the stations; NaN where not known. Of a cloud the mean.
    lowest_m, highest_m, sigma_m : ndarray, shape (m,)
        Of the points of a cloud around a station; empty for rasters.
    count : ndarray of int64, shape (m,)
        Points; empty for rasters.
    """

    line: Line
    source: str
    height_m: Array
    lowest_m: Array = field(default_factory=lambda: np.empty(0))
    highest_m: Array = field(default_factory=lambda: np.empty(0))
    sigma_m: Array = field(default_factory=lambda: np.empty(0))
    count: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))


def line_of(name: str, places: Array, step_m: float, unit: Metres = METRES) -> Line:
    """A line with stations a step apart, and one at its end.

    Parameters
    ----------
    name : str
    places : ndarray, shape (n, 2)
        In a unit.
    step_m : float
    unit : Metres

    Raises
    ------
    UsageError
        No length, no step, or too many stations.
    """
    places_m = places * unit.across
    shape = shapely.LineString(places_m) if len(places_m) > 1 else None
    length = 0.0 if shape is None else float(shape.length)
    if not (length > 0.0 and step_m > 0.0):
        raise UsageError(
            f"line {name}: {length:g} m long, with stations each {step_m:g} m; expected more than 0 of both"
        )
    if length / step_m > MOST_STATIONS:
        raise UsageError(
            f"line {name}: {length / step_m:,.0f} stations, expected at most {MOST_STATIONS:,}; take larger steps"
        )
    along = np.append(np.arange(0.0, length - 1e-9 * length, step_m), length)
    return Line(name, places_m, along, shapely.get_coordinates(shapely.line_interpolate_point(shape, along)), unit)


def of_raster(path: Path, lines: Sequence[Line]) -> list[Profile]:
    """Heights of a raster at the stations, bilinear between the centres of cells; NaN outside and beside unknown cells.

    Raises
    ------
    CaptureError
        It cannot be read.
    """
    with geotiff.opened(path) as raster:
        unit = line_unit(lines) if raster.crs is None else metres_in(raster.crs)
        return [Profile(line, path.name, unit.up * heights_at(raster, line.stations_m / unit.across)) for line in lines]


def line_unit(lines: Sequence[Line]) -> Metres:
    """What a file that states no CRS counts in: the unit of the lines."""
    return lines[0].unit if lines else METRES


def of_cloud(
    path: Path, lines: Sequence[Line], width_m: float, classes: Sequence[int] | None, progress: Callable[[int], object]
) -> list[Profile]:
    """Means, extremes and scatter of the points nearest to each station, within half a width of the line.

    Parameters
    ----------
    path : Path
    lines : sequence of Line
    width_m : float
    classes : sequence of int, optional
        Only points of these; default: all but noise and what moves.
    progress : callable
        Told of points done.

    Raises
    ------
    UsageError
        The width is not positive.
    CoverageError
        The cloud has no classes though some are asked for, or no point is near any line.
    """
    if not width_m > 0.0:
        raise UsageError(f"--width {width_m:g}: expected more than 0")
    cloud = reader.look(path)
    unit = line_unit(lines) if cloud.crs is None else metres_of(cloud)
    classed = "classification" in cloud.columns
    if classes is not None and not classed:
        raise CoverageError(f"{path}: its points have no classes, expected classes {', '.join(map(str, classes))}")
    sums = [_Sums(line) for line in lines]
    present = np.zeros(256, np.bool_)
    for chunk in reader.chunks(cloud, columns=("classification",) if classed else ()):
        xyz = unit.of(chunk.points.xyz_m)
        if classed:
            kind = chunk.points["classification"]
            present[kind] = True
            xyz = xyz[np.isin(kind, classes) if classes is not None else ~np.isin(kind, NO_SURFACE)]
        for each in sums:
            each.add(xyz, width_m)
        progress(len(chunk.points.xyz_m))
    if not any(each.count.any() for each in sums):
        of = "" if classes is None else f" of classes {', '.join(map(str, classes))}"
        there = "" if classes is None else f"; the cloud has classes {', '.join(map(str, np.flatnonzero(present)))}"
        raise CoverageError(f"{path}: no point{of} lies within {width_m / 2.0:g} m of a line{there}")
    return [each.profile(path.name) for each in sums]


class _Sums:
    """What is kept of the points around the stations of one line."""

    def __init__(self, line: Line) -> None:
        self.line, self.shape = line, shapely.LineString(line.places_m)
        shapely.prepare(self.shape)
        size = len(line.along_m)
        self.count = np.zeros(size, np.int64)
        self.total, self.squares = np.zeros(size), np.zeros(size)
        self.low, self.high = np.full(size, np.inf), np.full(size, -np.inf)
        self.base: float | None = None
        # half way between stations the next one's points begin
        self.borders = (line.along_m[1:] + line.along_m[:-1]) / 2.0

    def add(self, xyz: Array, width_m: float) -> None:
        west, south, east, north = self.shape.bounds
        half = width_m / 2.0
        x, y = xyz[:, 0], xyz[:, 1]
        xyz = xyz[(x >= west - half) & (x <= east + half) & (y >= south - half) & (y <= north + half)]
        if not len(xyz):
            return
        xyz = xyz[shapely.dwithin(self.shape, shapely.points(xyz[:, :2]), half)]
        if not len(xyz):
            return
        along = shapely.line_locate_point(self.shape, shapely.points(xyz[:, :2]))
        # what lies beyond an end is nearest to the end itself, and no part of the line
        station = np.searchsorted(self.borders, along)
        inner = ~self._beyond(xyz, along)
        station, z = station[inner], xyz[inner, 2]
        if self.base is None and len(z):
            self.base = float(z[0])  # squares of small numbers keep their digits
        d = z - (self.base or 0.0)
        size = len(self.count)
        self.count += np.bincount(station, minlength=size)
        self.total += np.bincount(station, d, size)
        self.squares += np.bincount(station, d**2, size)
        np.minimum.at(self.low, station, z)
        np.maximum.at(self.high, station, z)

    def _beyond(self, xyz: Array, along: Array) -> npt.NDArray[np.bool_]:
        places = self.line.places_m
        first, last = places[1] - places[0], places[-1] - places[-2]
        before = (along <= 0.0) & ((xyz[:, :2] - places[0]) @ first < 0.0)
        after = (along >= self.line.along_m[-1]) & ((xyz[:, :2] - places[-1]) @ last > 0.0)
        return np.asarray(before | after)

    def profile(self, source: str) -> Profile:
        seen = self.count > 0
        number = np.maximum(self.count, 1)
        mean = self.total / number
        spread = np.sqrt(np.maximum(self.squares / number - mean**2, 0.0) * number / np.maximum(number - 1, 1))
        sigma = np.where(self.count > 1, spread, np.nan)

        def known(values: Array) -> Array:
            return np.where(seen, values, np.nan)

        return Profile(
            self.line, source, known(mean + (self.base or 0.0)), known(self.low), known(self.high), sigma, self.count
        )
