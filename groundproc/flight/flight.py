"""What of a flight fits in memory: autopilot, lidar gyros, clocks; everything but the lidar's packets."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog import nmea, records
from flightlog.errors import LogError
from flightlog.logfile import LogReader
from flightlog.mavlink import Frame, FrameParser
from flightlog.signing import is_signed
from groundproc.flight import autopilot, load, merging, timebase, vehicle
from groundproc.flight.autopilot import Boot
from groundproc.flight.boardlog import BoardLogs
from groundproc.flight.lidar import lidar_of
from groundproc.flight.load import JUMP_NS
from groundproc.flight.positionpackets import PositionCollector, PositionSamples, position_samples
from groundproc.flight.sync import GyroTrack
from groundproc.flight.timeline import LidarRun
from groundproc.flight.vehicle import Choice
from groundproc.machine.aside import aside
from groundproc.machine.system import give_back_memory
from groundproc.sensors.model import Lidar

Progress = Callable[[int], None]


@dataclass(slots=True)
class Flight:
    """A flight without its points.

    Attributes
    ----------
    boots : list of Boot
    runs : list of LidarRun
    lidar : Lidar
        That it was recorded with.
    choice : Choice
        Whose boots these are, of the vehicles on the link.
    frames, bad_bytes, unknown : int
        MAVLink: frames read, bytes that belong to none, frames of messages outside the dialect.
    unsigned : int
        Frames left out because they are not signed, where the recorder had a key.
    board_logs, board_bad_bytes, board_not_finite : int
        Dataflash logs of the autopilot, bytes in them that belong to no message, and messages left out for values that are no numbers.
    """

    boots: list[Boot]
    runs: list[LidarRun]
    lidar: Lidar
    choice: Choice
    frames: int = 0
    bad_bytes: int = 0
    unknown: int = 0
    board_logs: int = 0
    board_bad_bytes: int = 0
    board_not_finite: int = 0
    unsigned: int = 0


def read_clocks(
    readers: Sequence[LogReader], link: str, progress: Progress | None = None
) -> tuple[list[LidarRun], list[Boot], Lidar]:
    """The runs of the lidar's clock and the boots of the autopilot, of which there may be none; and the lidar.

    Raises
    ------
    LogError
        No lidar packets in the logs.
    """
    if any(
        True
        for reader in readers
        for _ in reader.messages((records.MAVLINK.topic + link, records.DATAFLASH.topic + link))
    ):
        flight = read_flight(readers, link, progress)
        return flight.runs, flight.boots, flight.lidar
    lidar = lidar_of(readers)
    runs = _runs(readers, position_samples(readers, progress), lidar)
    if not runs:
        raise LogError(_NO_LIDAR.format(readers[0].path))
    return runs, [], lidar


_NO_LIDAR: Final = "{}: no lidar packets in the log"


def read_flight(readers: Sequence[LogReader], link: str, progress: Progress | None = None) -> Flight:
    """Read autopilot and lidar clock of one flight.

    Raises
    ------
    LogError
        No lidar packets, or no autopilot, in the logs.
    """
    lidar = lidar_of(readers)
    parser, samples = FrameParser(), PositionCollector(load.first_stamp(readers, lidar))
    logs, count, kept, unsigned = BoardLogs(), 0, [], 0
    needs_key = any(link in load.signed_links(reader) for reader in readers)
    for frame in _frames(readers, link, parser, (samples, logs), progress):
        if needs_key and not is_signed(frame):
            unsigned += 1
            continue
        count += 1
        if frame.message_id in autopilot.WANTED:  # the rest would fill the memory of an hour
            kept.append(frame)
    boards = logs.boots()
    if not count and not boards:
        raise LogError(
            f"{readers[0].path}: no MAVLink of the link {link!r} in the log, and no dataflash log of its autopilot; a trajectory needs one"
        )
    merged = merging.merge(autopilot.vehicles(kept) if count else [], boards)
    runs = _runs(readers, samples.samples(), lidar)
    if not runs:
        raise LogError(_NO_LIDAR.format(readers[0].path))
    choice = vehicle.choose(merged.vehicles, runs)
    kept.clear()  # as objects the frames are several times as large as the tables made of them
    give_back_memory()
    choice = replace(choice, notes=choice.notes + merged.notes)
    return Flight(
        choice.vehicle.boots,
        runs,
        lidar,
        choice,
        count,
        parser.bad_bytes,
        parser.unknown,
        len(boards),
        logs.bad_bytes,
        logs.not_finite,
        unsigned,
    )


def _frames(
    readers: Sequence[LogReader],
    link: str,
    parser: FrameParser,
    others: tuple[PositionCollector, BoardLogs],
    progress: Progress | None,
) -> Iterator[Frame]:
    """The frames of a link; position packets and the board's own logs go to `others`, so that the logs are read once for all."""
    samples, logs = others
    topics = (records.POSITION.topic, records.DATAFLASH.topic + link, records.MAVLINK.topic + link)
    for reader in load.in_order(readers):
        for message in reader.messages(topics, progress):
            if message.topic == records.POSITION.topic:
                samples.feed(message)
                continue
            if message.topic == records.DATAFLASH.topic + link:
                logs.feed(message)
                continue
            for time_ns, data in records.decode_raw(message.data):
                yield from parser.feed(time_ns, data)
    yield from parser.finish()


