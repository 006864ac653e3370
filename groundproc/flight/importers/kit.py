"""A kit of line scanner, IMU and GNSS on one time base into a flight log.

The lines become messages of their own; IMU and positions become the MAVLink messages that say just that (HIGHRES_IMU, GPS_RAW_INT), so
that all that reads an autopilot reads them. Their clock is UTC, "since boot" the time since the first of them.
"""

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pymavlink.dialects.v20 import ardupilotmega as dialect

from flightlog import __version__, frames, records
from flightlog.clock import utc_text
from flightlog.constants import NS_PER_MS, NS_PER_S, NS_PER_US
from flightlog.errors import CaptureError, LogError, UsageError
from flightlog.logwriter import LogWriter
from groundproc.files import written_aside
from groundproc.flight.importers.joining import LogMessage
from groundproc.flight.importers.lines import read_imu, read_lines
from groundproc.flight.lidar import STATED
from groundproc.flight.positions.reading import read_solution
from groundproc.flight.positions.solution import ELLIPSOID, MSL, Solution
from groundproc.sensors.linescan import LIDAR

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

_TOPIC: Final = records.MAVLINK.topic + "ins"
_BATCH_NS: Final = 100 * NS_PER_MS
_UNKNOWN: Final = 65_535
DAY_NS: Final = 86_400 * NS_PER_S
_LONGEST_NS: Final = 10 * DAY_NS
"""Of a flight's files; time since the first of them is counted in 32 bits of milliseconds."""


@dataclass(frozen=True, slots=True)
class Kit:
    """What an import of a kit found."""

    lines: int
    imu_samples: int
    positions: int


def import_kit(
    scans: Path, imu: Path, positions: Path, output: Path, *, attachments: dict[str, bytes], force: bool = False
) -> Kit:
    """Make a flight log of a line scanner's kit.

    Parameters
    ----------
    scans, imu : Path
        See `read_lines` and `read_imu`.
    positions : Path
        Anything that `read_solution` reads.
    output : Path
        The log to write; it appears when it is whole.
    attachments : dict of name to bytes
    force : bool
        Replace an existing output.

    Raises
    ------
    CaptureError
        The files do not overlap in time.
    UsageError
        The output exists.
    LogError
        An input that is not what it should be.
    """
    if output.exists() and not force:
        raise UsageError(f"{output}: exists already; give another name, or --force to replace it")
    lines = read_lines(scans)
    time_ns, rate, force_m_s2 = read_imu(imu)
    solution = read_solution(positions, near_utc_ns=int(lines["time_ns"][0]))
    if solution.height_reference not in (ELLIPSOID, MSL):
        raise LogError(
            f"{positions}: its heights are {solution.height_reference}, expected above the {ELLIPSOID} or above sea level ({MSL})"
        )
    start_ns = min(int(time_ns[0]), int(solution.time_ns[0]))
    _check_overlap({scans: lines["time_ns"], imu: time_ns, positions: solution.time_ns})
    events = (_imu(time_ns, rate, force_m_s2, start_ns), _fixes(solution, start_ns))
    messages = heapq.merge(
        (LogMessage(records.LINE_SCAN.topic, int(line["time_ns"]), records.encode_line(line)) for line in lines),
        _batches(_packed(heapq.merge(*events, key=itemgetter(0)))),
        key=lambda message: message.log_time_ns,
    )
    session = {"origin": "import", "version": __version__, STATED[1]: LIDAR.name}
    session["files"] = ", ".join(path.name for path in (scans, imu, positions))
    with written_aside(output) as aside, aside.open("wb") as stream:
        writer = LogWriter(
            stream, metadata={"swath.session": session}, attachments=attachments, library=f"swath {__version__}"
        )
        for message in messages:
            writer.write(*message)
        writer.finish()
    return Kit(len(lines), len(time_ns), len(solution.time_ns))


