"""From flight logs to products: the stages in order, and nothing else.

log --load--> packets, frames --timeline--> one time scale --trajectory--> poses --georeference--> points --products--> files
"""

import contextlib
import functools
import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flightlog.errors import UsageError
from flightlog.logfile import LogReader
from groundproc import geodesy, products
from groundproc.cloud import placing
from groundproc.estimation import methods
from groundproc.estimation.method import Estimate, Progress, chosen_table, gather
from groundproc.files import made_folder
from groundproc.flight.flight import read_flight
from groundproc.flight.mounting import find_mount
from groundproc.flight.timeline import legs
from groundproc.products.product import Context, Provenance, draw, streamed
from groundproc.sensors.hdl32e import Gate
from groundproc.sensors.lasers import ESTIMATE
from groundproc.steps.quality import describe, describe_log
from groundproc.survey import Survey
from groundproc.trajectory.table import read_trajectory


def process(
    logs: Sequence[Path], survey: Survey, folder: Path, progress: Progress, poses: Path | None = None
) -> dict[str, Any]:
    """Make the products of a flight that the survey chose.

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
    wanted = products.chosen(survey.products)
    lasers = chosen_table(survey)
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
            made = Estimate(read_trajectory(poses), mount, f"as {poses} has them", lasers, method="outside")
        trajectory = made.trajectory
        frame = trajectory.frame
        code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
        projection = geodesy.Projection(frame, geodesy.projected_crs(code))
        provenance = Provenance(tuple(describe_log(reader) for reader in readers))
        context = Context(folder, survey, made, projection, provenance)
        tally = placing.Tally()
        packets = placing.chunks(readers, timeline, tally, functools.partial(progress, "place"))
        gate = Gate(*survey.fov_deg, survey.min_range_m, survey.max_range_m)
        with streamed(wanted, context) as sinks:
            placed = placing.place(packets, trajectory, made.mount, projection, sinks, gate=gate, lasers=made.lasers)
        quality = describe(readers, survey, made, mount_source, flight, timeline, projection, tally, placed)
        draw(wanted, replace(context, quality=quality))
    return quality


def check_order(readers: list[LogReader]) -> None:
    """Sort logs by time; logs that overlap are not of one flight."""
    readers.sort(key=lambda reader: reader.start_ns)
    for before, after in itertools.pairwise(readers):
        if after.start_ns < before.end_ns - 1_000_000_000:
            raise UsageError(
                f"{before.path} and {after.path}: overlap in time; the parts of one flight follow each other"
            )
