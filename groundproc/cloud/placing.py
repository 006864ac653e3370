"""The stage that makes the cloud: every packet given its time and pose, placed, projected and written; and what became of each."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.errors import CoverageError
from flightlog.logfile import LogReader
from groundproc import geodesy
from groundproc.cloud import georeference, las
from groundproc.cloud.points import Dropped, Points
from groundproc.files import written_aside
from groundproc.flight import load
from groundproc.flight.timeline import Leg
from groundproc.products.pictures import CloudSample
from groundproc.sensors import hdl32e as decode
from groundproc.sensors import identity as sensor_model
from groundproc.sensors.hdl32e import Gate
from groundproc.survey import Survey
from groundproc.trajectory.estimate import Estimate

CHUNK_PACKETS: Final = 1808
"""Packets placed at a time, a second's worth: bounds the memory, and is long enough for both cores to compress."""


@dataclass(slots=True)
class Tally:
    """What became of the lidar's packets."""

    packets: int = 0
    masked_packets: int = 0
    masked_blocks: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    rejected: int = 0
    packets_without_leg: int = 0
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
        for packets, utc_ns in chunks(readers, timeline, tally, progress):
            points = georeference.georeference(packets, utc_ns, trajectory, made.mount, gate, made.lasers)
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
    extras: dict[str, npt.NDArray[Any]] = {"laser": points.laser, "range": points.range_steps}
    cloud.write(points.xyz_m, las.gps_time_s(points.time_ns), points.intensity, points.returns, extras)


def chunks(
    readers: Sequence[LogReader], timeline: Sequence[Leg], tally: Tally, progress: Callable[[int], None]
) -> Iterator[tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]]:
    """Packets of one return mode and one leg, about `CHUNK_PACKETS`, with the UTC of their stamps [ns]."""
    waiting: list[load.LidarBatch] = []
    size, first = 0, True
    for batch in load.lidar_batches(readers, progress):
        take_account(tally, batch)
        if not len(batch.packets):
            continue
        if first:
            sensor_model.refuse_other_models(batch.packets["data"], str(readers[0].path))
            first = False
        if waiting and (size >= CHUNK_PACKETS or not same_kind(waiting[-1], batch)):
            yield from in_utc(waiting, timeline, tally)
            waiting, size = [], 0
        waiting.append(batch)
        size += len(batch.packets)
    if waiting:
        yield from in_utc(waiting, timeline, tally)


def same_kind(before: load.LidarBatch, after: load.LidarBatch) -> bool:
    """Whether two batches may be placed together."""
    same_mode = before.packets["data"]["return_mode"][-1] == after.packets["data"]["return_mode"][0]
    return bool(same_mode) and not after.jumped


def in_utc(
    batches: Sequence[load.LidarBatch], timeline: Sequence[Leg], tally: Tally
) -> Iterator[tuple[npt.NDArray[np.void], npt.NDArray[np.int64]]]:
    """Join batches, give them UTC, and cut where the return mode changes within."""
    packets = load.joined([batch.packets for batch in batches])
    device_ns = np.concatenate([batch.device_time_ns for batch in batches])
    receive_ns = int(batches[0].receive_time_ns[0])
    leg = next(
        (leg for leg in timeline if leg.first_receive_ns - 10**9 <= receive_ns <= leg.last_receive_ns + 10**9), None
    )
    if leg is None:
        tally.packets_without_leg += len(packets)
        return
    yield from decode.by_mode(packets, leg.utc_from_lidar(device_ns))


def take_account(tally: Tally, batch: load.LidarBatch) -> None:
    """Add up what became of the packets before they reached the log."""
    tally.packets += len(batch.packets)
    if batch.account is not None:
        tally.masked_packets += batch.account.masked_packets
        tally.masked_blocks += batch.account.masked_blocks
        tally.kernel_drops += batch.account.kernel_drops
        tally.queue_drops += batch.account.queue_drops
        tally.rejected += batch.account.rejected_length + batch.account.rejected_content + batch.account.rejected_sender