def _check_overlap(times: dict[Path, Times]) -> None:
    for path, t in times.items():
        if int(t[-1]) - int(t[0]) > _LONGEST_NS:
            raise CaptureError(
                f"{path}: {utc_text(int(t[0]))} to {utc_text(int(t[-1]))} is no flight, expected {_LONGEST_NS // DAY_NS} days at most"
            )
    (first, span), *others = ((path, (int(t[0]), int(t[-1]))) for path, t in times.items())
    for path, (begin, end) in others:
        if min(end, span[1]) - max(begin, span[0]) < 2 * NS_PER_S:
            raise CaptureError(
                f"{path}: {utc_text(begin)} to {utc_text(end)} does not overlap by 2 s with {first}, "
                f"{utc_text(span[0])} to {utc_text(span[1])}; all times are UTC"
            )


def _packed(events: Iterable[tuple[int, Any]]) -> Iterator[tuple[int, bytes]]:
    """Messages as frames of one link, numbered in their order."""
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    for time_ns, message in events:
        yield time_ns, bytes(message.pack(link))
        link.seq = (link.seq + 1) % 256


def _imu(time_ns: Times, rate: Array, force: Array, start_ns: int) -> Iterator[tuple[int, Any]]:
    """HIGHRES_IMU of every sample, with a heartbeat and the time once a second."""
    # the turn from ins to forward, right, down is its own inverse
    gyro, accel = frames.ins_from_frd(rate), frames.ins_from_frd(force)
    next_ns = int(time_ns[0])
    for i, now_ns in enumerate(time_ns.tolist()):
        boot_us = (now_ns - start_ns) // NS_PER_US
        if now_ns >= next_ns:
            next_ns += NS_PER_S
            beat = dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_GENERIC, dialect.MAV_AUTOPILOT_GENERIC, 0, 0, dialect.MAV_STATE_ACTIVE, 3
            )
            yield now_ns, beat
            # to the millisecond that the message has, and received then, so that the clocks are tied exactly
            boot_ms = boot_us // 1000
            tied_ns = start_ns + boot_ms * NS_PER_MS + NS_PER_MS // 2
            yield tied_ns, dialect.MAVLink_system_time_message(tied_ns // NS_PER_US, boot_ms)
        sample = dialect.MAVLink_highres_imu_message(
            boot_us, *accel[i].tolist(), *gyro[i].tolist(), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0x3F
        )
        yield now_ns, sample


def _fixes(solution: Solution, start_ns: int) -> Iterator[tuple[int, Any]]:
    """GPS_RAW_INT of every position, with its own accuracy; a height above the ellipsoid is said to be one."""
    sigma = np.sqrt(np.diagonal(solution.covariance_m2, axis1=1, axis2=2))
    undulation = (
        np.zeros(len(sigma)) if solution.undulation_m is None else np.nan_to_num(solution.undulation_m, nan=0.0)
    )
    above_sea = solution.height_m - (undulation if solution.height_reference == ELLIPSOID else 0.0)
    for i, now_ns in enumerate(solution.time_ns.tolist()):
        horizontal, vertical = (
            (round(float(value) * 1e3) if np.isfinite(value) else 0) for value in (sigma[i, :2].max(), sigma[i, 2])
        )
        fix = dialect.MAVLink_gps_raw_int_message(
            (now_ns - start_ns) // NS_PER_US, 3,
            round(float(solution.latitude_deg[i]) * 1e7), round(float(solution.longitude_deg[i]) * 1e7),
            round(float(above_sea[i]) * 1e3), _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, 255,
            alt_ellipsoid=round(float(above_sea[i] + undulation[i]) * 1e3), h_acc=horizontal, v_acc=vertical,
        )  # fmt: skip
        yield now_ns, fix


def _batches(events: Iterator[tuple[int, bytes]]) -> Iterator[LogMessage]:
    """About 0.1 s in a message, as a recorder does it."""
    slot: list[tuple[int, bytes]] = []
    for event in chain(events, [None]):
        if slot and (event is None or event[0] >= slot[0][0] + _BATCH_NS):
            log_ns = slot[-1][0]
            yield LogMessage(_TOPIC, log_ns, records.encode_raw(log_ns, slot, "ins"))
            slot = []
        if event is not None:
            slot.append(event)
