"""The methods by their names on the command line."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from flightlog.errors import CoverageError, LogError, UsageError
from groundproc.estimation import filtered, ins
from groundproc.estimation.adjustment import adjusted
from groundproc.estimation.dynamic import dynamic
from groundproc.estimation.method import Estimate, Given, Progress
from groundproc.sensors.lasers import ESTIMATE
from groundproc.survey import Survey
from groundproc.trajectory.trajectory import Trajectory, joined


def estimate(given: Given, progress: Progress) -> Estimate:
    """Make the trajectory with the method that the survey chose, or with the best that the log allows.

    Raises
    ------
    UsageError
        An option is given that the method would not look at.
    SwathError
        The log does not hold what the method needs.
    """
    check(given.survey)
    names = candidates(given.survey)
    reasons: list[str] = []
    for name in names:
        try:
            made = METHODS[name](given, progress)
        except (LogError, CoverageError) as error:
            if name == names[-1]:
                raise
            reasons.append(f"not {name}, because {str(error).removeprefix(f'{name}: ')}")
            continue
        lasers = made.lasers if given.survey.lasers == ESTIMATE else given.lasers
        return replace(made, method=name, note="; ".join(reasons), lasers=lasers)
    raise AssertionError(f"no method for {given.survey.method}")


def candidates(survey: Survey) -> tuple[str, ...]:
    """Methods to try, the best first.

    `best` goes down only as far as the other options allow: only the adjustment is causal or takes control, only it and the filter take
    positions.
    """
    if survey.method != "best":
        return (survey.method,)
    if survey.causal or survey.control is not None:
        return ("adjusted",)
    return ("adjusted", "filtered") if survey.positions is not None else ("adjusted", "filtered", "ins")


def check(survey: Survey) -> None:
    """Refuse options that the chosen method would not look at.

    Raises
    ------
    UsageError
    """
    first = candidates(survey)[0]
    for name, users in OPTIONS_OF.items():
        value = getattr(survey, name)
        if value in (None, False):
            continue
        if first not in users:
            raise UsageError(
                f"{name}: {value} given, but only method {' or '.join(users)} uses it, not {survey.method}"
            )
        if survey.causal and name != "causal":
            raise UsageError(
                f"{name}: {value} given together with causal, which uses nothing that is known after the flight only"
            )
    if survey.lasers == ESTIMATE and (survey.causal or candidates(survey)[0] != "adjusted"):
        raise UsageError("lasers: estimate given, but only method adjusted finds them, and not with --causal")


def ins_estimate(given: Given, progress: Progress) -> Estimate:
    """The autopilot's own solution, interpolated; a boot that never had a fix leaves a gap.

    Raises
    ------
    LogError
        No boot gives a trajectory.
    """
    del progress
    placed, grid_ms = given.placed, given.survey.pose_grid_ms
    grid_ns = None if grid_ms is None else round(grid_ms * 1e6)
    parts: list[Trajectory] = []
    reasons: list[LogError] = []
    for number, (leg, fix) in enumerate(zip(placed, given.fixes, strict=True)):
        try:
            part = ins.ins_trajectory(leg.boot, fix, given.frame, leg.utc_from_boot, given.mount, grid_ns)
        except LogError as error:
            reasons.append(error)
            continue
        # a boot that went on over a jump of the lidar's clock belongs to both legs: each has its own side
        if number and placed[number - 1].boot is leg.boot and parts:
            part = part.after(int(parts[-1].time_ns[-1]))
        if number + 1 < len(placed) and placed[number + 1].boot is leg.boot:
            part = part.before(int(leg.utc_from_lidar(np.array([leg.last_lidar_ns]))[0]))
        if len(part) > 1:
            parts.append(part)
    if reasons and not parts:
        raise reasons[0]
    return Estimate(joined(parts), given.mount, ins.SIGMA_SOURCE)


def adjusted_estimate(given: Given, progress: Progress) -> Estimate:
    """Lidar, inertial sensors, GNSS and compass in one adjustment, begun from the autopilot's solution.

    Raises
    ------
    LogError
        A lidar with so few lasers that it does not see a surface twice within a slice.
    """
    if len(given.lidar.lasers) < LEAST_LASERS:
        raise LogError(
            f"adjusted: a {given.lidar.name} has {len(given.lidar.lasers)} laser; at least {LEAST_LASERS} are needed to see "
            "a surface again at once"
        )
    return adjusted.estimate(given, progress, ins_estimate(given, progress).trajectory)


def dynamic_estimate(given: Given, progress: Progress) -> Estimate:
    """The source's dynamic calibration of another method's trajectory."""
    return dynamic.dynamic_estimate(given, progress, METHODS[given.survey.dynamic.start])


OPTIONS_OF: Final = {
    "positions": ("adjusted", "filtered"),
    "control": ("adjusted",), "compass": ("dynamic",), "causal": ("adjusted",), "pose_grid_ms": ("ins",),
}  # fmt: skip
"""Options of the survey that some methods alone look at."""

LEAST_LASERS: Final = 8
"""Of a lidar whose motion the adjustment can tell from its returns."""

METHODS: Final[dict[str, Callable[[Given, Progress], Estimate]]] = {
    "ins": ins_estimate,
    "dynamic": dynamic_estimate,
    "filtered": filtered.filtered_estimate,
    "adjusted": adjusted_estimate,
}
