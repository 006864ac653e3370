"""From flight logs to products: the stages in order, and nothing else.

log --load--> packets, frames --timeline--> one time scale --trajectory--> poses --georeference--> points --products--> files
"""

import contextlib
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flightlog.errors import LogError, UsageError
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc import geodesy
from groundproc.cloud import write_cloud
from groundproc.files import made_folder, written_aside
from groundproc.flight import read_flight
from groundproc.mounting import find_mount
from groundproc.products.pictures import draw_cloud
from groundproc.quality import describe
from groundproc.survey import Survey
from groundproc.timeline import Leg, legs
from groundproc.trajectory import ins
from groundproc.trajectory.table import read_trajectory, write_trajectory
from groundproc.trajectory.trajectory import Trajectory, joined

Progress = Callable[[str, int], None]
"""Is told that so many more bytes of the logs are through a stage, "read" or "place"."""


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
    with contextlib.ExitStack() as stack:
        stack.enter_context(made_folder(folder))
        readers = [stack.enter_context(LogReader(path)) for path in logs]
        check_order(readers)
        mount, mount_source = find_mount(survey.mount, readers)
        flight = read_flight(readers, "ins", functools.partial(progress, "read"))
        timeline = legs(flight.runs, flight.boots, mount.mat_ins_lidar(), survey.sync)
        trajectory = fly(timeline, survey, mount) if poses is None else read_trajectory(poses)
        frame = trajectory.frame
        code = survey.crs or geodesy.utm_epsg(frame.latitude_deg, frame.longitude_deg)
        projection = geodesy.Projection(frame, geodesy.projected_crs(code))
        tally, sample = write_cloud(
            readers, timeline, trajectory, mount, survey, projection, folder, functools.partial(progress, "place")
        )
        write_trajectory(folder / "trajectory.csv", trajectory)
        draw_cloud(folder, sample, projection.crs.name)
        quality = describe(readers, survey, mount, mount_source, flight, timeline, trajectory, projection, tally)
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


def fly(timeline: Sequence[Leg], survey: Survey, mount: Mount) -> Trajectory:
    """The trajectory of all legs, in the local frame of the first fix; a boot that never had one leaves a gap.

    Raises
    ------
    LogError
        No boot gives a trajectory, or its heights are not of the kind asked for.
    """
    # where none has a fix, the first boot says what is missing
    placed = [leg for leg in timeline if ins.has_position(leg.boot)] or list(timeline[:1])
    undulation_m = None
    if survey.geoid is not None:
        place = ins.position_fixes(placed[0].boot, "msl")
        undulation_m = geodesy.undulation(survey.geoid, float(place.latitude_deg[0]), float(place.longitude_deg[0]))
    fixes = [ins.position_fixes(leg.boot, survey.height, undulation_m) for leg in placed]
    first = fixes[0]
    frame = geodesy.LocalFrame(float(first.latitude_deg[0]), float(first.longitude_deg[0]), float(first.height_m[0]))
    grid_ns = None if survey.pose_grid_ms is None else round(survey.pose_grid_ms * 1e6)
    parts: list[Trajectory] = []
    reasons: list[LogError] = []
    for number, (leg, fix) in enumerate(zip(placed, fixes, strict=True)):
        try:
            part = ins.ins_trajectory(leg.boot, fix, frame, leg.utc_from_boot, mount, grid_ns)
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
    return joined(parts)
