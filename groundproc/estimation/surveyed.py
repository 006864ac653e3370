"""The positions, poses and control points that the survey names, brought into the flight's local frame."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from flightlog.clock import utc_text
from flightlog.errors import LogError
from groundproc import geodesy
from groundproc.estimation import ownsolution
from groundproc.estimation.method import Given
from groundproc.flight.control import ControlPoint, read_control
from groundproc.flight.positions.fixes import OutsideFixes, Tied, lever_arm, outside_fixes
from groundproc.flight.positions.poses import FORMAT as POSES
from groundproc.flight.positions.poses import read_poses
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import ELLIPSOID, MSL, Quality, Solution
from groundproc.trajectory.covariance import correlation_of, scaled
from groundproc.trajectory.estimate import COVARIANCE, read_covariance, read_tied

SMOOTHED_INTERVAL_S: Final = 1.0
"""Spacing at which outside solutions are taken that were smoothed with an IMU: their errors hang together for about as long."""


REACH_NS: Final = 10**9
"""How far beyond the first and the last covariance of a file its correlations still hold: they change slowly."""
_LEAST_EIGENVALUE: Final = -1e-6
"""Of a correlation matrix; further below 0 it is not one that rounding has spoilt."""


def surveyed(given: Given) -> list[OutsideFixes]:
    """The positions and the poses that the survey names, in the local frame.

    Raises
    ------
    LogError, UsageError
        They cannot be read, none lies within the flight, or something about them is not known.
    """
    return [
        _in_frame(given, Path(place)) for place in (given.survey.positions, given.survey.poses) if place is not None
    ]


def _in_frame(given: Given, path: Path) -> OutsideFixes:
    """One file's."""
    survey, leg, fixes = given.survey, given.placed[0], given.fixes[0]
    start_ns, end_ns = leg.utc_from_boot(fixes.time_ns[[0, -1]]).tolist()
    if survey.poses is not None and path == Path(survey.poses):
        solution = read_poses(path, height_reference=_poses_height(survey.height))
    else:
        solution = read_solution(path, near_utc_ns=start_ns, poses_height=_poses_height(survey.height))
    beside = covariance_beside(path) if solution.format == POSES else None
    if beside is not None:
        solution = with_covariance(solution, beside)
    undulation_m = None
    if survey.geoid is not None:
        undulation_m = geodesy.undulation(survey.geoid, float(fixes.latitude_deg[0]), float(fixes.longitude_deg[0]))
    smoothed = bool((solution.quality == Quality.INERTIAL).any())
    outside = outside_fixes(
        solution,
        given.frame,
        lever_arm(solution, given.mount),
        height=survey.height,
        undulation_m=undulation_m,
        interval_s=SMOOTHED_INTERVAL_S if smoothed else 0.0,
    )
    if beside is not None:
        outside = with_ties(outside, beside)
    if not len(outside.between(start_ns, end_ns)):
        raise LogError(
            f"{path}: no position between {utc_text(start_ns)} and {utc_text(end_ns)}, when the autopilot had its own"
        )
    return outside


def _poses_height(height: str) -> str:
    """Poses do not say what their heights refer to; they are taken to be those of the survey."""
    return height if height in (ELLIPSOID, MSL) else ELLIPSOID


def covariance_beside(path: Path) -> Path | None:
    """The covariance.npz beside a table of poses, if there is one."""
    beside = path.parent / COVARIANCE
    return beside if beside.is_file() else None


