"""Which boot of the autopilot goes with which run of the lidar's clock: by their gyros, by receive times, or by the host's clock."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from flightlog.clock import utc_text
from flightlog.constants import NS_PER_S
from flightlog.errors import ClockError, SyncError
from groundproc.flight import claims, sync, timebase
from groundproc.flight.autopilot import Boot
from groundproc.flight.sync import LEAST_PEAK, GyroTrack, Peak, Sync
from groundproc.flight.timebase import HostLine, UtcTie
from groundproc.flight.timeline import Leg, LidarRun, Line, line_of

Array = npt.NDArray[np.float64]
LEAST_OVERLAP_NS: Final = 2 * NS_PER_S
SEARCH_S: Final = 15.0
"""Shifts tried about what receive times say; a radio delays by up to 2 s, two computers' clocks by more."""
DRIFT_SPAN_NS: Final = 600 * NS_PER_S
"""From here on the drift that receive times show is better than none: it smears the gyros' correlation, and is right to some 10 ppm."""


def legs(runs: Sequence[LidarRun], boots: Sequence[Boot], mat_ins_lidar: Array, how: str) -> list[Leg]:
    """Pair runs and boots that overlap in receive time, synchronise each pair, and find UTC.

    Parameters
    ----------
    runs, boots : sequences
    mat_ins_lidar : ndarray, shape (3, 3)
        The mount's rotation.
    how : str
        "gyro", "host", or "auto": gyros with receive times as the fallback.

    Raises
    ------
    SyncError
        `how` is "gyro" and the gyros do not tell.
    ClockError
        No pair overlaps; or the gyros do not tell, and a clock runs at another rate than the receive times.
    """
    found: list[Leg] = []
    for number, run in enumerate(runs):
        line: tuple[Line, ...] | None = None
        tie: UtcTie | None = None
        for boot in boots:
            boot_line = _overlap(run, boot)
            if boot_line is None:
                boot_line, match = _by_gyros_alone(run, boot, mat_ins_lidar, how)
            else:
                match = _synchronise(run, boot, boot_line, mat_ins_lidar, how)
            if boot_line is None or match is None:
                continue
            if line is None or tie is None:
                tie, line = _utc(run, boot, boot_line, match)
            last_lidar_ns = run.line.device_ns(run.last_receive_ns)
            found.append(Leg(boot, number, match, tie, line, run.first_receive_ns, run.last_receive_ns, last_lidar_ns))
    if not found:
        raise ClockError(_apart(runs, boots))
    return found


def _apart(runs: Sequence[LidarRun], boots: Sequence[Boot]) -> str:
    """Why no leg was found: the recordings are short, or of different times."""
    lidar = min(run.first_receive_ns for run in runs), max(run.last_receive_ns for run in runs)
    heard = [host_ns for _, host_ns in (boot.host_pairs() for boot in boots) if len(host_ns)]
    expected = f"expected {LEAST_OVERLAP_NS / NS_PER_S:g} s or more to tie their clocks by"
    if not heard:
        return f"lidar and autopilot: no message of the autopilot tells the time since its boot, {expected}"
    autopilot = min(int(host_ns.min()) for host_ns in heard), max(int(host_ns.max()) for host_ns in heard)
    common_s = (min(lidar[1], autopilot[1]) - max(lidar[0], autopilot[0])) / NS_PER_S
    if common_s > 0.0:
        return f"lidar and autopilot: the log holds {common_s:.1f} s of both together, {expected}"
    lidar_text, autopilot_text = (" to ".join(map(utc_text, span)) for span in (lidar, autopilot))
    return (
        f"lidar and autopilot: were not recorded at the same time (lidar {lidar_text}, autopilot {autopilot_text}), {expected}; "
        "are they of one flight, and were the clocks of both computers right?"
    )


