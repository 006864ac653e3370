"""The stage that makes the cloud: every packet given its time and pose, placed, projected and written; and what became of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.errors import CoverageError
from flightlog.logfile import LogReader
from groundproc import geodesy
from groundproc.cloud import georeference, las
from groundproc.cloud.points import Dropped, Points
from groundproc.estimation.method import Estimate
from groundproc.files import written_aside
from groundproc.flight import shots
from groundproc.flight.timeline import Leg
from groundproc.products.pictures import CloudSample
from groundproc.sensors.shots import Gate
from groundproc.survey import Survey


@dataclass(slots=True)
class Tally(shots.Tally):
    """What became of the lidar's packets, and of their shots."""

    written: int = 0
    dropped: Dropped = field(default_factory=Dropped)


def write_cloud(
    readers: Sequence[LogReader],
    timeline: Sequence[Leg],
    made: Estimate,
    survey: Survey,
    projection: geodesy.Projection,
    folder: Path,
    progress: Callable[[int], None],
) -> tuple[Tally, CloudSample]:
    """Place every packet and write cloud.laz."""
    tally, sample, trajectory = Tally(), CloudSample(), made.trajectory
    gate = Gate(*survey.fov_deg, survey.min_range_m, survey.max_range_m)
    start = projection.exact(trajectory.position_m[:1])[0]
    offset_m = [float(np.floor(start[0] / 100) * 100), float(np.floor(start[1] / 100) * 100), 0.0]
    with (
        written_aside(folder / "cloud.laz") as aside,
        las.CloudWriter(aside, [las.LASER, las.RANGE], crs=cloud_crs(projection, survey), offset_m=offset_m) as cloud,
    ):
        for seen in shots.shots(readers, timeline, gate, made.lasers, tally, progress):
            points = georeference.georeference(seen, trajectory, made.mount)
            tally.dropped = tally.dropped + points.dropped
            if len(points):
                project(points, projection)
                write_points(cloud, points)
                sample.add(points.xyz_m, points.intensity)
        tally.written = cloud.points
        if not tally.written:
            raise CoverageError(
                f"{readers[0].path}: not one of {tally.packets} lidar packets gives a point; "
                f"the trajectory covers {utc_text(int(trajectory.time_ns[0]))} to {utc_text(int(trajectory.time_ns[-1]))}, "
                f"and {tally.dropped.no_pose} shots lie outside it"
            )
    return tally, sample


def cloud_crs(projection: geodesy.Projection, survey: Survey) -> Any:
    """The CRS that the file states: with EGM 96 as the height reference where heights are above sea level."""
    return geodesy.with_sea_level(projection.crs) if survey.height == "msl" else projection.crs


def project(points: Points, projection: geodesy.Projection) -> None:
    """Put points into the projected CRS, in place."""
    georeference.project(points.xyz_m, projection.polynomial(*georeference.extent(points.xyz_m)))


def write_points(cloud: las.CloudWriter, points: Points) -> None:
    """Hand projected points to the file."""
    extras: dict[str, npt.NDArray[Any]] = {"laser": points.laser, "range": las.range_steps(points.range_m)}
    cloud.write(points.xyz_m, las.gps_time_s(points.time_ns), points.intensity, points.returns, extras)
