"""The receivers' counters, read once a second and turned into the status: rates, ages, states."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final

from flightlog.constants import NS_PER_MS, NS_PER_S
from flightlog.nmea import parse_rmc
from flightlog.records import ClockSync
from onboard import lidarstate, logfolder
from onboard.clocksync import utc_of_lidar
from onboard.config import RecorderConfig
from onboard.leftovers import Salvager
from onboard.lidar import LidarPort
from onboard.linkcounts import LinkCounts
from onboard.packetfilter import address_number
from onboard.recorder import Recorder
from onboard.sensorview import SensorView
from onboard.status import ClockStatus, LidarStatus, LinkStatus, RecorderStatus

_THERMAL: Final = Path("/sys/class/thermal")
_RATE_SECONDS: Final = 3
_PAUSE_S: Final = 0.5
_ENDURANCE_S: Final = 10.0
"""Over less than this the log's growth is not told from its bursts."""

PerSecond = Callable[[str, int], float]


class Rates:
    """Counts per second, from one status to the next."""

    def __init__(self) -> None:
        self._then_ns = self._now_ns = time.monotonic_ns()
        self._counts: dict[str, int] = {}

    def begin(self, now_ns: int) -> None:
        """Begin a status."""
        self._then_ns, self._now_ns = self._now_ns, now_ns

    def per_second(self, name: str, count: int) -> float:
        """Rate of a count since the status before."""
        new = count - self._counts.get(name, 0)
        self._counts[name] = count
        return round(new * NS_PER_S / max(self._now_ns - self._then_ns, NS_PER_MS), 1)


def _age_s(newest_ns: int, log_ns: int) -> float | None:
    return (log_ns - newest_ns) / NS_PER_S if newest_ns else None


class LidarReadings:
    """Reads the lidar's port.

    Parameters
    ----------
    port : LidarPort
    interface : str or None
        Its network interface; None: found by its address.
    """

    def __init__(self, port: LidarPort, interface: str | None) -> None:
        self._port, self._interface = port, interface
        self._sensor = ""
        self._newest = (0, 0)
        """Time of the newest packet and count of good ones at the status before."""
        self._steady: deque[tuple[int, int]] = deque(maxlen=_RATE_SECONDS + 1)
        """Time and count of good packets at each status of a stream that neither began nor ended since."""

    def _link(self) -> bool | None:
        """Whether its network link is up."""
        sensor = self._port.counts.sensor
        if self._interface is None and sensor != self._sensor:
            self._sensor = sensor
            self._interface = lidarstate.interface_towards(address_number(sensor))
        return lidarstate.carrier(self._interface)

    def _is_steady(self, log_ns: int, age_s: float | None) -> bool:
        """Whether the stream has lasted long enough to tell its rate; batches make one second uneven by a tenth."""
        if age_s is None or age_s > _PAUSE_S:
            self._steady.clear()
        else:
            self._steady.append((log_ns, self._port.counts.good))
        return len(self._steady) > _RATE_SECONDS

    def _mean_rate(self) -> float:
        if len(self._steady) < 2:
            return 0.0
        (then_ns, before), (now_ns, count) = self._steady[0], self._steady[-1]
        return (count - before) * NS_PER_S / (now_ns - then_ns)

    def _rate(self, newest_ns: int, good: int, by_status: float) -> float:
        """Packets per second by their own times; the times of two statuses would add an error of one poll's packets."""
        (then_ns, before), self._newest = self._newest, (newest_ns, good)
        if not then_ns or newest_ns <= then_ns:
            return by_status
        return round((good - before) * NS_PER_S / (newest_ns - then_ns), 1)

    def status(self, log_ns: int, per_second: PerSecond) -> LidarStatus:
        """What the status says of the lidar; to be asked once a second."""
        counts = self._port.counts
        age_s = _age_s(counts.newest_ns, log_ns)
        rate = self._rate(counts.newest_ns, counts.good, per_second("lidar", counts.good))
        rejected = dict(counts.rejected)
        rejected_s = {reason: per_second(reason, count) for reason, count in rejected.items()}
        seen = self._port.view() or SensorView()
        expected = seen.expected_packets_s if self._is_steady(log_ns, age_s) else 0.0
        link = True if age_s is not None and age_s < 0.5 else self._link()  # what packets come over is up
        return LidarStatus(
            state=lidarstate.classify(age_s, link, rejected_s, self._mean_rate(), expected),
            link=link,
            sensor=counts.sensor,
            age_s=age_s,
            packets_s=rate,
            expected_packets_s=seen.expected_packets_s,
            return_mode=seen.return_mode,
            rpm=seen.rpm,
            fov_start_deg=seen.fov_start_deg,
            fov_end_deg=seen.fov_end_deg,
            position_packets_s=per_second("position", counts.position_received),
            received=counts.received,
            kept=counts.kept,
            not_armed=counts.not_armed,
            recording=counts.recording,
            masked_packets=counts.masked_packets,
            kernel_drops=counts.kernel_drops,
            queue_drops=counts.queue_drops,
            position_kept=counts.position_kept,
            position_drops=counts.position_kernel_drops + counts.position_queue_drops,
            rejected=rejected,
            rejected_s=round(sum(rejected_s.values()), 1),
            pps=counts.pps,
            nmea=counts.nmea,
        )


