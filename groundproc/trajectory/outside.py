"""The positions or poses that the survey names, brought into the flight's local frame."""

from pathlib import Path
from typing import Final

from flightlog.clock import utc_text
from flightlog.errors import LogError
from groundproc import geodesy
from groundproc.positions.fixes import OutsideFixes, lever_arm, outside_fixes
from groundproc.positions.reading import read_solution
from groundproc.positions.solution import ELLIPSOID, MSL, Quality
from groundproc.trajectory.method import Given

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