def with_covariance(solution: Solution, path: Path) -> Solution:
    """Poses with the full covariance of a covariance.npz.

    Sigmas that the table states take precedence over those of the file, as for a trajectory of ours. Correlations are
    interpolated between the times of the file, and so are sigmas where the table has none.

    Raises
    ------
    LogError
        The file cannot be read, is of other times, or its matrices are no covariances.
    """
    time_ns, covariance = read_covariance(path)
    first, last = int(solution.time_ns[0]), int(solution.time_ns[-1])
    if first < time_ns[0] - REACH_NS or last > time_ns[-1] + REACH_NS:
        raise LogError(
            f"{path}: covers {utc_text(int(time_ns[0]))} to {utc_text(int(time_ns[-1]))}, expected all of {solution.source} beside it, "
            f"{utc_text(first)} to {utc_text(last)}; remove it where it belongs to other poses"
        )
    correlation = correlation_of(time_ns, covariance)
    least = float(np.linalg.eigvalsh(correlation.matrix).min())
    if not least > _LEAST_EIGENVALUE:
        raise LogError(f"{path}: a correlation matrix with an eigenvalue of {least:.2g} found, expected none below 0")
    with np.errstate(invalid="ignore"):
        of_file = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    between = [np.interp(solution.time_ns - time_ns[0], time_ns - time_ns[0], column) for column in of_file.T]
    sigma = np.where(np.isfinite(stated := _sigmas(solution)), stated, np.stack(between, axis=1))
    found = scaled(correlation.at(solution.time_ns), sigma[:, :3], sigma[:, 3:])
    return replace(
        solution,
        covariance_m2=found[:, :3, :3],
        attitude_covariance_rad2=found[:, 3:, 3:],
        cross_covariance_m_rad=found[:, :3, 3:],
        sigma_source=f"{solution.source} and {path.name}",
    )


def with_ties(fixes: OutsideFixes, path: Path) -> OutsideFixes:
    """Poses with what a covariance.npz says of how they hang together; as they are where it says nothing, or not of all of them.

    Raises
    ------
    LogError
        The file cannot be read, or its matrices are no covariances.
    """
    found = read_tied(path)
    if found is None:
        return fixes
    time_ns, _ = read_covariance(path)
    row = np.clip(np.searchsorted(time_ns, fixes.time_ns), 0, len(time_ns) - 1)
    if not np.array_equal(time_ns[row], fixes.time_ns):
        return fixes
    tied = Tied(*found).rows(row)
    for name, part in (("own", tied.own), ("shared", tied.shared)):
        size = np.trace(part, axis1=1, axis2=2)
        least = float((np.linalg.eigvalsh(part)[:, 0] / np.where(size > 0.0, size, 1.0)).min(initial=0.0))
        if least < _LEAST_EIGENVALUE:
            raise LogError(f"{path}: {name} with an eigenvalue of {least:.2g} of its size found, expected none below 0")
    return replace(fixes, tied=tied)


def _sigmas(solution: Solution) -> np.ndarray:
    """Sigmas of east, north, up, roll, pitch and heading as the table states them, shape (n, 6)."""
    attitude = solution.attitude_covariance_rad2
    turns = np.full_like(solution.sigma_m, np.nan) if attitude is None else np.sqrt(np.einsum("nii->ni", attitude))
    return np.concatenate([solution.sigma_m, turns], axis=1)


FARTHEST_M: Final = 1000.0
"""A control file none of whose points is so near to the flight is in other coordinates."""


def surveyed_control(given: Given) -> tuple[ControlPoint, ...]:
    """The control points and planes that the survey names, in the local frame: read in the output's coordinates and heights.

    Raises
    ------
    LogError, CaptureError
        They cannot be read, or lie nowhere near the flight.
    """
    survey, frame = given.survey, given.frame
    if survey.control is None:
        return ()
    points = read_control(Path(survey.control))
    code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
    projection = geodesy.Projection(frame, geodesy.projected_crs(code))
    places = projection.local(np.array([point.place_m for point in points]))
    flown = np.concatenate(
        [frame.from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_m) for fix in given.fixes]
    )
    off = np.abs(places[:, None] - flown[None, :: max(1, len(flown) // 500)]).max(axis=2).min(axis=1)
    if not np.nanmin(np.where(np.isfinite(off), off, np.inf)) < FARTHEST_M:
        raise LogError(
            f"{survey.control}: no point within {FARTHEST_M:.0f} m of the flight, expected coordinates of EPSG:{code} "
            f"({projection.crs.name}) and heights {ownsolution.HEIGHTS[survey.height]}"
        )
    return tuple(
        replace(point, place_m=place, normal=_local_normal(projection, point, place))
        for point, place in zip(points, places, strict=True)
        if np.isfinite(place).all()
    )


def _local_normal(projection: geodesy.Projection, point: ControlPoint, place: np.ndarray) -> np.ndarray | None:
    """A plane's normal, stated along the map's axes: these are turned by the convergence of meridians."""
    if point.normal is None:
        return None
    ahead = projection.local((point.place_m + point.normal)[None])[0] - place
    return np.asarray(ahead / np.linalg.norm(ahead))