def _runs(readers: Sequence[LogReader], samples: PositionSamples, lidar: Lidar) -> list[LidarRun]:
    """Cut at the jumps of the lidar's clock against receive times."""
    device, receive = samples.device_time_ns, samples.receive_time_ns
    has_positions = len(device) >= 2
    if not has_positions:
        device, receive = _batch_times(readers, lidar)
    if len(device) < 2:
        return []
    cuts = np.flatnonzero(np.abs(np.diff(device - receive)) > JUMP_NS) + 1
    edges = [0, *cuts.tolist(), len(device)]
    runs = []
    for a, b in itertools.pairwise(edges):
        if b - a < 2:
            continue
        part = slice(a, b)
        line = timebase.host_line(device[part], receive[part])
        (gyro, force), fixes = (_imu(samples, part), _fixes(samples, part)) if has_positions else ((None, None), ())
        runs.append(LidarRun(int(receive[a]), int(receive[b - 1]), line, gyro, fixes, force))
    return runs


def _batch_times(readers: Sequence[LogReader], lidar: Lidar) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Lidar and receive time of the first packet of every batch: for logs without position packets."""
    pairs = [
        (int(b.device_time_ns[0]), int(b.receive_time_ns[0]))
        for b in load.lidar_batches(readers, None, lidar)
        if len(b.packets)
    ]
    table = np.array(pairs, np.int64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _imu(samples: PositionSamples, part: slice) -> tuple[GyroTrack, npt.NDArray[np.float64]] | tuple[None, None]:
    """Rates and specific force of the samples that are later than all before them; of a long flight they are tens of megabytes."""
    time_ns = samples.device_time_ns[part]
    good = samples.has_imu[part].copy()
    good[1:] &= time_ns[1:] > np.maximum.accumulate(time_ns)[:-1]
    if good.sum() < 2 or np.ptp(samples.gyro_rad_s[part][good], axis=0).max() == 0.0:
        return None, None
    time_ns, rate, force = aside(time_ns[good], samples.gyro_rad_s[part][good], samples.accel_m_s2[part][good])
    return GyroTrack("the lidar", time_ns, rate), force


def _fixes(samples: PositionSamples, part: slice) -> tuple[tuple[int, nmea.Rmc], ...]:
    first, last = samples.receive_time_ns[part][0], samples.receive_time_ns[part][-1]
    found = []
    for sentence in samples.sentences:
        if first <= sentence.receive_time_ns <= last:
            fix = nmea.parse_rmc(sentence.text)
            if fix is not None:
                found.append((sentence.device_time_ns, fix))
    return tuple(found)
