"""The stage that makes the cloud: every packet given its time and pose, placed, projected and handed on; and what became of each."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.errors import CoverageError
from flightlog.logfile import LogReader
from flightlog.mount import Mount
from groundproc import geodesy
from groundproc.cloud import georeference
from groundproc.cloud.points import Dropped, Points
from groundproc.flight import load
from groundproc.flight.timeline import Leg
from groundproc.sensors import hdl32e as decode
from groundproc.sensors import identity as sensor_model
from groundproc.sensors.hdl32e import Gate, LaserTable
from groundproc.trajectory.trajectory import Trajectory

Times = npt.NDArray[np.int64]

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


@dataclass(frozen=True, slots=True)
class Placed:
    """How many points were placed, and what became of the other shots."""

    points: int
    dropped: Dropped


class Sink(Protocol):
    """Takes the points of a flight as they are placed."""

    def begin(self) -> None:
        """Get ready: the first points come."""

    def add(self, points: Points) -> None:
        """Take some projected points; their arrays are not to be changed."""

    def finish(self) -> None:
        """All points were given."""


def place(
    packets: Iterable[tuple[npt.NDArray[np.void], Times]],
    trajectory: Trajectory,
    mount: Mount,
    projection: geodesy.Projection,
    sinks: Sequence[Sink],
    *,
    gate: Gate,
    lasers: LaserTable,
) -> Placed:
    """Place and project all packets, and hand the points to the sinks, a second of flight at a time.

    Parameters
    ----------
    packets : iterable of (ndarray, ndarray of int64)
        As of `chunks`.
    trajectory : Trajectory
    mount : Mount
    projection : geodesy.Projection
        From the trajectory's frame.
    sinks : sequence of Sink
    gate : Gate
    lasers : LaserTable

    Raises
    ------
    CoverageError
        Not one point.
    """
    for sink in sinks:
        sink.begin()
    count, dropped = 0, Dropped()
    for some, utc_ns in packets:
        points = georeference.georeference(some, utc_ns, trajectory, mount, gate, lasers)
        dropped = dropped + points.dropped
        if len(points):
            count += len(points)
            project(points, projection)
            for sink in sinks:
                sink.add(points)
    if not count:
        raise CoverageError(
            f"not one lidar packet gives a point: the trajectory covers {utc_text(int(trajectory.time_ns[0]))} to "
            f"{utc_text(int(trajectory.time_ns[-1]))}, and {dropped.no_pose} shots lie outside it"
        )
    for sink in sinks:
        sink.finish()
    return Placed(count, dropped)


def project(points: Points, projection: geodesy.Projection) -> None:
    """Put points into the projected CRS, in place."""
    georeference.project(points.xyz_m, projection.polynomial(*georeference.extent(points.xyz_m)))


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
