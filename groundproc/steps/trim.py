"""Which part of a flight goes into the products, as the survey chose it."""

from collections.abc import Sequence
from pathlib import Path

import pyproj

from groundproc.cloud.selection import Choice, Selection, Times
from groundproc.cloud.spans import spans_ns
from groundproc.strips.manoeuvres import ends_ns, turns_ns
from groundproc.strips.options import StripOptions
from groundproc.survey import Survey
from groundproc.trajectory.trajectory import Trajectory
from groundproc.vectors.area import read_area


def selection_of(survey: Survey, trajectory: Trajectory, crs: pyproj.CRS) -> Selection:
    """What the survey wants of the points of a flight.

    Parameters
    ----------
    survey : Survey
    trajectory : Trajectory
        Seconds of the flight count from its first pose.
    crs : pyproj.CRS
        Of the points.

    Raises
    ------
    UsageError, CaptureError, GeodesyError
        A span of time or the area is not as it should be.
    """
    choices: list[Choice] = []
    if survey.times is not None:
        choices.append(Times("times", spans_ns(survey.times, int(trajectory.time_ns[0]))))
    if survey.without_ends:
        choices.append(Times("take-off and landing", ends_ns(trajectory), within=False))
    if survey.without_turns:
        choices.append(Times("turns", turns_ns(trajectory, StripOptions().turn_deg), within=False))
    if survey.area is not None:
        choices.append(read_area(Path(survey.area), crs, survey.area_keeps == "outside"))
    return Selection(choices)


def check_times(times: Sequence[str] | None) -> None:
    """Refuse what is no span of time, before the work.

    Raises
    ------
    UsageError
    """
    spans_ns(times or (), 0)
