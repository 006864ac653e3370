"""The given trajectory in map coordinates, and the corrected one as a trajectory again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pyproj

from flightlog import frames
from flightlog.errors import GeodesyError, LogError
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import Solution
from groundproc.geodesy import LocalFrame
from groundproc.trajectory.table import from_poses
from groundproc.trajectory.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_STEP_DEG: Final = 1e-4
"""Way to the north over which grid north is compared with true north [deg]."""
_SLOW_M_S: Final = 0.3
"""Below this speed a course says nothing."""


@dataclass(frozen=True, slots=True)
class Route:
    """A trajectory over a map.

    Attributes
    ----------
    poses : Trajectory
        Its positions are map coordinates less `origin_m`, its attitudes "map from body"; its frame is not used.
    origin_m : ndarray, shape (3,)
    latitude_deg, longitude_deg, height_m : ndarray, shape (n,)
        As given.
    north_rad : ndarray, shape (n,)
        True north on the map, counter-clockwise from grid north.
    undulation_m : float
        What was taken off its heights.
    has_attitude : bool
        False: attitudes are level along the course, and say nothing of a mount.
    source : str
    """

    poses: Trajectory
    origin_m: Array
    transformer: pyproj.Transformer
    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    north_rad: Array
    undulation_m: float
    has_attitude: bool
    source: str


def read_route(
    path: Path, crs: pyproj.CRS, *, near_utc_ns: int | None, week: int | None, undulation_m: float = 0.0
) -> Route:
    """Read a trajectory, whatever its format: trajectory.csv, SBET, RTKLIB .pos, NMEA.

    Parameters
    ----------
    path : Path
    crs : pyproj.CRS
        Of the cloud.
    near_utc_ns, week
        For formats that do not know the week.
    undulation_m : float
        Taken off the trajectory's heights where those of the cloud are above the geoid [m].

    Raises
    ------
    LogError
        It cannot be read, or holds less than two poses.
    GeodesyError
        There is no way from WGS 84 to the map.
    """
    solution = read_solution(path, near_utc_ns=near_utc_ns, week=week)
    if len(solution) < 2:
        raise LogError(f"{path}: {len(solution)} poses found, expected two or more")
    group = pyproj.transformer.TransformerGroup("EPSG:4326", crs, always_xy=True)
    if not group.transformers or not group.best_available:
        raise GeodesyError(f"{crs.name}: the transformation from WGS 84 is not available here")
    transformer = group.transformers[0]
    latitude, longitude = solution.latitude_deg, solution.longitude_deg
    east, north = transformer.transform(longitude, latitude)
    east_up, north_up = transformer.transform(longitude, latitude + _STEP_DEG)
    place = np.stack([east, north, solution.height_m - undulation_m], axis=1)
    if not np.isfinite(place).all():
        raise GeodesyError(f"{path}: its positions lie outside what {crs.name} covers")
    turn = np.arctan2(-(east_up - east), north_up - north)
    origin = np.round(place[len(place) // 2], -2)
    place -= origin
    quat = _attitudes(solution, place, turn)
    poses = from_poses(
        LocalFrame(float(latitude[0]), float(longitude[0]), 0.0), solution.time_ns, place, quat,
        solution.sigma_m, _attitude_sigma(solution),
    )  # fmt: skip
    return Route(
        poses, origin, transformer, latitude, longitude, solution.height_m, turn, undulation_m,
        solution.quat_place_ins_wxyz is not None, f"{solution.source} ({solution.format})",
    )  # fmt: skip


def about_north(angle_rad: Array) -> Array:
    """Quaternions of a turn about up, counter-clockwise, shape (n, 4)."""
    zero = np.zeros_like(angle_rad)
    return np.stack([np.cos(angle_rad / 2), zero, zero, np.sin(angle_rad / 2)], axis=-1)


def _attitudes(solution: Solution, place_m: Array, north_rad: Array) -> Array:
    """Map from body, shape (n, 4); where none are given, level along the course."""
    if solution.quat_place_ins_wxyz is not None:
        return frames.quat_multiply(about_north(north_rad), solution.quat_place_ins_wxyz)
    step = np.gradient(place_m[:, :2], solution.time_ns * 1e-9 - float(solution.time_ns[0]) * 1e-9, axis=0)
    moving = np.hypot(step[:, 0], step[:, 1]) > _SLOW_M_S
    course = np.arctan2(step[:, 0], step[:, 1])
    last = np.maximum.accumulate(np.where(moving, np.arange(len(course)), np.argmax(moving)))
    return about_north(-course[last])


def _attitude_sigma(solution: Solution) -> Array:
    if solution.attitude_covariance_rad2 is None:
        return np.full((len(solution), 3), np.nan)
    return np.asarray(np.sqrt(np.einsum("nii->ni", solution.attitude_covariance_rad2)))


def as_trajectory(route: Route, position_m: Array, quat: Array, sigma_m: Array, sigma_rad: Array) -> Trajectory:
    """A corrected route as a trajectory for `write_trajectory`, heights as in the given one.

    Parameters
    ----------
    route : Route
    position_m : ndarray, shape (n, 3)
        Map coordinates less the route's origin.
    quat : ndarray, shape (n, 4)
        Map from body.
    sigma_m, sigma_rad : ndarray, shape (n, 3)
    """
    place = position_m + route.origin_m
    longitude, latitude = route.transformer.transform(place[:, 0], place[:, 1], direction="INVERSE")
    height = place[:, 2] + route.undulation_m
    frame = LocalFrame(float(latitude[0]), float(longitude[0]), float(height[0]))
    level = frames.quat_multiply(about_north(-route.north_rad), quat)
    return from_poses(
        frame, route.poses.time_ns, frame.from_geodetic(latitude, longitude, height), level, sigma_m, sigma_rad
    )
