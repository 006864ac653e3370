"""A live session: what arrives goes to the estimator, what it finds to the products, the status and the page."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from flightlog import records
from flightlog.constants import NS_PER_S
from flightlog.hdl32e import POSITION_BYTES
from groundproc import sensors
from groundproc.flight import load
from groundproc.flight.load import DeviceClock
from groundproc.flight.positionpackets import PositionBatch, new_sentences
from groundproc.geodesy import LocalFrame
from groundproc.live.estimator import Estimator, Options
from groundproc.live.inbox import Inbox, Received
from groundproc.live.lag import Lag
from groundproc.live.pathline import PathLine
from groundproc.live.place import Figures, Place
from groundproc.live.products import LiveTrajectory, write_cloud
from groundproc.live.receivers import Counts
from groundproc.live.telemetry import Telemetry
from groundproc.live.voxelcloud import VoxelCloud
from groundproc.sensors import velodyne

SILENT_S: Final = 2.0
"""Without a packet for so long the lidar is said to be silent."""
THIN_S: Final = 0.5
THIN_MORE_S: Final = 1.0
SKIP_S: Final = 3.0
"""Behind real time by so much: only every second return is used, every fourth, none."""
_PAIR_NS: Final = 10_000_000
_WAIT_S: Final = 0.02


class Source(Protocol):
    """What fills the inbox."""

    def start(self) -> None:
        """Begin."""

    def close(self) -> None:
        """End."""

    def counts(self) -> Counts:
        """What did not become data."""


@dataclass(frozen=True, slots=True)
class Summary:
    """How a session ended."""

    places: int
    points: int
    seconds: float
    worst_lag_s: float
    status: dict[str, Any]


class Session:
    """Drives everything from one thread.

    Parameters
    ----------
    options : Options
    inbox : Inbox
    source : Source
    cloud : VoxelCloud
    trajectory : LiveTrajectory
    """

    def __init__(
        self, options: Options, inbox: Inbox, source: Source, cloud: VoxelCloud, trajectory: LiveTrajectory
    ) -> None:
        self.cloud, self.path, self.status = cloud, PathLine(), dict[str, Any]()
        self._options, self._inbox, self._source, self._trajectory = options, inbox, source, trajectory
        self._telemetry, self._figures = Telemetry(), Figures()
        self._lag = Lag()
        self._lidar = sensors.lidar(sensors.FLOWN)
        self._estimator = Estimator(options, self._telemetry, self._figures, None)
        self._data_clock = self._position_clock = DeviceClock()
        self._anchored = False
        self._text = ""
        self._last: Place | None = None
        self._packets = self._positions = 0
        self._before = (0.0, 0, 0, 0)
        self._rates = (0.0, 0.0, 0.0)
        self._heard_s: float | None = None
        self._pair_ns = 0
        self._lag_s = math.nan
        self._lags: deque[float] = deque(maxlen=10)
        self.worst_lag_s = 0.0
        self._places = 0
        self._utc_offset_ns = 0

    def run(
        self, is_over: Callable[[], bool], tell: Callable[[dict[str, Any]], None], idle_s: float | None = None
    ) -> Summary:
        """Work until told to end, or the input has ended or is silent for `idle_s` after it once was there.

        Parameters
        ----------
        is_over : callable
        tell : callable
            Is given the status once a second, and at the end.
        idle_s : float, optional

        Raises
        ------
        BaseException
            What a receiver failed with.
        """
        begun_s = told_s = time.monotonic()
        while not is_over():
            items = self._inbox.take(_WAIT_S)
            for item in items:
                self._take(item)
                # after each: a log that is there already comes in seconds at a time
                self._advance()
            now_s = time.monotonic()
            if now_s - told_s >= 1.0:
                told_s = now_s
                self._trajectory.flush()
                self.status = self._describe(now_s)
                tell(self.status)
            if not items and self._inbox.ended:
                break
            if idle_s is not None and self._heard_s is not None and now_s - self._heard_s > idle_s:
                break
        if self._inbox.failure is not None:
            raise self._inbox.failure
        self._estimator.sync.wait()
        self._trajectory.flush()
        self.status = self._describe(time.monotonic())
        tell(self.status)
        return Summary(self._places, self.cloud.count, time.monotonic() - begun_s, self.worst_lag_s, self.status)

    @property
    def frame(self) -> LocalFrame | None:
        """The local frame, once there was a position."""
        return self._estimator.frame

    def save_cloud(self, path: Path) -> int:
        """Write the thinned cloud; gives the number of points, 0 where there is none and nothing is written."""
        frame = self.frame
        return 0 if frame is None else write_cloud(path, self.cloud, frame, self._utc_offset_ns, self._options.height)

    # What arrives ---------------------------------------------------------------------------------------------------

    def _take(self, item: Received) -> None:
        if item.topic == records.MAVLINK.topic:
            for time_ns, data in item.chunks:
                self._telemetry.feed(time_ns, data)
        elif item.topic == records.LIDAR.topic:
            self._take_packets(item)
        else:
            self._take_positions(item)

    def _take_packets(self, item: Received) -> None:
        packets = item.packets[self._lidar.valid(item.packets)]
        if not len(packets):
            return
        receive_ns, stamps = self._lidar.receive_time_ns(packets), load.stamps_of(self._lidar, packets)
        self._anchor(stamps, receive_ns)
        device_ns, jumped = self._data_clock.extend(stamps, receive_ns)
        if jumped:
            self._begin_anew()
            return
        self._packets += len(packets)
        self._heard_s = item.arrival_s
        self._estimator.slicer.feed(packets, device_ns)
        if device_ns[-1] - self._pair_ns > _PAIR_NS:
            self._pair_ns = int(device_ns[-1])
            self._estimator.times.add(int(device_ns[-1]), int(receive_ns[-1]))
        self._lag.arrived(int(device_ns[-1]), round(item.arrival_s * NS_PER_S))

    def _take_positions(self, item: Received) -> None:
        chunks = [chunk for chunk in item.chunks if len(chunk[1]) == POSITION_BYTES]
        packets = velodyne.position_packets(b"".join(data for _, data in chunks))
        receive_ns = np.array([time_ns for time_ns, _ in chunks], np.int64)
        good = velodyne.is_position(packets) if len(packets) else np.zeros(0, np.bool_)
        packets, receive_ns = packets[good], receive_ns[good]
        if not len(packets):
            return
        self._anchor(packets["stamp_us"], receive_ns)
        device_ns, jumped = self._position_clock.extend(packets["stamp_us"], receive_ns)
        if jumped:
            self._begin_anew()
            return
        self._positions += len(packets)
        readings = velodyne.readings(packets)
        sentences = new_sentences(PositionBatch(readings, receive_ns, device_ns), self._text)
        if sentences:
            self._text = sentences[-1].text
            self._estimator.times.hear(sentences)
        has = readings.has_imu
        if has.any():
            self._estimator.inertial(device_ns[has], readings.gyro_rad_s[has], readings.accel_m_s2[has])

    def _anchor(self, stamps: npt.NDArray[np.uint32], receive_ns: npt.NDArray[np.int64]) -> None:
        """Both streams of the lidar count from the same hour."""
        if not self._anchored:
            first = DeviceClock()
            first.extend(stamps[:1], receive_ns[:1])
            self._data_clock = DeviceClock(first.device_ns, first.receive_ns)
            self._position_clock = DeviceClock(first.device_ns, first.receive_ns)
            self._anchored = True

    def _begin_anew(self) -> None:
        """A clock was set: times before and after do not compare."""
        self._figures.clock_jumps += 1
        self._anchored = False
        self._lag, self._pair_ns = Lag(), 0
        self._estimator = Estimator(self._options, self._telemetry, self._figures, self._estimator.frame)

    # What is found --------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        for place in self._estimator.advance():
            self._places += 1
            self._last = place
            if len(place.shots.time_ns):
                self.cloud.add(place.shots.time_ns, place.shots.xyz_m, place.shots.intensity, place.path)
            self.path.add(place.position_m)
            lag_s = self._lag.of(place.end_ns, time.monotonic_ns())
            self._mind(lag_s)
            self._utc_offset_ns = place.utc_ns - place.end_ns
            if self._estimator.frame is not None:
                self._trajectory.write(place, self._estimator.frame, lag_s)

    def _mind(self, lag_s: float) -> None:
        """Save work where the computer is too slow for a sensor that does not wait."""
        self._lag_s = lag_s
        self._lags.append(lag_s)
        if self._places > 20:  # the first ones wait for the start by design
            self.worst_lag_s = max(self.worst_lag_s, lag_s)
        if self._inbox.waits:
            return
        estimator = self._estimator
        estimator.thinning = 1 if lag_s < THIN_S else 2 if lag_s < THIN_MORE_S else 4
        estimator.skipping = lag_s > SKIP_S

    # Status ---------------------------------------------------------------------------------------------------------

    def _describe(self, now_s: float) -> dict[str, Any]:
        counts, place, tie, frame = self._source.counts(), self._last, self._estimator.tie, self.frame
        self._measure_rates(now_s)
        silent_s = None if self._heard_s is None else now_s - self._heard_s
        status: dict[str, Any] = {
            "state": self._state(silent_s),
            "trouble": counts.trouble,
            "seconds": self._places / 10.0,
            "rates_hz": {"data": self._rates[0], "position": self._rates[1], "mavlink": self._rates[2]},
            "lag_s": None if math.isnan(self._lag_s) else round(max(self._lags), 3),
            "worst_lag_s": round(self.worst_lag_s, 3),
            "drops": {
                "kernel": counts.kernel_drops,
                "queue": self._inbox.dropped,
                "rejected": counts.rejected,
                "late_returns": self._estimator.slicer.late,
                "bad_mavlink_bytes": self._telemetry.parser.bad_bytes,
            },
            "counts": asdict(self._figures) | {"reboots": self._telemetry.reboots},
            "cloud": {"points": self.cloud.count, "voxel_m": self.cloud.voxel_m},
            "sync": None
            if tie is None
            else {
                "method": tie.method,
                "sigma_ms": tie.sigma_ns * 1e-6,
                "offset_s": tie.offset_ns * 1e-9,
                "utc": tie.utc_source,
            },
            "pose": None if place is None or frame is None else _pose(place, frame),
        }
        return status

    def _state(self, silent_s: float | None) -> str:
        if silent_s is None:
            return "waiting for the lidar (data packets)"
        if silent_s > SILENT_S:
            return f"the lidar is silent for {silent_s:.0f} s"
        return self._estimator.state

    def _measure_rates(self, now_s: float) -> None:
        before_s, data, position, mavlink = self._before
        counts = (self._packets, self._positions, self._telemetry.frames)
        if now_s - before_s > 0.5:
            passed = now_s - before_s
            self._rates = (
                round((counts[0] - data) / passed, 1),
                round((counts[1] - position) / passed, 1),
                round((counts[2] - mavlink) / passed, 1),
            )
            self._before = (now_s, *counts)


def _pose(place: Place, frame: LocalFrame) -> dict[str, Any]:
    from flightlog import frames

    heading, pitch, roll = (
        round(float(np.rad2deg(a[0])), 2)
        for a in frames.attitude_of(frames.mat_from_quat(place.quat_local_ins_wxyz[None]))
    )
    latitude, longitude, height = (float(v[0]) for v in frame.to_geodetic(place.position_m[None]))
    return {
        "utc_ns": place.utc_ns,
        "latitude_deg": round(latitude, 8),
        "longitude_deg": round(longitude, 8),
        "height_m": round(height, 3),
        "local_m": [round(v, 3) for v in place.position_m.tolist()],
        "roll_deg": roll,
        "pitch_deg": pitch,
        "heading_deg": heading % 360.0,
        "speed_m_s": round(float(np.linalg.norm(place.velocity_m_s)), 2),
        "sigma_m": [round(v, 3) for v in place.sigma_m.tolist()],
        "matched": place.matched,
        "seen": place.seen,
        "residual_m": round(place.residual_m, 4) if math.isfinite(place.residual_m) else None,
    }