def _utc(run: LidarRun, boot: Boot, boot_line: HostLine, match: Sync) -> tuple[UtcTie, tuple[Line, ...]]:
    """What says which UTC it is, held against all else that says so; and from lidar time to it."""
    lidar, pilot = timebase.lidar_utc(run.fixes), timebase.boot_utc(boot)
    lidar_ns = run.line.reference_ns
    boot_ns = int(line_of(match)(np.array([lidar_ns]))[0])
    host = timebase.host_utc(boot_line, boot_ns)
    claimed = {claims.HOST: boot_ns + host.offset_ns}
    if lidar is not None:
        claimed[lidar.source] = lidar_ns + lidar.offset_ns
    if pilot is not None:
        claimed[pilot.source] = boot_ns + pilot.offset_ns
    held = claims.settled(claimed)
    tie = next((each for each in (lidar, pilot) if each is not None and each.source in held.add_ns), host)
    tie = replace(tie, offset_ns=tie.offset_ns + held.add_ns.get(tie.source, 0), mended=held.mended, doubts=held.doubts)
    return tie, (Line(tie.offset_ns),) if tie is not host and tie.source == claims.GPRMC else (
        line_of(match),
        Line(tie.offset_ns),
    )


def _overlap(run: LidarRun, boot: Boot) -> HostLine | None:
    """Receive time over boot time, None where the boot was not heard while the lidar ran."""
    boot_ns, host_ns = boot.host_pairs()
    if len(boot_ns) < 2:
        return None
    common = min(int(host_ns.max()), run.last_receive_ns) - max(int(host_ns.min()), run.first_receive_ns)
    return timebase.host_line(boot_ns, host_ns) if common >= LEAST_OVERLAP_NS else None


def _by_gyros_alone(
    run: LidarRun, boot: Boot, mat_ins_lidar: Array, how: str
) -> tuple[HostLine, Sync] | tuple[None, None]:
    """A board's own log that by UTC does not go with the lidar, whose computer may have had no clock: where its gyros fit nevertheless."""
    boot_ns, host_ns = boot.host_pairs()
    if boot.heard_by != "gps" or how == "host" or len(boot_ns) < 2:
        return None, None
    line = timebase.host_line(boot_ns, host_ns)
    try:
        return line, _gyro_sync(run, boot, mat_ins_lidar, _host_sync(run, line))
    except SyncError:
        return None, None


def likeness(run: LidarRun, boot: Boot) -> Peak | None:
    """How well the gyros of a boot fit the lidar's at the best shift there is; None where the two were not heard together.

    The highest of all series of gyros counts: a stranger's fit by none.

    Raises
    ------
    SyncError
        They cannot be compared: no gyros, or no motion.
    """
    boot_line = _overlap(run, boot)
    if boot_line is None:
        return None
    if run.gyro is None:
        raise SyncError("lidar: no gyro readings in its position packets (UDP port 8308)")
    host, peaks, reasons = _host_sync(run, boot_line), [], []
    for track in boot.gyros():
        for expected_ns in (host.offset_ns, None):
            try:
                peaks.append(sync.best_shift(run.gyro, track, None, expected_ns, SEARCH_S))
            except SyncError as error:
                reasons.append(error)
                continue
            if peaks[-1].height >= LEAST_PEAK:
                break
    if not peaks:
        raise reasons[0] if reasons else SyncError("MAVLink: no gyro rates (ATTITUDE, RAW_IMU) of the autopilot")
    return max(peaks, key=lambda peak: peak.height)


def _synchronise(run: LidarRun, boot: Boot, boot_line: HostLine, mat_ins_lidar: Array, how: str) -> Sync:
    host = _host_sync(run, boot_line)
    if how == "host":
        _check_rates(run, boot_line, "")
        return host
    try:
        found = _gyro_sync(run, boot, mat_ins_lidar, host)
        return _checked_drift(found)
    except SyncError as error:
        if how == "gyro":
            raise
        _check_rates(run, boot_line, f"; and {error}")
        return replace(host, note=f"{_HOST_NOTES[boot.heard_by]}, because: {error}")


_HOST_NOTES: Final = {
    "link": "receive times only",
    "gps": "UTC of the autopilot's GPS and of the lidar's computer only",
}


