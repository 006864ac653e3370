"""Step trajectory: the poses of the flight and all that is estimated with them, as a folder that can be read again."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from flightlog import config
from flightlog.errors import UsageError
from groundproc.estimation import methods
from groundproc.estimation.method import Estimate, chosen_table, gather
from groundproc.sensors.lasers import ESTIMATE
from groundproc.steps.run import Run
from groundproc.steps.step import Request, Step
from groundproc.survey import ClockSettings, MountSettings, PlacingSettings, TrajectorySettings, section
from groundproc.trajectory.table import read_trajectory, write_trajectory

NAMED: Final = ("mount", "positions", "control", "lasers", "compass", "geoid")
"""Options whose value may be the name of a file."""


def settings(request: Request) -> Mapping[str, Any]:
    """All but the output's CRS, which only control points are given in; what a method does not look at is left out."""
    survey = request.survey
    found = section(survey, ClockSettings, MountSettings)
    if request.poses is not None:
        return found | {"lasers": survey.lasers}
    found |= section(survey, TrajectorySettings, PlacingSettings)
    found |= {"height": survey.height, "geoid": survey.geoid}
    if survey.control is not None:
        found["crs"] = config.to_mapping(survey.crs)
    if survey.method != "dynamic":
        del found["dynamic"]
    if survey.method in ("ins", "filtered"):
        for name in config.to_mapping(PlacingSettings()):
            del found[name]
    return found


def files(request: Request) -> Mapping[str, Path]:
    """Files that the settings name."""
    found = {name: Path(str(value)) for name in NAMED if (value := getattr(request.survey, name)) is not None}
    named = {name: path for name, path in found.items() if path.is_file() and found[name] != Path(ESTIMATE)}
    return named if request.poses is None else named | {"trajectory": request.poses}


def check(request: Request) -> None:
    """Refuse options that the method would not look at, and files that cannot be read."""
    chosen_table(request.survey)
    if request.poses is None:
        methods.check(request.survey)
    elif request.survey.lasers == ESTIMATE:
        raise UsageError("lasers: estimate given, but with a trajectory from elsewhere nothing is estimated")


def work(run: Run, folder: Path) -> None:
    """Estimate, and write the estimate's folder."""
    made = made_of(run)
    write_trajectory(folder / "trajectory.csv", made.trajectory)
    for write in made.products:
        write(folder)


def made_of(run: Run) -> Estimate:
    """The estimate of this run."""
    if run.made is None:
        run.made = estimate(run)
    made: Estimate = run.made
    return made


def estimate(run: Run) -> Estimate:
    """By the method that the survey chose, or as poses from elsewhere have it."""
    mount, _ = run.mount_and_source
    poses, survey = run.request.poses, run.survey
    if poses is None:
        return methods.estimate(gather(run.readers, run.flight, run.timeline, mount, survey), run.progress)
    return Estimate(read_trajectory(poses), mount, f"as {poses} has them", chosen_table(survey), method="outside")


STEP: Final = Step(
    name="trajectory",
    about="poses, mount and lasers, with their covariance",
    after=(),
    reads_logs=True,
    settings=settings,
    files=files,
    work=work,
    check=check,
)
