"""Start, run, stop. Signals set a flag, the watchdog is fed only on progress, and the log is always closed."""

import gc
import logging
import os
import platform
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Final

from flightlog import __version__, config, records
from flightlog.constants import NS_PER_S
from flightlog.errors import SwathError
from flightlog.mount import Mount, load_mount
from flightlog.records import ClockSync, HostClock
from flightlog.stopflag import StopFlag
from onboard import announce, health, healthreport, leftovers, logfolder, metrics, notify
from onboard.announce import Announcer
from onboard.autopilot import Link
from onboard.config import SwathdConfig
from onboard.journal import event
from onboard.landing import Landing
from onboard.lidar import LidarPort
from onboard.readings import (
    LidarReadings,
    Rates,
    RecorderReadings,
    clock_status,
    lidar_sync,
    link_status,
    may_fly,
    temperature_c,
)
from onboard.recorder import Recorder
from onboard.relay import Relay
from onboard.segment import Segment
from onboard.status import Status, to_json
from onboard.timesync import ClockWatch, LogTime, read_clocks
from onboard.worker import Worker

_log = logging.getLogger(__name__)

_STATUS_S: Final = 1.0
_LIVE_POLL_MS: Final = 100
"""With somebody to watch: older packets are no live picture."""
_END_S: Final = 60.0
"""How long a worker may take to end: a slow disk gets the time to take what is in the backlog."""