def link_status(name: str, counts: LinkCounts, log_ns: int, per_second: PerSecond) -> LinkStatus:
    """What the status says of a MAVLink link."""
    return LinkStatus(
        connected=counts.connected,
        trouble=counts.trouble,
        age_s=_age_s(counts.newest_ns, log_ns),
        frames_s=per_second(f"{name} frames", counts.frames),
        bytes_s=per_second(f"{name} bytes", counts.received_bytes),
        autopilot="" if counts.autopilot is None else "{}/{}".format(*counts.autopilot),
        version=counts.version,
        heartbeats=counts.heartbeats,
        armed=counts.armed(log_ns),
        vehicles=["{}/{}".format(*address) for address in counts.vehicles.vehicles()],
        bad_bytes=counts.bad_bytes,
        unknown_frames=counts.unknown_frames,
        dropped_bytes=counts.queue_dropped_bytes,
        kernel_drops=counts.kernel_drops,
        achieved_hz=counts.achieved_hz,
        asked_hz=counts.asked_hz,
        requests=counts.requests,
        firmware=counts.firmware,
        signatures=counts.signatures,
    )


def lidar_sync(port: LidarPort, log_ns: int) -> ClockSync | None:
    """The lidar's clock for the log, with the hour from the newest GPS sentence that it passed on."""
    line = port.clock.line(log_ns)
    if line is None:
        return None
    counts = port.counts
    sentence_ns, rmc = counts.position_ns, parse_rmc(counts.nmea)
    utc_ns, source = utc_of_lidar(sentence_ns + line.offset_at(sentence_ns), rmc)
    return ClockSync(
        log_ns=log_ns,
        clock="lidar",
        offset_ns=line.offset_ns,
        skew_ppm=line.skew_ppm,
        uncertainty_ns=line.uncertainty_ns,
        utc_offset_ns=utc_ns + line.offset_ns if source else 0,
        samples=line.samples,
        restarts=port.clock.restarts,
        method=line.method,
        utc_source=source,
    )


def clock_status(sync: ClockSync, wall_minus_log_ns: int) -> ClockStatus:
    """What the status says of a clock."""
    return ClockStatus(
        method=sync.method.name,
        skew_ppm=round(sync.skew_ppm, 2),
        uncertainty_ms=round(sync.uncertainty_ns / NS_PER_MS, 3),
        samples=sync.samples,
        restarts=sync.restarts,
        utc_source=sync.utc_source.name,
        utc_minus_wall_s=(sync.utc_offset_ns - wall_minus_log_ns) / NS_PER_S if sync.utc_source else None,
    )


class Endurance:
    """How long the disk lasts at the last minute's rate."""

    def __init__(self) -> None:
        self._marks: deque[tuple[float, int]] = deque(maxlen=61)

    def minutes(self, time_s: float, free_bytes: int, floor_bytes: int) -> float | None:
        """Until `floor_bytes` are left; None: not known yet. To be asked once a second."""
        if self._marks and free_bytes > self._marks[-1][1] + (64 << 20):  # something was deleted
            self._marks.clear()
        self._marks.append((time_s, free_bytes))
        then_s, then_bytes = self._marks[0]
        if time_s - then_s < _ENDURANCE_S or then_bytes <= free_bytes:
            return None
        rate = (then_bytes - free_bytes) / (time_s - then_s)
        return round(max(0, free_bytes - floor_bytes) / rate / 60, 1)


class RecorderReadings:
    """The recorder's part of the status.

    Parameters
    ----------
    recorder : Recorder
    salvager : Salvager
    config : RecorderConfig
    """

    def __init__(self, recorder: Recorder, salvager: Salvager, config: RecorderConfig) -> None:
        self._recorder, self._salvager, self._config = recorder, salvager, config
        self._endurance = Endurance()

    def status(self, now_ns: int) -> RecorderStatus:
        """To be asked once a second; `now_ns` is the monotonic clock."""
        counts, backlog = self._recorder.counts, self._recorder.backlog
        leftover = self._salvager.counts
        try:
            free_bytes = logfolder.free_bytes(Path(counts.directory or self._config.directory))
        except OSError:  # the folder is gone; the recorder says so
            free_bytes = 0
        floor_bytes = self._config.min_free_mb << 20
        return RecorderStatus(
            segment=counts.segment,
            messages=counts.messages,
            bytes_on_disk=counts.bytes_on_disk,
            backlog_bytes=backlog.size_bytes,
            refused=backlog.refused,
            sync_age_s=(now_ns - counts.last_sync_ns) / NS_PER_S,
            slowest_sync_ms=counts.slowest_sync_ms,
            free_bytes=free_bytes,
            minutes_left=self._endurance.minutes(now_ns / NS_PER_S, free_bytes, floor_bytes),
            segments=counts.segments,
            space=counts.space.value,
            refused_for_space=counts.refused_for_space,
            lost_on_disk=counts.lost_on_disk,
            trouble=counts.trouble,
            abandoned=counts.abandoned,
            leftovers=leftover.found,
            leftovers_mended=leftover.mended,
            leftovers_left=leftover.left,
        )


@cache
def _sensors(zones: Path) -> list[Path]:
    return sorted(zones.glob("thermal_zone*/temp"))


def temperature_c(zones: Path = _THERMAL) -> float | None:
    """Of the hottest of the board's sensors; None: it has none."""
    found = []
    for sensor in _sensors(zones):
        with suppress(OSError, ValueError):
            found.append(int(sensor.read_text(encoding="ascii")) / 1000)
    return max(found, default=None)


def may_fly(links: Sequence[LinkCounts], log_ns: int) -> bool:
    """Whether the vehicle is armed, or nobody heard lately can say that it is not."""
    heard = [counts.armed(log_ns) for counts in links]
    return True in heard or False not in heard
