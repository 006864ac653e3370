"""From flight logs to products: the stages in order, and nothing else.

log --load--> packets, frames --timeline--> one time scale --trajectory--> poses --georeference--> points --products--> files
"""

import contextlib
import functools
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flightlog.errors import UsageError
from flightlog.logfile import LogReader
from groundproc import geodesy
from groundproc.cloud.placing import write_cloud
from groundproc.estimation import methods
from groundproc.estimation.method import Estimate, Progress, chosen_table, gather
from groundproc.files import made_folder, written_aside
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.timeline import legs
from groundproc.products.pictures import draw_cloud
from groundproc.sensors.lasers import ESTIMATE
from groundproc.steps.quality import describe
from groundproc.survey import Survey
from groundproc.trajectory.table import read_trajectory, write_trajectory


def process(
    logs: Sequence[Path], survey: Survey, folder: Path, progress: Progress, poses: Path | None = None
) -> dict[str, Any]:
    """Make cloud.laz, trajectory.csv, quality.json and pictures of a flight.

    Parameters
    ----------
    logs : sequence of Path
        One or several logs of one flight.
    survey : Survey
    folder : Path
        Made where it is not there.
    progress : Progress
    poses : Path, optional
        A trajectory.csv from elsewhere, in UTC, to place the points with in place of the autopilot's.

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
            made = methods.estimate(gather(readers, flight, timeline, mount, survey), progress)
        else:
            lasers = chosen_table(survey, flight.lidar.lasers)
            made = Estimate(read_trajectory(poses), mount, f"as {poses} has them", lasers, method="outside")
        trajectory = made.trajectory
        frame = trajectory.frame
        code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
        projection = geodesy.Projection(frame, geodesy.projected_crs(code))
        tally, sample = write_cloud(
            readers, timeline, made, survey, projection, folder, functools.partial(progress, "place")
        )
        write_trajectory(folder / "trajectory.csv", trajectory)
        for write in made.products:
            write(folder)
        draw_cloud(folder, sample, projection.crs.name)
        quality = describe(readers, survey, made, mount_source, flight, timeline, projection, tally)
        with written_aside(folder / "quality.json") as aside:
            aside.write_text(json.dumps(quality, indent=2) + "\n", encoding="utf-8")
    return quality


def check_order(readers: list[LogReader]) -> None:
    """Sort logs by time; logs that overlap are not of one flight."""
    readers.sort(key=lambda reader: reader.start_ns)
    for before, after in itertools.pairwise(readers):
        if after.start_ns < before.end_ns - 1_000_000_000:
            raise UsageError(
                f"{before.path} and {after.path}: overlap in time; the parts of one flight follow each other"
            )
