"""Where the sensor was when each point was measured: from a trajectory, or from the rays of shots with several echoes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyproj
from scipy.linalg import LinAlgError, solve

from flightlog import frames
from flightlog.clock import utc_text
from flightlog.errors import CoverageError, UsageError
from groundproc.cloud import reader
from groundproc.cloud.gpstime import Clock
from groundproc.cloud.reader import Chunk, Cloud
from groundproc.cloud.sameness import agreed_map_crs
from groundproc.geodesy import check_area
from groundproc.strips.route import Route, read_route

Array = npt.NDArray[np.float64]

_LEAST_M: Final = 3.0
"""Length of a ray between its first and its last echo."""
_KNOT_S: Final = 2.0
_GAP_S: Final = 20.0
"""A silence of a source id ends a strip."""
_MOST_RAYS: Final = 60_000
"""Of a strip in one chunk: more tell nothing new."""
_FEWEST_RAYS: Final = 200
_LEAST_ANGLE: Final = 0.02
"""Rays of a strip have to differ by so much [rad], or they tell no height."""
_FEWEST_PARALLEL: Final = 20
_PARALLEL_M: Final = 1000.0
"""Where rays tell the direction to the sensor alone, it is put so far away."""
_FARTHEST_M: Final = 20_000.0
_ROUNDS: Final = 10
_SOME: Final = 1000
"""Points of a chunk that tell how far the sensor is."""
_FARTHEST_SENSOR_M: Final = 10_000.0
_FLAT_M: Final = 500.0
_LEAST_RISE: Final = 0.1
"""What is farther away than _FLAT_M is seen from an aircraft, and so at no flatter an angle."""


class SensorPath(Protocol):
    """Places of the sensor."""

    @property
    def clock(self) -> Clock | None:
        """How stamps become UTC; None: they are taken as they are."""
        ...

    @property
    def source(self) -> str:
        """For the report."""
        ...

    def at(self, chunk: Chunk) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Map coordinates of the sensor for each point, shape (n, 3), and where they are known, shape (n,)."""
        ...


@dataclass(frozen=True, slots=True)
class Flown:
    """Along a trajectory.

    Attributes
    ----------
    route : Route
    clock : Clock
    lever_m : ndarray, shape (3,)
        Sensor in the body frame: right, forward, up.
    """

    route: Route
    clock: Clock | None
    lever_m: Array

    @property
    def source(self) -> str:
        """For the report."""
        return self.route.source

    def at(self, chunk: Chunk) -> tuple[Array, npt.NDArray[np.bool_]]:
        """See `SensorPath`."""
        poses, covered = self.route.poses.where_covered(chunk.points.time_ns)
        place = poses.position_m
        place[~covered] = 0.0
        if self.lever_m.any():
            quat = poses.quat_local_ins_wxyz
            quat[~covered] = (1.0, 0.0, 0.0, 0.0)
            place = place + np.einsum("nij,j->ni", frames.mat_from_quat(quat), self.lever_m)
        return place + self.route.origin_m, covered


