"""Before a flight: everything that is needed is tested, and each failure comes with its remedy. Nothing is recorded."""

import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flightlog.errors import SourceError, SwathError
from flightlog.mount import load_mount
from onboard.autopilot import Link
from onboard.config import LidarConfig, LinkConfig, RecorderConfig, SwathdConfig
from onboard.health import LOW_RATE, Level
from onboard.lidar import LidarPort
from onboard.lidar_settings import LidarSettings
from onboard.lidarstate import REMEDY, State
from onboard.parameter_link import ParameterLink
from onboard.parameters import GENERATION_MARKS, compare, generation, shipped
from onboard.readings import LidarReadings, Rates
from onboard.requester import streams_asked
from onboard.status import LidarStatus
from onboard.timesync import LogTime, read_clocks

_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")
_TRIAL_BYTES: Final = 16 << 20
_PIECE_BYTES: Final = 1 << 20
_LOG_MB_S: Final = 2.4
"""A lidar in single return mode, its position packets and MAVLink."""
_RPM_OFF: Final = 0.05
_FOV_OFF_DEG: Final = 6.0
"""What packets show of a field of view is whole sectors of 3 deg."""
_SETTLE_S: Final = 2.0
"""Until an autopilot was heard and its streams have begun."""


@dataclass(frozen=True, slots=True)
class Item:
    """What was tried and what came of it."""

    name: str
    level: Level
    found: str
    remedy: str = ""


def _good(name: str, found: str) -> Item:
    return Item(name, Level.GOOD, found)


def check(settings: SwathdConfig, config_path: Path, seconds: float) -> list[Item]:
    """Try everything; listens to lidar and autopilots for some seconds."""
    items = [_good("config", f"{config_path} is valid"), _check_mount(settings, config_path)]
    items += check_disk(settings.recorder)
    items.append(check_buffer(settings.lidar))
    items += _check_devices(settings, seconds)
    return items


def _check_mount(settings: SwathdConfig, config_path: Path) -> Item:
    if settings.mount is None:
        return _good("mount", "the nominal mount")
    try:
        load_mount(config_path.parent / settings.mount)
    except SwathError as error:
        return Item("mount", Level.CRITICAL, str(error), "correct the file, or set mount: null for the nominal mount")
    return _good("mount", f"{settings.mount} is valid")


# The machine ----------------------------------------------------------------------------------------------------------


