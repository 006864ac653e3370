"""The positions, poses and control points that the survey names, brought into the flight's local frame."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from flightlog.clock import utc_text
from flightlog.errors import LogError
from groundproc import geodesy
from groundproc.estimation import ins
from groundproc.estimation.method import Given
from groundproc.flight.control import ControlPoint, read_control
from groundproc.flight.positions.fixes import OutsideFixes, lever_arm, outside_fixes
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import ELLIPSOID, MSL, Quality

SMOOTHED_INTERVAL_S: Final = 1.0
"""Spacing at which outside solutions are taken that were smoothed with an IMU: their errors hang together for about as long."""


def surveyed(given: Given) -> list[OutsideFixes]:
    """The positions that the survey names, in the local frame.

    Raises
    ------
    LogError, UsageError
        They cannot be read, none lies within the flight, or something about them is not known.
    """
    survey = given.survey
    if survey.positions is None:
        return []
    leg, fixes = given.placed[0], given.fixes[0]
    start_ns, end_ns = leg.utc_from_boot(fixes.time_ns[[0, -1]]).tolist()
    solution = read_solution(Path(survey.positions), near_utc_ns=start_ns, poses_height=_poses_height(survey.height))
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
    if not len(outside.between(start_ns, end_ns)):
        raise LogError(
            f"{survey.positions}: no position between {utc_text(start_ns)} and {utc_text(end_ns)}, when the autopilot had its own"
        )
    return [outside]


def _poses_height(height: str) -> str:
    """Poses do not say what their heights refer to; they are taken to be those of the survey."""
    return height if height in (ELLIPSOID, MSL) else ELLIPSOID


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
            f"({projection.crs.name}) and heights {ins.HEIGHTS[survey.height]}"
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