def flown(
    clouds: Sequence[Cloud],
    path: Path,
    *,
    crs: pyproj.CRS | None = None,
    week: int | None = None,
    undulation_m: float = 0.0,
    lever_m: Sequence[float] = (0.0, 0.0, 0.0),
) -> Flown:
    """The path of a trajectory over some clouds of one CRS.

    Raises
    ------
    SwathError
        A file is not as it should be, or the trajectory is of another place or time than the clouds.
    """
    map_crs = agreed_map_crs(clouds, crs)
    standard = next((c for c in clouds if c.timed and not c.week_time), None)
    near = None
    if standard is not None:
        near = int(np.median(next(reader.chunks(standard, Clock(), ())).points.time_ns))
    try:
        route = read_route(path, map_crs, near_utc_ns=near, week=week, undulation_m=undulation_m)
    except UsageError as error:
        raise UsageError(f"{error}; say it with --week") from None
    check_area(map_crs, route.latitude_deg, route.longitude_deg)
    times = route.poses.time_ns
    return Flown(route, Clock(week, int(times[len(times) // 2])), np.asarray(lever_m, np.float64))


class Tally:
    """Whether a trajectory is of a cloud: counts points whose sensor it knows, and how far away that would have been.

    Parameters
    ----------
    trajectory : Path
    path : Flown
    cloud : Cloud
    """

    def __init__(self, trajectory: Path, path: Flown, cloud: Cloud) -> None:
        times = path.route.poses.time_ns
        self._cloud, self._path, self._span = cloud.path, trajectory, span(int(times[0]), int(times[-1]))
        self._points, self._known = 0, 0
        self._away: list[Array] = []

    def add(self, away_m: Array, known: npt.NDArray[np.bool_]) -> None:
        """Take the way from points to the sensor, shape (n, 3), and where it is known, shape (n,)."""
        self._points, self._known = self._points + len(known), self._known + int(known.sum())
        step = max(1, len(known) // _SOME)
        self._away.append(away_m[::step][known[::step]])

    def check(self) -> None:
        """See that the trajectory and the points belong together.

        Raises
        ------
        CoverageError
            They are of other times or of other places.
        """
        if self._known < self._points / 2:
            raise CoverageError(
                f"{self._path}: {self._points - self._known} of {self._points} points of {self._cloud} were measured when it has no pose "
                f"({self._span}); is it of this flight?"
            )
        away = np.abs(np.concatenate(self._away)) if self._away else np.empty((0, 3))
        if not len(away):
            return
        flat, up = float(np.median(np.hypot(away[:, 0], away[:, 1]))), float(np.median(away[:, 2]))
        if np.hypot(flat, up) > _FARTHEST_SENSOR_M or (flat > _FLAT_M and up < _LEAST_RISE * flat):
            raise CoverageError(
                f"{self._path}: the sensor would have been {flat:.0f} m beside the points of {self._cloud} and {up:.0f} m above them "
                "(median), farther than one sees; is the trajectory of this flight?"
            )


def span(first_ns: int, last_ns: int) -> str:
    """A time span in words."""
    return f"{utc_text(first_ns)} to {utc_text(last_ns)}"


@dataclass(frozen=True, slots=True)
class Leg:
    """The path of one strip: places at knots, straight between them.

    Attributes
    ----------
    time_s : ndarray, shape (k,)
    place_m : ndarray, shape (k, 3)
    """

    time_s: Array
    place_m: Array


@dataclass(frozen=True, slots=True)
class Seen:
    """As the rays of shots with several echoes tell it.

    Attributes
    ----------
    legs : mapping of int to list of Leg
        By point source id.
    """

    legs: Mapping[int, list[Leg]]
    clock: Clock | None = None
    source: str = "recovered from shots with several echoes"

    def at(self, chunk: Chunk) -> tuple[Array, npt.NDArray[np.bool_]]:
        """See `SensorPath`."""
        time_s = np.asarray(chunk.record.gps_time, np.float64)
        source = np.asarray(chunk.record.point_source_id)
        place, known = np.zeros((len(time_s), 3)), np.zeros(len(time_s), np.bool_)
        for number, legs in self.legs.items():
            for leg in legs:
                slack = _KNOT_S
                own = (source == number) & (time_s >= leg.time_s[0] - slack) & (time_s <= leg.time_s[-1] + slack)
                for axis in range(3):
                    place[own, axis] = _line(leg, time_s[own], axis)
                known |= own
        return place, known


def _line(leg: Leg, time_s: Array, axis: int) -> Array:
    """Straight between knots, and on beyond the first and the last."""
    place = leg.place_m[:, axis]
    k = np.clip(np.searchsorted(leg.time_s, time_s) - 1, 0, len(leg.time_s) - 2)
    share = (time_s - leg.time_s[k]) / (leg.time_s[k + 1] - leg.time_s[k])
    return np.asarray(place[k] + share * (place[k + 1] - place[k]))


class Rays:
    """Gathers rays through the echoes of one shot, chunk by chunk."""

    def __init__(self) -> None:
        self._parts: list[npt.NDArray[Any]] = []

    def add(self, chunk: Chunk) -> None:
        """Take the rays of a chunk."""
        record, xyz = chunk.record, chunk.points.xyz_m
        several = np.flatnonzero(np.asarray(record.number_of_returns) > 1)
        time_s, source = np.asarray(record.gps_time)[several], np.asarray(record.point_source_id)[several]
        rank = np.asarray(record.return_number)[several]
        order = np.lexsort((rank, time_s, source))
        several, time_s, source = several[order], time_s[order], source[order]
        if len(several) < 2:
            return
        new = np.r_[True, (np.diff(time_s) != 0) | (np.diff(source) != 0)]
        first = np.flatnonzero(new)
        last = np.r_[first[1:], len(several)] - 1
        apart = np.linalg.norm(xyz[several[first]] - xyz[several[last]], axis=1)
        kept = np.flatnonzero(apart >= _LEAST_M)
        if len(kept) > _MOST_RAYS:
            # the longest tell most, but those of a strip must not come from one place
            kept = kept[:: len(kept) // _MOST_RAYS + 1]
        rays = np.column_stack(
            [source[first[kept]], time_s[first[kept]], xyz[several[first[kept]]], xyz[several[last[kept]]]]
        )
        self._parts.append(rays)

    def path(self, *, directions: bool = False) -> Seen:
        """The sensor's path.

        Parameters
        ----------
        directions : bool
            It is asked for the directions of beams alone: where rays are parallel or few, the path lies far away along them.

        Raises
        ------
        CoverageError
            There are too few rays, or they all have one direction.
        """
        rays = np.concatenate(self._parts) if self._parts else np.empty((0, 8))
        legs: dict[int, list[Leg]] = {}
        for number in np.unique(rays[:, 0]):
            own = rays[rays[:, 0] == number]
            own = own[np.argsort(own[:, 1], kind="stable")]
            parts = np.split(own, np.flatnonzero(np.diff(own[:, 1]) > _GAP_S) + 1)
            told = [_leg(part) or (_along(part) if directions else None) for part in parts]
            found = [leg for leg in told if leg is not None]
            if found:
                legs[int(number)] = found
        if not legs:
            raise CoverageError(
                f"{len(rays)} shots with echoes {_LEAST_M:g} m apart or more found, too few to tell where the sensor was: "
                "give the trajectory with --trajectory"
            )
        return Seen(legs)


def recovered(cloud: Cloud) -> Seen | None:
    """The path that a cloud itself tells, as far as the directions of its beams go; None where it does not."""
    if not cloud.timed:
        return None
    rays = Rays()
    for chunk in reader.chunks(cloud, columns=()):
        rays.add(chunk)
    try:
        return rays.path(directions=True)
    except CoverageError:
        return None


def _along(rays: Array) -> Leg | None:
    """A straight path far away along the rays of a strip; None: they are too few."""
    if len(rays) < _FEWEST_PARALLEL:
        return None
    time_s, low = rays[:, 1], rays[:, 5:8]
    way = (rays[:, 2:5] - low).sum(axis=0)  # the longer ones tell more
    there = low + _PARALLEL_M * way / np.linalg.norm(way)
    ends_s = np.array([time_s[0], max(time_s[-1], time_s[0] + 0.1)])
    rows = np.column_stack([np.ones(len(time_s)), time_s - ends_s[0]])
    (place, speed), *_ = np.linalg.lstsq(rows, there, rcond=None)
    return Leg(ends_s, place + speed * (ends_s - ends_s[0])[:, None])


def _leg(rays: Array) -> Leg | None:
    """The path that the rays of a strip, shape (n, 8) in time order, meet best; None: they do not tell it.

    A ray's direction is known as the distance between its echoes allows. A first path is the one that the rays pass nearest; it leans
    towards the ground, where rays of wrong directions are nearer to everything. So the directions to the path are then fitted to those of
    the rays, by Gauss and Newton, with Cauchy's weights.
    """
    if len(rays) < _FEWEST_RAYS:
        return None
    time_s, low = rays[:, 1], rays[:, 5:8]
    way = rays[:, 2:5] - low
    length = np.linalg.norm(way, axis=1)
    direction = way / length[:, None]
    if direction.std(axis=0).max() < _LEAST_ANGLE:
        return None
    knots = max(2, round((time_s[-1] - time_s[0]) / _KNOT_S) + 1)
    knot_s = np.linspace(time_s[0], max(time_s[-1], time_s[0] + 0.1), knots)
    k = np.clip(np.searchsorted(knot_s, time_s) - 1, 0, knots - 2)
    share = (time_s - knot_s[k]) / (knot_s[k + 1] - knot_s[k])
    origin = low.mean(axis=0)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    place = _solve(across * (length**2)[:, None, None], low - origin, (k, share), knots)
    for _ in range(_ROUNDS):
        if place is None:
            return None
        at = (1 - share)[:, None] * place[k] + share[:, None] * place[k + 1]
        away = at - (low - origin)
        range_m = np.maximum(np.linalg.norm(away, axis=1), _LEAST_M)
        ahead = away / range_m[:, None]
        across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
        off = np.einsum("nij,nj->ni", across, direction)
        miss = np.linalg.norm(off, axis=1) * length
        robust = 1.0 / (1.0 + np.square(miss / max(2.0 * float(np.median(miss)), 1e-9)))
        weight = across * (robust * length**2 / range_m**2)[:, None, None]
        place = _solve(weight, at + range_m[:, None] * off, (k, share), knots)
    if place is None:
        return None
    above = np.linalg.norm(place - (low.mean(axis=0) - origin), axis=1)
    if not (above < _FARTHEST_M).all() or (place[:, 2] < 0.0).any():
        return None
    return Leg(knot_s, place + origin)


def _solve(weight: Array, place_m: Array, at: tuple[npt.NDArray[Any], Array], knots: int) -> Array | None:
    """Places at knots by least squares; a straight path where the rays of a knot say little."""
    k, share = at
    normal, right = np.zeros((knots, 3, knots, 3)), np.zeros((knots, 3))
    pulled = np.einsum("nij,nj->ni", weight, place_m)
    for a, left in ((0, 1 - share), (1, share)):
        np.add.at(right, k + a, left[:, None] * pulled)
        for b, other in ((0, 1 - share), (1, share)):
            block = np.zeros((knots, 3, 3))
            np.add.at(block, k + a, (left * other)[:, None, None] * weight)
            for n in range(knots):
                m = n - a + b
                if 0 <= m < knots:
                    normal[n, :, m, :] += block[n]
    scale = float(np.trace(normal.reshape(3 * knots, -1))) / (3 * knots)
    for n in range(1, knots - 1):
        for i, vi in ((n - 1, 1.0), (n, -2.0), (n + 1, 1.0)):
            for j, vj in ((n - 1, 1.0), (n, -2.0), (n + 1, 1.0)):
                normal[i, :, j, :] += np.eye(3) * vi * vj * scale * 1e-2
    try:
        found = solve(normal.reshape(3 * knots, 3 * knots), right.ravel(), assume_a="pos")
    except LinAlgError:
        return None
    return np.asarray(found).reshape(knots, 3)