class Daemon:
    """The running daemon.

    Parameters
    ----------
    settings : SwathdConfig
    config_path : Path
        Where they came from; a relative mount file is beside it.
    stop : StopFlag
        Set it to end `run`; a signal handler may.

    Raises
    ------
    SwathError
        A port is taken, the folder is not writable, the mount file is wrong.
    """

    def __init__(self, settings: SwathdConfig, config_path: Path, stop: StopFlag) -> None:
        mount = Mount() if settings.mount is None else load_mount(config_path.parent / settings.mount)
        started = read_clocks()
        self._log_time = LogTime.start(started)
        self._clock_watch = ClockWatch(self._log_time)
        self._started_ns = started.monotonic_ns
        self._boot_id = boot_id()
        self._directory = Path(settings.recorder.directory)
        self._status_path = settings.status_path(os.environ.get("RUNTIME_DIRECTORY"))
        self._metrics_path = None if settings.health.prometheus is None else Path(settings.health.prometheus)
        self._stop = stop
        self._unwritten: set[Path] = set()
        self._landing = Landing()
        self._links: dict[str, Link] = {}
        self._relay: Relay | None = None

        # The ports first: packets wait in their buffers while the log is opened.
        self._recorder: Recorder | None = None
        self._only_armed = settings.recorder.lidar == "armed"
        lidar = settings.lidar
        if settings.downlink.address is not None:
            lidar = replace(lidar, poll_ms=min(lidar.poll_ms, _LIVE_POLL_MS))
        self._lidar = LidarPort(lidar, self._log_time, self._put, self._is_flight, self._handed_over)
        try:
            keep_free_bytes = 2 * settings.recorder.min_free_mb << 20
            self._salvager = leftovers.begin(self._directory, keep_free_bytes, settings.recorder.compression)
            self._recorder = Recorder(
                settings.recorder, lambda directory: self._open_segment(directory, settings, mount)
            )
        except BaseException:
            self._lidar.close()
            raise
        self._relay = None if settings.downlink.address is None else Relay(settings.downlink)
        for name, link in settings.links().items():
            self._links[name] = Link(name, link, self._log_time, self._put)
        self._rates = Rates()
        self._lidar_readings = LidarReadings(self._lidar, settings.lidar.interface)
        self._recorder_readings = RecorderReadings(self._recorder, self._salvager, settings.recorder)
        self._announcer = Announcer()

    def _open_segment(self, directory: Path, settings: SwathdConfig, mount: Mount) -> Segment:
        path = logfolder.next_segment_path(directory, self._boot_id)
        now = read_clocks()
        boottime_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        clock = HostClock(self._log_time.at(now), now.realtime_ns, now.monotonic_ns, boottime_ns)
        fov = settings.lidar.fov
        session = {
            "boot_id": self._boot_id,
            "host": platform.node(),
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            "version": __version__,
            "log_minus_monotonic_ns": str(self._log_time.anchor_ns),
            "fov_start_deg": f"{fov.start_deg:g}",
            "fov_end_deg": f"{fov.end_deg:g}",
            "segment": path.stem,
            "signed_links": ",".join(name for name, link in settings.links().items() if link.signing_key is not None),
        }
        topics = [records.LIDAR.topic, records.LIDAR_ACCOUNT.topic, records.POSITION.topic]
        topics += [records.CLOCK_SYNC.topic]
        topics += [records.MAVLINK.topic + name for name in settings.links()]
        return Segment(
            path,
            metadata={"swath.session": session, "foxglove": {"deviceName": platform.node()}},
            attachments={"config.yaml": config.dump(settings).encode(), "mount.yaml": mount.yaml().encode()},
            topics=topics,
            first=(records.HOST_CLOCK.topic, clock.log_ns, records.encode_host_clock(clock)),
            compression=settings.recorder.compression,
        )

    def _put(self, topic: str, log_time_ns: int, data: bytes, vital: bool) -> bool:
        assert self._recorder is not None
        if self._relay is not None:
            self._relay.offer(topic, data)
        return self._recorder.put(topic, log_time_ns, data, vital)

    def _handed_over(self) -> None:
        assert self._recorder is not None
        self._recorder.handed_over()

    def _is_flight(self) -> bool:
        """Whether the lidar is to be recorded: where nobody can say that the vehicle is disarmed, it is."""
        if not self._only_armed:
            return True
        log_ns = self._log_time.at(read_clocks())
        return may_fly([link.counts for link in self._links.values()], log_ns)

    @property
    def _workers(self) -> list[Worker]:
        """In the order in which they are stopped: the writer comes last."""
        assert self._recorder is not None
        return [self._lidar, *self._links.values(), self._recorder]

    def run(self) -> None:
        """Record until told to stop.

        Raises
        ------
        SwathError
            A worker died; the log was closed as well as could be.
        """
        # A computing thread yields after 1 ms instead of 5: the lidar's must not wait for the writer's.
        sys.setswitchinterval(0.001)
        gc.freeze()  # what was made so far is there to stay: no need to walk over it again and again
        for worker in reversed(self._workers):
            worker.start()
        self._salvager.start()
        if self._relay is not None:  # none of the workers: nothing of the recording depends on it
            self._relay.start()
        name = self._segment_name
        _log.info("recording to %s", self._directory / name, extra=event("recording", segment=name))
        try:
            self._attend()
        finally:
            notify.stopping()
            self._salvager.stop()
            for worker in self._workers:
                worker.stop(_END_S)
            if self._relay is not None:
                self._relay.stop()
        self._write_status(self._status())
        if failures := self._failures():
            raise SwathError("; ".join(failures))

    @property
    def _segment_name(self) -> str:
        assert self._recorder is not None
        return self._recorder.counts.segment

    def _attend(self) -> None:
        """Clocks, status and watchdog, once a second, until asked to stop or a worker died."""
        is_ready = False
        while not self._stop.is_set() and not self._failures():
            now_ns = time.monotonic_ns()
            clock = self._clock_watch.record()
            if abs(clock.step_ns) > NS_PER_S:
                step_s = clock.step_ns / NS_PER_S
                fields = event("clock_step", step_s=f"{step_s:.6f}")
                _log.warning("the wall clock was set by %.3f s; log time goes on evenly", step_s, extra=fields)
            self._put(records.HOST_CLOCK.topic, clock.log_ns, records.encode_host_clock(clock), True)
            syncs = self._clock_syncs(clock)
            status = self._status()
            status = replace(
                status,
                clocks={sync.clock: clock_status(sync, clock.realtime_ns - clock.log_ns) for sync in syncs},
                temperature_c=temperature_c(),
            )
            self._write_status(status)
            self._announce(status)
            self._note_landing(health.armed(status, status.time_ns, self._boot_id))
            if not is_ready:
                notify.ready(healthreport.summary(status))
                is_ready = True
            self._stroke(status, now_ns)
            self._stop.wait(_STATUS_S)

    def _note_landing(self, is_armed: bool | None) -> None:
        """A flight ends with its disarming: its segment is closed then, so that it can be pulled."""
        assert self._recorder is not None
        if self._landing.look(is_armed, time.monotonic_ns()):
            self._recorder.rotate()

    def _clock_syncs(self, clock: HostClock) -> list[ClockSync]:
        """How the devices' clocks stand to log time, also for the log."""
        found = [link.clock.sync(clock.log_ns) for link in self._links.values()]
        syncs = [sync for sync in (lidar_sync(self._lidar, clock.log_ns), *found) if sync is not None]
        for sync in syncs:
            self._put(records.CLOCK_SYNC.topic, sync.log_ns, records.encode_clock_sync(sync), True)
        return syncs

    def _announce(self, status: Status) -> None:
        """Tell the pilot, through the autopilots; messages wait until one listens."""
        if not any(link.listens for link in self._links.values()):
            return
        text = self._announcer.next(announce.states(status))
        messages = [*announce.numbers(status), *([text] if text is not None else [])]
        for link in self._links.values():
            link.tell(messages)

    def _stroke(self, status: Status, now_ns: int) -> None:
        """Tell systemd that all is well, if it is."""
        reasons = health.stalled({worker.name: worker.progress_ns for worker in self._workers}, now_ns)
        if reasons:
            _log.error("%s", "; ".join(reasons), extra=event("hang"))
            notify.status("; ".join(reasons))
        else:
            notify.status(healthreport.summary(status))
            notify.watchdog()

    def _failures(self) -> list[str]:
        found = [worker.failure for worker in self._workers if worker.failure]
        for worker in self._workers:
            if worker.is_alive() and worker.stopping:
                found.append(f"{worker.name} did not end within {_END_S:.0f} s")
            elif worker.ident is not None and not (worker.is_alive() or worker.stopping or worker.failure):
                found.append(f"{worker.name} ended by itself")
        return found

    # Status -------------------------------------------------------------------------------------------------------

    def _write_status(self, status: Status) -> None:
        texts = {self._status_path: to_json(status)}
        if self._metrics_path is not None:
            verdict = health.judge(status, status.time_ns, self._boot_id)
            armed = health.armed(status, status.time_ns, self._boot_id)
            texts[self._metrics_path] = metrics.text(status, verdict, armed)
        for path, text in texts.items():
            try:
                logfolder.write_atomically(path, text, sync=False)
            except OSError as error:
                if path not in self._unwritten:
                    _log.error("%s cannot be written (%s)", path, error.strerror)
                self._unwritten.add(path)
            else:
                self._unwritten.discard(path)

    def _status(self) -> Status:
        now = read_clocks()
        log_ns = self._log_time.at(now)
        self._rates.begin(now.monotonic_ns)
        return Status(
            time_ns=now.monotonic_ns,
            boot_id=self._boot_id,
            version=__version__,
            pid=os.getpid(),
            uptime_s=(now.monotonic_ns - self._started_ns) / NS_PER_S,
            clock_steps=self._clock_watch.steps,
            lidar=self._lidar_readings.status(log_ns, self._rates.per_second),
            links={
                name: link_status(name, link.counts, log_ns, self._rates.per_second)
                for name, link in self._links.items()
            },
            recorder=self._recorder_readings.status(now.monotonic_ns),
            failures=self._failures(),
            downlink=None if self._relay is None else self._relay.status(self._rates.per_second),
        )


def boot_id() -> str:
    """What tells this boot of the machine from every other."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def run(settings: SwathdConfig, config_path: Path) -> None:
    """Record until SIGTERM or SIGINT; see Daemon for the errors."""
    stop = StopFlag()

    def on_signal(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    signal.signal(
        signal.SIGHUP, signal.SIG_IGN
    )  # nothing can be read anew in flight, and a terminal that closes ends no recording
    Daemon(settings, config_path, stop).run()
