"""Step trajectory: the poses of the flight and all that is estimated with them, as a folder that can be read again."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from flightlog import config
from flightlog.errors import UsageError
from flightlog.mount import Mount
from groundproc.estimation import methods, surveyed
from groundproc.estimation.method import chosen_corrections, gather
from groundproc.sensors.lasers import ESTIMATE
from groundproc.steps.place import check_place
from groundproc.steps.request import Request
from groundproc.steps.run import Run
from groundproc.steps.step import WHOLE, Folders, Step
from groundproc.survey import ClockSettings, MountSettings, PlacingSettings, Survey, TrajectorySettings, section
from groundproc.trajectory.estimate import FILES, TRAJECTORY, Estimate, is_estimate, read_estimate, write_estimate
from groundproc.trajectory.table import read_trajectory

NAMED: Final = ("mount", "positions", "poses", "control", "lasers", "compass", "geoid")
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
    tried = [methods.find(name) for name in methods.candidates(survey)]
    looked_at = {option for method in tried for option in method.options}
    if not any(method.uses_points for method in tried):
        for name in config.to_mapping(PlacingSettings()):
            del found[name]
    return {name: value for name, value in found.items() if name in looked_at or name not in methods.users()}


def files(request: Request) -> Mapping[str, Path]:
    """Files that the settings name."""
    found = {name: Path(str(value)) for name in NAMED if (value := getattr(request.survey, name)) is not None}
    named = {name: path for name, path in found.items() if path.is_file() and found[name] != Path(ESTIMATE)}
    for name in ("positions", "poses"):
        if name in named and (beside := surveyed.covariance_beside(named[name])) is not None:
            named[f"{name}: {beside.name}"] = beside
    if request.poses is None:
        return named
    folder = request.poses if request.poses.is_dir() else request.poses.parent
    if request.poses.is_dir() or (request.poses.name == TRAJECTORY and is_estimate(folder)):
        return named | {f"trajectory: {name}": folder / name for name in FILES if (folder / name).is_file()}
    return named | {"trajectory": request.poses}


def check(request: Request) -> None:
    """Refuse options that the method would not look at, and files that cannot be read."""
    chosen_corrections(request.survey)
    if request.poses is None:
        methods.check(request.survey)
        return
    if request.survey.lasers == ESTIMATE:
        raise UsageError("lasers: estimate given, but with a trajectory from elsewhere nothing is estimated")
    plain = section(Survey(), TrajectorySettings)
    for name, value in section(request.survey, TrajectorySettings).items():
        if name != "lasers" and value != plain[name]:
            raise UsageError(
                f"{name}: {value} given, but nothing uses it: with a trajectory from elsewhere nothing is estimated"
            )


def work(run: Run, folders: Folders) -> None:
    """Estimate, and write the estimate's folder."""
    write_estimate(folders[WHOLE], estimate(run))


def estimate(run: Run) -> Estimate:
    """By the method that the survey chose, or as a trajectory from elsewhere has it."""
    mount, source = run.mount_and_source
    poses, survey = run.request.poses, run.survey
    if poses is not None:
        return from_elsewhere(poses, survey, mount, source)
    given = gather(run.readers, run.flight, run.timeline, mount, survey, source)
    # now, and not after minutes of work
    for fixes in given.fixes:
        check_place(survey, fixes.latitude_deg, fixes.longitude_deg)
    return methods.estimate(given, run.progress)


def from_elsewhere(place: Path, survey: Survey, mount: Mount, mount_source: str) -> Estimate:
    """A trajectory made before, with what lies beside it; mount and lasers that the survey names go before those.

    Parameters
    ----------
    place : Path
        Folder of an estimate or its trajectory.csv; or a trajectory.csv that lies alone, which is taken with `mount`.

    Raises
    ------
    LogError, ConfigError
        It cannot be read.
    """
    folder = place if place.is_dir() else place.parent
    if place.is_dir() or (place.name == TRAJECTORY and is_estimate(folder)):
        made = read_estimate(folder)
        made = replace(made, note="; ".join(filter(None, (made.note, f"read from {folder}"))))
    else:
        note = f"{place} lies alone: mount, lasers and clocks are those of the log and the survey"
        made = Estimate(
            read_trajectory(place),
            mount,
            f"as {place} has them",
            method="outside",
            mount_source=mount_source,
            note=note,
        )
    if survey.mount is not None:
        made = replace(made, mount=mount, mount_source=mount_source, mount_sigma=None)
    return made if survey.lasers is None else replace(made, corrections=chosen_corrections(survey))


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