def _checked_drift(found: Sync) -> Sync:
    """Refuse gyros that fit with a drift that no two crystals have."""
    if abs(found.drift_ppm) > timebase.LARGEST_DRIFT * 1e6 + 3.0 * found.sigma_drift_ppm:
        raise SyncError(
            f"gyros of lidar and autopilot: they fit with a drift of {found.drift_ppm:.0f} ppm, expected at most "
            f"{timebase.LARGEST_DRIFT * 1e6:.0f} between two crystals"
        )
    return found


def _check_rates(run: LidarRun, boot_line: HostLine, why: str) -> None:
    """Refuse receive times as a tie where a device's clock runs at another rate than they do.

    Raises
    ------
    ClockError
    """
    for name, line in (("lidar", run.line), ("autopilot", boot_line)):
        if line.rate != 1.0:
            raise ClockError(
                f"{name}: its clock ran at {line.rate:.4g} times the receive times, expected 1 within "
                f"{timebase.LARGEST_DRIFT * 1e6:.0f} ppm, so that receive times cannot tie lidar and autopilot{why}; was the "
                "recording made of a simulator that does not run in real time, or were its stamps changed?"
            )


def _host_sync(run: LidarRun, boot_line: HostLine) -> Sync:
    """Both clocks through receive times: right to the difference of two unknown delays."""
    middle = run.line.reference_ns
    host_ns = run.line.host_ns(middle)
    boot_ns = host_ns - boot_line.offset_ns
    boot_ns -= round((boot_ns - boot_line.reference_ns) * boot_line.drift_ppm * 1e-6)
    return Sync(
        method="host",
        offset_ns=boot_ns - middle,
        sigma_offset_ns=float(np.hypot(run.line.sigma_ns, boot_line.sigma_ns)),
        reference_ns=middle,
        drift_ppm=run.line.drift_ppm - boot_line.drift_ppm,
        sigma_drift_ppm=timebase.LARGEST_DRIFT * 1e6,
        note="receive times only",
    )


def _gyro_sync(run: LidarRun, boot: Boot, mat_ins_lidar: Array, host: Sync) -> Sync:
    """Gyro correlation with each of the boot's gyro series; the one whose stamps the trajectory uses is preferred.

    Different messages are stamped at different points of the autopilot's loop: half of what they differ by goes into the sigma.
    """
    if run.gyro is None:
        raise SyncError("lidar: no gyro readings in its position packets (UDP port 8308)")
    tracks = boot.gyros()
    if not tracks:
        raise SyncError("MAVLink: no gyro rates (ATTITUDE, RAW_IMU) of the autopilot in the log")
    results: list[Sync] = []
    reasons: list[SyncError] = []
    for track in tracks:
        try:
            results.append(_search(run.gyro, track, mat_ins_lidar, host))
        except SyncError as error:
            reasons.append(error)
    if not results:
        raise reasons[0]
    sharpest = min(results, key=lambda result: result.sigma_offset_ns)
    chosen = next(r for r in results if r.sigma_offset_ns <= 4.0 * sharpest.sigma_offset_ns)
    apart = max(abs(r.offset_ns - chosen.offset_ns) for r in results)
    apart = (
        apart if apart < 20_000_000 else 0
    )  # a series that is off by more is of another sensor, or has found another peak
    return replace(chosen, sigma_offset_ns=float(np.hypot(chosen.sigma_offset_ns, 0.5 * apart)))


def _search(gyro: GyroTrack, track: GyroTrack, mat_ins_lidar: Array, host: Sync) -> Sync:
    """Near what receive times say, then anywhere: the two recordings may be from computers whose clocks differ."""
    known = min(int(np.ptp(each.time_ns)) for each in (gyro, track)) >= DRIFT_SPAN_NS
    match = partial(
        sync.synchronise,
        gyro,
        track,
        mat_ins_lidar=mat_ins_lidar,
        expected_drift_ppm=host.drift_ppm if known else 0.0,
    )
    try:
        return match(expected_ns=host.offset_ns, search_s=SEARCH_S)
    except SyncError:
        result = match()
    apart_s = (result.offset_ns - host.offset_ns) / NS_PER_S
    note = f"the two recordings' receive times differ by {apart_s:+.1f} s from what the gyros say"
    return replace(result, note="; ".join(filter(None, (result.note, note))))