def check_disk(recorder: RecorderConfig) -> list[Item]:
    """Space for the logs, and the speed at which they can be made safe."""
    directory = Path(recorder.directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        disk = os.statvfs(directory)
        speed_mb_s, slowest_ms = _write_speed(directory)
    except OSError as error:
        remedy = f"make {directory} writable for this user, or run the check as the user of the service"
        return [Item("disk", Level.CRITICAL, f"{directory}: {error.strerror}", remedy)]
    free_mb = disk.f_bavail * disk.f_frsize / 1e6
    minutes = max(0.0, (free_mb - recorder.min_free_mb) / _LOG_MB_S / 60)
    space = f"{free_mb / 1e3:.1f} GB free, {minutes:.0f} min of recording"
    level = Level.CRITICAL if minutes < 5 else Level.WARNING if minutes < 30 else Level.GOOD
    remedy = "pull the logs and acknowledge them, or delete what is not needed" if level else ""
    speed = f"{speed_mb_s:.0f} MB/s, the slowest sync of {_PIECE_BYTES >> 20} MiB took {slowest_ms:.0f} ms"
    slow = Level.CRITICAL if speed_mb_s < _LOG_MB_S else Level.WARNING if speed_mb_s < 2 * _LOG_MB_S else Level.GOOD
    faster = f"a flight writes {_LOG_MB_S} MB/s; use a faster card, or another directory" if slow else ""
    return [Item("disk space", level, space, remedy), Item("disk speed", slow, speed, faster)]


def _write_speed(directory: Path) -> tuple[float, float]:
    """MB/s of synced writing, and the slowest sync [ms]."""
    piece, slowest_s = os.urandom(_PIECE_BYTES), 0.0
    with tempfile.TemporaryFile(dir=directory, buffering=0) as file:
        begin_s = time.monotonic()
        for _ in range(_TRIAL_BYTES // _PIECE_BYTES):
            before_s = time.monotonic()
            file.write(piece)
            os.fdatasync(file.fileno())
            slowest_s = max(slowest_s, time.monotonic() - before_s)
        took_s = time.monotonic() - begin_s
    return _TRIAL_BYTES / 1e6 / took_s, slowest_s * 1e3


def check_buffer(lidar: LidarConfig, limit_file: Path = _RMEM_MAX) -> Item:
    """Whether the kernel grants the receive buffer."""
    wanted = lidar.receive_buffer_kb * 1024
    limit = int(limit_file.read_text(encoding="ascii"))
    found = f"{min(wanted, limit) // 1024} kB of the {wanted // 1024} kB asked for"
    if limit >= wanted:
        return _good("receive buffer", found)
    return Item("receive buffer", Level.WARNING, found, f"sysctl -w net.core.rmem_max={wanted}")


# The devices ----------------------------------------------------------------------------------------------------------


def _check_devices(settings: SwathdConfig, seconds: float) -> list[Item]:
    """Listen to all at once."""
    log_time = LogTime.start(read_clocks())
    links = {name: Link(name, link, log_time, _drop) for name, link in settings.links().items()}
    with _running(links) as counts_then:
        try:
            items = _check_lidar(settings, log_time, seconds, links, counts_then)
        except SourceError as error:
            remedy = "end the program that has it (swathd itself: systemctl stop swathd), or change the port"
            items = [Item("lidar", Level.CRITICAL, str(error), remedy)]
            time.sleep(seconds)
    for name, link in links.items():
        items += _check_link(name, link, settings.links()[name], counts_then.get(name, Counter()), seconds - _SETTLE_S)
        if link.counts.autopilot is not None and settings.links()[name].requests:
            items.append(check_parameters(name, settings.links()[name]))
    return items


def _drop(topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
    del topic, log_time_ns, data, vital
    return True


@contextmanager
def _running(links: dict[str, Link]) -> Iterator[dict[str, Counter[int]]]:
    """Links that run; what is given is for noting what had come of each when it had settled."""
    for link in links.values():
        link.start()
    try:
        yield {}
    finally:
        for link in links.values():
            link.stop()


def _check_lidar(
    settings: SwathdConfig,
    log_time: LogTime,
    seconds: float,
    links: dict[str, Link],
    counts_then: dict[str, Counter[int]],
) -> list[Item]:
    port = LidarPort(settings.lidar, log_time, _drop)
    readings, rates = LidarReadings(port, settings.lidar.interface), Rates()
    port.start()
    status = LidarStatus()
    begin_s = time.monotonic()
    try:
        while time.monotonic() - begin_s < seconds:
            time.sleep(1.0)
            if time.monotonic() - begin_s >= _SETTLE_S and not counts_then:
                counts_then.update({name: Counter(link.counts.messages) for name, link in links.items()})
            now = read_clocks()
            rates.begin(now.monotonic_ns)
            status = readings.status(log_time.at(now), rates.per_second)
    finally:
        port.stop()
    return judge_lidar(status, settings.lidar, LidarSettings())


def judge_lidar(status: LidarStatus, lidar: LidarConfig, wanted: LidarSettings) -> list[Item]:
    """What the packets say of the lidar and its settings."""
    if status.state not in (State.GOOD, State.RATE_LOW):
        rejected = "".join(f", {count} x {reason}" for reason, count in status.rejected.items())
        return [Item("lidar", Level.CRITICAL, f"{status.state}{rejected}", REMEDY[status.state])]
    low = status.state == State.RATE_LOW
    found = f"{status.packets_s:.0f} packets/s from {status.sensor}, {status.return_mode} return"
    items = [Item("lidar", Level(low), found, REMEDY[State.RATE_LOW] if low else "")]
    apply = "swathd lidar apply"
    off = abs(status.rpm / wanted.rpm - 1) > _RPM_OFF
    items.append(Item("lidar speed", Level(off), f"{status.rpm:.0f} rpm of {wanted.rpm}", apply if off else ""))
    blind = missing_deg(status, lidar) > _FOV_OFF_DEG
    sent = f"{status.fov_start_deg:.0f} to {status.fov_end_deg:.0f} deg sent"
    sent += f", {lidar.fov.start_deg:.0f} to {lidar.fov.end_deg:.0f} deg recorded"
    items.append(Item("lidar field of view", Level(blind), sent, apply if blind else ""))
    silent = not status.position_packets_s
    rate = f"{status.position_packets_s:.0f} packets/s, GPS sentence {status.nmea or 'none'}"
    remedy = "without its gyros the clocks cannot be matched; check the position port"
    items.append(Item("lidar position packets", Level(silent), rate, remedy if silent else ""))
    return items


def missing_deg(status: LidarStatus, lidar: LidarConfig) -> float:
    """How much of the sector to be recorded the lidar does not send [deg]."""
    sent_width = (status.fov_end_deg - status.fov_start_deg) % 360 or 360.0
    width = (lidar.fov.end_deg - lidar.fov.start_deg) % 360 or 360.0
    begin = (lidar.fov.start_deg - status.fov_start_deg) % 360
    inside = max(0.0, min(sent_width, begin + width) - begin) + max(0.0, min(sent_width, begin + width - 360))
    return width - inside


def _check_link(name: str, link: Link, config: LinkConfig, then: Counter[int], seconds: float) -> list[Item]:
    counts, title = link.counts, f"link {name}"
    if counts.trouble:
        remedy = "check the cable and the name of the device; end the program that has it"
        return [Item(title, Level.CRITICAL, counts.trouble, remedy)]
    if counts.autopilot is None:
        remedy = f"check power, cable, {config.baud} baud, and that the port speaks MAVLink (SERIALn_PROTOCOL)"
        return [Item(title, Level.CRITICAL, f"no autopilot heard, {counts.received_bytes} bytes received", remedy)]
    system, component = counts.autopilot
    items = [_good(title, f"autopilot {system}/{component}, MAVLink {counts.version}, {counts.heartbeats} heartbeats")]
    if config.requests and seconds > 0:
        hz = {
            m: ((counts.messages[n] - then[n]) / seconds, rate)
            for m, n, rate in streams_asked(config.streams, counts.kind)
        }
        low = any(found < LOW_RATE * rate for found, rate in hz.values())
        found = ", ".join(f"{message} {rate:.1f} of {asked} Hz" for message, (rate, asked) in hz.items())
        remedy = "set the SRx_ parameters of that port, or a faster baud rate" if low else ""
        items.append(Item(f"{title} rates", Level(low), found, remedy))
    return items


def check_parameters(name: str, config: LinkConfig) -> Item:
    """The autopilot's parameters against firmware_config."""
    title, remedy = f"parameters {name}", f"swathd parameters apply --device {config.device} --board {name}"
    try:
        with ParameterLink(config) as link:
            link.find_autopilot()
            wanted = shipped(name, generation(link.read(GENERATION_MARKS)))
            differences = compare(wanted, link.read(wanted))
    except SwathError as error:
        return Item(title, Level.WARNING, str(error), f"compare them by hand: {remedy.replace('apply', 'show')}")
    if not differences:
        return _good(title, f"all {len(wanted)} are as wanted")
    some = "; ".join(map(str, differences[:3])) + ("; ..." if len(differences) > 3 else "")
    return Item(title, Level.WARNING, f"{len(differences)} of {len(wanted)} differ: {some}", remedy)
