"""From flight logs to products: the stages in order, and nothing else.

log --load--> packets, frames --timeline--> one time scale --trajectory--> poses --georeference--> points --products--> files
"""

import contextlib
import functools
import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flightlog.errors import UsageError
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc import geodesy
from groundproc.cloud.placing import write_cloud
from groundproc.estimation import methods
from groundproc.estimation.method import Progress, chosen_corrections, gather
from groundproc.files import made_folder, written_aside
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.timeline import legs, tied
from groundproc.products.pictures import draw_cloud
from groundproc.sensors.lasers import ESTIMATE
from groundproc.steps.quality import describe
from groundproc.survey import Survey
from groundproc.trajectory.estimate import TRAJECTORY, Estimate, is_estimate, read_estimate, write_estimate
from groundproc.trajectory.table import read_trajectory


def process(
    logs: Sequence[Path], survey: Survey, folder: Path, progress: Progress, poses: Path | None = None
) -> dict[str, Any]:
    """Make cloud.laz, the files of the estimate, quality.json and pictures of a flight.

    Parameters
    ----------
    logs : sequence of Path
        One or several logs of one flight.
    survey : Survey
    folder : Path
        Made where it is not there.
    progress : Progress
    poses : Path, optional
        A trajectory made before, in UTC, to place the points with: an estimate's folder or a trajectory.csv.

    Returns
    -------
    dict
        What quality.json holds.
    """
    if survey.crs is not None:
        geodesy.projected_crs(survey.crs)  # a wrong code is said before the work, not after
    if poses is None:
        methods.check(survey)
    elif survey.lasers == ESTIMATE:
        raise UsageError("lasers: estimate given, but with a trajectory from elsewhere nothing is estimated")
    with contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder))
        readers = [stack.enter_context(LogReader(path)) for path in logs]
        check_order(readers)
        mount, mount_source = find_mount(survey.mount, readers)
        flight = read_flight(readers, "ins", functools.partial(progress, "read"))
        timeline = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), survey.sync)
        if poses is None:
            made = methods.estimate(gather(readers, flight, timeline, mount, survey, mount_source), progress)
        else:
            made = from_elsewhere(poses, survey, mount, mount_source)
            timeline = tied(timeline, made.ties) if made.ties else timeline
        trajectory = made.trajectory
        frame = trajectory.frame
        code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
        projection = geodesy.Projection(frame, geodesy.projected_crs(code))
        tally, sample = write_cloud(
            readers, timeline, made, survey, projection, folder, functools.partial(progress, "place")
        )
        write_estimate(folder, made)
        for write in made.products:
            write(folder)
        draw_cloud(folder, sample, projection.crs.name)
        quality = describe(readers, survey, made, flight, timeline, projection, tally)
        with written_aside(folder / "quality.json") as aside:
            aside.write_text(json.dumps(quality, indent=2) + "\n", encoding="utf-8")
    return quality


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


def check_order(readers: list[LogReader]) -> None:
    """Sort logs by time; logs that overlap are not of one flight."""
    readers.sort(key=lambda reader: reader.start_ns)
    for before, after in itertools.pairwise(readers):
        if after.start_ns < before.end_ns - 1_000_000_000:
            raise UsageError(
                f"{before.path} and {after.path}: overlap in time; the parts of one flight follow each other"
            )
