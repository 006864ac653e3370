"""The shots of a flight in UTC, piece by piece, and what became of the lidar's packets on the way."""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from flightlog.logfile import LogReader
from groundproc.flight import load
from groundproc.flight.lidar import lidar_of
from groundproc.flight.load import LidarBatch, Progress
from groundproc.flight.summary.lidar import LidarSummary
from groundproc.machine.readahead import ahead
from groundproc.sensors.model import Lidar
from groundproc.sensors.shots import Gate, LaserTable, Shots

_PIECES_S: Final = 2
"""In a second of flight. Half a second is 300,000 shots, some 20 MB while they are placed.

Of shorter pieces decoding loses up to a fifth of its speed.
"""
_SLACK_NS: Final = 10**9
"""A batch belongs to a leg up to so long before and after the leg was received."""
_READING: Final = threading.Lock()
"""Streams of one flight share its logs: they are read one at a time."""


class LidarClock(Protocol):
    """A stretch of receive times [log] in which the lidar's time has one way to the scale of a flight: a leg, or a clock tie."""

    @property
    def first_receive_ns(self) -> int:
        """Where it begins."""

    @property
    def last_receive_ns(self) -> int:
        """Where it ends."""

    def utc_from_lidar(self, time_ns: npt.NDArray[np.int64], /) -> npt.NDArray[np.int64]:
        """Times on the scale [ns] of lidar times, shape (n,)."""


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
    summary: LidarSummary | None = None
    """Tells from the stamps what is missing: recordings of other programs have no account."""

    @property
    def lost_packets(self) -> int:
        """Packets that the lidar sent and nobody left out, and that are not there."""
        return 0 if self.summary is None else int(self.summary.result()["lost_packets"])

    def add(self, batch: LidarBatch) -> None:
        """Add up what became of the packets before they reached the log."""
        self.packets += len(batch.packets)
        if self.summary is not None:
            self.summary.add(batch)
        if batch.account is not None:
            self.masked_packets += batch.account.masked_packets
            self.masked_blocks += batch.account.masked_blocks
            self.kernel_drops += batch.account.kernel_drops
            self.queue_drops += batch.account.queue_drops
            self.rejected += (
                batch.account.rejected_length + batch.account.rejected_content + batch.account.rejected_sender
            )


def shots(
    readers: Sequence[LogReader],
    timeline: Sequence[LidarClock],
    gate: Gate,
    lasers: LaserTable | None = None,
    tally: Tally | None = None,
    progress: Progress | None = None,
) -> Iterator[Shots]:
    """Stream the shots of a flight, about half a second at a time; each piece is of one leg and one return mode.

    A thread decodes the next piece while one is used.

    Parameters
    ----------
    readers : sequence of LogReader
        The flight's logs.
    timeline : sequence of LidarClock
        Each with a line from lidar time to UTC; packets outside all of them are counted and left out.
    gate : Gate
    lasers : LaserTable, optional
        Default: the manual's.
    tally : Tally, optional
        Is added to; without one nobody counts, and packets are not looked through for what is missing.
    progress : callable, optional
        Called with the number of file bytes done since the last call.
    """
    read = 0

    def count(done: int) -> None:
        nonlocal read
        read += done

    told = 0
    with contextlib.closing(ahead(_decoded(readers, timeline, gate, lasers, tally, count), _READING)) as pieces:
        for piece in pieces:
            yield piece
            del piece  # before the next one is waited for
            if progress is not None and read > told:
                progress((now := read) - told)
                told = now
    if progress is not None and read > told:
        progress(read - told)


def _decoded(
    readers: Sequence[LogReader],
    timeline: Sequence[LidarClock],
    gate: Gate,
    lasers: LaserTable | None,
    tally: Tally | None,
    progress: Progress,
) -> Iterator[Shots]:
    """The shots, piece by piece."""
    lidar = lidar_of(readers)
    if tally is not None:
        tally.summary = tally.summary or LidarSummary(lidar)
    for batches in _pieces(load.lidar_batches(readers, progress, lidar), lidar, tally):
        packets = load.joined([batch.packets for batch in batches])
        leg = _leg_of(int(batches[0].receive_time_ns[0]), timeline)
        if leg is None:
            if tally is not None:
                tally.packets_without_leg += len(packets)
            continue
        device_ns = np.concatenate([batch.device_time_ns for batch in batches])
        yield from lidar.decode(packets, leg.utc_from_lidar(device_ns), gate, lasers)


def _pieces(batches: Iterator[LidarBatch], lidar: Lidar, tally: Tally | None) -> Iterator[list[LidarBatch]]:
    """Batches that may be decoded as one, about half a second together: that bounds the memory."""
    waiting: list[LidarBatch] = []
    size = 0
    for batch in batches:
        if tally is not None:
            tally.add(batch)
        if not len(batch.packets):
            continue
        new = bool(waiting) and (batch.jumped or not lidar.same_kind(waiting[-1].packets, batch.packets))
        if waiting and (size * _PIECES_S >= lidar.records_s or new):
            yield waiting
            waiting, size = [], 0
        waiting.append(batch)
        size += len(batch.packets)
    if waiting:
        yield waiting


def _leg_of(receive_ns: int, timeline: Sequence[LidarClock]) -> LidarClock | None:
    """The leg in which something was received at a time [ns of log time]."""
    return next(
        (leg for leg in timeline if leg.first_receive_ns - _SLACK_NS <= receive_ns <= leg.last_receive_ns + _SLACK_NS),
        None,
    )
